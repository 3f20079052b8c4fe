"""Errors of an estimated trajectory: absolute, relative, drift; and its covariances against them.

Definitions are those of J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems"
(IROS 2012), as evo computes them. Both trajectories have the same stamps, and are in one frame
(`nodes.judging.evaluation.alignment`). Relative errors stay within a piece of the truth, if pieces
are given: a number for each pose, which changes where the truth has a hole.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from nodes.trajectory import Trajectory
from runtime.figures import KITTI_LENGTHS, SHARES

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


def absolute_errors(truth: Trajectory, estimate: Trajectory) -> dict[str, float]:
    """Return the absolute trajectory errors (ATE) of an aligned estimate, by name with unit.

    Of distances: root mean square (also by axis of the truth's frame), mean, median, standard
    deviation, maximum; root mean squares of orientations' angles, and of headings (body's x axis
    along z).

    Raises:
        ValueError: The stamps of the two differ.
    """
    same_stamps(truth, estimate)
    errors = position_errors(truth.positions, estimate.positions)
    angles = rotation_errors(truth.orientations, estimate.orientations)
    x, y, z = (estimate.positions - truth.positions).T
    ahead, heading = (t.rotations().apply([1.0, 0.0, 0.0]) @ [1, 1j, 0] for t in (truth, estimate))
    return {
        "ate_rmse_m": rms(errors),
        "ate_mean_m": float(errors.mean()),
        "ate_median_m": float(np.median(errors)),
        "ate_std_m": float(errors.std()),
        "ate_max_m": float(errors.max()),
        "ate_north_rmse_m": rms(x),
        "ate_east_rmse_m": rms(y),
        "ate_down_rmse_m": rms(z),
        "rot_rmse_deg": rms(np.degrees(angles)),
        "heading_rmse_deg": rms(np.angle(heading * ahead.conj(), deg=True)),
    }


def path_errors(
    truth: Trajectory,
    estimate: Trajectory,
    delta: float = 1.0,
    pieces: Indices | None = None,
) -> dict[str, float]:
    """Return the relative errors (RPE) over all pairs of poses a given path length apart.

    As evo's ``--delta 1 --delta_unit m --all_pairs --pairs_from_reference``; only an alignment's
    scale changes them.

    Args:
        delta: Length of true path in metres; a pair may miss it by a tenth.

    Raises:
        ValueError: The stamps of the two differ, or no poses are that far apart.
    """
    same_stamps(truth, estimate)
    distances = truth.distances()
    first, last = path_pairs(distances, delta, pieces=pieces)
    if not len(first):
        raise ValueError(
            f"relative error: expected poses {delta:g} m apart along the path, found none "
            f"in {len(truth)} poses and {distances[-1]:.3f} m"
        )
    shifts, angles = relative_errors(truth, estimate, first, last)
    return {
        f"rpe_{delta:g}m_trans_percent": 100.0 * rms(shifts) / delta,
        f"rpe_{delta:g}m_rot_deg_per_m": rms(np.degrees(angles)) / delta,
    }


def frame_errors(
    truth: Trajectory, estimate: Trajectory, pieces: Indices | None = None
) -> dict[str, float]:
    """Return the relative errors from pose to pose, evo's default; a `ValueError` below two."""
    same_stamps(truth, estimate)
    first = np.arange(len(truth) - 1)
    if pieces is not None:
        first = first[pieces[1:] == pieces[:-1]]
    if not len(first):
        raise ValueError(f"relative error: expected two poses in a piece, found {len(truth)}")
    shifts, angles = relative_errors(truth, estimate, first, first + 1)
    return {"rpe_frame_trans_m": rms(shifts), "rpe_frame_rot_deg": rms(np.degrees(angles))}


def segment_errors(
    truth: Trajectory, estimate: Trajectory, path: float, pieces: Indices | None = None
) -> dict[str, float | None]:
    """Return the relative errors over stretches of a flight: shares of its path, and KITTI's.

    As the development kit of KITTI's odometry benchmark (A. Geiger, P. Lenz, R. Urtasun, CVPR 2012;
    ``evaluate_odometry.cpp``): mean errors of stretches, divided by their length; but every pose
    (not every tenth) begins a stretch, which ends at the pose nearest to its length, within a tenth
    (`path_pairs`).

    Args:
        path: Metres of the whole flight, above 0.

    Returns:
        By name, over 1, 2, 5, 10 and 20 % of `path` and their ``mean``, `None` for a length that no
        stretch has; of paths over 100 m over 100, 200, … 800 m, and ``kitti``, their mean.

    Raises:
        ValueError: The stamps of the two differ.
    """
    same_stamps(truth, estimate)
    distances = truth.distances()
    shares = {f"{share}pct": share / 100.0 * path for share in SHARES}
    metres = {f"{metres}m": float(metres) for metres in KITTI_LENGTHS if metres < path}
    figures: dict[str, float | None] = {}
    for lengths, mean in ((shares, "mean"), (metres, "kitti")):
        everything: list[tuple[Floats, Floats]] = []
        for name, length in lengths.items():
            shifts, angles = relative_errors(
                truth, estimate, *path_pairs(distances, length, pieces=pieces)
            )
            errors = 100.0 * shifts / length, np.degrees(angles) / length
            everything.append(errors)
            figures |= dict(zip(_segment_names(name), map(_mean, errors), strict=True))
        if everything:
            all_of = (np.concatenate(values) for values in zip(*everything, strict=True))
            figures |= dict(zip(_segment_names(mean), map(_mean, all_of), strict=True))
    return figures


def _segment_names(which: str) -> tuple[str, str]:
    return f"rpe_{which}_trans_percent", f"rpe_{which}_rot_deg_per_m"


def _mean(values: Floats) -> float | None:
    return float(values.mean()) if len(values) else None


def end_error_percent(truth: Trajectory, estimate: Trajectory) -> float:
    """Return the error of the last pose seen from the first, in percent of the true path.

    Only an alignment's scale changes it.

    Raises:
        ValueError: The stamps of the two differ, or the true path has no length.
    """
    same_stamps(truth, estimate)
    length = truth.length()
    if not length > 0.0:
        raise ValueError(f"end: expected a path longer than 0 m, found {len(truth)} poses on it")
    ends = np.array([0]), np.array([len(truth) - 1])
    shifts, _ = relative_errors(truth, estimate, *ends)
    return 100.0 * float(shifts[0]) / length


def path_pairs(
    distances: Floats,  # path length from the start to each pose, metres, not falling, shape (n,)
    delta: float,  # metres between the two, above 0
    tolerance: float = 0.1,  # share by which a pair may miss it
    pieces: Indices | None = None,  # of the poses, not falling, shape (n,): no pair leaves one
) -> tuple[Indices, Indices]:
    """Return all pairs of poses a given path length apart, as evo's `filter_pairs_by_path` does.

    Each pose's partner is the nearest in distance; the first of equals.

    Returns:
        Row numbers of the first and of the second poses, each of shape (m,).

    Raises:
        ValueError: `delta` is not a positive length.
    """
    if not 0.0 < delta < math.inf:
        raise ValueError(f"path_pairs: delta: expected a length above 0 m, found {delta}")
    if pieces is not None and len(pieces) and pieces[0] != pieces[-1]:
        starts = [0, *(np.flatnonzero(np.diff(pieces)) + 1).tolist(), len(pieces)]
        pairs = [
            [start + rows for rows in path_pairs(distances[start:end], delta, tolerance)]
            for start, end in itertools.pairwise(starts)
        ]
        first, second = (np.concatenate(rows) for rows in zip(*pairs, strict=True))
        return first, second
    n = len(distances)
    first = np.arange(n - 1)
    above = np.minimum(np.searchsorted(distances, distances[:-1] + delta), n - 1)
    # The nearest from below, and of those that stand on one spot the one that came first: where
    # that is the pair's first pose or an earlier one, it misses by the whole length.
    below = np.searchsorted(distances, distances[above - 1])
    miss_above = np.abs(distances[above] - distances[first] - delta)
    miss_below = np.abs(distances[below] - distances[first] - delta)
    second = np.where(miss_below <= miss_above, below, above)
    within = np.minimum(miss_below, miss_above) <= delta * tolerance
    return first[within], second[within]


def position_errors(truth: Floats, estimate: Floats) -> Floats:
    """Return the distances between positions, metres: shapes (n, 3) and (n, 3) to (n,)."""
    return np.asarray(np.linalg.norm(estimate - truth, axis=1))


def rotation_errors(truth: Floats, estimate: Floats) -> Floats:
    """Return the angles between unit quaternions w, x, y, z (n, 4), radians in [0, π]."""
    apart, along = (np.linalg.norm(estimate + s * truth, axis=1) for s in (-1.0, 1.0))
    return np.asarray(4.0 * np.arctan2(np.minimum(apart, along), np.maximum(apart, along)))


def _turns(first: Floats, last: Floats) -> Floats:
    """Return the rotations from the first to the last, each in its first: quaternions (n, 4)."""
    (w, x, y, z), (a, b, c, d) = first.T * [[1.0], [-1.0], [-1.0], [-1.0]], last.T
    return np.stack(
        [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ],
        axis=1,
    )


def interpolated(known: Indices, values: Floats, stamps: Indices) -> Floats:
    """Return values at other times, also repeated: shapes (n,), (n, d), (k,) to (k, d)."""
    times = stamps - known[0], known - known[0]  # so that a float holds every nanosecond
    return np.stack([np.interp(*times, column) for column in values.T], axis=1)


def same_stamps(truth: Trajectory, estimate: Trajectory) -> None:
    """Raise `ValueError` unless two trajectories have the same stamps."""
    if len(truth) != len(estimate):
        raise ValueError(
            f"expected poses at the same stamps, found {len(truth)} of the truth "
            f"and {len(estimate)} of the estimate; see associate()"
        )
    if differ := np.flatnonzero(truth.stamps != estimate.stamps).tolist():
        row = differ[0]
        raise ValueError(
            f"expected poses at the same stamps, found {truth.stamps[row]} ns of the truth beside "
            f"{estimate.stamps[row]} ns of the estimate in row {row}; see associate()"
        )


def relative_errors(
    truth: Trajectory, estimate: Trajectory, first: Indices, last: Indices
) -> tuple[Floats, Floats]:
    """Return errors (m, rad; (m,)) of motions between pairs of row numbers; see `path_pairs`."""
    (r1, p1), (r2, p2) = (
        (t.rotations(), t.positions[last] - t.positions[first]) for t in (truth, estimate)
    )
    true_motion = r1[first].inv().apply(p1)
    estimated_motion = r2[first].inv().apply(p2)
    turns = (_turns(t.orientations[first], t.orientations[last]) for t in (truth, estimate))
    shifts = np.linalg.norm(estimated_motion - true_motion, axis=1)
    return np.asarray(shifts), rotation_errors(*turns)


def rms(values: Floats) -> float:
    """Return the root mean square."""
    return math.sqrt(float(np.mean(values**2)))


_SINGULAR = 1e-9  # smallest eigenvalue of an invertible correlation matrix
_BLOCK = 4096
_THREE_SIGMA = float(chdtri(3, math.erfc(3.0 / math.sqrt(2.0))))  # NEES of 3 sigma: 14.16


def consistency(
    truth: Trajectory,
    estimate: Trajectory,
    covariances: Floats,  # of (x, y, z, roll, pitch, yaw) in the truth's frame, shape (n, 6, 6)
) -> dict[str, float | int | None]:
    """Return the consistency of pose errors with the received covariances.

    The normalized estimation error squared (NEES), ``eᵀ P⁻¹ e`` of error e and covariance P, is
    chi-squared if the covariances are true: its mean is the number of dimensions (position 3, pose
    6), and 95 % of the values are within 0.216 to 9.35, and 1.24 to 14.4; greater means
    overconfident. Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to
    Tracking and Navigation" (2001), section 5.4. A pose's error is the difference of positions, and
    the rotation vector from true to estimated orientation, along the axes of the truth's frame.

    Returns:
        Means and shares by name. A covariance not symmetric and positive definite is counted as
        outside of all bounds, and left out of the means (`None` if no other is left).

    Raises:
        ValueError: The stamps of the two differ.
    """
    same_stamps(truth, estimate)
    shifts = estimate.positions - truth.positions
    turns: Rotation = estimate.rotations() * truth.rotations().inv()
    errors = np.concatenate([shifts, turns.as_rotvec()], axis=1)
    valid = positive_definite(covariances)
    figures: dict[str, float | int | None] = {"covariance_invalid": int((~valid).sum())}
    for name, size in (("position", 3), ("pose", 6)):
        e, p = errors[valid, :size], covariances[valid, :size, :size]
        nees = np.einsum("ni,ni->n", e, np.linalg.solve(p, e[..., None])[..., 0])
        low, high = chdtri(size, 0.975), chdtri(size, 0.025)
        inside = int(((nees >= low) & (nees <= high)).sum())
        figures[f"nees_{name}"] = float(nees.mean()) if len(nees) else None
        figures[f"nees_{name}_inside_percent"] = 100.0 * inside / len(valid)
        if name == "position":
            covered = int((nees <= _THREE_SIGMA).sum())
            figures["within_3_sigma_percent"] = 100.0 * covered / len(valid)
    return figures


def positive_definite(matrices: Floats) -> npt.NDArray[np.bool_]:
    """Return a mask (n,) of symmetric positive definite matrices (n, k, k), after scaling."""
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
