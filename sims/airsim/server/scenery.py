"""Methods of what is around the vehicles: wind, lines of sight, extents, the level, messages."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from events import Vector3
from events.frames import flip_yz, from_geodetic
from sims.airsim.server.methods import rpc
from sims.airsim.structures import GeoPoint, Vector3r
from sims.worlds.wind import check_strength

if TYPE_CHECKING:
    from sims.airsim.server.node import AirsimServer

FARTHEST_PLACE = 1e9
"""Degrees, and metres above the sea."""

MOST_MESSAGES, LONGEST_MESSAGE = 1000, 500
"""Messages of clients that are logged, and characters of one."""


class Scenery:
    """Wind, lines of sight, extents, the level, and messages of clients."""

    def __init__(self, server: AirsimServer) -> None:
        self._server = server
        self._messages = 0
        self._wind_before: Vector3 | None = None

    @rpc("simSetWind")
    def set_wind(self, velocity: Vector3r) -> None:
        """Set the mean wind, in the world's NED frame; gusts and turbulence of the file stay."""
        wind = velocity.x_val, velocity.y_val, velocity.z_val
        check_strength(wind)
        self._blow(wind)

    def reset(self) -> None:
        """Let the wind blow as before clients changed it."""
        if self._wind_before is not None:
            self._blow(self._wind_before)
            self._wind_before = None

    def _blow(self, wind: Vector3) -> None:
        world = self._server.world
        if world.simulation is not None:
            world.simulation.advance_to(self._server.clock.now())
        if self._wind_before is None:
            self._wind_before = world.air.velocity if world.air is not None else (0.0, 0.0, 0.0)
        world.set_wind(wind)

    @rpc("simTestLineOfSightToPoint")
    def sees_point(self, point: GeoPoint, vehicle: str = "") -> bool:
        """Return whether nothing is between a vehicle and a place on the earth."""
        served = self._server.find_vehicle(vehicle)
        return self._is_free(served.state().position, self._in_map(point), served.name)

    @rpc("simTestLineOfSightBetweenPoints")
    def sees_between(self, first: GeoPoint, second: GeoPoint) -> bool:
        """Return whether nothing is between two places on the earth."""
        return self._is_free(self._in_map(first), self._in_map(second))

    @rpc("simGetWorldExtents")
    def extents(self) -> list[GeoPoint]:
        """Return the southernmost, westernmost and lowest, and the opposite corner of all objects.

        What is without end, such as a plane, is not counted.
        """
        model, data = self._server.world.model, self._server.objects.data()
        shown = {geom for geoms in self._server.objects.geoms.values() for geom in geoms}
        bounded = [geom for geom in sorted(shown) if model.geom_rbound[geom] > 0.0]
        boxes = model.geom_aabb[bounded]
        axes = data.geom_xmat[bounded].reshape(-1, 3, 3)
        middle = data.geom_xpos[bounded] + np.einsum("nij,nj->ni", axes, boxes[:, :3])
        reach = np.einsum("nij,nj->ni", np.abs(axes), boxes[:, 3:])
        north, west, up = (middle + reach).max(axis=0, initial=-1e9).tolist()
        south, east, down = (middle - reach).min(axis=0, initial=1e9).tolist()
        geo_point = self._server.find_vehicle("").geo_point
        return [geo_point((south, -west, -down)), geo_point((north, -east, -up))]

    @rpc("simLoadLevel")
    def load_level(self, name: str) -> bool:
        """Return whether this is the world's name: another cannot be loaded in a run."""
        return name == self._server.world.name

    @rpc("simPrintLogMessage")
    def message(self, text: str, parameter: str = "", severity: int = 0) -> None:
        """Log a message: of severity 1 as a warning, of 2 as an error, else as an info."""
        self._messages += 1
        if self._messages <= MOST_MESSAGES:
            log = self._server.log
            write = {1: log.warning, 2: log.error}.get(severity, log.info)
            text = f"{text}{parameter}"[:LONGEST_MESSAGE]
            write("a client says: %s", text if text.isprintable() else ascii(text))

    def _is_free(self, start: Vector3, end: Vector3, vehicle: str = "") -> bool:
        """Return whether nothing but a vehicle is on a straight line, metres in ``map``."""
        world, data = self._server.world, self._server.objects.data()
        body = mujoco.mj_name2id(world.model, mujoco.mjtObj.mjOBJ_BODY, f"{vehicle}/base_link")
        begin, way = np.array(flip_yz(start)), np.subtract(flip_yz(end), flip_yz(start))
        length = float(np.linalg.norm(way))
        if not 1e-9 < length < math.inf:
            return length <= 1e-9
        found = np.zeros(1, np.int32)
        distance: float = mujoco.mj_ray(
            world.model, data, begin, way / length, None, 1, body, found
        )
        return distance < 0.0 or distance >= length

    def _in_map(self, point: GeoPoint) -> Vector3:
        place = point.latitude, point.longitude, point.altitude
        if not all(abs(number) <= FARTHEST_PLACE for number in place):
            raise ValueError(f"place: expected up to {FARTHEST_PLACE:g}, found {place}")
        return from_geodetic(place, self._server.find_vehicle("").config.origin)
