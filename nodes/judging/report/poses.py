"""Trajectories as a report needs them: read leniently, with their gaps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from nodes.judging.evaluation.coverage import Interval, cover
from nodes.trajectory import Trajectory
from nodes.trajectory.formats import read_tum
from runtime.time.schedule import SECOND

Floats = npt.NDArray[np.float64]

GAP = SECOND // 2
"""Silence that counts as lost (ns)."""

_FARTHEST = 1e12
"""Metres: an estimate that has burst goes beyond all that can be squared, or drawn."""


def read_poses(path: Path) -> Trajectory:
    """Read a TUM file that may end in the middle of a line, as that of a killed run does.

    Raises:
        ValueError: It cannot be read or holds something else.
    """
    poses = read_tum(path, whole=False, in_order=False)
    if (far := np.abs(poses.positions).max()) > _FARTHEST:
        raise ValueError(f"expected positions within {_FARTHEST:g} m, found {far:g} m")
    return poses


def gaps(estimate: Trajectory | None, truth: Trajectory | None) -> list[Interval]:
    """Return where an estimator was silent while there was a truth, by the stamps of its poses."""
    if estimate is None:
        return []
    frames = estimate.stamps if truth is None else truth.stamps
    return cover(frames, estimate.stamps, GAP).lost


def broken(values: Floats, stamps: npt.NDArray[np.int64], lost: Sequence[Interval]) -> Floats:
    """Return a copy in which a line does not go on across a lost interval: NaN at its end.

    Args:
        values: Shape (n,) or (n, k).
        stamps: Nanoseconds, shape (n,).
        lost: Intervals.
    """
    values = values.copy()
    for start, end in lost:
        inside = (stamps > start) & (stamps < end)
        values[inside] = np.nan
        after = int(np.searchsorted(stamps, end))
        if after < len(values) and not inside.any():
            values[after] = np.nan
    return values
