"""Covariances that an estimator gives with its poses, held against its errors."""

from __future__ import annotations

from math import erfc, sqrt

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from nodes.judging.evaluation.metrics import Floats, same_stamps
from nodes.trajectory import Trajectory

_SINGULAR = 1e-9
"""Smallest eigenvalue of a correlation matrix that can be inverted."""
_BLOCK = 4096
_THREE_SIGMA = float(chdtri(3, erfc(3.0 / sqrt(2.0))))
"""NEES of three dimensions that is as rarely exceeded as 3 sigma of one: 14.16."""


def consistency(
    truth: Trajectory, estimate: Trajectory, covariances: Floats
) -> dict[str, float | int | None]:
    """Return how well the errors of poses agree with the covariances that came with them.

    The normalized estimation error squared (NEES) is ``eᵀ P⁻¹ e``, with the error e and its stated
    covariance P. If the covariances are true, it is distributed as chi-squared: its mean is the
    number of dimensions, 3 for the position and 6 for the pose, and 95 % of the values are within
    the two-sided bounds (0.216 to 9.35, and 1.24 to 14.4). Greater means overconfident. Y.
    Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and
    Navigation" (2001), section 5.4.

    The error of the pose is the difference of the positions, and the rotation vector that turns the
    true orientation to the estimated one, both along the axes of the truth's frame.

    Args:
        truth: The true poses.
        estimate: The aligned ones, at the same stamps.
        covariances: Of (x, y, z, roll, pitch, yaw) in the truth's frame, shape (n, 6, 6).

    Returns:
        Means and shares by name. A covariance that is not symmetric and positive definite is none:
        it is counted, is outside of all bounds, and has no part in the means, which are `None` if
        no other is left.

    Raises:
        ValueError: The stamps of the two differ.
    """
    same_stamps(truth, estimate)
    shifts = estimate.positions - truth.positions
    turns: Rotation = estimate.rotations() * truth.rotations().inv()
    errors = np.concatenate([shifts, turns.as_rotvec()], axis=1)
    valid = positive_definite(covariances)
    found: dict[str, float | int | None] = {"covariance_invalid": int((~valid).sum())}
    for name, size in (("position", 3), ("pose", 6)):
        e, p = errors[valid, :size], covariances[valid, :size, :size]
        nees = np.einsum("ni,ni->n", e, np.linalg.solve(p, e[..., None])[..., 0])
        low, high = chdtri(size, 0.975), chdtri(size, 0.025)
        inside = int(((nees >= low) & (nees <= high)).sum())
        found[f"nees_{name}"] = float(nees.mean()) if len(nees) else None
        found[f"nees_{name}_inside_percent"] = 100.0 * inside / len(valid)
        if name == "position":
            covered = int((nees <= _THREE_SIGMA).sum())
            found["within_3_sigma_percent"] = 100.0 * covered / len(valid)
    return found


def positive_definite(matrices: Floats) -> npt.NDArray[np.bool_]:
    """Tell which matrices, shape (n, k, k), are symmetric and positive definite, shape (n,).

    They are scaled to correlations before, as their units differ.
    """
    if len(matrices) > _BLOCK:  # each copy of many takes much memory
        blocks = np.split(matrices, range(_BLOCK, len(matrices), _BLOCK))
        return np.concatenate([positive_definite(block) for block in blocks])
    variances = np.einsum("nii->ni", matrices)
    possible = np.isfinite(matrices).all(axis=(1, 2)) & (variances > 0.0).all(axis=1)
    deviations = np.sqrt(np.where(possible[:, None], variances, 1.0))
    scaled = np.where(possible[:, None, None], matrices, 0.0)
    scaled = scaled / (deviations[:, :, None] * deviations[:, None, :])
    skew = abs(scaled - np.swapaxes(scaled, 1, 2)).max(axis=(1, 2))
    return np.asarray(possible & (skew < 1e-6) & (np.linalg.eigvalsh(scaled)[:, 0] > _SINGULAR))
