"""Events to ROS messages, in ROS's frames and axes: a function for each row of `mappings`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from events import (
    Announcement,
    BodyAnnouncement,
    CameraAnnouncement,
    DepthImage,
    Event,
    FluidPressure,
    Image,
    Imu,
    LidarScan,
    MagneticField,
    NavSatFix,
    Odometry,
    PointCloud,
    PoseEstimate,
    PoseStamped,
    Quaternion,
    Range,
    Score,
    SegmentationImage,
    TransformStamped,
    Vector3,
    Wind,
)
from events.frames import Axes, convert_covariance, convert_points, convert_rotation, convert_vector
from nodes.ros2.messages import images
from nodes.ros2.messages.images import COMPRESSED, LIDAR_POINT, POINT, ImageWriter
from nodes.ros2.messages.topics import FrameNames, PublishingConfig
from nodes.ros2.messages.transforms import Paths, Transform, Transforms
from nodes.ros2.messages.typestore import Time, TypeStore

_ZEROS_9, _ZEROS_36 = np.zeros(9), np.zeros(36)
_UNKNOWN = np.array([-1.0, *[0.0] * 8])  # covariance of an unmeasured quantity (sensor_msgs/Imu)


class Outgoing:
    """Context of outgoing messages: types, frames, settings, announcements."""

    def __init__(
        self,
        store: TypeStore,
        config: PublishingConfig,
        time: Callable[[int], Time],  # returns the time in messages of a stamp (ns)
    ) -> None:
        self.store, self.config, self.time = store, config, time
        self.names = FrameNames()
        self.transforms = Transforms(self.names, config.vehicle, config.tf)
        self.paths = Paths(store, self.names, config)
        self.cameras: dict[str, CameraAnnouncement] = {}  # by source
        self.bodies: set[str] = set()  # sources of self-moving bodies
        # Announcement of a topic, by its kind and source.
        self.sensors: dict[tuple[str, str], Any] = {}
        self._writers: dict[tuple[str, str, str], ImageWriter] = {}

    def announced(self, announcement: Announcement) -> None:
        """Register an announcement."""
        if isinstance(announcement, CameraAnnouncement):
            self.cameras[announcement.source] = announcement
        elif isinstance(announcement, BodyAnnouncement):
            self.bodies.add(announcement.source)
        self.transforms.announced(announcement)

    def make(self, type_: str, **fields: Any) -> Any:
        """Return a message from all of its fields."""
        return self.store.message(type_)(**fields)

    def header(self, event: Any, frame_id: str | None = None) -> Any:
        """Return the header of an event's message, by default in the event's frame."""
        frame = self.names.name(event.frame_id if frame_id is None else frame_id, event.source)
        return self.store.header(self.time(event.stamp), frame)

    def image(self, event: Image | DepthImage | SegmentationImage, encoding: str) -> bytearray:
        """Return a ``sensor_msgs/msg/Image``, by a writer kept for later images."""
        key = event.source, self.names.name(event.frame_id, event.source), encoding
        if key not in self._writers:
            self._writers[key] = ImageWriter(self.store, *key[1:])
        return self._writers[key].write(self.time(event.stamp), event.data)

    def compressed(self, event: Image | DepthImage, form: str, data: Any) -> Any:
        """Return a ``sensor_msgs/msg/CompressedImage``."""
        return self.make(COMPRESSED, header=self.header(event), format=form, data=data)

    def rows(
        self, event: PointCloud | LidarScan, kind: np.dtype[np.void]
    ) -> tuple[bytearray, np.ndarray[Any, np.dtype[np.void]]]:
        """Return a cloud's message with its points in ROS's axes, and its rows for the rest."""
        points = convert_points(self.names.axes(event.frame_id), event.points)
        return images.cloud(self.store, self.header(event), points, kind)

    def xyz(self, vector: Vector3, type_: str = "geometry_msgs/msg/Vector3") -> Any:
        """Return a ``Vector3`` or ``Point`` of a vector in ROS's axes."""
        x, y, z = vector
        return self.make(type_, x=x, y=y, z=z)

    def vector(self, axes: Axes, vector: Vector3) -> Any:
        """Return a ``geometry_msgs/msg/Vector3`` of a vector in our axes."""
        return self.xyz(convert_vector(axes, vector))

    def quaternion(self, rotation: Quaternion) -> Any:
        """Return a ``geometry_msgs/msg/Quaternion`` of a rotation in ROS's axes."""
        w, x, y, z = rotation
        return self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def pose(self, event: Odometry | PoseStamped | PoseEstimate, child: Axes) -> Any:
        """Return a ``geometry_msgs/msg/Pose`` of a frame with these axes."""
        axes = self.names.axes(event.frame_id)
        return self.make(
            "geometry_msgs/msg/Pose",
            position=self.xyz(convert_vector(axes, event.position), "geometry_msgs/msg/Point"),
            orientation=self.quaternion(convert_rotation(axes, child, event.orientation)),
        )

    def twist(self, linear: Vector3, angular: Vector3) -> Any:
        """Return a ``geometry_msgs/msg/Twist`` of vectors in ROS's axes."""
        vectors = self.xyz(linear), self.xyz(angular)
        return self.make("geometry_msgs/msg/Twist", linear=vectors[0], angular=vectors[1])

    def with_covariance(self, part: str, value: Any, covariance: Any = _ZEROS_36) -> Any:
        """Return a ``PoseWithCovariance`` or ``TwistWithCovariance``; zeros: nothing is known."""
        fields = {part: value, "covariance": covariance}
        return self.make(f"geometry_msgs/msg/{part.capitalize()}WithCovariance", **fields)

    def tree(self, time: Time, transforms: Sequence[Transform]) -> Any:
        """Return a ``tf2_msgs/msg/TFMessage``, if there are any transforms."""
        messages = [
            self.make(
                "geometry_msgs/msg/TransformStamped",
                header=self.store.header(time, transform.parent),
                child_frame_id=transform.child,
                transform=self.make(
                    "geometry_msgs/msg/Transform",
                    translation=self.xyz(transform.translation),
                    rotation=self.quaternion(transform.rotation),
                ),
            )
            for transform in transforms
        ]
        return self.make("tf2_msgs/msg/TFMessage", transforms=messages) if messages else None


def nothing(*_: Any) -> None:
    """Make no message."""


# Images and point clouds, which take long: in threads, one for each type of event.


def camera_info(out: Outgoing, event: Image | DepthImage) -> Any:
    """Return a sensor_msgs/CameraInfo: K, D, R (identity) and P, with a stereo baseline."""
    camera = out.cameras[event.source]
    info = camera.info
    no_region = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
    # K, and of a stereo rig's right camera -fx times its baseline.
    projection = np.column_stack([info.matrix(), [0.0 - info.fx * camera.baseline, 0.0, 0.0]])
    return out.make(
        "sensor_msgs/msg/CameraInfo",
        header=out.header(event, camera.frame_id),
        height=info.height,
        width=info.width,
        distortion_model=info.distortion_model,
        d=np.array(info.distortion, np.float64),
        k=info.matrix().ravel(),
        r=np.eye(3).ravel(),
        p=projection.ravel(),
        binning_x=0,
        binning_y=0,
        roi=out.make("sensor_msgs/msg/RegionOfInterest", **no_region),
    )


def image(out: Outgoing, event: Image) -> bytearray:
    """Return a sensor_msgs/Image of colours or grey."""
    return out.image(event, event.encoding)


def compressed_image(out: Outgoing, event: Image) -> Any:
    """Return a sensor_msgs/CompressedImage as image_transport's plugin does."""
    form, colour = out.config.compressed_images or "png", event.data.ndim == 3
    names = ("rgb8", "bgr8") if colour else ("mono8", "mono8")
    code = images.encode_image(event.data, form, out.config.jpeg_quality)
    return out.compressed(event, f"{names[0]}; {form} compressed {names[1]}", code)


def depth(out: Outgoing, event: DepthImage) -> bytearray:
    """Return a sensor_msgs/Image of metres or millimetres."""
    encoding = "16UC1" if out.config.raw_depth == "millimetres" else "32FC1"
    return out.image(event, encoding)


def compressed_depth(out: Outgoing, event: DepthImage) -> Any:
    """Return a sensor_msgs/CompressedImage of depth."""
    config, inverse = out.config, out.config.compressed_depth == "inverse"
    if inverse:
        code = images.inverse_depth(event.data, config.depth_max, config.depth_quantization)
    else:
        code = images.depth_in_millimetres(event.data)
    form = f"{'32FC1' if inverse else '16UC1'}; compressedDepth png"
    return out.compressed(event, form, np.frombuffer(code, np.uint8))


def segmentation(out: Outgoing, event: SegmentationImage) -> bytearray:
    """Return a sensor_msgs/Image of numbers."""
    return out.image(event, "32SC1")


def cloud(out: Outgoing, event: PointCloud) -> bytearray:
    """Return a sensor_msgs/PointCloud2 with colours: white where there are none."""
    message, rows = out.rows(event, POINT)
    rows["bgr"] = event.colors[:, ::-1] if len(event.colors) else 255
    return message


def lidar(out: Outgoing, event: LidarScan) -> bytearray:
    """Return a sensor_msgs/PointCloud2 of a lidar's turn."""
    message, rows = out.rows(event, LIDAR_POINT)
    rows["intensity"], rows["ring"], rows["time"] = event.intensities, event.rings, event.times
    return message


# Small messages.


def odometry(out: Outgoing, event: Odometry) -> Any:
    """Return a nav_msgs/Odometry: the pose in its parent, the twist in the body."""
    axes = out.names.axes(event.child_frame_id)
    linear, angular = event.linear_velocity, event.angular_velocity
    twist = out.twist(convert_vector(axes, linear), convert_vector(axes, angular))
    return out.make(
        "nav_msgs/msg/Odometry",
        header=out.header(event),
        child_frame_id=out.names.name(event.child_frame_id, event.source),
        pose=out.with_covariance("pose", out.pose(event, axes)),
        twist=out.with_covariance("twist", twist),
    )


def pose(out: Outgoing, event: PoseStamped) -> Any:
    """Return a geometry_msgs/PoseStamped of a camera's optical frame, or of a body."""
    camera = out.cameras.get(event.source)
    axes: Axes = "body" if camera is None else out.names.axes(camera.frame_id)
    pose_message = out.pose(event, axes)
    return out.make("geometry_msgs/msg/PoseStamped", header=out.header(event), pose=pose_message)


def estimate(out: Outgoing, event: PoseEstimate) -> Any:
    """Return a geometry_msgs/PoseStamped."""
    pose_message = out.pose(event, out.names.axes(event.child_frame_id))
    return out.make("geometry_msgs/msg/PoseStamped", header=out.header(event), pose=pose_message)


def estimate_with_covariance(out: Outgoing, event: PoseEstimate) -> Any:
    """Return a geometry_msgs/PoseWithCovarianceStamped; zeros if nothing is known."""
    covariance = _ZEROS_36
    if event.covariance:
        axes = out.names.axes(event.frame_id)
        covariance = convert_covariance(axes, np.array(event.covariance))
    pose_message = out.pose(event, out.names.axes(event.child_frame_id))
    return out.make(
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        header=out.header(event),
        pose=out.with_covariance("pose", pose_message, covariance),
    )


def transforms(
    out: Outgoing, event: Odometry | PoseStamped | PoseEstimate | TransformStamped
) -> Any:
    """Return a tf2_msgs/TFMessage of the moving frames in an event."""
    return out.tree(out.time(event.stamp), out.transforms.of(event))


def fixed_transforms(out: Outgoing, _: Event | None) -> Any:
    """Return a tf2_msgs/TFMessage of all fixed frames."""
    return out.tree(out.time(0), out.transforms.static())


def path(out: Outgoing, event: Odometry | PoseEstimate) -> bytearray | None:
    """Return a nav_msgs/Path of a source, if due."""
    return out.paths.message(event, out.time(event.stamp))


def imu(out: Outgoing, event: Imu) -> Any:
    """Return a sensor_msgs/Imu without orientation; covariances are noise density² times rate."""
    axes, noise = out.names.axes(event.frame_id), out.sensors.get(("imu", event.source))
    gyroscope = accelerometer = _ZEROS_9
    if noise is not None:
        gyroscope = _diagonal(noise.gyroscope_noise_density**2 * noise.rate)
        accelerometer = _diagonal(noise.accelerometer_noise_density**2 * noise.rate)
    return out.make(
        "sensor_msgs/msg/Imu",
        header=out.header(event),
        orientation=out.quaternion((1.0, 0.0, 0.0, 0.0)),
        orientation_covariance=_UNKNOWN,
        angular_velocity=out.vector(axes, event.angular_velocity),
        angular_velocity_covariance=gyroscope,
        linear_acceleration=out.vector(axes, event.linear_acceleration),
        linear_acceleration_covariance=accelerometer,
    )


def distance(out: Outgoing, event: Range) -> Any:
    """Return a sensor_msgs/Range of a sensor looking along its frame's x axis."""
    type_ = out.store.message("sensor_msgs/msg/Range")
    sensor, more = out.sensors.get(("range", event.source)), {}
    if "variance" in type_.__annotations__:  # since Iron; 0 says: not known
        more["variance"] = 0.0 if sensor is None else sensor.noise**2
    return type_(
        header=out.header(event),
        radiation_type=type_.INFRARED,
        field_of_view=event.field_of_view,
        min_range=event.min_range,
        max_range=event.max_range,
        range=event.range,
        **more,
    )


def pressure(out: Outgoing, event: FluidPressure) -> Any:
    """Return a sensor_msgs/FluidPressure."""
    return out.make(
        "sensor_msgs/msg/FluidPressure",
        header=out.header(event, _frame(out, "pressure", event)),
        fluid_pressure=event.fluid_pressure,
        variance=event.variance,
    )


def magnetic_field(out: Outgoing, event: MagneticField) -> Any:
    """Return a sensor_msgs/MagneticField; a covariance of zeros says: not known."""
    sensor = out.sensors.get(("magnetic", event.source))
    return out.make(
        "sensor_msgs/msg/MagneticField",
        header=out.header(event),
        magnetic_field=out.vector(out.names.axes(event.frame_id), event.magnetic_field),
        magnetic_field_covariance=_ZEROS_9 if sensor is None else _diagonal(sensor.noise**2),
    )


def fix(out: Outgoing, event: NavSatFix) -> Any:
    """Return a sensor_msgs/NavSatFix, whose status is the event's; its covariance is in ENU."""
    status = out.store.message("sensor_msgs/msg/NavSatStatus")
    type_ = out.store.message("sensor_msgs/msg/NavSatFix")
    covariance, known = _ZEROS_9, type_.COVARIANCE_TYPE_UNKNOWN
    if event.position_covariance:
        covariance = convert_covariance("world", np.array(event.position_covariance))
        known = type_.COVARIANCE_TYPE_KNOWN
    return type_(
        header=out.header(event, _frame(out, "fix", event)),
        status=status(status=event.status, service=status.SERVICE_GPS),
        latitude=event.latitude,
        longitude=event.longitude,
        altitude=event.altitude,
        position_covariance=covariance,
        position_covariance_type=known,
    )


def fix_velocity(out: Outgoing, event: NavSatFix) -> Any:
    """Return a geometry_msgs/TwistStamped of a receiver's velocity, in ``map``."""
    twist = out.twist(convert_vector("world", event.velocity), (0.0, 0.0, 0.0))
    return out.make("geometry_msgs/msg/TwistStamped", header=out.header(event, "map"), twist=twist)


def wind(out: Outgoing, event: Wind) -> Any:
    """Return a geometry_msgs/Vector3Stamped of the air's velocity, in ``map``."""
    header, vector = out.header(event, "map"), out.vector("world", event.velocity)
    return out.make("geometry_msgs/msg/Vector3Stamped", header=header, vector=vector)


def score(out: Outgoing, event: Score) -> Any:
    """Return a std_msgs/Float64."""
    return out.make("std_msgs/msg/Float64", data=event.value)


def number(out: Outgoing, event: Event, field: str) -> Any:
    """Return a std_msgs/Float64 of a measured field."""
    return out.make("std_msgs/msg/Float64", data=getattr(event, field))


def vector(out: Outgoing, event: Event, field: str) -> Any:
    """Return a geometry_msgs/Vector3Stamped of a measured field, in the event's frame."""
    frame_id = getattr(event, "frame_id", "base_link")
    measured = out.vector(out.names.axes(frame_id), getattr(event, field))
    header = out.header(event, frame_id)
    return out.make("geometry_msgs/msg/Vector3Stamped", header=header, vector=measured)


def clock(out: Outgoing, now: int) -> Any:
    """Return a rosgraph_msgs/Clock of a time (ns)."""
    sec, nanosec = out.time(now)
    time = out.make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
    return out.make("rosgraph_msgs/msg/Clock", clock=time)


def _frame(out: Outgoing, kind: str, event: Event) -> str:
    sensor = out.sensors.get((kind, event.source))
    return "base_link" if sensor is None else str(sensor.frame_id)


def _diagonal(variance: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.diag([variance] * 3).ravel()
