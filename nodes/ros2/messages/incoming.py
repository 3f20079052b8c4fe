"""Events from ROS messages, in our frames. Invalid messages raise ValueError.

A function for each row of `mappings`, as for users' own mappings. World ENU becomes NED, body FLU
FRD; optical axes stay.
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf, isfinite
from types import SimpleNamespace
from typing import Any, TypeVar

import msgspec
import numpy as np

from events import (
    CameraAnnouncement,
    CameraInfo,
    DepthImage,
    Event,
    FluidPressure,
    Image,
    Imu,
    MagneticField,
    NavSatFix,
    Odometry,
    PoseEstimate,
    PoseSetpoint,
    PositionSetpoint,
    Quaternion,
    Range,
    Vector3,
    VelocitySetpoint,
)
from events.camera_info import COEFFICIENTS
from events.frames import (
    OPTICAL_TO_FRD,
    axes_of,
    convert_covariance,
    convert_rotation,
    convert_vector,
    normalize,
    yaw_of,
)
from nodes.ros2.messages.images import (
    decode_compressed,
    depth_pixels,
    high_byte,
    image_pixels,
    known_depth,
)
from nodes.ros2.messages.typestore import Stamps

E = TypeVar("E", bound=Event)


class MessageContext(msgspec.Struct, frozen=True, kw_only=True):
    """Input of a reader besides the message."""

    source: str  # of the event
    now: int  # on the run's clock (ns)
    stamps: Stamps = Stamps()
    frame_id: str = ""  # if set, replaces the message's
    vehicle: str = ""  # of a set-point

    def stamp(self, header: Any) -> int:
        """Return a header's time as a stamp; a `ValueError` if it is no time of this run."""
        return self.stamps.back(header.stamp.sec, header.stamp.nanosec, self.now)

    def frame(self, header: Any, default: str) -> str:
        """Return the frame for an event: `frame_id`, the header's, or else `default`."""
        return self.frame_id or header.frame_id or default

    def event(self, kind: type[E], header: Any, **fields: Any) -> E:
        """Return an event of `source` at a header's time."""
        return kind(stamp=self.stamp(header), source=self.source, **fields)


Reader = Callable[[Any, MessageContext], Event | None]


def estimate(message: Any, context: MessageContext) -> Event:
    """Read a PoseStamped as an estimate."""
    return _estimate(message.header, message.pose, (), context)


def estimate_with_covariance(message: Any, context: MessageContext) -> Event:
    """Read a PoseWithCovarianceStamped, or an Odometry, as an estimate."""
    covariance = message.pose.covariance
    if not np.isfinite(covariance).all():
        raise ValueError("covariance: expected finite numbers")
    values = covariance if covariance.any() else ()
    child = getattr(message, "child_frame_id", "") or "base_link"
    return _estimate(message.header, message.pose.pose, values, context, child)


def newest(message: Any, context: MessageContext) -> Event:
    """Read the last pose of a Path, whose messages repeat all poses so far, as an estimate."""
    if not message.poses:
        raise ValueError("poses: expected one or more, found none")
    pose = message.poses[-1]
    pose.header.frame_id = pose.header.frame_id or message.header.frame_id
    return estimate(pose, context)


def odometry(message: Any, context: MessageContext) -> Event:
    """Read an Odometry as a body's pose and twist."""
    frame_id, child = context.frame(message.header, "odom"), message.child_frame_id or "base_link"
    position, orientation = _pose(message.pose.pose, frame_id, child)
    twist, axes = message.twist.twist, axes_of(child)
    return context.event(
        Odometry,
        message.header,
        frame_id=frame_id,
        child_frame_id=child,
        position=position,
        orientation=orientation,
        linear_velocity=convert_vector(axes, _vector(twist.linear)),
        angular_velocity=convert_vector(axes, _vector(twist.angular)),
    )


def velocity(message: Any, context: MessageContext) -> Event:
    """Read a Twist as a velocity along the vehicle's heading."""
    return _velocity(message, context.now, context.frame_id or "heading", context)


def stamped_velocity(message: Any, context: MessageContext) -> Event:
    """Read a TwistStamped as a velocity in ``map``, or else along the vehicle's heading."""
    frame_id = "map" if context.frame(message.header, "") == "map" else "heading"
    return _velocity(message.twist, context.stamp(message.header), frame_id, context)


def position(message: Any, context: MessageContext) -> Event:
    """Read a PoseStamped as a place to be at, with its heading."""
    place, orientation = _pose_in_map(message, context)
    target = {"vehicle": context.vehicle, "position": place, "yaw": yaw_of(orientation)}
    return context.event(PositionSetpoint, message.header, **target)


def pose(message: Any, context: MessageContext) -> Event:
    """Read a PoseStamped as a place to be at in an attitude."""
    place, orientation = _pose_in_map(message, context)
    target = {"vehicle": context.vehicle, "position": place, "orientation": orientation}
    return context.event(PoseSetpoint, message.header, **target)


def imu(message: Any, context: MessageContext) -> Event:
    """Read an Imu, without its orientation."""
    frame_id = context.frame(message.header, "base_link")
    axes = axes_of(frame_id)
    return context.event(
        Imu,
        message.header,
        frame_id=frame_id,
        angular_velocity=convert_vector(axes, _vector(message.angular_velocity)),
        linear_acceleration=convert_vector(axes, _vector(message.linear_acceleration)),
    )


def distance(message: Any, context: MessageContext) -> Event:
    """Read a Range; a distance outside its limits is out of reach."""
    least, most, measured = (
        float(value) for value in (message.min_range, message.max_range, message.range)
    )
    return context.event(
        Range,
        message.header,
        frame_id=context.frame(message.header, "base_link"),
        range=measured if least <= measured <= most else inf,
        field_of_view=float(message.field_of_view),
        min_range=least,
        max_range=most,
    )


def pressure(message: Any, context: MessageContext) -> Event:
    """Read a FluidPressure."""
    value, variance = float(message.fluid_pressure), float(message.variance)
    return context.event(FluidPressure, message.header, fluid_pressure=value, variance=variance)


def magnetic_field(message: Any, context: MessageContext) -> Event:
    """Read a MagneticField, without its covariance."""
    frame_id = context.frame(message.header, "base_link")
    field = convert_vector(axes_of(frame_id), _vector(message.magnetic_field))
    return context.event(MagneticField, message.header, frame_id=frame_id, magnetic_field=field)


def fix(message: Any, context: MessageContext) -> Event:
    """Read a NavSatFix; a `ValueError` if the receiver has no fix."""
    if message.status.status < 0:
        raise ValueError("status: expected a fix, found none")
    known = message.position_covariance_type != message.COVARIANCE_TYPE_UNKNOWN
    covariance = convert_covariance("world", message.position_covariance) if known else np.empty(0)
    return context.event(
        NavSatFix,
        message.header,
        latitude=float(message.latitude),
        longitude=float(message.longitude),
        altitude=float(message.altitude),
        position_covariance=tuple(covariance.tolist()),
    )


def image(message: Any, context: MessageContext) -> Event:
    """Read an Image or a CompressedImage as a colour or grey image."""
    raw = hasattr(message, "encoding")
    pixels = image_pixels(message) if raw else high_byte(decode_compressed(message))
    encoding, frame_id = "rgb8" if pixels.ndim == 3 else "mono8", context.frame(message.header, "")
    return context.event(Image, message.header, frame_id=frame_id, encoding=encoding, data=pixels)


def depth(message: Any, context: MessageContext) -> Event:
    """Read an Image or a CompressedImage as depth."""
    raw = hasattr(message, "encoding")
    metres = depth_pixels(message) if raw else decode_compressed(message)
    if metres.dtype == np.uint16:  # millimetres as an ordinary PNG
        metres = known_depth(metres, 0.001)
    if metres.dtype != np.float32 or metres.ndim != 2:
        raise ValueError(
            f"expected depth in 16 bits or metres, found {metres.dtype} {metres.shape}"
        )
    frame_id = context.frame(message.header, "")
    return context.event(DepthImage, message.header, frame_id=frame_id, data=metres)


def true_odometry(message: Any, context: MessageContext) -> Event:
    """Read an Odometry as the true pose of a body, in ``map`` unless settings say otherwise."""
    context = msgspec.structs.replace(context, frame_id=context.frame_id or "map")
    return msgspec.structs.replace(odometry(message, context), child_frame_id="base_link")


def true_pose(message: Any, context: MessageContext) -> Event:
    """Read a PoseStamped as the true pose of a body, like `true_odometry`."""
    frame_id = context.frame_id or "map"
    place, orientation = _pose(message.pose, frame_id, "base_link")
    return context.event(
        Odometry,
        message.header,
        frame_id=frame_id,
        position=place,
        orientation=orientation,
        linear_velocity=(0.0, 0.0, 0.0),  # unknown
        angular_velocity=(0.0, 0.0, 0.0),
    )


def true_transform(message: Any, context: MessageContext) -> Event:
    """Read a TransformStamped as the true pose of a body, like `true_odometry`."""
    moved = message.transform
    pose = SimpleNamespace(position=moved.translation, orientation=moved.rotation)
    return true_pose(SimpleNamespace(header=message.header, pose=pose), context)


def nothing(message: Any, context: MessageContext) -> None:
    """Make no event of a message."""


def camera_announcement(
    message: Any,
    source: str,
    images: tuple[str, ...],  # kinds of its images
    frame_id: str = "",  # if set, replaces the message's
) -> CameraAnnouncement:
    """Return the announcement, by a CameraInfo, of a camera looking ahead from the body's origin.

    Raises:
        ValueError: The message is no camera's calibration.
    """
    info = camera_info(message)
    return CameraAnnouncement(
        stamp=0,
        source=source,
        images=images,
        info=info,
        rate=30.0,  # unknown
        latency=0.0,
        baseline=abs(float(message.p[3])) / info.fx,
        frame_id=frame_id or message.header.frame_id,
        parent_frame_id="base_link",
        position=(0.0, 0.0, 0.0),
        orientation=OPTICAL_TO_FRD,
    )


def camera_info(message: Any) -> CameraInfo:
    """Read the intrinsics of a CameraInfo; a `ValueError` if its distortion is unknown."""
    fx, skew, cx, _, fy, cy, *_ = (float(value) for value in message.k)
    coefficients = tuple(float(value) for value in message.d)
    sizes = 1 <= message.width <= 16384 and 1 <= message.height <= 16384
    finite = isfinite(fx + fy + cx + cy + sum(coefficients))
    if not (sizes and fx > 0.0 and fy > 0.0 and skew == 0.0 and finite):
        raise ValueError(
            f"expected a calibrated camera, found {message.width} x {message.height} pixels "
            f"with K = {message.k.tolist()} and D = {list(coefficients[:8])}"
        )
    part = message.roi.width not in {0, message.width} or message.roi.height not in {
        0,
        message.height,
    }
    if part or message.binning_x > 1 or message.binning_y > 1:
        raise ValueError(
            "expected a calibration of whole images, found binning of "
            f"{message.binning_x} x {message.binning_y} and a region of interest of "
            f"{message.roi.width} x {message.roi.height} pixels"
        )
    model = message.distortion_model
    if not any(coefficients) and model != "equidistant":
        model, coefficients = "plumb_bob", (0.0,) * 5
    expected = COEFFICIENTS.get(model, 0)
    # plumb_bob of four has no k3; OpenCV's rational model may have more, of a thin prism and tilt.
    coefficients += (0.0,) * (expected - len(coefficients) if len(coefficients) == 4 else 0)
    if not expected or len(coefficients) < expected or any(coefficients[expected:]):
        known = ", ".join(f"{name} with {count}" for name, count in COEFFICIENTS.items())
        raise ValueError(
            f"expected one of {known} coefficients, found {model!r:.80} with {len(message.d)}"
        )
    return CameraInfo(
        width=int(message.width),
        height=int(message.height),
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        distortion_model=model,
        distortion=coefficients[:expected],
    )


def _estimate(
    header: Any, pose: Any, covariance: Any, context: MessageContext, child: str = "base_link"
) -> Event:
    frame_id = context.frame(header, "odom")
    place, orientation = _pose(pose, frame_id, child)
    values = convert_covariance(axes_of(frame_id), covariance).tolist() if len(covariance) else ()
    return context.event(
        PoseEstimate,
        header,
        frame_id=frame_id,
        child_frame_id=child,
        position=place,
        orientation=orientation,
        covariance=tuple(values),
    )


def _velocity(twist: Any, stamp: int, frame_id: str, context: MessageContext) -> Event:
    turned = convert_vector("world" if frame_id == "map" else "body", _vector(twist.linear))
    return VelocitySetpoint(
        stamp=stamp,
        source=context.source,
        vehicle=context.vehicle,
        frame_id=frame_id,
        velocity=turned,
        yaw_rate=-_vector(twist.angular)[2],
    )


def _pose_in_map(message: Any, context: MessageContext) -> tuple[Vector3, Quaternion]:
    frame_id = context.frame(message.header, "map")
    if frame_id != "map":
        raise ValueError(f'frame_id: expected "map", found {frame_id!r:.80}')
    return _pose(message.pose, "map", "base_link")


def _pose(pose: Any, parent: str, child: str) -> tuple[Vector3, Quaternion]:
    q, axes = pose.orientation, axes_of(parent)
    rotation = normalize((float(q.w), float(q.x), float(q.y), float(q.z)))
    return (
        convert_vector(axes, _vector(pose.position)),
        convert_rotation(axes, axes_of(child), rotation),
    )


def _vector(vector: Any) -> Vector3:
    x, y, z = float(vector.x), float(vector.y), float(vector.z)
    if not isfinite(x + y + z):
        raise ValueError(f"expected finite numbers, found {(x, y, z)}")
    return (x, y, z)
