"""Measurements of sensors, and the table of the kinds of sensors.

Arrays are checked and made read-only when the event is made: what has been sent does not change,
and an image passes from node to node by reference.
"""

from __future__ import annotations

import msgspec
import numpy as np
import numpy.typing as npt

from events.announcements import (
    Announcement,
    BarometerAnnouncement,
    ImuAnnouncement,
    LidarAnnouncement,
    MagnetometerAnnouncement,
    NavSatAnnouncement,
    RangeAnnouncement,
)
from events.base import Category, Event, Vector3, check, check_covariance, publish


class Image(Event, category=Category.SENSOR, eq=False):
    """A colour or grey image, as ROS's ``sensor_msgs/Image``.

    Attributes:
        frame_id: Optical frame.
        encoding: ``rgb8`` or ``mono8``.
        exposure_time: Seconds that the shutter was open; 0 if that is unknown or no time.
        gain: Factor of the amplifier; 1 if unknown.
        data: uint8, shape (height, width, 3) for ``rgb8``, (height, width) for ``mono8``.
    """

    frame_id: str
    encoding: str = "rgb8"
    exposure_time: float = 0.0
    gain: float = 1.0
    data: npt.NDArray[np.uint8]

    def __post_init__(self) -> None:
        check(self)
        publish("Image", "data", self.data, np.uint8, {2, 3})


class DepthImage(Event, category=Category.SENSOR, eq=False):
    """Planar depth (along the optical z axis, not along the ray), REP 118's ``32FC1``.

    Attributes:
        frame_id: Optical frame.
        data: float32 metres, shape (height, width); ``inf`` where nothing was hit, or the sensor
            found no depth.
    """

    frame_id: str
    data: npt.NDArray[np.float32]

    def __post_init__(self) -> None:
        check(self)
        publish("DepthImage", "data", self.data, np.float32, {2})


class SegmentationImage(Event, category=Category.SENSOR, eq=False):
    """Object number of each pixel.

    Attributes:
        frame_id: Optical frame.
        data: int32 object numbers, shape (height, width); -1 where nothing was hit.
    """

    frame_id: str
    data: npt.NDArray[np.int32]

    def __post_init__(self) -> None:
        check(self)
        publish("SegmentationImage", "data", self.data, np.int32, {2})


class Imu(Event, category=Category.SENSOR):
    """Inertial measurement, as ROS's ``sensor_msgs/Imu`` without the orientation.

    Attributes:
        frame_id: Frame of the measurement.
        angular_velocity: Radians per second in that frame.
        linear_acceleration: Specific force, metres per second squared in that frame
            (at rest, in FRD: about (0, 0, -9.81)).
    """

    frame_id: str = "base_link"
    angular_velocity: Vector3
    linear_acceleration: Vector3

    def __post_init__(self) -> None:
        check(self, self.angular_velocity, self.linear_acceleration)


class FluidPressure(Event, category=Category.SENSOR):
    """Barometer, as ROS's ``sensor_msgs/FluidPressure``.

    Attributes:
        fluid_pressure: Pascal.
        variance: Pascal squared; 0 if unknown.
    """

    fluid_pressure: float
    variance: float = 0.0

    def __post_init__(self) -> None:
        check(self, (self.fluid_pressure, self.variance, 0.0))


class MagneticField(Event, category=Category.SENSOR):
    """Magnetometer, as ROS's ``sensor_msgs/MagneticField``.

    Attributes:
        frame_id: Frame of the measurement.
        magnetic_field: Tesla in that frame.
    """

    frame_id: str = "base_link"
    magnetic_field: Vector3

    def __post_init__(self) -> None:
        check(self, self.magnetic_field)


class NavSatFix(Event, category=Category.SENSOR):
    """Satellite position, as ROS's ``sensor_msgs/NavSatFix``.

    Attributes:
        latitude: Degrees north.
        longitude: Degrees east.
        altitude: Metres above the WGS 84 ellipsoid.
        position_covariance: Of (north, east, down), m²: 9 numbers, row by row; empty if unknown.
        velocity: Of the antenna, metres per second in ``map``, as receivers measure it by Doppler
            shift.
        status: As ROS's ``sensor_msgs/NavSatStatus``: 0 is a fix, -1 none yet.
    """

    latitude: float
    longitude: float
    altitude: float
    position_covariance: tuple[float, ...] = ()
    velocity: Vector3 = (0.0, 0.0, 0.0)
    status: int = 0

    def __post_init__(self) -> None:
        check(self, (self.latitude, self.longitude, self.altitude), self.velocity)
        check_covariance(self, "position_covariance", 3)


class Range(Event, category=Category.SENSOR):
    """Distance sensor, as ROS's ``sensor_msgs/Range``.

    Attributes:
        frame_id: Frame of the sensor, which looks along its x axis.
        range: Metres; ``inf`` if nothing is in reach, ``-inf`` if something is too close (REP 117).
        field_of_view: Radians; 0 of a single ray.
        min_range: Metres.
        max_range: Metres.
    """

    frame_id: str = "base_link"
    range: float
    field_of_view: float = 0.0
    min_range: float
    max_range: float

    def __post_init__(self) -> None:
        check(self)


class LidarScan(Event, category=Category.SENSOR, eq=False):
    """A single turn of a lidar, like the ``sensor_msgs/PointCloud2`` of a ROS lidar driver.

    `stamp` is the time of the first ray. Each point is in the sensor's frame at the time of its own
    ray, `stamp` + its `times`: a moving sensor's cloud is skewed, as a real one's is. Rays that hit
    nothing give no point.

    Attributes:
        frame_id: Frame of the sensor: x forward, y right, z down.
        points: float32 metres, shape (n, 3).
        intensities: float32, 0 to 1, shape (n,).
        times: float32 seconds after `stamp`, shape (n,), not falling.
        rings: uint16 number of the ray's channel, 0 the uppermost, shape (n,).
    """

    frame_id: str
    points: npt.NDArray[np.float32]
    intensities: npt.NDArray[np.float32]
    times: npt.NDArray[np.float32]
    rings: npt.NDArray[np.uint16]

    def __post_init__(self) -> None:
        check(self)
        publish("LidarScan", "points", self.points, np.float32, {2})
        publish("LidarScan", "intensities", self.intensities, np.float32, {1})
        publish("LidarScan", "times", self.times, np.float32, {1})
        publish("LidarScan", "rings", self.rings, np.uint16, {1})
        count = len(self.times)
        if self.points.shape != (count, 3) or {len(self.intensities), len(self.rings)} != {count}:
            raise TypeError(
                f"LidarScan: expected points, intensities and rings of {count} times, found "
                f"shapes {self.points.shape}, {self.intensities.shape}, {self.rings.shape}"
            )

    @property
    def end(self) -> int:
        """Stamp of the last ray with a point, nanoseconds."""
        return self.stamp + (round(float(self.times[-1]) * 1e9) if len(self.times) else 0)


class SensorKind(msgspec.Struct, frozen=True, kw_only=True):
    """Kind of sensor: its events, and their names wherever they are sent, shown or written.

    Attributes:
        name: Name in settings: of the table of the sensor in a vehicle's, and in ``reads``.
        event: Type of the measurements.
        announcement: Type of the sensor's announcement.
        group: Name of the measurements in the plural: of the vehicle's output, the group of topics,
            and the part of the tree of plots.
        fields: Fields of a measurement that are numbers or vectors (x, y, z), with their units.
        plots: Titles of the plots with a place of their own, by field.
    """

    name: str
    event: type[Event]
    announcement: type[Announcement]
    group: str
    fields: dict[str, str] = {}
    plots: dict[str, str] = {}


SENSOR_KINDS = {
    kind.name: kind
    for kind in (
        SensorKind(
            name="imu",
            event=Imu,
            announcement=ImuAnnouncement,
            group="imu",
            fields={"angular_velocity": "rad/s", "linear_acceleration": "m/s²"},
            plots={
                "angular_velocity": "angular velocity",
                "linear_acceleration": "specific force",
            },
        ),
        SensorKind(
            name="barometer",
            event=FluidPressure,
            announcement=BarometerAnnouncement,
            group="pressures",
            fields={"fluid_pressure": "Pa"},
            plots={"fluid_pressure": "pressure"},
        ),
        SensorKind(
            name="magnetometer",
            event=MagneticField,
            announcement=MagnetometerAnnouncement,
            group="magnetic_fields",
            fields={"magnetic_field": "T"},
            plots={"magnetic_field": "magnetic field"},
        ),
        SensorKind(
            name="gnss",
            event=NavSatFix,
            announcement=NavSatAnnouncement,
            group="fixes",
            fields={"latitude": "°", "longitude": "°", "altitude": "m", "velocity": "m/s"},
            plots={"velocity": "satellite velocity"},
        ),
        SensorKind(
            name="range",
            event=Range,
            announcement=RangeAnnouncement,
            group="ranges",
            fields={"range": "m"},
            plots={"range": "range"},
        ),
        SensorKind(
            name="lidar",
            event=LidarScan,
            announcement=LidarAnnouncement,
            group="lidar_scans",
        ),
    )
}
"""The kinds of sensors, by name; those of other packages are in `runtime.sensors`."""


def numbers(event: Event, field: str) -> tuple[float, ...]:
    """Return the values of a measured field: a single number, or x, y and z."""
    value = getattr(event, field)
    return value if isinstance(value, tuple) else (value,)
