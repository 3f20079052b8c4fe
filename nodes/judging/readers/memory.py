"""Reader of trajectories in memory: arrays, and this project's own `Trajectory`."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from nodes.judging.evaluation.metrics import Floats
from nodes.judging.readers import AXES, AxesName, Collected, Source, of_body
from nodes.trajectory import Trajectory


def of_memory(name: str, poses: Any, axes: AxesName | None, camera: Floats | None = None) -> Source:
    """Return the source of a trajectory in memory; `axes` and `camera` as of `read`.

    Args:
        poses: A `Trajectory`, or rows as TUM's, whose bad ones are left out and counted as a
            file's: seconds, x, y, z in metres, and a quaternion x, y, z, w, shape (n, 8), or
            without the quaternion, (n, 4).

    Raises:
        ValueError: It is neither.
    """
    if isinstance(poses, Trajectory):
        source = Source(name=name, file=name, poses=poses)
    else:
        rows = np.asarray(poses, dtype=np.float64)
        if rows.ndim != 2 or rows.shape[1] not in {4, 8}:
            raise ValueError(
                f"{name}: expected a file, a Trajectory, or TUM's rows of shape (n, 8), or (n, 4) "
                f"without a quaternion, found an array of shape {rows.shape}"
            )
        if len(far := rows[abs(rows[:, 0]) > _LONGEST_SECONDS, 0]):
            raise ValueError(f"{name}: expected stamps in seconds, as TUM's, found {far[0]:.6g}")
        collected = Collected(name)
        for number, (stamp, *row) in enumerate(rows.tolist()):
            time = round(stamp * 1e9) if np.isfinite(stamp) else None
            turn = [row[6], *row[3:6]] if len(row) == 7 else None
            collected.add(time, row[:3], turn, row=f": row {number}")
        source = msgspec.structs.replace(collected.source(), name=name, file=name)
    if axes:
        source = msgspec.structs.replace(source, axes=AXES[axes])
    return source if camera is None else of_body(source, camera)


_LONGEST_SECONDS = 9.2e9  # what 64 bits of nanoseconds hold
