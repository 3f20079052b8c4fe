"""Trajectories as a report needs them: read leniently, laid on the truth, with their gaps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from nodes.evaluation.alignment import align, associate
from nodes.evaluation.coverage import Interval, cover
from nodes.evaluation.judging import Errors
from nodes.evaluation.metrics import position_errors, rotation_errors
from nodes.trajectory import Trajectory

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

SECOND = 1_000_000_000
GAP = SECOND // 2
"""Silence that counts as lost (ns)."""

_FARTHEST = 1e12
"""Metres: an estimate that has burst goes beyond all that can be squared, or drawn."""


def read_poses(path: Path) -> Trajectory:
    """Read a TUM file that may end in the middle of a line, as that of a killed run does.

    Raises:
        OSError: It cannot be read.
        ValueError: It holds something else.
    """
    text = path.read_text(encoding="utf-8")
    whole = text[: text.rfind("\n") + 1]
    lines = [line for line in whole.splitlines() if line and line[0] != "#"]
    if not lines:
        raise ValueError("expected rows of timestamp tx ty tz qx qy qz qw, found none")
    rows = np.loadtxt(lines, ndmin=2)
    if rows.shape[1] != 8:
        raise ValueError(f"expected 8 numbers a row, found {rows.shape[1]}")
    if (far := np.abs(rows[:, 1:4]).max()) > _FARTHEST:
        raise ValueError(f"expected positions within {_FARTHEST:g} m, found {far:g} m")
    # Whole seconds apart, as those of a calendar leave a float no nanoseconds.
    halves = [line.split(None, 1)[0].partition(".") for line in lines]
    stamps = np.array([int(s) * SECOND + int(f"{f:0<9}"[:9]) for s, _, f in halves], np.int64)
    _, kept = np.unique(stamps, return_index=True)  # in order; of equal stamps the first
    return Trajectory(stamps[kept], rows[kept, 1:4], rows[kept][:, [7, 4, 5, 6]])


def lay_on(truth: Trajectory, said: Trajectory) -> tuple[Trajectory, Errors]:
    """Lay an estimate's first pose on the true one, and return what it is off from there.

    Raises:
        ValueError: They have no time in common.
    """
    there, kept = associate(truth, said)
    moved = align(kept, there, "origin").trajectory
    errors = Errors(
        stamps=moved.stamps,
        since=np.zeros(0, np.int64),  # when each came is not known
        position=position_errors(there.positions, moved.positions),
        rotation=rotation_errors(there.orientations, moved.orientations),
    )
    return moved, errors


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
