"""Whether positions and paths of a vehicle are free, checked in the world before a run.

Places are metres NED, and are those of the origin of ``base_link``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from typing import Any

import mujoco
import numpy as np

from events import Vector3
from events.frames import flip_yz
from sims.vehicle.model import STANDING_HEIGHT, mover_of

DEPTH = 0.02
"""Metres that a vehicle may reach into something: feet that stand, a propeller that brushes."""

FALL = 0.05
"""Metres above the ground at which a vehicle does not stand on it."""


class Clearance:
    """What a vehicle would meet at a place, or on a straight line."""

    def __init__(self, model: mujoco.MjModel, name: str) -> None:
        self._model = model
        self._data: Any = mujoco.MjData(model)
        self._body = model.body(f"{name}/base_link").id
        pose = int(model.joint(f"{name}/free").qposadr[0])
        self._place = self._data.qpos[pose : pose + 3]
        mujoco.mj_fwdPosition(model, self._data)
        self._movers = [mover_of(model, geom) for geom in range(model.ngeom)]
        solid = (model.geom_contype | model.geom_conaffinity) != 0
        # Group 0: solids. Group 1: what a ray must not hit, which is only to be seen or moves.
        self._no_hits = np.where(solid & (np.array(self._movers) == ""), 0, 1)

    def at(self, place: Vector3, *, now: bool = False) -> str:
        """Return the name of what the vehicle would be stuck in, level; empty for nothing.

        Args:
            place: Metres NED.
            now: Whether it would be there at the start, when other vehicles and what moves by
                itself are where they begin; later they are elsewhere.
        """
        self._place[:] = flip_yz(place)
        mujoco.mj_fwdPosition(self._model, self._data)
        contact, body_of = self._data.contact, self._model.geom_bodyid
        deepest, found = 0.0, ""
        for pair, distance in zip(contact.geom.tolist(), contact.dist.tolist(), strict=True):
            own = [geom for geom in pair if body_of[geom] == self._body]
            other = pair[0] if own[-1:] == pair[1:] else pair[1]
            if len(own) != 1 or (self._movers[other] and not now):
                continue
            if distance < min(deepest, 0.0 if self._movers[other] else -DEPTH):
                deepest = distance
                found = self._name_of(other)
        return found

    def between(self, start: Vector3, end: Vector3) -> str:
        """Return the name of the first solid on a line; empty for none."""
        geom, _ = self._ray(start, [b - a for a, b in zip(start, end, strict=True)])
        return "" if geom is None else self._name_of(geom)

    def ground_below(self, place: Vector3) -> float | None:
        """Return metres down to the next solid from a vehicle's feet; `None` if there is none."""
        _, distance = self._ray(place, (0.0, 0.0, 1e4))
        return None if distance is None else distance - STANDING_HEIGHT

    def _ray(self, start: Vector3, way: Sequence[float]) -> tuple[int | None, float | None]:
        """Return the first solid and its distance, metres."""
        length = math.hypot(*way)
        if length < 1e-6:
            return None, None
        x, y, z = (component / length for component in way)
        direction = np.array(flip_yz((x, y, z)))
        hit = np.zeros(1, np.int32)
        groups = self._model.geom_group.copy()
        self._model.geom_group[:] = self._no_hits
        try:
            distance = mujoco.mj_ray(
                self._model,
                self._data,
                np.array(flip_yz(start)),
                direction,
                np.array([1, 0, 0, 0, 0, 0], np.uint8),
                1,
                self._body,
                hit,
            )
        finally:
            self._model.geom_group[:] = groups
        geom = int(hit[0])
        return (None, None) if geom < 0 or distance >= length else (geom, distance)

    def _name_of(self, geom: int) -> str:
        model = self._model
        if self._movers[geom]:
            return self._movers[geom]
        kind = "the ground" if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE else ""
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom) or mujoco.mj_id2name(
            model, mujoco.mjtObj.mjOBJ_BODY, int(model.geom_bodyid[geom])
        )
        if kind and name and name != "world":
            return f"{kind} ({name})"
        return kind or str(name or f"geom {geom}")


def trouble_at_start(world: Clearance, place: Vector3) -> str:
    """Return why a vehicle cannot stand at a position; empty if it can."""
    if found := world.at(place, now=True):
        return f"expected a free place to start at, found {show(place)} in {found}"
    if world.ground_below(place) is None:
        return f"expected ground below the start, found none at {show(place)}: outside the world"
    return ""


def trouble_on_path(
    world: Clearance, start: Vector3, waypoints: Iterable[Vector3], margin: float = 0.0
) -> str:
    """Return why a vehicle cannot fly from point to point; empty if it can.

    Args:
        world: Solids of the world.
        start: Position of the vehicle, which first climbs to the height of the first waypoint.
        waypoints: The waypoints, connected by straight lines with rounded corners.
        margin: Metres that it moves to and fro along each axis before it sets off.
    """
    return next(_troubles(world, start, tuple(waypoints), margin), "")


def _troubles(
    world: Clearance, start: Vector3, waypoints: Sequence[Vector3], margin: float
) -> Iterator[str]:
    for number, place in enumerate(waypoints):
        if found := world.at(place):
            down = ": heights are negative, z is down" if found.startswith("the ground") else ""
            where = f"waypoints[{number}]: expected a free place"
            yield f"{where}, found {show(place)} in {found}{down}"
    if not waypoints:
        return
    above = (start[0], start[1], waypoints[0][2])
    for axis in range(3) if margin else ():
        for side in (-margin, margin):
            x, y, z = (value + side * (k == axis) for k, value in enumerate(above))
            if found := world.at((x, y, z)):
                yield (
                    f"excitation: expected {margin:g} m of free room about {show(above)}, found "
                    f"{found} at {show((x, y, z))}"
                )
    for number, (before, place) in enumerate(pairwise([start, above, *waypoints])):
        if found := world.between(before, place):
            yield (
                f"waypoints[{max(number - 1, 0)}]: expected a free way there, found {found} "
                f"between {show(before)} and {show(place)}"
            )


def show(place: Vector3) -> str:
    """Return a place as it stands in a file."""
    return f"[{', '.join(f'{component + 0.0:g}' for component in place)}]"
