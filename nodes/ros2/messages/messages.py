"""Events to ROS messages that are small: as CDR, in ROS's frames. Images are in `images`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from events import (
    CameraAnnouncement,
    FluidPressure,
    Imu,
    ImuAnnouncement,
    MagneticField,
    MagnetometerAnnouncement,
    NavSatFix,
    Odometry,
    PoseEstimate,
    PoseStamped,
    Quaternion,
    Range,
    RangeAnnouncement,
    Score,
    SensorAnnouncement,
    Vector3,
    Wind,
)
from events.frames import Axes, convert_covariance, convert_rotation, convert_vector
from nodes.ros2.messages.calibration import projection_matrix
from nodes.ros2.messages.topics import FrameNames
from nodes.ros2.messages.typestore import Time, TypeStore

_ZEROS_9, _ZEROS_36 = np.zeros(9), np.zeros(36)
_UNKNOWN = np.array([-1.0, *[0.0] * 8])
"""A covariance that says: this is not measured (sensor_msgs/Imu)."""


class Transform(NamedTuple):
    """A frame in its parent, already in ROS's names and axes."""

    parent: str
    child: str
    translation: Vector3
    rotation: Quaternion


class Messages:
    """Makes messages."""

    def __init__(self, store: TypeStore, frames: FrameNames) -> None:
        self._store = store
        self._frames = frames
        names = {
            "vector": "geometry_msgs/msg/Vector3",
            "point": "geometry_msgs/msg/Point",
            "quaternion": "geometry_msgs/msg/Quaternion",
            "pose": "geometry_msgs/msg/Pose",
            "twist": "geometry_msgs/msg/Twist",
            "pose_covariance": "geometry_msgs/msg/PoseWithCovariance",
            "twist_covariance": "geometry_msgs/msg/TwistWithCovariance",
            "transform": "geometry_msgs/msg/Transform",
            "transform_stamped": "geometry_msgs/msg/TransformStamped",
        }
        self._make: dict[str, Any] = {name: store.message(type_) for name, type_ in names.items()}

    def odometry(self, time: Time, event: Odometry) -> bytearray:
        """Return a nav_msgs/Odometry: the pose in its parent, the twist in the body."""
        make, axes = self._make, self._frames.axes(event.child_frame_id)
        twist = make["twist"](
            linear=self._vector(convert_vector(axes, event.linear_velocity)),
            angular=self._vector(convert_vector(axes, event.angular_velocity)),
        )
        pose = self._pose(event.frame_id, axes, event.position, event.orientation)
        message = self._store.message("nav_msgs/msg/Odometry")(
            header=self._header(time, event.frame_id, event.source),
            child_frame_id=self._frames.name(event.child_frame_id, event.source),
            pose=make["pose_covariance"](pose=pose, covariance=_ZEROS_36),
            twist=make["twist_covariance"](twist=twist, covariance=_ZEROS_36),
        )
        return self._store.serialize(message)

    def pose(self, time: Time, event: PoseStamped | PoseEstimate, child: Axes) -> bytearray:
        """Return a geometry_msgs/PoseStamped; `child` are the axes of the frame that is placed."""
        message = self._store.message("geometry_msgs/msg/PoseStamped")(
            header=self._header(time, event.frame_id, event.source),
            pose=self._pose(event.frame_id, child, event.position, event.orientation),
        )
        return self._store.serialize(message)

    def pose_with_covariance(self, time: Time, event: PoseEstimate, child: Axes) -> bytearray:
        """Return a geometry_msgs/PoseWithCovarianceStamped; zeros if nothing is known."""
        covariance = _ZEROS_36
        if event.covariance:
            axes = self._frames.axes(event.frame_id)
            covariance = convert_covariance(axes, np.array(event.covariance))
        pose = self._pose(event.frame_id, child, event.position, event.orientation)
        message = self._store.message("geometry_msgs/msg/PoseWithCovarianceStamped")(
            header=self._header(time, event.frame_id, event.source),
            pose=self._make["pose_covariance"](pose=pose, covariance=covariance),
        )
        return self._store.serialize(message)

    def imu(self, time: Time, event: Imu, noise: ImuAnnouncement | None) -> bytearray:
        """Return a sensor_msgs/Imu without orientation.

        The covariances are those of one sample: squared noise density times rate.
        """
        axes = self._frames.axes(event.frame_id)
        gyroscope = accelerometer = _ZEROS_9
        if noise is not None:
            gyroscope = _diagonal(noise.gyroscope_noise_density**2 * noise.rate)
            accelerometer = _diagonal(noise.accelerometer_noise_density**2 * noise.rate)
        message = self._store.message("sensor_msgs/msg/Imu")(
            header=self._header(time, event.frame_id, event.source),
            orientation=self._make["quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
            orientation_covariance=_UNKNOWN,
            angular_velocity=self._vector(convert_vector(axes, event.angular_velocity)),
            angular_velocity_covariance=gyroscope,
            linear_acceleration=self._vector(convert_vector(axes, event.linear_acceleration)),
            linear_acceleration_covariance=accelerometer,
        )
        return self._store.serialize(message)

    def camera_info(self, time: Time, camera: CameraAnnouncement) -> bytearray:
        """Return a sensor_msgs/CameraInfo: K, D, R (one) and P, with a stereo rig's baseline."""
        info = camera.info
        message = self._store.message("sensor_msgs/msg/CameraInfo")(
            header=self._header(time, camera.frame_id),
            height=info.height,
            width=info.width,
            distortion_model=info.distortion_model,
            d=np.array(info.distortion, np.float64),
            k=info.matrix().ravel(),
            r=np.eye(3).ravel(),
            p=projection_matrix(camera).ravel(),
            binning_x=0,
            binning_y=0,
            roi=self._store.message("sensor_msgs/msg/RegionOfInterest")(
                x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
            ),
        )
        return self._store.serialize(message)

    def transforms(self, time: Time, transforms: Iterable[Transform]) -> bytearray:
        """Return a tf2_msgs/TFMessage."""
        make = self._make
        message = self._store.message("tf2_msgs/msg/TFMessage")(
            transforms=[
                make["transform_stamped"](
                    header=self._store.header(time, each.parent),
                    child_frame_id=each.child,
                    transform=make["transform"](
                        translation=self._vector(each.translation),
                        rotation=self._quaternion(each.rotation),
                    ),
                )
                for each in transforms
            ]
        )
        return self._store.serialize(message)

    def clock(self, time: Time) -> bytearray:
        """Return a rosgraph_msgs/Clock."""
        stamp = self._store.message("builtin_interfaces/msg/Time")(sec=time[0], nanosec=time[1])
        return self._store.serialize(self._store.message("rosgraph_msgs/msg/Clock")(clock=stamp))

    def range(self, time: Time, event: Range, sensor: RangeAnnouncement | None = None) -> bytearray:
        """Return a sensor_msgs/Range of a sensor that looks along its frame's x axis."""
        type_ = self._store.message("sensor_msgs/msg/Range")
        more = {}
        if "variance" in type_.__annotations__:  # since Iron; 0 says: not known
            more["variance"] = 0.0 if sensor is None else sensor.noise**2
        message = type_(
            header=self._header(time, event.frame_id, event.source),
            radiation_type=type_.INFRARED,
            field_of_view=event.field_of_view,
            min_range=event.min_range,
            max_range=event.max_range,
            range=event.range,
            **more,
        )
        return self._store.serialize(message)

    def pressure(
        self, time: Time, event: FluidPressure, sensor: SensorAnnouncement | None = None
    ) -> bytearray:
        """Return a sensor_msgs/FluidPressure."""
        message = self._store.message("sensor_msgs/msg/FluidPressure")(
            header=self._header(time, _frame(sensor), event.source),
            fluid_pressure=event.fluid_pressure,
            variance=event.variance,
        )
        return self._store.serialize(message)

    def magnetic_field(
        self, time: Time, event: MagneticField, sensor: MagnetometerAnnouncement | None = None
    ) -> bytearray:
        """Return a sensor_msgs/MagneticField; a covariance of zeros says: not known."""
        axes = self._frames.axes(event.frame_id)
        message = self._store.message("sensor_msgs/msg/MagneticField")(
            header=self._header(time, event.frame_id, event.source),
            magnetic_field=self._vector(convert_vector(axes, event.magnetic_field)),
            magnetic_field_covariance=_ZEROS_9 if sensor is None else _diagonal(sensor.noise**2),
        )
        return self._store.serialize(message)

    def fix(
        self, time: Time, event: NavSatFix, sensor: SensorAnnouncement | None = None
    ) -> bytearray:
        """Return a sensor_msgs/NavSatFix, whose status is the event's; its covariance is in ENU."""
        status = self._store.message("sensor_msgs/msg/NavSatStatus")
        type_ = self._store.message("sensor_msgs/msg/NavSatFix")
        covariance, known = _ZEROS_9, type_.COVARIANCE_TYPE_UNKNOWN
        if event.position_covariance:
            covariance = convert_covariance("world", np.array(event.position_covariance))
            known = type_.COVARIANCE_TYPE_KNOWN
        message = type_(
            header=self._header(time, _frame(sensor), event.source),
            status=status(status=event.status, service=status.SERVICE_GPS),
            latitude=event.latitude,
            longitude=event.longitude,
            altitude=event.altitude,
            position_covariance=covariance,
            position_covariance_type=known,
        )
        return self._store.serialize(message)

    def fix_velocity(self, time: Time, event: NavSatFix) -> bytearray:
        """Return a geometry_msgs/TwistStamped of a receiver's velocity, in ``map``."""
        linear = self._vector(convert_vector("world", event.velocity))
        message = self._store.message("geometry_msgs/msg/TwistStamped")(
            header=self._header(time, "map"),
            twist=self._make["twist"](linear=linear, angular=self._vector((0.0, 0.0, 0.0))),
        )
        return self._store.serialize(message)

    def wind(self, time: Time, event: Wind) -> bytearray:
        """Return a geometry_msgs/Vector3Stamped of the air's velocity, in ``map``."""
        message = self._store.message("geometry_msgs/msg/Vector3Stamped")(
            header=self._header(time, "map"),
            vector=self._vector(convert_vector("world", event.velocity)),
        )
        return self._store.serialize(message)

    def score(self, event: Score) -> bytearray:
        """Return a std_msgs/Float64."""
        return self._store.serialize(self._store.message("std_msgs/msg/Float64")(data=event.value))

    def _header(self, time: Time, frame_id: str, source: str = "") -> Any:
        return self._store.header(time, self._frames.name(frame_id, source))

    def _pose(self, parent: str, child: Axes, position: Vector3, orientation: Quaternion) -> Any:
        axes = self._frames.axes(parent)
        x, y, z = convert_vector(axes, position)
        return self._make["pose"](
            position=self._make["point"](x=x, y=y, z=z),
            orientation=self._quaternion(convert_rotation(axes, child, orientation)),
        )

    def _vector(self, vector: Vector3) -> Any:
        x, y, z = vector
        return self._make["vector"](x=x, y=y, z=z)

    def _quaternion(self, rotation: Quaternion) -> Any:
        w, x, y, z = rotation
        return self._make["quaternion"](x=x, y=y, z=z, w=w)


def _frame(sensor: SensorAnnouncement | None) -> str:
    return "base_link" if sensor is None else sensor.frame_id


def _diagonal(variance: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.diag([variance] * 3).ravel()
