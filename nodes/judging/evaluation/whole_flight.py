"""Errors over a whole flight, in which time without a pose counts as the worst dead reckoning.

The errors of the poses there are (`nodes.judging.evaluation.metrics`) say nothing of those that are
missing: an estimator that gives up when it gets difficult would look better than one that drifts.
Here every image of the flight has an error. Where the estimator is lost, its last pose is held, and
what it cannot know is added: the length of the true path since then. So being lost costs as much as
a drift of 100 %, wherever the vehicle flies meanwhile: a tour that ends where it began makes nobody
look good who stayed there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nodes.judging.evaluation.coverage import Interval, Stamps, answered
from nodes.judging.evaluation.metrics import Floats, interpolated, position_errors
from nodes.trajectory import Trajectory


def held_errors(
    truth: Trajectory, frames: Stamps, poses: Stamps, errors: Floats, lost: Sequence[Interval]
) -> Floats:
    """Return the position error at each image of a flight, as its estimator said at that time.

    An image has the error of the worst pose that is nearer to it in time than to any other image,
    so that nothing hides between images; if there is none, that of the nearest pose; or, if it has
    no pose within a lost interval, that of the last pose before plus the true path length since.
    Before the first pose, that is the path length since the first image.

    Args:
        truth: The true poses.
        frames: Stamps of the flight's images (ns), strictly rising, within the truth's time.
        poses: Stamps of the poses, strictly rising, shape (n,), n ≥ 0.
        errors: Distance of each to the truth after alignment, metres, shape (n,).
        lost: Intervals without a pose; see `nodes.judging.evaluation.coverage.cover`.

    Returns:
        Metres, one for each image.
    """
    path = _path_at(truth, frames)
    if not len(poses) or not len(frames):
        return np.asarray(path - path[:1])
    missing = np.zeros(len(frames), np.bool_)
    for start, end in lost:
        missing |= (frames >= start) & (frames <= end)
    missing &= ~answered(frames, poses)
    after = np.clip(np.searchsorted(poses, frames), 1, max(len(poses) - 1, 1))
    nearer = abs(poses[after - 1] - frames) <= abs(poses[after % len(poses)] - frames)
    found = errors[np.where(nearer, after - 1, after % len(poses))]
    own = np.searchsorted((frames[:-1] + frames[1:]) // 2, poses)  # the image of each pose
    worst = np.full(len(frames), -np.inf)
    np.maximum.at(worst, own, errors)
    found = np.where(np.bincount(own, minlength=len(frames)) > 0, worst, found)
    before = np.searchsorted(poses, frames, side="right") - 1
    none = before < 0
    since = np.where(none, path[:1], _path_at(truth, poses)[before])
    held = np.where(none, 0.0, errors[before]) + path - since
    return np.asarray(np.where(missing, held, found))


def interpolated_errors(truth: Trajectory, frames: Stamps, estimate: Trajectory) -> Floats:
    """Return the position error at each image of a flight, for poses that were corrected later.

    Between two poses, key frames perhaps, the estimate is interpolated. Before the first and after
    the last, the nearer one is held, and the true path length from there is added.

    Args:
        truth: The true poses.
        frames: Stamps of the flight's images (ns), strictly rising, within the truth's time.
        estimate: The aligned poses.

    Returns:
        Metres, one for each image.
    """
    first, last = int(estimate.stamps[0]), int(estimate.stamps[-1])
    inside = np.clip(frames, first, last)
    away = abs(_path_at(truth, frames) - _path_at(truth, inside))
    true, said = (interpolated(t.stamps, t.positions, inside) for t in (truth, estimate))
    return position_errors(true, said) + away


def _path_at(truth: Trajectory, stamps: Stamps) -> Floats:
    """Return the path length from the start of the truth to each time, metres."""
    return interpolated(truth.stamps, truth.distances()[:, None], stamps)[:, 0]
