"""Methods that read sensors: the newest sample that a vehicle's node has sent, as AirSim has it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from events import Announcement, Event, announcements, sensors
from events.frames import multiply, rotate
from sims.airsim import structures, wire
from sims.airsim.server.methods import Caller, RpcError, rpc
from sims.airsim.server.vehicles import ServedMultirotor
from sims.airsim.structures import GeoPoint, Pose, Quaternionr, Vector3r
from sims.sensors.earth import altitude_at
from sims.vehicle import TIMESTEP_NS

if TYPE_CHECKING:
    from sims.airsim.server.node import AirsimServer

GAUSS = 1e-4
"""Tesla."""

MOST_UNCERTAIN_2D = 4.0
"""Metres of horizontal uncertainty up to which AirSim's receiver has a fix in the plane."""

SAMPLES = (
    *(sensors.Imu, sensors.FluidPressure, sensors.MagneticField),
    *(sensors.NavSatFix, sensors.Range, sensors.LidarScan),
)
"""Events that are samples of sensors."""


class Sensors:
    """The sensors of all vehicles, known by their announcements.

    Before a sensor's first sample all its numbers and its stamp are 0.
    """

    def __init__(self, server: AirsimServer) -> None:
        self._server = server
        self._announced: dict[str, Announcement] = {}
        self._newest: dict[str, Any] = {}
        self._orientations: dict[str, Quaternionr] = {}

    def announced(self, announcement: Announcement) -> None:
        """Take note of a vehicle's sensor."""
        vehicle = self._server.vehicles.get(announcement.source.partition("/")[0])
        if isinstance(vehicle, ServedMultirotor):
            self._announced[announcement.source] = announcement
            if isinstance(announcement, announcements.LidarAnnouncement):
                # A turn, and one until the next is there.
                self._server.world.remember(2.1 / announcement.rate + announcement.latency)

    def note(self, sample: Event) -> None:
        """Take note of a sample, and with an IMU's of the true orientation at its stamp."""
        if sample.source in self._announced:
            self._newest[sample.source] = sample
            if isinstance(sample, sensors.Imu):
                vehicle = self._server.find_multirotor(sample.source.partition("/")[0])
                turn = Quaternionr(*vehicle.physics.state().orientation)
                self._orientations[sample.source] = turn

    @rpc("getImuData")
    def imu(self, name: str, vehicle: str = "") -> structures.ImuData:
        """Return the newest sample of an IMU, with the true orientation at its stamp."""
        sensor, sample = self._read(announcements.ImuAnnouncement, "IMU", name, vehicle)
        if sample is None:
            turn = self._server.find_multirotor(vehicle).state().orientation
            return structures.ImuData(orientation=Quaternionr(*turn))
        return structures.ImuData(
            sample.stamp,
            self._orientations[sensor.source],
            Vector3r(*sample.angular_velocity),
            Vector3r(*sample.linear_acceleration),
        )

    @rpc("getBarometerData")
    def barometer(self, name: str, vehicle: str = "") -> structures.BarometerData:
        """Return the newest pressure of a barometer, and the altitude at QNH 1013.25 hPa."""
        kind = announcements.BarometerAnnouncement
        _, sample = self._read(kind, "barometer", name, vehicle)
        if sample is None:
            return structures.BarometerData()
        pressure = sample.fluid_pressure
        return structures.BarometerData(sample.stamp, altitude_at(pressure), pressure)

    @rpc("getMagnetometerData")
    def magnetometer(self, name: str, vehicle: str = "") -> structures.MagnetometerData:
        """Return the newest field of a magnetometer, Gauss; the covariance is empty."""
        kind = announcements.MagnetometerAnnouncement
        _, sample = self._read(kind, "magnetometer", name, vehicle)
        if sample is None:
            return structures.MagnetometerData()
        field = Vector3r(*(component / GAUSS for component in sample.magnetic_field))
        return structures.MagnetometerData(sample.stamp, field)

    @rpc("getGpsData")
    def gps(self, name: str, vehicle: str = "") -> structures.GpsData:
        """Return the newest fix of a satellite receiver; `eph` and `epv` are standard deviations.

        Its name is ``gps``, as AirSim calls it by default, or ``gnss``.
        """
        name = "gnss" if name == "gps" else name
        _, fix = self._read(announcements.NavSatAnnouncement, "gps", name, vehicle)
        if fix is None:
            return structures.GpsData()
        covariance = fix.position_covariance or (0.0,) * 9
        eph, epv = math.sqrt(covariance[0]), math.sqrt(covariance[8])
        fix_type = 3 if fix.status >= 0 else 2 if eph <= MOST_UNCERTAIN_2D else 0
        place = GeoPoint(fix.latitude, fix.longitude, fix.altitude)
        velocity = Vector3r(*fix.velocity)
        report = structures.GnssReport(place, eph, epv, velocity, fix_type, fix.stamp // 1000)
        return structures.GpsData(fix.stamp, report, is_valid=True)

    @rpc("getDistanceSensorData")
    def distance(self, name: str, vehicle: str = "") -> structures.DistanceSensorData:
        """Return the newest range of a range finder; its limits if nothing or too much is near."""
        kind = announcements.RangeAnnouncement
        sensor, sample = self._read(kind, "distance sensor", name, vehicle)
        low, high = sensor.min_range, sensor.max_range
        found = 0.0 if sample is None else min(max(sample.range, low), high)
        return structures.DistanceSensorData(
            0 if sample is None else sample.stamp,
            found,
            low,
            high,
            Pose(Vector3r(*sensor.position), Quaternionr(*sensor.orientation)),
        )

    @rpc("getLidarData")
    def lidar(
        self, caller: Caller, name: str, vehicle: str = ""
    ) -> structures.LidarData | structures.CosysLidarData:
        """Return the newest whole turn of a lidar, channel by channel, freed of the motion's skew.

        Each ray is placed by where the sensor was at its own time. The stamp and the pose are of
        the first ray. `segmentation` is -1, and Cosys' `groundtruth` is empty text, for all points.
        """
        sensor, scan = self._read(announcements.LidarAnnouncement, "lidar", name, vehicle)
        is_cosys = caller.flavour == "cosys"
        if scan is None:
            return structures.CosysLidarData() if is_cosys else structures.LidarData()
        served = self._server.find_multirotor(vehicle)
        places, turns = _poses(served.physics, sensor, scan)
        places -= served.origin
        steps = scan.times.astype(np.float64) / (TIMESTEP_NS * 1e-9)
        # As `sims.sensors.lidar` takes them: the place of the nearest millisecond.
        points = scan.points.astype(np.float64)
        if len(points):
            between = Slerp(np.arange(len(places)), turns)(np.minimum(steps, len(places) - 1))
            points = places[np.rint(steps).astype(np.intp)] + between.apply(points)
        if self._server.config.lidar_frame == "SensorLocalFrame":
            points = turns[0].inv().apply(points - places[0])
        cloud = wire.float_array(points[np.argsort(scan.rings, kind="stable")])
        turn = turns[0].as_quat(scalar_first=True).tolist()
        pose = Pose(Vector3r(*places[0].tolist()), Quaternionr(*turn))
        if is_cosys:
            return structures.CosysLidarData(scan.stamp, cloud, pose, ("",) * len(points))
        return structures.LidarData(scan.stamp, cloud, pose, (-1,) * len(points))

    def _read(self, kind: type, called: str, name: str, vehicle: str) -> tuple[Any, Any]:
        """Return a sensor's announcement and newest sample; of an empty name the first's.

        Raises:
            RpcError: There is none.
        """
        prefix = self._server.find_multirotor(vehicle).name + "/"
        name = self._server.config.sensor_names.get(name, name)
        for source, sensor in self._announced.items():
            own = source.removeprefix(prefix) if source.startswith(prefix) else ""
            if isinstance(sensor, kind) and own and name in ("", own):
                return sensor, self._newest.get(source)
        raise RpcError(f"No {called} with name {name} exist on vehicle")


def _poses(physics: Any, sensor: Any, scan: Any) -> tuple[Any, Rotation]:
    """Return the sensor's pose at each millisecond of a scan: metres in ``map``, shape (n, 3)."""
    places, turns = [], []
    for stamp in range(scan.stamp, scan.end + 2 * TIMESTEP_NS, TIMESTEP_NS):
        state = physics.state_in(*physics.simulation.history.at(min(stamp, physics.time_ns)))
        places.append(np.add(state.position, rotate(state.orientation, sensor.position)))
        turns.append(multiply(state.orientation, sensor.orientation))
    return np.array(places), Rotation.from_quat(turns, scalar_first=True)
