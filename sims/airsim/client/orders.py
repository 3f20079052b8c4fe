"""Commands and set-points of a run, passed on to a server's vehicle as scripts would do it."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from typing import Any

import events as ev
from events.frames import rotate, yaw_of
from sims.airsim.client.calls import Calls
from sims.airsim.client.rpc import RpcCallError
from sims.airsim.structures import YawMode

_PULL, _FASTEST = 1.0, 5.0
"""Velocity towards a set-point of position, for each metre that it is away (1/s), and at most."""
_LONG = 3600.0
"""Seconds that a landing may take: at AirSim's 0.2 m/s, a limit of 60 s ends it 12 m below."""

_PHASES: dict[type[ev.Command], tuple[set[str], str]] = {
    ev.Arm: ({"disarmed"}, "armed"),
    ev.Takeoff: ({"disarmed", "armed"}, "taking off"),
    ev.Hover: ({"taking off", "flying", "landing"}, "flying"),
    ev.Land: ({"taking off", "flying"}, "landing"),
    ev.Disarm: ({"armed", "taking off", "flying", "landing"}, "disarmed"),
}
"""In which phases a command is taken, and to which it leads."""


class Orders:
    """What a vehicle has been ordered to do, and how far it has come.

    Phases and refusals are those of `sims.vehicle.Autopilot`, so that the same pilot flies both.
    A take-off is AirSim's, and then a climb to the altitude asked for. A set-point holds on the
    server for three periods: some may be late, none may stay.

    Args:
        calls: A connection for commands alone.
        vehicle: Name of the vehicle on the server.
        flying: Whether it is in the air already.
        timeout: Age at which set-points end, ns; those of position hold.
        period: Seconds between two calls of `obey`.
        refused: Is told what the server refused.
    """

    def __init__(
        self,
        calls: Calls,
        vehicle: str,
        flying: bool,
        timeout: int,
        period: float,
        refused: Callable[[str], None],
    ) -> None:
        self.phase = "flying" if flying else "disarmed"
        self._calls, self._vehicle, self._refused = calls, vehicle, refused
        self._timeout, self._duration = timeout, 3.0 * period
        self._queue: list[ev.Command] = []
        self._setpoint: ev.Setpoint | None = None
        self._task: asyncio.Future[Any] | None = None
        """The take-off or landing whose reply is to come."""

    def take(self, order: ev.Command | ev.Setpoint) -> str:
        """Take an order for the next `obey`, and return why it is refused; empty if it is not."""
        if isinstance(order, ev.Setpoint):
            allowed, then = {"armed", "flying"}, "flying"
        else:
            allowed, then = _PHASES.get(type(order), (set[str](), ""))
        if self.phase not in allowed:
            return self.phase
        if isinstance(order, ev.Setpoint):
            self._setpoint = order
        else:
            self._setpoint = None
            if isinstance(order, ev.Takeoff) and self.phase == "disarmed":
                self._queue.append(ev.Arm(stamp=order.stamp, source=order.source))
            self._queue.append(order)
        self.phase = then
        return ""

    def resume(self) -> None:
        """Go on with a new connection: the reply to a task of the old one will not come."""
        self._task = None
        if self.phase == "landing":
            self._queue.append(ev.Land(stamp=0, source=""))

    async def obey(self, now: int, pose: ev.Odometry) -> list[type[ev.VehicleEvent]]:
        """Pass on what was ordered since the last call, and return what happened to the vehicle.

        Args:
            now: Time of the run (ns).
            pose: The vehicle's last known state.

        Raises:
            OSError: The connection is lost.
        """
        happened: list[type[ev.VehicleEvent]] = []
        queue, self._queue = self._queue, []
        for order in queue:
            self._task = None
            match order:
                case ev.Arm() | ev.Disarm():
                    happened += await self._arm(isinstance(order, ev.Arm))
                case ev.Takeoff():
                    x, y, z = pose.position
                    self._setpoint = ev.PositionSetpoint(
                        stamp=now,
                        source=order.source,
                        position=(x, y, z - order.altitude),
                        yaw=yaw_of(pose.orientation),
                    )
                    self._task = self._send("takeoff", 20.0)
                case ev.Land():
                    self._task = self._send("land", _LONG)
                case _:
                    self._send("hover")
        if self._task is not None:
            await self._calls.settle()  # if it ended before now, its reply is here then
            if self._task.done():
                happened += await self._ended(self._task)
        elif self.phase == "taking off" and _is_there(self._setpoint, pose):
            self.phase = "flying"
            happened.append(ev.TakenOff)
        if self._setpoint is not None and self._task is None:
            lasting = isinstance(self._setpoint, ev.PositionSetpoint)
            if lasting or now - self._setpoint.stamp <= self._timeout:
                self._send(*move(self._setpoint, pose, self._duration))
                await self._calls.settle()  # before time goes on, it is with the server
        elif queue:
            await self._calls.settle()
        return happened

    async def _ended(self, task: asyncio.Future[Any]) -> list[type[ev.VehicleEvent]]:
        """Go on after a task: stop the motors after a landing."""
        self._task = None
        if self.phase != "landing":
            return []
        if task.exception() is not None:
            self.phase = "flying"
        elif task.result() is True:
            self.phase = "disarmed"
            return [ev.Landed, *await self._arm(False)]
        else:  # somebody else's command came between
            self._task = self._send("land", _LONG)
        return []

    async def _arm(self, arm: bool) -> list[type[ev.VehicleEvent]]:
        try:
            if await self._calls.call("armDisarm", arm, self._vehicle) is not True:
                self._refused(f"armDisarm: {arm}")
        except RpcCallError as error:
            self._refused(f"armDisarm: {error}")
        return [ev.Armed if arm else ev.Disarmed]

    def _send(self, method: str, *arguments: Any) -> asyncio.Future[Any]:
        """Send a task whose reply comes when it ends; an error of it is told, not dropped."""
        task = self._calls.send(method, *arguments, self._vehicle)

        def note(done: asyncio.Future[Any]) -> None:
            if isinstance(error := done.exception(), RpcCallError):
                self._refused(f"{method}: {error}")

        task.add_done_callback(note)
        return task


def move(setpoint: ev.Setpoint, pose: ev.Odometry, duration: float) -> tuple[Any, ...]:
    """Return the call that makes a vehicle at a pose follow a set-point for some seconds.

    Returns:
        The method and its arguments but for the vehicle's name.
    """
    match setpoint:
        case ev.PositionSetpoint():
            apart = [a - b for a, b in zip(setpoint.position, pose.position, strict=True)]
            pull = _PULL * min(1.0, _FASTEST / max(_PULL * math.hypot(*apart), 1e-9))
            velocity = [f + pull * d for f, d in zip(setpoint.velocity, apart, strict=True)]
            mode = YawMode(False, math.degrees(setpoint.yaw))
            return ("moveByVelocity", *velocity, duration, 0, mode)
        case ev.VelocitySetpoint():
            method = "moveByVelocity" + ("BodyFrame" if setpoint.frame_id == "heading" else "")
            mode = YawMode(True, math.degrees(setpoint.yaw_rate))
            return (method, *setpoint.velocity, duration, 0, mode)
        case ev.AttitudeSetpoint():
            w, x, y, z = setpoint.orientation
            roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
            pitch = math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x))))
            angles = roll, pitch, yaw_of(setpoint.orientation)
            return ("moveByRollPitchYawThrottle", *angles, setpoint.thrust, duration)
        case ev.BodyRateSetpoint():
            rates = setpoint.angular_velocity
            return ("moveByAngleRatesThrottle", *rates, setpoint.thrust, duration)
    raise ValueError(f"{type(setpoint).__name__} is no set-point of a multirotor")


def _is_there(setpoint: ev.Setpoint | None, pose: ev.Odometry) -> bool:
    """Return whether a climb is over: near its end, and slow."""
    assert isinstance(setpoint, ev.PositionSetpoint)
    velocity = rotate(pose.orientation, pose.linear_velocity)
    return abs(setpoint.position[2] - pose.position[2]) < 0.1 and math.hypot(*velocity) < 0.2
