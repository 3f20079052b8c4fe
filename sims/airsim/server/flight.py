"""Methods that let a vehicle fly; each replies when its task has ended."""

from __future__ import annotations

import asyncio
import itertools
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from events import Vector3
from sims.airsim.server import moves
from sims.airsim.server.carrot import lookahead_of
from sims.airsim.server.methods import RpcError, rpc
from sims.airsim.server.moves import Heading
from sims.airsim.server.tasks import Task
from sims.airsim.server.vehicles import ServedMultirotor
from sims.airsim.structures import Vector3r, YawMode

if TYPE_CHECKING:
    from sims.airsim.server.node import AirsimServer

Reply = asyncio.Future[bool]

_SLOW = 0.5
"""Metres per second of take-off, hovering and going home."""
_MOST = 1e6
"""In SI units; no vehicle goes farther or faster."""
_STRAIGHT = Heading()


class Flight:
    """Moves by position and velocity."""

    def __init__(self, server: AirsimServer) -> None:
        self._server = server

    @rpc("takeoff")
    def takeoff(self, timeout: float, vehicle: str) -> Reply:
        """Climb 2 m at 0.5 m/s."""
        flown = self._commanded(vehicle)
        state = flown.state()
        speed = math.hypot(*state.velocity)
        if speed > 0.05:
            raise RpcError(
                "Cannot perform takeoff because vehicle is already moving with velocity "
                f"{speed:f} m/s"
            )
        x, y, z = state.position
        return self._fly(flown, [(x, y, z - 2.0)], _SLOW, timeout)

    @rpc("land")
    def land(self, timeout: float, vehicle: str) -> Reply:
        """Go down at 0.2 m/s, and stop the motors on the ground; the vehicle stays armed."""
        return self._start(vehicle, Task(moves.landing(), timeout, at_limit=False))

    @rpc("goHome")
    def go_home(self, timeout: float, vehicle: str) -> Reply:
        """Fly straight to where the vehicle was at the start, at 0.5 m/s."""
        flown = self._commanded(vehicle)
        return self._fly(flown, [flown.origin], _SLOW, timeout)

    @rpc("hover")
    def hover(self, vehicle: str) -> Reply:
        """Stop, and hold the place."""
        flown = self._commanded(vehicle)
        return self._fly(flown, [flown.state().position], _SLOW, math.inf)

    @rpc("moveToPosition")
    def move_to_position(
        self,
        x: float,
        y: float,
        z: float,
        velocity: float,
        timeout: float,
        drivetrain: int,
        yaw_mode: YawMode,
        lookahead: float,
        adaptive: float,
        vehicle: str,
    ) -> Reply:
        """Fly straight to a place of the local frame, at a speed."""
        flown = self._commanded(vehicle)
        path = [flown.in_map(Vector3r(x, y, z))]
        heading = _heading(drivetrain, yaw_mode)
        return self._fly(flown, path, velocity, timeout, heading, lookahead, adaptive)

    @rpc("moveByVelocity")
    def move_by_velocity(
        self,
        vx: float,
        vy: float,
        vz: float,
        duration: float,
        drivetrain: int,
        yaw_mode: YawMode,
        vehicle: str,
    ) -> Reply:
        """Move at a velocity north, east, down."""
        heading = _heading(drivetrain, yaw_mode)
        _check((vx, vy, vz))
        return self._start(vehicle, moves.by_velocity((vx, vy, vz), heading, duration))

    def _start(self, vehicle: str, task: Task) -> Reply:
        return self._server.tasks.start(self._commanded(vehicle), task)

    def _fly(
        self,
        vehicle: ServedMultirotor,
        path: Sequence[Vector3],
        velocity: float,
        timeout: float,
        heading: Heading = _STRAIGHT,
        lookahead: float = -1.0,
        adaptive: float = 1.0,
    ) -> Reply:
        _check(*path, (velocity, lookahead, adaptive))
        if not velocity > 0.0:
            raise RpcError(f"velocity: expected a number > 0, found {velocity}")
        ahead = lookahead_of(lookahead, adaptive, velocity)
        whole = [vehicle.state().position, *path]
        task = moves.along_path(whole, velocity, ahead, heading, timeout)
        return self._server.tasks.start(vehicle, task)

    def _commanded(self, name: str) -> ServedMultirotor:
        """Return a vehicle that clients may command.

        Raises:
            RpcError: They may not: where AirSim would do nothing, or wait for ever.
        """
        vehicle = self._server.find_multirotor(name)
        if not vehicle.api_control:
            raise RpcError(
                f"vehicle '{vehicle.name}' is not under API control: call enableApiControl first"
            )
        if not vehicle.armed:
            raise RpcError(f"vehicle '{vehicle.name}' is disarmed: call armDisarm first")
        return vehicle


def _heading(drivetrain: int, mode: YawMode) -> Heading:
    """Return where to look.

    Raises:
        RpcError: It is not said in numbers.
    """
    _check((mode.yaw_or_rate,))
    return Heading(drivetrain == 1, mode)


def _check(*groups: Sequence[float]) -> None:
    """Raise if any number is none, or one that would lead nowhere."""
    for number in itertools.chain(*groups):
        if not -_MOST <= number <= _MOST:
            raise RpcError(f"expected numbers up to {_MOST:g}, found {number}")
