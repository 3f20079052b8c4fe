"""Modes, commands and offboard set-points: from messages to a vehicle's set-points."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import events as ev
from events import Vector3
from events.frames import yaw_of
from visnav_mavlink.links import mav
from visnav_mavlink.missions import Item, Missions, is_speed
from visnav_mavlink.setpoints import Offboard
from visnav_mavlink.vehicle import (
    COPTER_MODES,
    GLOBAL_FRAMES,
    LOCAL_SCALE,
    MODES,
    SECOND,
    Parameters,
    Vehicle,
)

COPTER_TIMEOUT = 3 * SECOND  # as long as Copter follows a velocity
OFFBOARD_TIMEOUT = SECOND // 2  # PX4's COM_OF_LOSS_T: without a set-point for longer it holds
ARRIVED = 0.3  # metres from a place at which it is reached
LEAST_CLIMB = 0.3  # metres
FORCED = 21196  # param2 of a disarming in the air (mavlink.io, MAV_CMD_COMPONENT_ARM_DISARM)
_OK, _NO = mav.MAV_RESULT_ACCEPTED, mav.MAV_RESULT_DENIED
_LATER, _UNKNOWN = mav.MAV_RESULT_TEMPORARILY_REJECTED, mav.MAV_RESULT_UNSUPPORTED
STICK_CLIMB, STICK_TURN = 1.0, 1.0  # at the end of a stick: metres, and radians per second
_STICKS, _NO_STICK = {"position", "altitude"}, 2**15 - 1
LONGEST_STAY = 3600  # at a mission's item, seconds
_PLACES = {mav.MAV_CMD_NAV_WAYPOINT, mav.MAV_CMD_NAV_TAKEOFF}
_ITEMS = _PLACES | {
    mav.MAV_CMD_DO_CHANGE_SPEED,
    mav.MAV_CMD_NAV_DELAY,
    mav.MAV_CMD_NAV_LAND,
    mav.MAV_CMD_NAV_RETURN_TO_LAUNCH,
}
_UNKNOWN_PLACE = 2**31 - 1  # of an integer coordinate, as NaN is of a number


class Flight:
    """Flies a vehicle by the requests of MAVLink's programs.

    Args:
        act: Sends a command or a set-point of these fields to the vehicle.
        report: Sends a sentence to all programs, by ``STATUSTEXT``, and to the log.
        warn_once: Writes a sentence to the log, the first time.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        missions: Missions,
        parameters: Parameters,
        act: Callable[..., None],
        report: Callable[[str], None],
        warn_once: Callable[[str], None],
    ) -> None:
        self._vehicle, self._missions, self._parameters = vehicle, missions, parameters
        self._act, self._report, self._warn_once = act, report, warn_once
        self._goal: tuple[Vector3, float] | None = None  # place and heading
        self._carrot: Vector3 = (0.0, 0.0, 0.0)  # goes there at the cruising speed
        self._speed: float | None = None
        self._lands_at_goal = False
        self._followed: int | None = None  # stamp of the carrot's last step
        self._wait_until: int | None = None  # of a mission's item: once its place is reached
        self._offboard = Offboard(vehicle)
        self._commands: dict[int, Callable[[Any, int], int]] = {
            mav.MAV_CMD_COMPONENT_ARM_DISARM: self._arm,
            mav.MAV_CMD_NAV_TAKEOFF: self._take_off,
            mav.MAV_CMD_NAV_LAND: self._land,
            mav.MAV_CMD_NAV_RETURN_TO_LAUNCH: lambda _, now: self.set_mode("return", now),
            mav.MAV_CMD_DO_SET_MODE: self._set_mode,
            mav.MAV_CMD_DO_CHANGE_SPEED: lambda m, _: self._change_speed(m.param2),
            mav.MAV_CMD_DO_REPOSITION: self._reposition,
            mav.MAV_CMD_MISSION_START: self._start_mission,
            mav.MAV_CMD_DO_SET_MISSION_CURRENT: lambda m, _: self._missions.jump(m.param1),
        }

    def command(self, message: Any, now: int) -> int:
        """Carry out a ``COMMAND_LONG`` or ``COMMAND_INT``; return its ``MAV_RESULT``."""
        number = message.command
        if (handler := self._commands.get(number)) is None:
            self._warn_once(f"command {number} is not supported")
            return int(_UNKNOWN)
        return int(handler(message, now))

    def set_mode(self, mode: str, now: int, climb: float = math.nan, resumes: bool = True) -> int:
        """Change to a mode; return a ``MAV_RESULT``.

        Args:
            climb: Metres of a take-off; those of the parameter if NaN.
            resumes: Whether a mission continues, or from its first item after its last.
        """
        vehicle = self._vehicle
        if mode == "offboard" and now - self._offboard.stamp > OFFBOARD_TIMEOUT:
            self._report("offboard: expected set-points before, found none of the last 0.5 s")
            return int(_LATER)
        if mode == "mission" and not self._missions.items:
            self._report("mission: expected one, found none: upload it first")
            return int(_LATER)
        if mode in {"takeoff", "return"} and not vehicle.armed:
            self._report(f"{mode} denied: expected an armed vehicle, found it disarmed")
            return int(_LATER)
        flies = self._flies
        if mode == "takeoff" and (flies or vehicle.mode == "land"):
            doing = "landing" if vehicle.mode == "land" else "in the air"
            self._report(f"takeoff denied: expected a vehicle on the ground, found it {doing}")
            return int(_LATER)
        if mode == "mission" and resumes:
            self._missions.resume()
        self._drop_goal()
        if vehicle.mode in {"takeoff", "land"} and mode != vehicle.mode and flies:
            self._act(ev.Hover)  # else its set-points would not count
        vehicle.mode = mode
        if mode == "takeoff":
            usual = self._parameters["MIS_TAKEOFF_ALT"]
            self._act(ev.Takeoff, altitude=usual if math.isnan(climb) else climb)
        elif mode == "land" and vehicle.armed:
            self._act(ev.Land)
        elif mode in {"hold", "manual", *_STICKS} and flies:
            self._act(ev.Hover)
        elif mode == "return" and vehicle.home is not None and flies:
            x, y, z = vehicle.home
            high = min(vehicle.position[2], z - self._parameters["RTL_RETURN_ALT"])
            self._set_goal((x, y, high))
            self._lands_at_goal = True
        return int(_OK)

    def set_custom_mode(self, number: int, now: int) -> int:
        """Change to a mode by a ``custom_mode``; return a ``MAV_RESULT``."""
        if self._vehicle.is_copter:
            return self._set_copter_mode(number, now)
        return self._set_px4_mode(number >> 16 & 255, number >> 24 & 255, now)

    def _set_mode(self, message: Any, now: int) -> int:
        if self._vehicle.is_copter:
            return self._set_copter_mode(message.param2, now)
        return self._set_px4_mode(message.param2, message.param3, now)

    def _set_px4_mode(self, main: float, sub: float, now: int) -> int:
        for mode, numbers in MODES.items():
            if numbers == (main, sub):
                return self.set_mode(mode, now)
        self._warn_once(f"mode {main:g}, {sub:g} is not supported")
        return int(_UNKNOWN)

    def _set_copter_mode(self, number: float, now: int) -> int:
        if number == COPTER_MODES[self._vehicle.mode]:
            return int(_OK)
        for mode, copter_number in COPTER_MODES.items():
            if copter_number == number:
                return self.set_mode(mode, now)
        self._warn_once(f"mode {number:g} of Copter is not supported")
        return int(_UNKNOWN)

    def handle_event(self, event: ev.VehicleEvent) -> None:
        """Update armed state, mode and mission by an event of the vehicle."""
        vehicle = self._vehicle
        if isinstance(event, ev.Armed):
            vehicle.armed = True
        elif isinstance(event, ev.Disarmed | ev.Landed):
            vehicle.armed = vehicle.armed and not isinstance(event, ev.Disarmed)
            if vehicle.mode in {"land", "takeoff", "return"}:
                vehicle.mode = "hold"
            if self._missions.landing and isinstance(event, ev.Landed):
                self._missions.reached()
                self._report_end()
            self._missions.landing = False
        elif isinstance(event, ev.TakenOff) and vehicle.mode == "takeoff":
            vehicle.mode = "hold"

    def offboard(self, message: Any, now: int) -> None:
        """Handle a set-point of position, velocity, attitude or rates; sent in offboard mode.

        A `ValueError` says why it cannot be followed.
        """
        setpoint = self._offboard.accept(message, now)
        if setpoint.dropped:
            self._warn_once(f"{message.get_type()}: {setpoint.dropped} are not followed")
        if self._vehicle.is_copter and self._vehicle.mode == "hold" and self._flies:
            self.set_mode("offboard", now)
        if self._vehicle.mode == "offboard":
            self._act(setpoint.kind, **setpoint.fields)

    def move_sticks(self, message: Any) -> str:
        """Fly by a ``MANUAL_CONTROL``; return why it has no effect, if so."""
        if self._vehicle.mode not in _STICKS or not self._vehicle.armed:
            return "expected an armed vehicle in mode POSCTL or ALTCTL"
        forward, right, turn = (_stick(value) for value in (message.x, message.y, message.r))
        up = 0.0 if message.z == _NO_STICK else min(max(message.z / 500 - 1, -1.0), 1.0)
        if self._flies or up > 0.0:
            speed = self._speed or self._parameters["MPC_XY_CRUISE"]
            self._act(
                ev.VelocitySetpoint,
                velocity=(forward * speed, right * speed, -up * STICK_CLIMB),
                yaw_rate=turn * STICK_TURN,
                frame_id="heading",
            )
        return ""

    def update(self, now: int) -> None:
        """Send the next set-points of the offboard program, the mission or the goal."""
        vehicle = self._vehicle
        if vehicle.mode == "offboard":
            self._update_offboard(now)
        if vehicle.mode == "mission":
            self._update_mission(now)
        if self._goal is not None and vehicle.armed:
            self._follow(now)

    def _update_offboard(self, now: int) -> None:
        """Hold when set-points end; Copter's end later, and its places stay."""
        is_copter = self._vehicle.is_copter
        setpoint = self._offboard.renew(now, all_of_them=is_copter)
        stays = is_copter and setpoint is not None and setpoint.kind is ev.PositionSetpoint
        timeout = COPTER_TIMEOUT if is_copter else OFFBOARD_TIMEOUT
        if now - self._offboard.stamp > timeout and not stays:
            self._report(f"offboard: no set-point for {timeout / SECOND:g} s: holding")
            self.set_mode("hold", now)
        elif setpoint is not None:
            self._act(setpoint.kind, **setpoint.fields)

    def fly_to(self, item: Item, now: int) -> str:
        """Fly to an item's place at once; return the reason if that is impossible."""
        if not self._flies:
            return "expected a vehicle in the air"
        try:
            place = self._vehicle.place_of(*item.place)
        except ValueError as error:
            return str(error)
        self.set_mode("hold", now)
        self._set_goal(place)
        return ""

    def drop_item(self) -> None:
        """Cancel a mission's item under way, as another one follows."""
        if self._vehicle.mode == "mission":
            self._drop_goal()

    def _drop_goal(self) -> None:
        self._goal, self._lands_at_goal, self._wait_until = None, False, None
        self._missions.landing = False

    def lost(self, action: str, now: int) -> None:
        """Hold or land in the air, as no program is connected; a return or a landing continues."""
        if self._lands_at_goal:
            return
        if self._vehicle.landed_state == mav.MAV_LANDED_STATE_IN_AIR:
            self._report(f"no program is heard any more: {action}")
            self.set_mode(action, now)

    def _arm(self, message: Any, now: int) -> int:  # noqa: ARG002
        vehicle = self._vehicle
        if message.param1 == 1:
            if not vehicle.ready:
                self._report("arming denied: expected a pose of the vehicle, found none yet")
                return int(_LATER)
            if not vehicle.armed:
                self._act(ev.Arm)
                vehicle.armed = True  # a take-off may come before its event does
            return int(_OK)
        in_air = vehicle.landed_state != mav.MAV_LANDED_STATE_ON_GROUND
        if message.param1 != 0 or (in_air and message.param2 != FORCED):
            self._report("disarming denied: in the air")
            return int(_NO)
        self._act(ev.Disarm)
        return int(_OK)

    def _take_off(self, message: Any, now: int) -> int:
        vehicle, (frame, x, y, z) = self._vehicle, self._location(message)
        if math.isnan(z) or not vehicle.armed:
            return self.set_mode("takeoff", now)
        try:
            place = vehicle.place_of(frame, math.nan, math.nan, z)
        except ValueError as error:
            return self._denied("takeoff", error)
        height = vehicle.position[2] - place[2]
        if height < LEAST_CLIMB:
            above = "home" if GLOBAL_FRAMES.get(frame) else "sea level"
            target = f"{z:g} m above {above}" if frame in GLOBAL_FRAMES else f"{z:g} m down"
            return self._denied(
                "takeoff",
                f"expected an altitude {LEAST_CLIMB:g} m or more above the vehicle, found "
                f"{target}, which is {-height:.1f} m below it",
            )
        if math.isfinite(x) and math.isfinite(y) and (x or y):
            self._warn_once("takeoff: its place is not flown to: it goes straight up")
        return self.set_mode("takeoff", now, climb=height)

    def _land(self, message: Any, now: int) -> int:
        try:
            place = self._landing_place(*self._location(message)[:3])
        except ValueError as error:
            return self._denied("land", error)
        if place is None or not self._flies:
            return self.set_mode("land", now)
        self.set_mode("hold", now)
        self._set_goal(place)
        self._lands_at_goal = True
        return int(_OK)

    def _landing_place(self, frame: int, x: float, y: float) -> Vector3 | None:
        """Return where to go before landing; `None` for NaN, and zeros of a global frame: here."""
        if math.isnan(x) or math.isnan(y) or (frame != mav.MAV_FRAME_LOCAL_NED and not (x or y)):
            return None
        return self._vehicle.place_of(frame, x, y, math.nan)

    @property
    def _flies(self) -> bool:
        vehicle = self._vehicle
        return vehicle.armed and vehicle.landed_state != mav.MAV_LANDED_STATE_ON_GROUND

    def _denied(self, action: str, reason: object) -> int:
        self._report(f"{action} denied: {reason}")
        return int(_NO)

    def _change_speed(self, speed: float) -> int:
        if not is_speed(speed):
            return self._denied("speed", f"expected a positive one, found {speed:g}")
        if speed != -1:
            self._speed = speed if speed > 0 else None
        return int(_OK)

    def _start_mission(self, message: Any, now: int) -> int:
        if self._missions.items and (
            reason := self._missions.start(message.param1, message.param2)
        ):
            return self._denied("mission", reason)
        return self.set_mode("mission", now, resumes=False)

    def _reposition(self, message: Any, now: int) -> int:
        """Fly to a place; hold if it is the vehicle's, as ground stations pause."""
        vehicle, place = self._vehicle, self._location(message)
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
            self._set_goal(goal, message.param4)
        return int(_OK)

    def _set_goal(self, place: Vector3, yaw: float = math.nan) -> None:
        vehicle = self._vehicle
        heading = yaw if math.isfinite(yaw) else yaw_of(vehicle.orientation)
        self._goal, self._carrot = (place, heading), vehicle.position
        self._followed = None

    def _follow(self, now: int) -> None:
        """Advance the carrot, and check whether the place is reached."""
        assert self._goal is not None
        place, heading = self._goal
        seconds = 0.0 if self._followed is None else (now - self._followed) / SECOND
        self._followed = now
        speed = self._speed or self._parameters["MPC_XY_CRUISE"]
        distance = math.dist(self._carrot, place)
        part = 1.0 if distance <= speed * seconds else speed * seconds / distance
        x, y, z = (a + part * (b - a) for a, b in zip(self._carrot, place, strict=True))
        self._carrot = (x, y, z)
        self._act(ev.PositionSetpoint, position=self._carrot, yaw=heading)
        if part < 1.0 or math.dist(self._vehicle.position, place) > ARRIVED:
            return
        self._goal, item = None, self._missions.current()
        if self._vehicle.mode == "mission" and item is not None and not self._lands_at_goal:
            stay = item.params[0] if item.command == mav.MAV_CMD_NAV_WAYPOINT else 0
            self._wait_until = now + (round(stay * SECOND) if 0 < stay <= LONGEST_STAY else 0)
        elif self._lands_at_goal:
            by_item = self._vehicle.mode == "mission"
            self.set_mode("land", now)
            self._missions.landing = by_item

    def _update_mission(self, now: int) -> None:
        """Start a mission's item, or wait until its stay is over."""
        if self._wait_until is not None:
            if now < self._wait_until:
                return
            self._wait_until = None
            self._missions.reached()
        if self._goal is None:
            self._start_item(now)

    def _start_item(self, now: int) -> None:
        vehicle, item = self._vehicle, self._missions.current()
        if item is None:
            self._report_end()
            self.set_mode("hold", now)
            return
        kind = item.command
        try:
            landing = None
            if kind == mav.MAV_CMD_NAV_LAND and self._flies:
                landing = self._landing_place(*item.place[:3])
            place = vehicle.place_of(*item.place) if kind in _PLACES else landing
        except ValueError as error:  # as of a place known in part, once the vehicle is far away
            self._report(f"mission: {error}: holding")
            self.set_mode("hold", now)
            return
        if kind in _PLACES and not vehicle.armed:
            return
        if place is not None:
            if kind == mav.MAV_CMD_NAV_TAKEOFF:
                place = (*vehicle.position[:2], place[2])
            self._set_goal(place, math.nan if landing else math.radians(item.params[3]))
            self._lands_at_goal = landing is not None
        elif kind == mav.MAV_CMD_DO_CHANGE_SPEED:
            self._change_speed(item.params[1])
            self._missions.reached()
        elif kind == mav.MAV_CMD_NAV_DELAY:
            self._wait_until = now + round(item.params[0] * SECOND)
        elif kind == mav.MAV_CMD_NAV_LAND:
            self.set_mode("land", now)
            self._missions.landing = vehicle.armed
            if not vehicle.armed:
                self._missions.reached()
        else:
            self._missions.reached()
            self.set_mode("return", now)

    def _report_end(self) -> None:
        """Report that there is no further item."""
        if self._missions.current() is None:
            self._report("mission finished" if self._missions.items else "mission cleared: holding")

    def _location(self, message: Any) -> tuple[int, float, float, float]:
        """Return a command's frame and place, as `Vehicle.place_of` takes it."""
        if message.get_type() == "COMMAND_LONG":
            above_home, above_sea = mav.MAV_FRAME_GLOBAL_RELATIVE_ALT, mav.MAV_FRAME_GLOBAL
            frame = above_home if self._vehicle.is_copter else above_sea
            return frame, message.param5 * 1e7, message.param6 * 1e7, message.param7
        scale = 1 if message.frame in GLOBAL_FRAMES else LOCAL_SCALE
        x, y = (
            math.nan if coordinate == _UNKNOWN_PLACE else coordinate * scale
            for coordinate in (message.x, message.y)
        )
        return message.frame, x, y, message.z

    def refusal(self, item: Item) -> str:
        """Return why a mission's item cannot be flown; empty if it can."""
        kind = item.command
        try:
            if kind in _PLACES:
                self._vehicle.place_of(*item.place)
            elif kind == mav.MAV_CMD_NAV_LAND:
                self._landing_place(*item.place[:3])
        except ValueError as error:
            return str(error)
        if kind == mav.MAV_CMD_NAV_DELAY and not 0 <= item.params[0] <= LONGEST_STAY:
            return f"expected a delay of 0 to {LONGEST_STAY} s, found {item.params[0]:g}"
        if kind == mav.MAV_CMD_DO_CHANGE_SPEED and not is_speed(item.params[1]):
            return f"expected a positive speed, found {item.params[1]:g}"
        return "" if kind in _ITEMS else f"command {kind} is not supported"


def _stick(value: int) -> float:
    """Return a stick's position, -1 to 1; the middle if there is no such stick."""
    return 0.0 if value == _NO_STICK else min(max(value / 1000, -1.0), 1.0)
