"""What sensors measure.

Arrays are checked and made read-only when the event is made: what has been sent does not change,
and an image passes from node to node by reference.
"""

from __future__ import annotations

from typing import Any, ClassVar

import msgspec
import numpy as np
import numpy.typing as npt

from events.base import Category, Event, Quaternion, Vector3
from events.checks import check, check_pose


def publish(owner: str, name: str, array: Any, dtype: type, ndim: set[int]) -> None:
    """Make `array` read-only, or report how it differs from what the field holds."""
    if not isinstance(array, np.ndarray) or array.dtype != dtype or array.ndim not in ndim:
        found = (
            f"{array.dtype} of shape {array.shape}"
            if isinstance(array, np.ndarray)
            else type(array).__name__
        )
        dims = " or ".join(str(n) for n in sorted(ndim))
        raise TypeError(
            f"{owner}.{name}: expected a {dims}-dimensional {np.dtype(dtype)} array, found {found}"
        )
    array.setflags(write=False)


class CameraInfo(msgspec.Struct, frozen=True, kw_only=True):
    """Pinhole intrinsics in OpenCV's convention: pixel *centres* have whole coordinates.

    A point (x, y, z) in the optical frame falls on column ``fx·x/z + cx``, row ``fy·y/z + cy``.

    Attributes:
        width: Pixels.
        height: Pixels.
        fx: Focal length in pixels along the columns.
        fy: Focal length in pixels along the rows.
        cx: Principal point, column; ``(width - 1) / 2`` for an ideal camera.
        cy: Principal point, row.
        distortion: plumb_bob coefficients (k1, k2, p1, p2, k3); zeros for an ideal camera.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)

    @classmethod
    def from_fov(cls, width: int, height: int, horizontal_fov: float) -> CameraInfo:
        """Make an ideal camera with square pixels from its horizontal field of view (radians)."""
        focal = width / (2.0 * np.tan(horizontal_fov / 2.0))
        return cls(
            width=width,
            height=height,
            fx=float(focal),
            fy=float(focal),
            cx=(width - 1) / 2,
            cy=(height - 1) / 2,
        )

    def matrix(self) -> npt.NDArray[np.float64]:
        """Return K, shape (3, 3), as OpenCV takes it."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])


class Image(Event, eq=False):
    """A colour or grey image, as ROS's ``sensor_msgs/Image``.

    Attributes:
        frame_id: Optical frame.
        encoding: ``rgb8`` or ``mono8``.
        data: uint8, shape (height, width, 3) for ``rgb8``, (height, width) for ``mono8``.
    """

    category: ClassVar[Category] = Category.SENSOR

    frame_id: str
    encoding: str = "rgb8"
    data: npt.NDArray[np.uint8]

    def __post_init__(self) -> None:
        check(self)
        publish("Image", "data", self.data, np.uint8, {2, 3})


class DepthImage(Event, eq=False):
    """Planar depth (along the optical z axis, not along the ray), REP 118's ``32FC1``.

    Attributes:
        frame_id: Optical frame.
        data: float32 metres, shape (height, width); ``inf`` where nothing was hit.
    """

    category: ClassVar[Category] = Category.SENSOR

    frame_id: str
    data: npt.NDArray[np.float32]

    def __post_init__(self) -> None:
        check(self)
        publish("DepthImage", "data", self.data, np.float32, {2})


class SegmentationImage(Event, eq=False):
    """Which object each pixel shows.

    Attributes:
        frame_id: Optical frame.
        data: int32 object numbers, shape (height, width); -1 where nothing was hit.
    """

    category: ClassVar[Category] = Category.SENSOR

    frame_id: str
    data: npt.NDArray[np.int32]

    def __post_init__(self) -> None:
        check(self)
        publish("SegmentationImage", "data", self.data, np.int32, {2})


class Imu(Event):
    """Inertial measurement, as ROS's ``sensor_msgs/Imu`` without the orientation.

    Attributes:
        frame_id: Frame of the measurement.
        angular_velocity: Radians per second in that frame.
        linear_acceleration: Specific force, metres per second squared in that frame
            (at rest, in FRD: about (0, 0, -9.81)).
    """

    category: ClassVar[Category] = Category.SENSOR

    frame_id: str = "base_link"
    angular_velocity: Vector3
    linear_acceleration: Vector3

    def __post_init__(self) -> None:
        check(self, self.angular_velocity, self.linear_acceleration)


class FluidPressure(Event):
    """Barometer, as ROS's ``sensor_msgs/FluidPressure``.

    Attributes:
        fluid_pressure: Pascal.
        variance: Pascal squared; 0 if unknown.
    """

    category: ClassVar[Category] = Category.SENSOR

    fluid_pressure: float
    variance: float = 0.0

    def __post_init__(self) -> None:
        check(self, (self.fluid_pressure, self.variance, 0.0))


class MagneticField(Event):
    """Magnetometer, as ROS's ``sensor_msgs/MagneticField``.

    Attributes:
        magnetic_field: Tesla in the body frame.
    """

    category: ClassVar[Category] = Category.SENSOR

    magnetic_field: Vector3

    def __post_init__(self) -> None:
        check(self, self.magnetic_field)


class NavSatFix(Event):
    """Satellite position, as ROS's ``sensor_msgs/NavSatFix``.

    Attributes:
        latitude: Degrees north.
        longitude: Degrees east.
        altitude: Metres above the WGS 84 ellipsoid.
    """

    category: ClassVar[Category] = Category.SENSOR

    latitude: float
    longitude: float
    altitude: float

    def __post_init__(self) -> None:
        check(self, (self.latitude, self.longitude, self.altitude))


class Range(Event):
    """Distance sensor, as ROS's ``sensor_msgs/Range``.

    Attributes:
        range: Metres; ``inf`` if nothing is in reach.
        min_range: Metres.
        max_range: Metres.
    """

    category: ClassVar[Category] = Category.SENSOR

    range: float
    min_range: float
    max_range: float

    def __post_init__(self) -> None:
        check(self)


class LaserScan3D(Event, eq=False):
    """One sweep of a lidar.

    Attributes:
        frame_id: Frame of the points.
        points: float32 metres, shape (n, 3).
        orientation: Rotation from the sensor to ``map`` when it was taken.
    """

    category: ClassVar[Category] = Category.SENSOR

    frame_id: str
    points: npt.NDArray[np.float32]
    orientation: Quaternion = (1.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        check_pose(self, (0.0, 0.0, 0.0), self.orientation)
        publish("LaserScan3D", "points", self.points, np.float32, {2})
