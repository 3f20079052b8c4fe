"""Alignment of an estimate with the truth: by its first pose, or by least squares of positions."""

from __future__ import annotations

from typing import Literal

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from nodes.judging.evaluation.metrics import same_stamps
from nodes.trajectory import Trajectory
from runtime.time.clock import SECOND

Floats = npt.NDArray[np.float64]

AlignmentMethod = Literal["none", "origin", "posyaw", "se3", "sim3"]
"""Transform from the estimate's frame to the truth's.

``none``: none. ``origin``: the first pose is moved onto the first true pose. Least squares over
positions: ``posyaw``: translation and heading (4 degrees of freedom), for estimates that know the
vertical, as those of an IMU do; ``se3``: rigid; ``sim3``: with scale, for an unknown unit.
"""


class Alignment(msgspec.Struct, frozen=True, eq=False):
    """Aligned estimate, and its transform: position ``scale · R · p + t``."""

    trajectory: Trajectory  # the estimate, now in the truth's frame
    rotation: Floats  # R, estimate's frame to the truth's, shape (3, 3)
    translation: Floats  # t, metres in the truth's frame, shape (3,)
    scale: float  # true length of the estimate's unit


def align(
    estimate: Trajectory,
    truth: Trajectory,
    method: AlignmentMethod,
    first: float | None = None,
) -> Alignment:
    """Move an estimate into the truth's frame.

    Args:
        truth: True poses at the same stamps; see `nodes.trajectory.associate`.
        first: Beginning that the transform is computed from: a number of poses (int), or seconds
            (float); the whole if not given.

    Raises:
        ValueError: The stamps differ; or positions lie on a line or a point, and their method
            needs more.
    """
    same_stamps(truth, estimate)
    rotation, translation, scale = np.eye(3), np.zeros(3), 1.0
    if method == "none":
        return Alignment(estimate, rotation, translation, scale)
    used = slice(None)
    if isinstance(first, int):
        used = slice(first)
    elif first is not None:
        used = slice(int((truth.stamps - truth.stamps[0] <= round(first * SECOND)).sum()))
    source, target = estimate.take(used), truth.take(used)
    if method == "origin" or (method == "posyaw" and len(source) == 1):
        turn = target.rotations()[0] * source.rotations()[0].inv()
        rotation = turn.as_matrix() if method == "origin" else _about_z(turn)
        translation = target.positions[0] - rotation @ source.positions[0]
    elif method == "posyaw":
        rotation, translation = least_squares_heading(source.positions, target.positions)
    else:
        rotation, translation, scale = umeyama(
            source.positions, target.positions, with_scale=method == "sim3"
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


def _about_z(turn: Rotation) -> Floats:
    """Return the rotation about z nearest to another, shape (3, 3)."""
    _, _, z, w = turn.as_quat()
    if w * w + z * z == 0.0:  # a half turn about a horizontal axis: every heading is as near
        return np.eye(3)
    return np.asarray(Rotation.from_quat([0.0, 0.0, z, w]).as_matrix())


def least_squares_heading(source: Floats, target: Floats) -> tuple[Floats, Floats]:
    """Return R about z (3, 3), t (3,) with the least mean square of ``target - (R · source + t)``.

    Z. Zhang, D. Scaramuzza, "A tutorial on quantitative trajectory evaluation for visual(-inertial)
    odometry", IROS 2018, section III-B. The z axes of both frames are vertical.

    Args:
        source: Points, shape (n, 3).
        target: The same points elsewhere, shape (n, 3).

    Raises:
        ValueError: The points of one have no extent beside z.
    """
    mean_source, mean_target = source.mean(axis=0), target.mean(axis=0)
    a, b = source - mean_source, target - mean_target
    cosine = float((a[:, :2] * b[:, :2]).sum())
    sine = float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())
    extent = float(np.linalg.norm(a[:, :2]) * np.linalg.norm(b[:, :2]))
    if not np.hypot(cosine, sine) > 1e-12 * extent > 0.0:
        raise ValueError(
            f"alignment: expected positions that differ beside their height, found {len(a)} with "
            f"spreads {_spreads(a)} m in the estimate and {_spreads(b)} m in the truth"
        )
    rotation = Rotation.from_euler("z", np.arctan2(sine, cosine)).as_matrix()
    return rotation, mean_target - rotation @ mean_source


def umeyama(source: Floats, target: Floats, *, with_scale: bool) -> tuple[Floats, Floats, float]:
    """Return R (3, 3), t (3,), c with the least mean square of ``target - (c · R · source + t)``.

    S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns",
    IEEE PAMI 13(4), 1991; equation numbers are that paper's.

    Args:
        source: Points, shape (n, 3).
        target: The same points elsewhere, shape (n, 3).
        with_scale: Whether c may differ from 1.

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
