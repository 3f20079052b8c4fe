"""True poses of data sets: rows as published, of which bad ones are counted, not the end.

TUM's own freiburg2_desk repeats a stamp, and others have rows of NaN where nothing was tracked.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from events.base import UNIT_TOLERANCE
from nodes.trajectory_files import Row, read_rows

Poses = list[tuple[int, list[float]]]
"""Stamps (ns), rising, each with x y z (m), qw qx qy qz, and where given velocities (m/s)."""

_TOLERANCE = 0.01  # deviation of a quaternion's length from 1, for files of few decimals
_SHOWN = 200  # characters of an example


def read_truth(
    path: Path,
    complain: Callable[[str], None],  # called with a sentence on what was left out
    *,
    euroc: bool,  # nanoseconds, commas, the scalar first; else TUM's: seconds, the scalar last
    whole: bool = True,  # whether a last line without its end counts
) -> Poses:
    """Read true poses of 8 columns, of 17 (EuRoC's), or of 4, positions only.

    Rows without a pose, and all but the first of a stamp, are left out. Poses of which only
    positions are known have the axes of the world.

    Raises:
        ValueError: It cannot be read, or no row is a pose; the message names the first wrong line.
    """
    meaning = "timestamp, p x 3, q x 4" + (", v x 3, b_w x 3, b_a x 3" if euroc else "")
    columns = (17, 8, 4) if euroc else (8, 4)
    rows = list(read_rows(path, "," if euroc else None, columns, meaning, whole=whole))
    wrong: list[str] = []
    poses: dict[int, list[float]] = {}
    repeated = 0
    positions_only = all(len(row.fields) == 4 or _no_rotation(row) for row in rows)
    for row in rows:
        try:
            stamp = row.nanoseconds() if euroc else row.seconds()
            pose = _pose(row, euroc=euroc, positions_only=positions_only)
        except ValueError as error:
            wrong.append(str(error))
            continue
        if stamp in poses:
            repeated += 1
        else:
            poses[stamp] = pose
    if not poses:
        raise ValueError(wrong[0])
    reasons = [f"{repeated} repeat a stamp"] if repeated else []
    if wrong:
        reasons.append(f"{len(wrong)} are no pose, the first: {wrong[0]:.{_SHOWN}}")
    if reasons:
        complain(
            f"{path}: {len(wrong) + repeated} of {len(rows)} true poses are left out: "
            f"{'; '.join(reasons)}"
        )
    if positions_only:
        complain(
            f"{path}: it has positions only: what depends on true orientations (rotation, RPE, "
            "alignment by the origin) means nothing"
        )
    return sorted(poses.items())


def _no_rotation(row: Row) -> bool:
    """Return whether a row has four zeros in the place of a quaternion."""
    try:
        return not any(row.numbers(4, 8))
    except ValueError:
        return False


def _pose(row: Row, *, euroc: bool, positions_only: bool) -> list[float]:
    position = row.numbers(1, 4)
    if positions_only:
        return [*position, 1.0, 0.0, 0.0, 0.0]
    numbers = row.numbers(4, 8)
    if len(numbers) < 4:
        row.wrong("a quaternion", f"{len(row.fields)} fields")
    quaternion = np.array(numbers if euroc else [numbers[3], *numbers[:3]])
    length = float(np.linalg.norm(quaternion))
    if not abs(length - 1.0) <= _TOLERANCE:
        row.wrong("a quaternion of length 1", f"w x y z = {quaternion.tolist()}")
    if abs(length - 1.0) > (UNIT_TOLERANCE if euroc else 1e-12):
        quaternion /= length
    return [*position, *quaternion.tolist(), *row.numbers(8, 11)]
