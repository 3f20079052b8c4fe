"""Motions for simulators, read as `judge` reads trajectories: world NED, the body's axes named."""

from __future__ import annotations

from nodes.judging.readers.conversion import converted
from nodes.judging.readers.table import read_truth
from runtime.recorded import MotionFile, RecordedMotion


def read_motion(file: MotionFile) -> RecordedMotion:
    """Read a motion; see `runtime.recorded`."""
    place = f"{file.path}:{file.part}" if file.part else file.path
    axes = None if file.axes == "auto" else file.axes
    try:
        source = read_truth(place, file.times, axes, columns=file.columns)
    except ValueError as error:
        text = str(error).replace("--times", "times").replace("--columns", "columns")
        raise ValueError(text) from None
    if source.positions_only:
        raise ValueError(f"{place}: expected orientations, found positions only")
    world = source.axes.world or source.usual.world
    if world is None:
        raise ValueError(
            f'axes: expected "ned", "nwu" (z up), "enu" or "optical", since {place} does not '
            "declare which way is up"
        )
    body = source.axes.body or source.usual.body
    poses = converted(source, world, "frd").poses
    return RecordedMotion(
        stamps=poses.stamps,
        positions=poses.positions,
        orientations=poses.orientations,
        body=body or "",
        notes=source.notes,
    )
