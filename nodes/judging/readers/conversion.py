"""Conversion of truth and estimates to common axes: a world NED, a body FRD.

Poses are taken as they stand, and the body is the same in truth and estimate, unless a source
declares its axes. A source without a declaration takes that of the other. What both declare
is converted. In the end all are NED and FRD, the axes of a run's report.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from nodes.judging.readers.axes import BODIES, WORLDS, Body, World
from nodes.trajectory import Trajectory

if TYPE_CHECKING:
    from nodes.judging.readers.source import Source


def to_common_axes(
    truth: Source, estimates: Sequence[Source], *, worlds_matter: bool = False
) -> tuple[Source, list[Source]]:
    """Return truth and estimates in NED and FRD, by the rule above.

    Args:
        worlds_matter: Whether estimates are compared in the truth's world as they are, without
            being aligned.

    Raises:
        ValueError: The truth declares nothing, and the estimates differ in what they declare.
    """
    worlds = [source.axes.world for source in estimates]
    bodies = [source.axes.body for source in estimates]
    if truth.axes.body is None:
        _check_agreement("body", estimates, bodies)
    if truth.axes.world is None and worlds_matter:
        _check_agreement("world", estimates, worlds)
    sources = [truth, *estimates]
    world: World = "ned"
    body: Body = "frd"
    for axes in reversed([*(s.axes for s in sources), *(s.usual for s in sources)]):
        world, body = axes.world or world, axes.body or body
    moved = [
        converted(source, source.axes.world or world, source.axes.body or body)
        for source in sources
    ]
    return moved[0], moved[1:]


def _check_agreement(what: str, estimates: Sequence[Source], names: Sequence[str | None]) -> None:
    declared = {
        f"{source.name}: {name}": name
        for source, name in zip(estimates, names, strict=True)
        if name is not None
    }
    if len({*declared.values()}) > 1:
        raise ValueError(
            f"expected the axes of the truth's {what} (--truth-axes), as the estimates declare "
            f"different ones ({', '.join(declared)}), found none"
        )


def converted(source: Source, world: World, body: Body) -> Source:
    """Return a source of these axes in NED and FRD."""
    if (world, body) == ("ned", "frd"):
        return source
    to_ned, to_frd = WORLDS[world], BODIES[body]
    turns = to_ned @ source.poses.rotations().as_matrix() @ to_frd.T
    matrices = np.tile(np.eye(4), (len(source.poses), 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = turns, source.poses.positions @ to_ned.T
    both = np.kron(np.eye(2), to_ned)
    return msgspec.structs.replace(
        source,
        poses=Trajectory.from_matrices(source.poses.stamps, matrices),
        covariances=None if source.covariances is None else both @ source.covariances @ both.T,
        velocities=None if source.velocities is None else source.velocities @ to_ned.T,
        lever=tuple((to_frd @ source.lever).tolist()),
    )
