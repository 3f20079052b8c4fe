"""What is known of a vehicle, and the telemetry that says so."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from events import Odometry, PoseEstimate, Quaternion, Vector3
from events.frames import Geodetic, rotate, rotate_inverse, to_geodetic, yaw_of
from nodes.mavlink.links import mav

SECOND = 1_000_000_000

MODES = {
    "manual": (1, 0),
    "position": (3, 0),
    "takeoff": (4, 2),
    "hold": (4, 3),
    "mission": (4, 4),
    "return": (4, 5),
    "land": (4, 6),
    "offboard": (6, 0),
}
"""Name to PX4's main and sub mode, which programs read from and write into ``custom_mode``."""

ON_GROUND = 0.15  # metres above the start below which an armed vehicle stands
_HEALTHY = (
    mav.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | mav.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | mav.MAV_SYS_STATUS_SENSOR_3D_MAG
    | mav.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE
    | mav.MAV_SYS_STATUS_SENSOR_BATTERY
    | mav.MAV_SYS_STATUS_PREARM_CHECK
)
_ESTIMATED = (
    mav.ESTIMATOR_ATTITUDE
    | mav.ESTIMATOR_VELOCITY_HORIZ
    | mav.ESTIMATOR_VELOCITY_VERT
    | mav.ESTIMATOR_POS_HORIZ_REL
    | mav.ESTIMATOR_POS_VERT_ABS
    | mav.ESTIMATOR_PRED_POS_HORIZ_REL
)


@dataclass
class Vehicle:
    """State of a vehicle: where it is by what flies it, armed or not, and its mode.

    Attributes:
        origin: Place of ``map``'s origin.
        home: Where it stood at first, metres in ``map``.
        gps: Whether it has a global position.
    """

    origin: Geodetic
    gps: bool
    home: Vector3 | None = None
    stamp: int = 0
    position: Vector3 = (0.0, 0.0, 0.0)
    velocity: Vector3 = (0.0, 0.0, 0.0)
    rates: Vector3 = (0.0, 0.0, 0.0)
    orientation: Quaternion = (1.0, 0.0, 0.0, 0.0)
    armed: bool = False
    mode: str = "hold"

    def note(self, pose: Odometry | PoseEstimate) -> None:
        """Take note of the newest pose."""
        self.stamp, self.position, self.orientation = pose.stamp, pose.position, pose.orientation
        if isinstance(pose, Odometry):
            self.velocity = rotate(pose.orientation, pose.linear_velocity)
            self.rates = pose.angular_velocity
        elif pose.velocity is not None:
            self.velocity = pose.velocity
        if self.home is None:
            self.home = self.position

    @property
    def ready(self) -> bool:
        """Whether it knows where it is, and so can fly."""
        return self.home is not None

    @property
    def height(self) -> float:
        """Metres above home."""
        return 0.0 if self.home is None else self.home[2] - self.position[2]

    @property
    def landed_state(self) -> int:
        """As MAVLink's ``MAV_LANDED_STATE``."""
        if not self.armed or (self.height < ON_GROUND and self.mode != "takeoff"):
            return int(mav.MAV_LANDED_STATE_ON_GROUND)
        states = {
            "takeoff": mav.MAV_LANDED_STATE_TAKEOFF,
            "land": mav.MAV_LANDED_STATE_LANDING,
        }
        return int(states.get(self.mode, mav.MAV_LANDED_STATE_IN_AIR))

    def place(self, position: Vector3) -> tuple[int, int, int]:
        """Return latitude and longitude, 1e-7 degrees, and altitude, mm, of a place in ``map``."""
        latitude, longitude, altitude = to_geodetic(position, self.origin)
        return round(latitude * 1e7), round(longitude * 1e7), round(altitude * 1e3)


def _heartbeat(v: Vehicle, _: int) -> Any:
    main, sub = MODES[v.mode]
    flags = mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | mav.MAV_MODE_FLAG_STABILIZE_ENABLED
    flags |= mav.MAV_MODE_FLAG_GUIDED_ENABLED if main in {4, 6} else 0
    flags |= mav.MAV_MODE_FLAG_SAFETY_ARMED if v.armed else 0
    return mav.MAVLink_heartbeat_message(
        mav.MAV_TYPE_QUADROTOR,
        mav.MAV_AUTOPILOT_PX4,
        flags,
        main << 16 | sub << 24,
        mav.MAV_STATE_ACTIVE if v.armed else mav.MAV_STATE_STANDBY,
        3,
    )


def _sys_status(v: Vehicle, _: int) -> Any:
    there = _HEALTHY | (mav.MAV_SYS_STATUS_SENSOR_GPS if v.gps else 0)
    there |= mav.MAV_SYS_STATUS_SENSOR_VISION_POSITION
    health = there if v.ready else there & ~mav.MAV_SYS_STATUS_PREARM_CHECK
    return mav.MAVLink_sys_status_message(there, there, health, 0, 16200, -1, 100, 0, 0, 0, 0, 0, 0)


def _battery(v: Vehicle, _: int) -> Any:  # noqa: ARG001
    cells = [4050] * 4 + [65535] * 6
    return mav.MAVLink_battery_status_message(0, 0, 0, 32767, cells, -1, -1, -1, 100)


def _attitude(v: Vehicle, ms: int) -> Any:
    w, x, y, z = v.orientation
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(min(max(2 * (w * y - z * x), -1.0), 1.0))
    return mav.MAVLink_attitude_message(ms, roll, pitch, yaw_of(v.orientation), *v.rates)


def _attitude_quaternion(v: Vehicle, ms: int) -> Any:
    return mav.MAVLink_attitude_quaternion_message(ms, *v.orientation, *v.rates)


def _local_position(v: Vehicle, ms: int) -> Any:
    return mav.MAVLink_local_position_ned_message(ms, *v.position, *v.velocity)


def _global_position(v: Vehicle, ms: int) -> Any:
    if not v.gps:
        return None
    speeds = [round(100 * each) for each in v.velocity]
    relative = round(1e3 * v.height)
    return mav.MAVLink_global_position_int_message(
        ms, *v.place(v.position), relative, *speeds, _heading(v)
    )


def _gps_raw(v: Vehicle, ms: int) -> Any:
    fix = (mav.GPS_FIX_TYPE_3D_FIX, *v.place(v.position)) if v.gps else (0, 0, 0, 0)
    speed = math.hypot(*v.velocity[:2])
    course = round(math.degrees(math.atan2(v.velocity[1], v.velocity[0])) % 360 * 100) % 36000
    return mav.MAVLink_gps_raw_int_message(
        1000 * ms, *fix, 80, 120, round(100 * speed), course, 12 if v.gps else 0
    )


def _home_position(v: Vehicle, ms: int) -> Any:
    if v.home is None or not v.gps:
        return None
    level = [1.0, 0.0, 0.0, 0.0]
    return mav.MAVLink_home_position_message(
        *v.place(v.home), *v.home, level, 0.0, 0.0, 0.0, 1000 * ms
    )


def _odometry(v: Vehicle, _: int) -> Any:
    unknown = [math.nan] + [0.0] * 20
    body = rotate_inverse(v.orientation, v.velocity)
    frames = mav.MAV_FRAME_LOCAL_NED, mav.MAV_FRAME_BODY_FRD
    pose = *v.position, list(v.orientation)
    return mav.MAVLink_odometry_message(
        v.stamp // 1000, *frames, *pose, *body, *v.rates, unknown, unknown
    )


def _vfr_hud(v: Vehicle, _: int) -> Any:
    speed = math.hypot(*v.velocity[:2])
    altitude = v.origin[2] - v.position[2]
    return mav.MAVLink_vfr_hud_message(
        speed, speed, _heading(v) // 100, 0, altitude, -v.velocity[2]
    )


def _extended_sys_state(v: Vehicle, _: int) -> Any:
    return mav.MAVLink_extended_sys_state_message(mav.MAV_VTOL_STATE_UNDEFINED, v.landed_state)


def _estimator_status(v: Vehicle, ms: int) -> Any:
    flags = _ESTIMATED | (mav.ESTIMATOR_POS_HORIZ_ABS if v.gps else 0)
    return mav.MAVLink_estimator_status_message(
        1000 * ms, flags if v.ready else 0, 0, 0, 0, 0, 0, 0, 0.1, 0.1
    )


def _autopilot_version(v: Vehicle, _: int) -> Any:  # noqa: ARG001
    can = (
        mav.MAV_PROTOCOL_CAPABILITY_MISSION_INT
        | mav.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
        | mav.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
        | mav.MAV_PROTOCOL_CAPABILITY_SET_ATTITUDE_TARGET
        | mav.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
        | mav.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_GLOBAL_INT
        | mav.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    )
    none = [0] * 8
    return mav.MAVLink_autopilot_version_message(
        can, 1 << 24 | 255, 0, 0, 0, none, none, none, 0, 0, 1
    )


def _heading(v: Vehicle) -> int:
    return round(math.degrees(yaw_of(v.orientation)) % 360 * 100) % 36000


Make = Callable[[Vehicle, int], Any]
TELEMETRY: dict[int, tuple[float, Make]] = {
    mav.MAVLINK_MSG_ID_HEARTBEAT: (1.0, _heartbeat),
    mav.MAVLINK_MSG_ID_SYS_STATUS: (2.0, _sys_status),
    mav.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: (5.0, _extended_sys_state),
    mav.MAVLINK_MSG_ID_ATTITUDE: (20.0, _attitude),
    mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: (20.0, _attitude_quaternion),
    mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED: (20.0, _local_position),
    mav.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: (10.0, _global_position),
    mav.MAVLINK_MSG_ID_ODOMETRY: (20.0, _odometry),
    mav.MAVLINK_MSG_ID_GPS_RAW_INT: (5.0, _gps_raw),
    mav.MAVLINK_MSG_ID_HOME_POSITION: (1.0, _home_position),
    mav.MAVLINK_MSG_ID_VFR_HUD: (5.0, _vfr_hud),
    mav.MAVLINK_MSG_ID_BATTERY_STATUS: (1.0, _battery),
    mav.MAVLINK_MSG_ID_ESTIMATOR_STATUS: (1.0, _estimator_status),
    mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION: (0.0, _autopilot_version),
}
"""Message's number to its rate, Hz (0: only if asked for), and its maker from `Vehicle` and ms."""


class Telemetry:
    """Sends messages, each at its rate."""

    def __init__(self, vehicle: Vehicle, send: Callable[[Any], None]) -> None:
        self._vehicle, self._send = vehicle, send
        self._periods = {n: round(SECOND / hz) for n, (hz, _) in TELEMETRY.items() if hz}
        self._due = dict.fromkeys(self._periods, 0)

    def set_period(self, number: int, microseconds: float) -> bool:
        """Set a message's period; 0 its own, below never; `False` if there is no such message."""
        if number not in TELEMETRY or not math.isfinite(microseconds):
            return False
        own = TELEMETRY[number][0]
        if microseconds < 0 or (microseconds == 0 and not own):
            self._periods.pop(number, None)
        else:
            self._periods[number] = round(SECOND / own if not microseconds else microseconds * 1e3)
            self._due.setdefault(number, 0)
        return True

    def update(self, now: int) -> None:
        """Send all that is due at a stamp (ns)."""
        for number, period in self._periods.items():
            if now >= self._due[number]:
                self._due[number] = max(self._due[number] + period, now - period)
                self.tell(number, now)

    def tell(self, number: int, now: int) -> bool:
        """Send a message now; `False` if there is none."""
        found = TELEMETRY.get(number)
        message = found[1](self._vehicle, now // 1_000_000 % 2**32) if found else None
        if message is not None:
            self._send(message)
        return message is not None
