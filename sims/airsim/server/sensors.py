"""Methods that read sensors: the newest sample that a vehicle's node has sent, as AirSim has it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from events import (
    Announcement,
    BarometerAnnouncement,
    Event,
    FluidPressure,
    Imu,
    ImuAnnouncement,
    LidarAnnouncement,
    LidarScan,
    MagneticField,
    MagnetometerAnnouncement,
    NavSatAnnouncement,
    NavSatFix,
    Quaternion,
    Range,
    RangeAnnouncement,
    Vector3,
)
from events.rotations import multiply, rotate
from sims.airsim import wire
from sims.airsim.server.methods import Caller, RpcError, rpc
from sims.airsim.server.vehicles import ServedMultirotor
from sims.airsim.structures import (
    BarometerData,
    CosysLidarData,
    DistanceSensorData,
    GeoPoint,
    GnssReport,
    GpsData,
    ImuData,
    LidarData,
    MagnetometerData,
    Pose,
    Quaternionr,
    Vector3r,
)
from sims.sensors.barometer import altitude_at
from sims.vehicle import TIMESTEP_NS

if TYPE_CHECKING:
    from sims.airsim.server.node import AirsimServer

GAUSS = 1e-4
"""Tesla."""

MOST_UNCERTAIN_2D = 4.0
"""Metres of horizontal uncertainty up to which AirSim's receiver has a fix in the plane."""

SAMPLES = (Imu, FluidPressure, MagneticField, NavSatFix, Range, LidarScan)
"""Events that are samples of sensors."""

Sensor = (
    ImuAnnouncement
    | BarometerAnnouncement
    | MagnetometerAnnouncement
    | NavSatAnnouncement
    | RangeAnnouncement
    | LidarAnnouncement
)
A = TypeVar("A", bound=Sensor)


class _Newest(NamedTuple):
    """A sensor's newest sample, and the vehicle's orientation at its time."""

    sample: Any
    orientation: Quaternion


class Sensors:
    """The sensors of all vehicles, known by their announcements.

    Before a sensor's first sample all its numbers and its stamp are 0.
    """

    def __init__(self, server: AirsimServer) -> None:
        self._server = server
        self._announced: dict[str, Sensor] = {}
        self._newest: dict[str, _Newest] = {}

    def announced(self, announcement: Announcement) -> None:
        """Take note of a vehicle's sensor."""
        vehicle = self._server.vehicles.get(announcement.source.partition("/")[0])
        if not isinstance(vehicle, ServedMultirotor) or not isinstance(announcement, Sensor):
            return
        self._announced[announcement.source] = announcement
        if isinstance(announcement, LidarAnnouncement):  # a turn, and one until the next is there
            self._server.world.remember(2.1 / announcement.rate + announcement.latency)

    def note(self, sample: Event) -> None:
        """Take note of a sample."""
        if sample.source in self._announced:
            vehicle = self._server.find_multirotor(sample.source.partition("/")[0])
            self._newest[sample.source] = _Newest(sample, vehicle.physics.state().orientation)

    @rpc("getImuData")
    def imu(self, name: str, vehicle: str = "") -> ImuData:
        """Return the newest sample of an IMU, with the true orientation at its stamp."""
        sensor = self._find(ImuAnnouncement, "IMU", name, vehicle)
        if (newest := self._newest.get(sensor.source)) is None:
            return ImuData(
                orientation=Quaternionr(*self._server.find_multirotor(vehicle).state().orientation)
            )
        sample = newest.sample
        return ImuData(
            time_stamp=sample.stamp,
            orientation=Quaternionr(*newest.orientation),
            angular_velocity=Vector3r(*sample.angular_velocity),
            linear_acceleration=Vector3r(*sample.linear_acceleration),
        )

    @rpc("getBarometerData")
    def barometer(self, name: str, vehicle: str = "") -> BarometerData:
        """Return the newest pressure of a barometer, and the altitude at QNH 1013.25 hPa."""
        sensor = self._find(BarometerAnnouncement, "barometer", name, vehicle)
        if (newest := self._newest.get(sensor.source)) is None:
            return BarometerData()
        pressure = newest.sample.fluid_pressure
        return BarometerData(newest.sample.stamp, altitude_at(pressure), pressure)

    @rpc("getMagnetometerData")
    def magnetometer(self, name: str, vehicle: str = "") -> MagnetometerData:
        """Return the newest field of a magnetometer, Gauss; the covariance is empty."""
        sensor = self._find(MagnetometerAnnouncement, "magnetometer", name, vehicle)
        if (newest := self._newest.get(sensor.source)) is None:
            return MagnetometerData()
        x, y, z = newest.sample.magnetic_field
        return MagnetometerData(newest.sample.stamp, Vector3r(x / GAUSS, y / GAUSS, z / GAUSS))

    @rpc("getGpsData")
    def gps(self, name: str, vehicle: str = "") -> GpsData:
        """Return the newest fix of a satellite receiver; `eph` and `epv` are standard deviations.

        Its name is ``gps``, as AirSim calls it by default, or ``gnss``.
        """
        name = "gnss" if name == "gps" else name
        sensor = self._find(NavSatAnnouncement, "gps", name, vehicle)
        if (newest := self._newest.get(sensor.source)) is None:
            return GpsData()
        fix = newest.sample
        covariance = fix.position_covariance or (0.0,) * 9
        eph, epv = math.sqrt(covariance[0]), math.sqrt(covariance[8])
        report = GnssReport(
            geo_point=GeoPoint(fix.latitude, fix.longitude, fix.altitude),
            eph=eph,
            epv=epv,
            velocity=Vector3r(*fix.velocity),
            fix_type=3 if fix.status >= 0 else 2 if eph <= MOST_UNCERTAIN_2D else 0,
            time_utc=fix.stamp // 1000,
        )
        return GpsData(fix.stamp, report, is_valid=True)

    @rpc("getDistanceSensorData")
    def distance(self, name: str, vehicle: str = "") -> DistanceSensorData:
        """Return the newest range of a range finder; its limits if nothing or too much is near."""
        sensor = self._find(RangeAnnouncement, "distance sensor", name, vehicle)
        pose = Pose(Vector3r(*sensor.position), Quaternionr(*sensor.orientation))
        low, high = sensor.min_range, sensor.max_range
        if (newest := self._newest.get(sensor.source)) is None:
            return DistanceSensorData(0, 0.0, low, high, pose)
        found = min(max(newest.sample.range, low), high)
        return DistanceSensorData(newest.sample.stamp, found, low, high, pose)

    @rpc("getLidarData")
    def lidar(self, caller: Caller, name: str, vehicle: str = "") -> LidarData | CosysLidarData:
        """Return the newest whole turn of a lidar, channel by channel, freed of the motion's skew.

        Each ray is placed by where the sensor was at its own time. The stamp and the pose are of
        the first ray. `segmentation` is -1, and Cosys' `groundtruth` is empty text, for all points.
        """
        sensor = self._find(LidarAnnouncement, "lidar", name, vehicle)
        newest = self._newest.get(sensor.source)
        if newest is None:
            return CosysLidarData() if caller.flavour == "cosys" else LidarData()
        scan = newest.sample
        served = self._server.find_multirotor(vehicle)
        places, turns = _poses(served.physics, sensor, scan)
        places -= served.origin
        points = _at_their_times(scan, places, turns)
        if self._server.config.lidar_frame == "SensorLocalFrame":
            points = turns[0].inv().apply(points - places[0])
        cloud = wire.float_array(points[np.argsort(scan.rings, kind="stable")])
        turn = turns[0].as_quat(scalar_first=True).tolist()
        pose = Pose(Vector3r(*places[0].tolist()), Quaternionr(*turn))
        if caller.flavour == "cosys":
            return CosysLidarData(scan.stamp, cloud, pose, ("",) * len(points))
        return LidarData(scan.stamp, cloud, pose, (-1,) * len(points))

    def _find(self, kind: type[A], called: str, name: str, vehicle: str) -> A:
        """Return a sensor; of an empty name the first of its kind.

        Raises:
            RpcError: There is none.
        """
        prefix = self._server.find_multirotor(vehicle).name + "/"
        name = self._server.config.sensor_names.get(name, name)
        for source, sensor in self._announced.items():
            own = source.removeprefix(prefix) if source.startswith(prefix) else ""
            if isinstance(sensor, kind) and own and name in ("", own):
                return sensor
        raise RpcError(f"No {called} with name {name} exist on vehicle")


def _poses(physics: Any, sensor: Any, scan: LidarScan) -> tuple[Any, Any]:
    """Return the sensor's pose at each millisecond of a scan: metres in ``map``, shape (n, 3)."""
    stamps = range(scan.stamp, scan.end + TIMESTEP_NS, TIMESTEP_NS)
    history = physics.simulation.history
    places: list[Vector3] = []
    turns: list[Quaternion] = []
    for stamp in stamps:
        state = physics.state_in(*history.at(stamp))
        lever = rotate(state.orientation, sensor.position)
        x, y, z = (a + b for a, b in zip(state.position, lever, strict=True))
        places.append((x, y, z))
        turns.append(multiply(state.orientation, sensor.orientation))
    return np.array(places), Rotation.from_quat(turns, scalar_first=True)


def _at_their_times(scan: LidarScan, places: Any, turns: Any) -> Any:
    """Return a scan's points, each placed by the sensor's pose at its own time, shape (n, 3).

    As `sims.sensors.scanner` takes them: the place of the nearest millisecond, and the rotation
    between two.
    """
    steps = scan.times.astype(np.float64) / (TIMESTEP_NS * 1e-9)
    last = len(places) - 1
    whole = np.minimum(steps.astype(np.intp), last)
    quaternions = turns.as_quat()
    before, after = quaternions[whole], quaternions[np.minimum(whole + 1, last)]
    after = after * np.where((before * after).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    between = before + (steps - whole)[:, None] * (after - before)
    nearest = np.minimum(np.rint(steps).astype(np.intp), last)
    if not len(steps):
        return np.empty((0, 3))
    return places[nearest] + Rotation.from_quat(between).apply(scan.points)
