"""Stamps of images, from a list of them or from poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nodes.judging.evaluation.record import Stamps
from nodes.judging.readers.files import stamp_rows


def read_stamps(path: Path) -> Stamps:
    """Return the stamps (ns) of a list of images or of poses: the first field of each row.

    With commas nanoseconds (EuRoC, VSLAM-LAB), else seconds (TUM, KITTI).

    Raises:
        ValueError: It cannot be read, or the stamps do not rise; the message names the line.
    """
    rows = stamp_rows(path)
    stamps = np.array([stamp for _, stamp in rows], np.int64)
    if back := np.flatnonzero(np.diff(stamps) <= 0).tolist():
        before, after = stamps[back[0] : back[0] + 2]
        rows[back[0] + 1][0].wrong(f"a stamp above {before} ns", f"{after} ns")
    return stamps
