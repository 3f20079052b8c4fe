"""Modes, commands and offboard set-points: from messages to what a vehicle is told."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import events as ev
from events import Setpoint, Vector3
from events.frames import from_geodetic, yaw_of
from visnav_mavlink.links import mav
from visnav_mavlink.vehicle import MODES, SECOND, Item, Missions, Parameters, Vehicle

OFFBOARD_TIMEOUT = SECOND // 2  # PX4's COM_OF_LOSS_T: without a set-point for longer it holds
ARRIVED = 0.3  # metres from a place at which it is reached
FARTHEST = 1e4  # metres from the origin that a place may be
FORCED = 21196  # param2 of a disarming in the air (mavlink.io, MAV_CMD_COMPONENT_ARM_DISARM)
YAW_GAIN = 1.5  # of a heading that is asked for beside a velocity, 1/s
_OK, _NO = mav.MAV_RESULT_ACCEPTED, mav.MAV_RESULT_DENIED
_LATER, _UNKNOWN = mav.MAV_RESULT_TEMPORARILY_REJECTED, mav.MAV_RESULT_UNSUPPORTED
_BODY = {mav.MAV_FRAME_BODY_NED, mav.MAV_FRAME_BODY_OFFSET_NED, mav.MAV_FRAME_BODY_FRD}
_GLOBAL = {
    mav.MAV_FRAME_GLOBAL: False,
    mav.MAV_FRAME_GLOBAL_INT: False,
    mav.MAV_FRAME_GLOBAL_RELATIVE_ALT: True,
    mav.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT: True,
}  # whether altitudes are above home


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
        self._offboard = -(1 << 62)  # stamp of the newest set-point
        self._commands: dict[int, Callable[[Sequence[float], int], int]] = {
            mav.MAV_CMD_COMPONENT_ARM_DISARM: self._arm,
            mav.MAV_CMD_NAV_TAKEOFF: self._take_off,
            mav.MAV_CMD_NAV_LAND: lambda p, now: self.set_mode("land", now),  # noqa: ARG005
            mav.MAV_CMD_NAV_RETURN_TO_LAUNCH: lambda p, now: self.set_mode("return", now),  # noqa: ARG005
            mav.MAV_CMD_DO_SET_MODE: self._do_set_mode,
            mav.MAV_CMD_DO_CHANGE_SPEED: self._change_speed,
            mav.MAV_CMD_MISSION_START: lambda p, now: self.set_mode("mission", now),  # noqa: ARG005
            mav.MAV_CMD_DO_SET_MISSION_CURRENT: lambda p, _: self._missions.jump(p[0]),
        }

    def command(self, message: Any, now: int) -> int:
        """Carry out a ``COMMAND_LONG`` or ``COMMAND_INT``; return its ``MAV_RESULT``."""
        number = message.command
        numbers = [message.param1, message.param2, message.param3, message.param4]
        if number == mav.MAV_CMD_DO_REPOSITION:
            return self._reposition(message, now)
        if message.get_type() == "COMMAND_INT":
            numbers += [message.x, message.y, message.z]
        else:
            numbers += [message.param5, message.param6, message.param7]
        if (do := self._commands.get(number)) is None:
            self._once(f"command {number} is not supported")
            return int(_UNKNOWN)
        return int(do(numbers, now))

    def set_mode(self, mode: str, now: int) -> int:
        """Go over to a mode; return a ``MAV_RESULT``."""
        vehicle = self._vehicle
        if mode == "offboard" and now - self._offboard > OFFBOARD_TIMEOUT:
            self._tell("offboard: expected set-points before, found none of the last 0.5 s")
            return int(_LATER)
        if mode == "mission" and not self._missions.items:
            self._tell("mission: expected one, found none: upload it first")
            return int(_LATER)
        if mode in {"takeoff", "return"} and not vehicle.armed:
            self._tell(f"{mode} denied: expected an armed vehicle, found it disarmed")
            return int(_LATER)
        self._goal, self._lands_there, self._wait_until = None, False, 0
        flies = vehicle.armed and vehicle.landed_state != mav.MAV_LANDED_STATE_ON_GROUND
        if vehicle.mode in {"takeoff", "land"} and mode != vehicle.mode and flies:
            self._act(ev.Hover)  # else its set-points would not count
        vehicle.mode = mode
        if mode == "takeoff":
            self._act(ev.Takeoff, altitude=self._parameters["MIS_TAKEOFF_ALT"])
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
        """Take a set-point of position, velocity, attitude or rates; sent on in offboard mode."""
        made = self._setpoint(message)
        if made is None:
            return
        self._offboard = now
        if self._vehicle.mode == "offboard":
            kind, fields = made
            self._act(kind, **fields)

    def update(self, now: int) -> None:
        """Go on with what is under way."""
        vehicle = self._vehicle
        if vehicle.mode == "offboard" and now - self._offboard > OFFBOARD_TIMEOUT:
            self._tell("offboard: no set-point for 0.5 s: holding")
            self.set_mode("hold", now)
        if vehicle.mode == "mission" and self._goal is None and now >= self._wait_until:
            self._next_item(now)
        if self._goal is not None and vehicle.armed:
            self._follow(now)

    def lost(self, action: str, now: int) -> None:
        """Do what is to be done without any program in the air: ``hold`` or ``land``."""
        if self._vehicle.landed_state == mav.MAV_LANDED_STATE_IN_AIR:
            self._tell(f"no program is heard any more: {action}")
            self.set_mode(action, now)

    def position_of(self, frame: int, x: float, y: float, z: float) -> Vector3 | None:
        """Return a message's place in ``map``, metres; `None` if nobody can fly there.

        `x` and `y` are 1e-7 degrees in global frames.
        """
        vehicle = self._vehicle
        if frame in _GLOBAL:
            home = vehicle.home or (0.0, 0.0, 0.0)
            above = vehicle.origin[2] - home[2] if _GLOBAL[frame] else 0.0
            if not (math.isfinite(z) and abs(x) <= 9e8 and abs(y) <= 18e8):
                return None
            position = from_geodetic((x * 1e-7, y * 1e-7, z + above), vehicle.origin)
        elif frame == mav.MAV_FRAME_LOCAL_NED:
            position = (x, y, z)
        else:
            return None
        return position if all(abs(coordinate) <= FARTHEST for coordinate in position) else None

    def _arm(self, numbers: Sequence[float], now: int) -> int:  # noqa: ARG002
        vehicle = self._vehicle
        if numbers[0] == 1:
            if not vehicle.ready:
                self._tell("arming denied: expected a pose of the vehicle, found none yet")
                return int(_LATER)
            if not vehicle.armed:
                self._act(ev.Arm)
                vehicle.armed = True  # a take-off may come before its event does
            return int(_OK)
        in_air = vehicle.landed_state != mav.MAV_LANDED_STATE_ON_GROUND
        if numbers[0] != 0 or (in_air and numbers[1] != FORCED):
            self._tell("disarming denied: in the air")
            return int(_NO)
        self._act(ev.Disarm)
        return int(_OK)

    def _take_off(self, numbers: Sequence[float], now: int) -> int:
        vehicle, altitude = self._vehicle, numbers[6]
        if math.isfinite(altitude) and vehicle.armed and vehicle.home:  # above sea level
            height = altitude - (vehicle.origin[2] - vehicle.home[2])
            if not 0.3 <= height <= FARTHEST:
                self._tell(f"takeoff denied: expected 0.3 m or more above home, found {height:g}")
                return int(_NO)
            self.set_mode("hold", now)
            vehicle.mode = "takeoff"
            self._act(ev.Takeoff, altitude=height)
            return int(_OK)
        return self.set_mode("takeoff", now)

    def _do_set_mode(self, numbers: Sequence[float], now: int) -> int:
        return self.set_px4_mode(numbers[1], numbers[2], now)

    def _change_speed(self, numbers: Sequence[float], now: int) -> int:  # noqa: ARG002
        if not (math.isfinite(numbers[1]) and numbers[1] > 0):
            return int(_NO)
        self._speed = numbers[1]
        return int(_OK)

    def _reposition(self, message: Any, now: int) -> int:
        if message.get_type() == "COMMAND_INT":
            frame, x, y, z = message.frame, message.x, message.y, message.z
        else:
            frame, z = mav.MAV_FRAME_GLOBAL, message.param7
            x, y = message.param5 * 1e7, message.param6 * 1e7
        place = self.position_of(frame, x, y, z)
        vehicle = self._vehicle
        if place is None or not vehicle.armed or vehicle.home is None:
            self._tell("reposition denied: expected a vehicle in the air, and a place")
            return int(_NO)
        self.set_mode("hold", now)
        if math.isfinite(message.param1) and message.param1 > 0:
            self._speed = message.param1
        self._go(place, message.param4)
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
            place = self.position_of(item.frame, item.x, item.y, item.z)
            assert place is not None  # which `Missions` has made sure of
            if kind == mav.MAV_CMD_NAV_TAKEOFF:
                place = (*vehicle.position[:2], place[2])
            self._go(place, math.radians(item.params[3]))
        elif kind == mav.MAV_CMD_DO_CHANGE_SPEED:
            self._change_speed(item.params, now)
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
            return self.position_of(item.frame, item.x, item.y, item.z) is None
        if item.command == mav.MAV_CMD_NAV_DELAY:
            return not 0 <= item.params[0] <= 3600
        return item.command not in {
            mav.MAV_CMD_DO_CHANGE_SPEED,
            mav.MAV_CMD_NAV_LAND,
            mav.MAV_CMD_NAV_RETURN_TO_LAUNCH,
        }

    def _setpoint(self, message: Any) -> tuple[type[Setpoint], dict[str, Any]] | None:
        """Return the set-point that a message asks for; `None` if it cannot be followed."""
        mask, kind = message.type_mask, message.get_type()
        if kind == "SET_ATTITUDE_TARGET":
            return self._attitude(message, mask)
        frame = message.coordinate_frame
        no_place, no_speed = mask & 0b111 == 0b111, mask & 0b111000 == 0b111000
        velocity = tuple(0.0 if math.isnan(v) else v for v in (message.vx, message.vy, message.vz))
        turn = 0.0 if mask & 2048 or math.isnan(message.yaw_rate) else message.yaw_rate
        own = yaw_of(self._vehicle.orientation)
        yaw = own if mask & 1024 or math.isnan(message.yaw) else message.yaw
        if not all(map(math.isfinite, (*velocity, turn, yaw))):
            return self._no_setpoint(f"{kind} with numbers that are none")
        if not no_place:
            if kind == "SET_POSITION_TARGET_GLOBAL_INT":
                place = self.position_of(frame, message.lat_int, message.lon_int, message.alt)
            else:
                place = self.position_of(frame, message.x, message.y, message.z)
            if place is None:
                return self._no_setpoint(f"{kind} with a place in frame {frame}")
            ahead = {} if no_speed else {"velocity": velocity}
            return ev.PositionSetpoint, {"position": place, "yaw": yaw, "yaw_rate": turn} | ahead
        if no_speed:
            return self._no_setpoint(f"{kind} with neither position nor velocity")
        if mask & 1024 == 0:
            turn += YAW_GAIN * math.remainder(yaw - own, math.tau)
        frame_id = "heading" if frame in _BODY else "map"
        return ev.VelocitySetpoint, {
            "velocity": velocity, "yaw_rate": turn, "frame_id": frame_id
        }  # fmt: skip

    def _attitude(self, message: Any, mask: int) -> tuple[type[Setpoint], dict[str, Any]] | None:
        thrust = message.thrust
        rates = (message.body_roll_rate, message.body_pitch_rate, message.body_yaw_rate)
        if mask & 128:
            if not all(map(math.isfinite, (*rates, thrust))):
                return self._no_setpoint("SET_ATTITUDE_TARGET with numbers that are none")
            return ev.BodyRateSetpoint, {"angular_velocity": rates, "thrust": thrust}
        size = math.hypot(*message.q)
        if not (math.isfinite(size) and math.isfinite(thrust) and size > 0.5):
            return self._no_setpoint("SET_ATTITUDE_TARGET with no attitude")
        turned = tuple(part / size for part in message.q)
        return ev.AttitudeSetpoint, {"orientation": turned, "thrust": thrust}

    def _no_setpoint(self, what: str) -> tuple[type[Setpoint], dict[str, Any]] | None:
        self._once(f"{what} is not followed")
        return None
