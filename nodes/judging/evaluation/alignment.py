"""Bringing an estimate and the truth together: in frame and in scale."""

from __future__ import annotations

from typing import Literal

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from nodes.judging.evaluation.metrics import same_stamps
from nodes.trajectory import Trajectory

Floats = npt.NDArray[np.float64]

How = Literal["none", "origin", "se3", "sim3"]
"""``none``: as it is. ``origin``: first pose on first pose. ``se3``: rigid, by least squares over
all positions. ``sim3``: the same with scale, for estimates whose unit of length is their own."""


class Alignment(msgspec.Struct, frozen=True, eq=False):
    """An aligned estimate, and what was done to it: position ``scale · R · p + t``.

    Attributes:
        trajectory: The estimate, now in the truth's frame.
        rotation: R, estimate's frame to the truth's, shape (3, 3).
        translation: t, metres in the truth's frame, shape (3,).
        scale: True length of the estimate's unit.
    """

    trajectory: Trajectory
    rotation: Floats
    translation: Floats
    scale: float


def align(estimate: Trajectory, truth: Trajectory, how: How) -> Alignment:
    """Move an estimate into the truth's frame.

    Args:
        truth: True poses at the same stamps; see `nodes.trajectory.associate`.
        how: See `How`.

    Raises:
        ValueError: The stamps differ; or all positions of one lie on a line (or a point), and
            so determine nothing of the rotation about it.
    """
    same_stamps(truth, estimate)
    rotation, translation, scale = np.eye(3), np.zeros(3), 1.0
    if how == "none":
        return Alignment(estimate, rotation, translation, scale)
    if how == "origin":
        rotation = (truth.rotations()[0] * estimate.rotations()[0].inv()).as_matrix()
        translation = truth.positions[0] - rotation @ estimate.positions[0]
    else:
        rotation, translation, scale = umeyama(
            estimate.positions, truth.positions, with_scale=how == "sim3"
        )
    moved = transform(estimate, rotation, translation, scale)
    return Alignment(moved, rotation, translation, scale)


def transform(
    trajectory: Trajectory, rotation: Floats, translation: Floats, scale: float = 1.0
) -> Trajectory:
    """Return a trajectory in another frame: position ``scale · R · p + t``, orientation ``R · q``.

    Args:
        rotation: R, old frame to new, shape (3, 3).
        translation: t, metres in the new frame, shape (3,).
    """
    turned = Rotation.from_matrix(rotation) * trajectory.rotations()
    return Trajectory(
        trajectory.stamps,
        scale * trajectory.positions @ rotation.T + translation,
        turned.as_quat(scalar_first=True),
    )


def umeyama(source: Floats, target: Floats, *, with_scale: bool) -> tuple[Floats, Floats, float]:
    """Return R, t, c that minimise the mean square of ``target - (c · R · source + t)``.

    S. Umeyama, "Least-squares estimation of transformation parameters between two point
    patterns", IEEE PAMI 13(4), 1991; equation numbers are that paper's.

    Args:
        source: Points, shape (n, 3).
        target: The same points elsewhere, shape (n, 3).
        with_scale: Whether c may differ from 1.

    Returns:
        R of shape (3, 3), t of shape (3,), c.

    Raises:
        ValueError: One of the sets lies on a line (or a point).
    """
    mean_source, mean_target = source.mean(axis=0), target.mean(axis=0)  # (34), (35)
    a, b = source - mean_source, target - mean_target
    u, d, vt = np.linalg.svd(b.T @ a / len(a))  # of (38)
    # These are products of spreads: the second direction must be a millionth of the first.
    if not d[1] > 1e-12 * d[0] > 0.0:
        raise ValueError(
            f"alignment: expected positions that do not all lie on one line, found {len(a)} with "
            f"spreads {_spreads(a)} m in the estimate and {_spreads(b)} m in the truth"
        )
    s = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])  # (43)
    rotation = u * s @ vt  # (40)
    # (42) with (36)
    scale = float(d @ s / np.mean(np.sum(a**2, axis=1))) if with_scale else 1.0
    return rotation, mean_target - scale * rotation @ mean_source, scale  # (41)


def _spreads(points: Floats) -> str:
    """Return the standard deviations along the principal directions, for a message."""
    deviations = np.linalg.svd(points, compute_uv=False) / np.sqrt(len(points))
    return " × ".join(f"{value:.3g}" for value in deviations)
