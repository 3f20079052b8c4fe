"""Knowledge of a vehicle: its state and telemetry, and its parameters."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any
from weakref import WeakKeyDictionary

from events import FluidPressure, Imu, MagneticField, Odometry, PoseEstimate, Quaternion, Vector3
from events.frames import Geodetic, from_geodetic, rotate, rotate_inverse, to_geodetic, yaw_of
from visnav_mavlink.links import Links, Peer, Sender, ardupilot_dialect, highres_imu, mav
from visnav_mavlink.settings import RATE

SECOND = 1_000_000_000
LEAST_PERIOD = round(SECOND / RATE)  # of a message

MODES = {
    "manual": (1, 0),
    "altitude": (2, 0),
    "position": (3, 0),
    "takeoff": (4, 2),
    "hold": (4, 3),
    "mission": (4, 4),
    "return": (4, 5),
    "land": (4, 6),
    "offboard": (6, 0),
}
"""Name to PX4's main and sub mode, which programs read from and write into ``custom_mode``."""

COPTER_MODES = {
    "manual": 0,
    "altitude": 2,
    "mission": 3,
    "hold": 4,
    "takeoff": 4,
    "offboard": 4,
    "position": 5,
    "return": 6,
    "land": 9,
}
"""Name to the mode of ArduPilot's Copter: all that a program steers is GUIDED, 4."""

GLOBAL_FRAMES = {
    mav.MAV_FRAME_GLOBAL: False,
    mav.MAV_FRAME_GLOBAL_INT: False,
    mav.MAV_FRAME_GLOBAL_RELATIVE_ALT: True,
    mav.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT: True,
}
"""Frames of latitude and longitude, and whether their altitudes are above home."""

LOCAL_SCALE = 1e-4  # metres per unit of a local coordinate sent as an integer
FARTHEST = 1e4  # metres from the origin that a place may be
EARTH = 6371e3  # mean radius, metres
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
_PREDICTED = mav.ESTIMATOR_PRED_POS_HORIZ_ABS

Sample = Imu | MagneticField | FluidPressure


@dataclass
class Vehicle:
    """State of a vehicle: where it is by what flies it, armed or not, and its mode.

    Attributes:
        origin: Place of ``map``'s origin.
        home: Where it stood at first, metres in ``map``.
        gps: Whether it has a global position.
        is_copter: Whether it is seen as ArduPilot's Copter, not as PX4.
        imu_orientation: Rotation from its IMU's frame to the body's; `None` without an IMU.
        measured: Newest sample of each kind of sensor, with its number among all samples.
        progress: Returns the fields of its mission's ``MISSION_CURRENT``.
    """

    origin: Geodetic
    gps: bool
    is_copter: bool = False
    home: Vector3 | None = None
    stamp: int = 0
    position: Vector3 = (0.0, 0.0, 0.0)
    velocity: Vector3 = (0.0, 0.0, 0.0)
    rates: Vector3 = (0.0, 0.0, 0.0)
    orientation: Quaternion = (1.0, 0.0, 0.0, 0.0)
    armed: bool = False
    mode: str = "hold"
    imu_orientation: Quaternion | None = None
    measured: dict[type[Sample], tuple[int, Any]] = field(default_factory=dict)
    samples: int = 0
    progress: Callable[[], tuple[int, int, int, int]] = lambda: (0, 65535, 0, 0)

    def set_pose(self, pose: Odometry | PoseEstimate) -> None:
        """Set the pose, and the velocity if known; the first pose is home."""
        self.stamp, self.position, self.orientation = pose.stamp, pose.position, pose.orientation
        if isinstance(pose, Odometry):
            self.velocity = rotate(pose.orientation, pose.linear_velocity)
            self.rates = pose.angular_velocity
        elif pose.velocity is not None:
            self.velocity = pose.velocity
        if self.home is None:
            self.home = self.position

    def add_sample(self, sample: Sample) -> None:
        """Add a sensor's newest sample."""
        self.samples += 1
        self.measured[type(sample)] = self.samples, sample

    @property
    def ready(self) -> bool:
        """Return whether it has a pose, and so can fly."""
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

    def place_of(self, frame: int, x: float, y: float, z: float) -> Vector3:
        """Return a message's place in ``map``, metres; NaN means where the vehicle is.

        `x` and `y` are 1e-7 degrees in global frames, metres in the local one; `z` is an altitude,
        or metres down. A `ValueError` says why the place cannot be flown to.
        """
        if frame == mav.MAV_FRAME_LOCAL_NED:
            position = (x, y, z)
        elif frame in GLOBAL_FRAMES:
            above = 0.0
            if GLOBAL_FRAMES[frame] and self.home is not None:
                above = self.origin[2] - self.home[2]
            latitude, longitude, altitude = self.place(self.position)
            degrees = (latitude if math.isnan(x) else x, longitude if math.isnan(y) else y)
            up = altitude * 1e-3 if math.isnan(z) else z + above
            if not (math.isfinite(up) and abs(degrees[0]) <= 9e8 and abs(degrees[1]) <= 18e8):
                raise ValueError("expected latitude, longitude and altitude, found no such place")
            position = from_geodetic((degrees[0] * 1e-7, degrees[1] * 1e-7, up), self.origin)
        else:
            raise ValueError(f"expected a local or global frame, found frame {frame}")
        north, east, down = (
            current if math.isnan(value) else coordinate
            for current, value, coordinate in zip(self.position, (x, y, z), position, strict=True)
        )
        if not all(abs(coordinate) <= FARTHEST for coordinate in (north, east, down)):
            raise ValueError(
                "expected a place within {:g} km of the vehicle's origin, {:.6f}, {:.6f}, {:.0f} m;"
                " found it {:,.0f} km away: set the origin near it".format(
                    FARTHEST / 1000, *self.origin, _along_earth(north, east, down) / 1000
                )
            )
        return north, east, down

    def place(self, position: Vector3) -> tuple[int, int, int]:
        """Return latitude and longitude, 1e-7 degrees, and altitude, mm, of a place in ``map``."""
        latitude, longitude, altitude = to_geodetic(position, self.origin)
        return round(latitude * 1e7), round(longitude * 1e7), round(altitude * 1e3)


def _along_earth(north: float, east: float, down: float) -> float:
    """Return the distance of a place from the origin, metres; along the earth if it is far."""
    straight = math.hypot(north, east, down)
    if straight > 2.0 * EARTH:
        return straight
    return 2.0 * EARTH * math.asin(straight / (2.0 * EARTH))


def _heartbeat(v: Vehicle, _: int) -> Any:
    main, sub = MODES[v.mode]
    autopilot, custom = mav.MAV_AUTOPILOT_PX4, main << 16 | sub << 24
    if v.is_copter:
        autopilot, custom = mav.MAV_AUTOPILOT_ARDUPILOTMEGA, COPTER_MODES[v.mode]
    flags = mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | mav.MAV_MODE_FLAG_STABILIZE_ENABLED
    flags |= mav.MAV_MODE_FLAG_GUIDED_ENABLED if main in {4, 6} else 0
    flags |= mav.MAV_MODE_FLAG_SAFETY_ARMED if v.armed else 0
    return mav.MAVLink_heartbeat_message(
        mav.MAV_TYPE_QUADROTOR,
        autopilot,
        flags,
        custom,
        mav.MAV_STATE_ACTIVE if v.armed else mav.MAV_STATE_STANDBY,
        3,
    )


def _sys_status(v: Vehicle, _: int) -> Any:
    present = _HEALTHY | (mav.MAV_SYS_STATUS_SENSOR_GPS if v.gps else 0)
    present |= mav.MAV_SYS_STATUS_SENSOR_VISION_POSITION
    health = present if v.ready else present & ~mav.MAV_SYS_STATUS_PREARM_CHECK
    health |= mav.MAV_SYS_STATUS_GEOFENCE  # not there; MAVProxy takes an unhealthy one for a breach
    return mav.MAVLink_sys_status_message(
        present, present, health, 0, 16200, -1, 100, 0, 0, 0, 0, 0, 0
    )


def _system_time(v: Vehicle, ms: int) -> Any:  # noqa: ARG001
    return mav.MAVLink_system_time_message(0, ms)  # no date: a run has none


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
    speeds = [round(100 * speed) for speed in v.velocity]
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


def _ekf_status(v: Vehicle, _: int) -> Any:
    if not v.is_copter:
        return None
    flags = _ESTIMATED | (mav.ESTIMATOR_POS_HORIZ_ABS | _PREDICTED if v.gps else 0)
    return ardupilot_dialect().MAVLink_ekf_status_report_message(
        flags if v.ready else 0, 0.1, 0.1, 0.1, 0.1, 0.1
    )


def _highres_imu(v: Vehicle, since: int) -> Any:
    """Return the newest samples, those after the number `since` as new; `None` if the IMU's is not.

    It is in the body's frame, as PX4's.
    """
    kinds = Imu, MagneticField, FluidPressure
    (number, imu), field, pressure = (v.measured.get(kind, (0, None)) for kind in kinds)
    if imu is None or number <= since:
        return None
    if v.imu_orientation is not None:
        imu = Imu(
            stamp=imu.stamp, source=imu.source,
            angular_velocity=rotate(v.imu_orientation, imu.angular_velocity),
            linear_acceleration=rotate(v.imu_orientation, imu.linear_acceleration),
        )  # fmt: skip
    updated = [True, field[0] > since, pressure[0] > since]
    return highres_imu(imu, field[1], pressure[1], updated)


def _mission_current(v: Vehicle, _: int) -> Any:
    return mav.MAVLink_mission_current_message(*v.progress())


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


_EKF_STATUS_REPORT = 193  # of ArduPilot's dialect
_HIGHRES_IMU = mav.MAVLINK_MSG_ID_HIGHRES_IMU
Make = Callable[[Vehicle, int], Any]
TELEMETRY: dict[int, tuple[float, Make]] = {
    mav.MAVLINK_MSG_ID_HEARTBEAT: (1.0, _heartbeat),
    mav.MAVLINK_MSG_ID_SYS_STATUS: (2.0, _sys_status),
    mav.MAVLINK_MSG_ID_SYSTEM_TIME: (1.0, _system_time),
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
    _HIGHRES_IMU: (20.0, _highres_imu),  # of samples since the last one to a peer
    mav.MAVLINK_MSG_ID_MISSION_CURRENT: (1.0, _mission_current),
    mav.MAVLINK_MSG_ID_ESTIMATOR_STATUS: (1.0, _estimator_status),
    _EKF_STATUS_REPORT: (1.0, _ekf_status),
    mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION: (0.0, _autopilot_version),
}
"""Message's number to its rate, Hz (0: only if asked for), and its maker from `Vehicle` and ms."""


STREAMS: dict[int, tuple[int, ...]] = {
    mav.MAV_DATA_STREAM_ALL: tuple(
        number
        for number, (rate, _) in TELEMETRY.items()
        if rate and number != mav.MAVLINK_MSG_ID_HEARTBEAT
    ),
    mav.MAV_DATA_STREAM_RAW_SENSORS: (_HIGHRES_IMU,),
    mav.MAV_DATA_STREAM_EXTENDED_STATUS: (
        mav.MAVLINK_MSG_ID_SYS_STATUS,
        mav.MAVLINK_MSG_ID_GPS_RAW_INT,
        mav.MAVLINK_MSG_ID_MISSION_CURRENT,
    ),
    mav.MAV_DATA_STREAM_POSITION: (
        mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
        mav.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
    ),
    mav.MAV_DATA_STREAM_EXTRA1: (mav.MAVLINK_MSG_ID_ATTITUDE,),
    mav.MAV_DATA_STREAM_EXTRA2: (mav.MAVLINK_MSG_ID_VFR_HUD,),
    mav.MAV_DATA_STREAM_EXTRA3: (
        mav.MAVLINK_MSG_ID_BATTERY_STATUS,
        mav.MAVLINK_MSG_ID_SYSTEM_TIME,
    ),
}
"""Messages of ``REQUEST_DATA_STREAM``'s streams, as ArduPilot groups them."""


@dataclass
class Timer:
    """Period of a message, and when it is due (ns).

    Attributes:
        since: Number of the newest sample that was sent, of a message of samples.
    """

    period: int
    due: int = 0
    since: int = 0

    def pop_due(self, now: int) -> bool:
        """Return whether it is due, and set the next time; after a gap, a period from now."""
        if now < self.due:
            return False
        self.due = (self.due if now - self.due < self.period else now) + self.period
        return True


class Telemetry:
    """Sends messages to each peer at the rates that this peer has asked for."""

    def __init__(self, vehicle: Vehicle, links: Links, report: Callable[[str], None]) -> None:
        self._vehicle, self._links, self._report = vehicle, links, report
        self._timers: WeakKeyDictionary[Peer, dict[int, Timer]] = WeakKeyDictionary()
        request, version = self._request, mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION
        home = mav.MAVLINK_MSG_ID_HOME_POSITION
        self._commands: dict[int, Callable[[Peer, Any, int], bool]] = {
            mav.MAV_CMD_SET_MESSAGE_INTERVAL: lambda peer, m, _: (
                self._is_available(m.param1) and self.set_period(peer, m.param1, m.param2)
            ),
            mav.MAV_CMD_GET_MESSAGE_INTERVAL: lambda peer, m, _: self._send_period(peer, m.param1),
            mav.MAV_CMD_REQUEST_MESSAGE: lambda peer, m, now: (
                self._send_period(peer, m.param2)
                if m.param1 == mav.MAVLINK_MSG_ID_MESSAGE_INTERVAL
                else request(peer, m.param1, now)
            ),
            mav.MAV_CMD_GET_HOME_POSITION: lambda peer, _, now: request(peer, home, now),
            mav.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: lambda peer, _, now: request(
                peer, version, now
            ),
        }

    def command(self, peer: Peer, message: Any, now: int) -> int | None:
        """Carry out a command about messages; return its ``MAV_RESULT``, `None` for others."""
        if (handler := self._commands.get(message.command)) is None:
            return None
        done = handler(peer, message, now)
        return int(mav.MAV_RESULT_ACCEPTED if done else mav.MAV_RESULT_UNSUPPORTED)

    def set_period(self, peer: Peer, number: float, microseconds: float) -> bool:
        """Set a message's period; 0 its own, below never; `False` if there is no such message."""
        if number not in TELEMETRY or not math.isfinite(microseconds):
            return False
        usual_rate, timers = TELEMETRY[int(number)][0], self._timers_of(peer)
        if microseconds < 0 or (microseconds == 0 and not usual_rate):
            timers.pop(int(number), None)
            return True
        period = round(microseconds * 1e3 if microseconds else SECOND / usual_rate)
        if period < LEAST_PERIOD:
            name = getattr(mav.mavlink_map.get(number), "msgname", f"message {number:g}")
            self._report(f"{name}: expected at most {RATE:g} Hz, which now comes")
            period = LEAST_PERIOD
        timers.setdefault(int(number), Timer(period)).period = period
        return True

    def set_stream(self, peer: Peer, stream: int, hertz: int) -> bool:
        """Set the rates of a stream's messages; `False` if it has none."""
        numbers = [n for n in STREAMS.get(stream, ()) if not self._unavailability(n)]
        for number in numbers:
            self.set_period(peer, number, 1e6 / hertz if hertz else -1)
        return bool(numbers)

    def update(self, now: int) -> None:
        """Send all that is due at a stamp (ns)."""
        messages: dict[tuple[int, int], Any] = {}
        for peer in [*self._links.peers]:
            for number, timer in self._timers_of(peer).items():
                if not timer.pop_due(now):
                    continue
                key = number, timer.since
                if key not in messages:
                    messages[key] = self._make(*key, now)
                if messages[key] is not None:
                    self._links.send_to(peer, messages[key])
                if number == _HIGHRES_IMU:
                    timer.since = self._vehicle.samples

    def _timers_of(self, peer: Peer) -> dict[int, Timer]:
        if (timers := self._timers.get(peer)) is None:
            rates = {number: hz for number, (hz, _) in TELEMETRY.items() if hz}
            timers = {number: Timer(round(SECOND / hz)) for number, hz in rates.items()}
            self._timers[peer] = timers
        return timers

    def _make(self, number: int, since: int, now: int) -> Any:
        if number == _HIGHRES_IMU:
            return _highres_imu(self._vehicle, since)
        return TELEMETRY[number][1](self._vehicle, now // 1_000_000 % 2**32)

    def _unavailability(self, number: float) -> str:
        """Return why a message can never be sent; empty if it can."""
        if number == _HIGHRES_IMU and self._vehicle.imu_orientation is None:
            return "HIGHRES_IMU: expected a vehicle with an IMU, found none"
        if number == _EKF_STATUS_REPORT and not self._vehicle.is_copter:
            return "EKF_STATUS_REPORT: it is ArduPilot's"
        return ""

    def _is_available(self, number: float) -> bool:
        """Return whether a message can be sent; report the reason if not."""
        if reason := self._unavailability(number):
            self._report(reason)
        return not reason

    def _request(self, peer: Peer, number: float, now: int) -> bool:
        message = self._make(int(number), 0, now) if number in TELEMETRY else None
        if message is not None:
            self._links.send_to(peer, message)
        return message is not None

    def _send_period(self, peer: Peer, number: float) -> bool:
        if not (math.isfinite(number) and 0 <= number <= 65535):
            return False
        timer = self._timers_of(peer).get(int(number))
        period = 0 if number not in TELEMETRY else timer.period // 1000 if timer else -1
        self._links.send_to(peer, mav.MAVLink_message_interval_message(int(number), period))
        return True


PARAMETERS = {
    "MIS_TAKEOFF_ALT": (2.5, 0.3, 100.0),
    "MPC_XY_CRUISE": (2.0, 0.1, 20.0),
    "RTL_RETURN_ALT": (2.5, 0.0, 100.0),
}
"""PX4's name to value, least and most: metres above home; metres per second."""
INERT, MOST_INERT = ("EKF2_", "COM_", "NAV_"), 500  # beginnings of names without effect; how many


class Parameters(dict[str, float]):
    """Parameters that have a meaning here, by PX4's names; sent as 32-bit floats.

    Those of PX4's filter and safety that programs set before a flight are kept, and given back as
    they came, but have no effect.
    """

    def __init__(self, send: Callable[[Any], None], report: Callable[[str], None]) -> None:
        super().__init__({name: value for name, (value, *_) in PARAMETERS.items()})
        self._send, self._report = send, report
        self._inert: dict[str, tuple[float, int]] = {}  # value as sent, and its type

    def handle(self, message: Any, sender: Sender) -> str | None:
        """Answer a request of the parameter protocol; return what is wrong with it, if so."""
        kind, names = message.get_type(), [*self, *self._inert]
        if kind == "PARAM_REQUEST_LIST":
            for name in names:
                self._send_parameter(name)
            return None
        if kind == "PARAM_REQUEST_READ" and message.param_index >= 0:
            if message.param_index >= len(names):
                self._send_error(sender, "", message.param_index)
                return f"parameter {message.param_index} is unknown here"
            self._send_parameter(names[message.param_index])
            return None
        name = message.param_id.rstrip("\0")
        warning = None
        if kind == "PARAM_SET" and name.startswith(INERT) and len(self._inert) < MOST_INERT:
            if name not in self._inert:
                warning = f"{name} is kept, but nothing here is set by it"
            self._inert[name] = message.param_value, message.param_type
        elif kind == "PARAM_SET" and name in self:
            _, least, most = PARAMETERS[name]
            if message.param_type != mav.MAV_PARAM_TYPE_REAL32:
                self._report(f"{name}: expected a REAL32, found type {message.param_type}")
            elif least <= message.param_value <= most:
                self[name] = message.param_value
            else:
                self._report(f"{name}: expected {least:g} to {most:g}")
        if name not in self and name not in self._inert:
            self._send_error(sender, name, -1)
            return f"parameter {name} is unknown here"
        self._send_parameter(name)
        return warning

    def _send_error(self, sender: Sender, name: str, index: int) -> None:
        """Answer that there is no such parameter, so that programs stop asking."""
        if hasattr(mav, "MAVLink_param_error_message"):  # older dialects have no such message
            unknown = mav.MAV_PARAM_ERROR_DOES_NOT_EXIST
            self._send(mav.MAVLink_param_error_message(*sender, name.encode(), index, unknown))

    def _send_parameter(self, name: str) -> None:
        real, names = mav.MAV_PARAM_TYPE_REAL32, [*self, *self._inert]
        value, kind = self._inert.get(name) or (self[name], real)
        self._send(
            mav.MAVLink_param_value_message(
                name.encode(), value, kind, len(names), names.index(name)
            )
        )
