"""Modes, commands and offboard set-points: from messages to what a vehicle is told."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import events as ev
from events import Vector3
from events.frames import yaw_of
from visnav_mavlink.links import mav
from visnav_mavlink.setpoints import Offboard
from visnav_mavlink.vehicle import (
    GLOBAL_FRAMES,
    LOCAL_SCALE,
    MODES,
    SECOND,
    Item,
    Missions,
    Parameters,
    Vehicle,
)

OFFBOARD_TIMEOUT = SECOND // 2  # PX4's COM_OF_LOSS_T: without a set-point for longer it holds
ARRIVED = 0.3  # metres from a place at which it is reached
LEAST_CLIMB = 0.3  # metres
FORCED = 21196  # param2 of a disarming in the air (mavlink.io, MAV_CMD_COMPONENT_ARM_DISARM)
_OK, _NO = mav.MAV_RESULT_ACCEPTED, mav.MAV_RESULT_DENIED
_LATER, _UNKNOWN = mav.MAV_RESULT_TEMPORARILY_REJECTED, mav.MAV_RESULT_UNSUPPORTED
_UNKNOWN_PLACE = 2**31 - 1  # of an integer coordinate, as NaN is of a number


class Flight:
    """Flies a vehicle as MAVLink's programs ask it to.

    Args:
        act: Sends a command or a set-point of these fields to the vehicle.
        tell: Says a sentence to all programs, by ``STATUSTEXT``, and to the log.
        once: Says a sentence to the log, the first time.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        missions: Missions,
        parameters: Parameters,
        act: Callable[..., None],
        tell: Callable[[str], None],
        once: Callable[[str], None],
    ) -> None:
        self._vehicle, self._missions, self._parameters = vehicle, missions, parameters
        self._act, self._tell, self._once = act, tell, once
        self._goal: tuple[Vector3, float] | None = None  # place and heading
        self._carrot: Vector3 = (0.0, 0.0, 0.0)  # goes there at the cruising speed
        self._speed: float | None = None
        self._lands_there = False
        self._followed: int | None = None  # stamp of the carrot's last step
        self._wait_until = 0
        self._offboard = Offboard(vehicle)
        self._commands: dict[int, Callable[[Any, int], int]] = {
            mav.MAV_CMD_COMPONENT_ARM_DISARM: self._arm,
            mav.MAV_CMD_NAV_TAKEOFF: self._take_off,
            mav.MAV_CMD_NAV_LAND: self._land,
            mav.MAV_CMD_NAV_RETURN_TO_LAUNCH: lambda _, now: self.set_mode("return", now),
            mav.MAV_CMD_DO_SET_MODE: lambda m, now: self.set_px4_mode(m.param2, m.param3, now),
            mav.MAV_CMD_DO_CHANGE_SPEED: lambda m, _: self._change_speed(m.param2),
            mav.MAV_CMD_DO_REPOSITION: self._reposition,
            mav.MAV_CMD_MISSION_START: lambda _, now: self.set_mode("mission", now),
            mav.MAV_CMD_DO_SET_MISSION_CURRENT: lambda m, _: self._missions.jump(m.param1),
        }

    def command(self, message: Any, now: int) -> int:
        """Carry out a ``COMMAND_LONG`` or ``COMMAND_INT``; return its ``MAV_RESULT``."""
        number = message.command
        if (do := self._commands.get(number)) is None:
            self._once(f"command {number} is not supported")
            return int(_UNKNOWN)
        return int(do(message, now))

    def set_mode(self, mode: str, now: int, climb: float = math.nan) -> int:
        """Go over to a mode; return a ``MAV_RESULT``.

        Args:
            climb: Metres of a take-off; those of the parameter if NaN.
        """
        vehicle = self._vehicle
        if mode == "offboard" and now - self._offboard.stamp > OFFBOARD_TIMEOUT:
            self._tell("offboard: expected set-points before, found none of the last 0.5 s")
            return int(_LATER)
        if mode == "mission" and not self._missions.items:
            self._tell("mission: expected one, found none: upload it first")
            return int(_LATER)
        if mode in {"takeoff", "return"} and not vehicle.armed:
            self._tell(f"{mode} denied: expected an armed vehicle, found it disarmed")
            return int(_LATER)
        flies = vehicle.armed and vehicle.landed_state != mav.MAV_LANDED_STATE_ON_GROUND
        if mode == "takeoff" and (flies or vehicle.mode == "land"):
            doing = "landing" if vehicle.mode == "land" else "in the air"
            self._tell(f"takeoff denied: expected a vehicle on the ground, found it {doing}")
            return int(_LATER)
        self._goal, self._lands_there, self._wait_until = None, False, 0
        if vehicle.mode in {"takeoff", "land"} and mode != vehicle.mode and flies:
            self._act(ev.Hover)  # else its set-points would not count
        vehicle.mode = mode
        if mode == "takeoff":
            usual = self._parameters["MIS_TAKEOFF_ALT"]
            self._act(ev.Takeoff, altitude=usual if math.isnan(climb) else climb)
        elif mode == "land" and vehicle.armed:
            self._act(ev.Land)
        elif mode in {"hold", "position", "manual"} and flies:
            self._act(ev.Hover)
        elif mode == "return" and vehicle.home is not None and flies:
            x, y, z = vehicle.home
            high = min(vehicle.position[2], z - self._parameters["RTL_RETURN_ALT"])
            self._go((x, y, high))
            self._lands_there = True
        return int(_OK)

    def set_px4_mode(self, main: float, sub: float, now: int) -> int:
        """Go over to a mode by PX4's numbers; return a ``MAV_RESULT``."""
        for mode, numbers in MODES.items():
            if numbers == (main, sub):
                return self.set_mode(mode, now)
        self._once(f"mode {main:g}, {sub:g} is not supported")
        return int(_UNKNOWN)

    def noted(self, event: ev.VehicleEvent) -> None:
        """Take note of an event of the vehicle."""
        vehicle = self._vehicle
        if isinstance(event, ev.Armed):
            vehicle.armed = True
        elif isinstance(event, ev.Disarmed | ev.Landed):
            vehicle.armed = vehicle.armed and not isinstance(event, ev.Disarmed)
            if vehicle.mode in {"land", "takeoff", "return"}:
                vehicle.mode = "hold"
        elif isinstance(event, ev.TakenOff) and vehicle.mode == "takeoff":
            vehicle.mode = "hold"

    def offboard(self, message: Any, now: int) -> None:
        """Take a set-point of position, velocity, attitude or rates; sent on in offboard mode.

        A `ValueError` says why it cannot be followed.
        """
        made = self._offboard.take(message, now)
        if made.dropped:
            self._once(f"{message.get_type()}: {made.dropped} are not followed")
        if self._vehicle.mode == "offboard":
            self._act(made.kind, **made.fields)

    def update(self, now: int) -> None:
        """Go on with what is under way."""
        vehicle = self._vehicle
        if vehicle.mode == "offboard" and now - self._offboard.stamp > OFFBOARD_TIMEOUT:
            self._tell("offboard: no set-point for 0.5 s: holding")
            self.set_mode("hold", now)
        elif vehicle.mode == "offboard" and (made := self._offboard.again(now)):
            self._act(made.kind, **made.fields)
        if vehicle.mode == "mission" and self._goal is None and now >= self._wait_until:
            self._next_item(now)
        if self._goal is not None and vehicle.armed:
            self._follow(now)

    def lost(self, action: str, now: int) -> None:
        """Do what is to be done without any program in the air: ``hold`` or ``land``.

        A return or a landing goes on.
        """
        if self._lands_there:
            return
        if self._vehicle.landed_state == mav.MAV_LANDED_STATE_IN_AIR:
            self._tell(f"no program is heard any more: {action}")
            self.set_mode(action, now)

    def _arm(self, message: Any, now: int) -> int:  # noqa: ARG002
        vehicle = self._vehicle
        if message.param1 == 1:
            if not vehicle.ready:
                self._tell("arming denied: expected a pose of the vehicle, found none yet")
                return int(_LATER)
            if not vehicle.armed:
                self._act(ev.Arm)
                vehicle.armed = True  # a take-off may come before its event does
            return int(_OK)
        in_air = vehicle.landed_state != mav.MAV_LANDED_STATE_ON_GROUND
        if message.param1 != 0 or (in_air and message.param2 != FORCED):
            self._tell("disarming denied: in the air")
            return int(_NO)
        self._act(ev.Disarm)
        return int(_OK)

    def _take_off(self, message: Any, now: int) -> int:
        vehicle, (frame, x, y, z) = self._vehicle, _location(message)
        if math.isnan(z) or not vehicle.armed:
            return self.set_mode("takeoff", now)
        try:
            place = vehicle.place_of(frame, math.nan, math.nan, z)
        except ValueError as error:
            return self._denied("takeoff", error)
        height = vehicle.position[2] - place[2]
        if height < LEAST_CLIMB:
            above = "home" if GLOBAL_FRAMES.get(frame) else "sea level"
            shown = f"{z:g} m above {above}" if frame in GLOBAL_FRAMES else f"{z:g} m down"
            return self._denied(
                "takeoff",
                f"expected an altitude {LEAST_CLIMB:g} m or more above the vehicle, found {shown}, "
                f"which is {-height:.1f} m below it",
            )
        if math.isfinite(x) and math.isfinite(y) and (x or y):
            self._once("takeoff: its place is not flown to: it goes straight up")
        return self.set_mode("takeoff", now, climb=height)

    def _land(self, message: Any, now: int) -> int:
        frame, x, y, _ = _location(message)
        return self._land_at(frame, x, y, now)

    def _land_at(self, frame: int, x: float, y: float, now: int) -> int:
        """Land at a place; here if its coordinates are NaN, or zeros of a global frame."""
        vehicle = self._vehicle
        flies = vehicle.armed and vehicle.landed_state != mav.MAV_LANDED_STATE_ON_GROUND
        here = math.isnan(x) or math.isnan(y) or (frame in GLOBAL_FRAMES and not (x or y))
        if here or not flies:
            return self.set_mode("land", now)
        try:
            place = vehicle.place_of(frame, x, y, math.nan)
        except ValueError as error:
            return self._denied("land", error)
        self.set_mode("hold", now)
        self._go(place)
        self._lands_there = True
        return int(_OK)

    def _denied(self, what: str, why: object) -> int:
        self._tell(f"{what} denied: {why}")
        return int(_NO)

    def _change_speed(self, speed: float) -> int:
        if not (math.isfinite(speed) and speed > 0):
            return self._denied("speed", f"expected a positive one, found {speed:g}")
        self._speed = speed
        return int(_OK)

    def _reposition(self, message: Any, now: int) -> int:
        """Go to a place; hold if it is where the vehicle is, as ground stations pause."""
        vehicle, place = self._vehicle, _location(message)
        if not vehicle.armed or vehicle.home is None:
            return self._denied("reposition", "expected an armed vehicle, found it disarmed")
        try:
            goal = vehicle.place_of(*place)
        except ValueError as error:
            return self._denied("reposition", error)
        self.set_mode("hold", now)
        if math.isfinite(message.param1) and message.param1 > 0:
            self._speed = message.param1
        if not all(map(math.isnan, (*place[1:], message.param4))):
            self._go(goal, message.param4)
        return int(_OK)

    def _go(self, place: Vector3, yaw: float = math.nan) -> None:
        vehicle = self._vehicle
        heading = yaw if math.isfinite(yaw) else yaw_of(vehicle.orientation)
        self._goal, self._carrot = (place, heading), vehicle.position
        self._followed = None

    def _follow(self, now: int) -> None:
        """Move the carrot on, and see whether the place is reached."""
        assert self._goal is not None
        place, heading = self._goal
        seconds = 0.0 if self._followed is None else (now - self._followed) / SECOND
        self._followed = now
        speed = self._speed or self._parameters["MPC_XY_CRUISE"]
        left = math.dist(self._carrot, place)
        part = 1.0 if left <= speed * seconds else speed * seconds / left
        x, y, z = (a + part * (b - a) for a, b in zip(self._carrot, place, strict=True))
        self._carrot = (x, y, z)
        self._act(ev.PositionSetpoint, position=self._carrot, yaw=heading)
        if part < 1.0 or math.dist(self._vehicle.position, place) > ARRIVED:
            return
        self._goal = None
        if self._lands_there:
            self.set_mode("land", now)
        elif self._vehicle.mode == "mission" and (item := self._missions.current()):
            stay = item.params[0]
            self._wait_until = now + round(stay * SECOND) if 0 < stay <= 3600 else 0
            self._missions.reached()

    def _next_item(self, now: int) -> None:
        """Begin with a mission's next item."""
        vehicle = self._vehicle
        item = self._missions.current()
        if item is None:
            self._tell("mission finished")
            self.set_mode("hold", now)
            return
        kind = item.command
        if kind == mav.MAV_CMD_NAV_WAYPOINT or kind == mav.MAV_CMD_NAV_TAKEOFF:
            if not vehicle.armed:
                return
            place = vehicle.place_of(item.frame, item.x, item.y, item.z)
            if kind == mav.MAV_CMD_NAV_TAKEOFF:
                place = (*vehicle.position[:2], place[2])
            self._go(place, math.radians(item.params[3]))
        elif kind == mav.MAV_CMD_DO_CHANGE_SPEED:
            self._change_speed(item.params[1])
            self._missions.reached()
        elif kind == mav.MAV_CMD_NAV_DELAY:
            self._wait_until = now + round(item.params[0] * SECOND)
            self._missions.reached()
        else:
            self._missions.reached()
            self.set_mode("land" if kind == mav.MAV_CMD_NAV_LAND else "return", now)

    def refused(self, item: Item) -> bool:
        """Tell whether a mission's item cannot be flown."""
        if item.command in {mav.MAV_CMD_NAV_WAYPOINT, mav.MAV_CMD_NAV_TAKEOFF}:
            try:
                self._vehicle.place_of(item.frame, item.x, item.y, item.z)
            except ValueError:
                return True
            return False
        if item.command == mav.MAV_CMD_NAV_DELAY:
            return not 0 <= item.params[0] <= 3600
        return item.command not in {
            mav.MAV_CMD_DO_CHANGE_SPEED,
            mav.MAV_CMD_NAV_LAND,
            mav.MAV_CMD_NAV_RETURN_TO_LAUNCH,
        }


def _location(message: Any) -> tuple[int, float, float, float]:
    """Return a command's frame and place, as `Vehicle.place_of` takes it."""
    if message.get_type() == "COMMAND_LONG":
        x, y = message.param5 * 1e7, message.param6 * 1e7
        return mav.MAV_FRAME_GLOBAL, x, y, message.param7
    scale = 1 if message.frame in GLOBAL_FRAMES else LOCAL_SCALE
    x, y = (
        math.nan if coordinate == _UNKNOWN_PLACE else coordinate * scale
        for coordinate in (message.x, message.y)
    )
    return message.frame, x, y, message.z
