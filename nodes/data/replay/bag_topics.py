"""What a file need not say of a ROS bag: which topics are read as what, and where cameras sit.

Topics are known by type and name, cameras by the bag's fixed transforms (``/tf_static``).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from events.frames import convert_rotation, convert_vector
from events.poses import Pose
from events.rotations import multiply, normalize, rotate
from nodes.data.replay.reader import ReplayError
from nodes.data.replay.settings import BagTopic, Use
from runtime.errors import suggest

TYPES: dict[Use, tuple[str, ...]] = {
    "image": ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"),
    "depth": ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"),
    "camera": ("sensor_msgs/msg/CameraInfo",),
    "imu": ("sensor_msgs/msg/Imu",),
    "odometry": ("nav_msgs/msg/Odometry",),
    "truth": (
        "nav_msgs/msg/Odometry",
        "geometry_msgs/msg/PoseStamped",
        "geometry_msgs/msg/TransformStamped",
    ),
    "estimate": (
        "nav_msgs/msg/Odometry",
        "geometry_msgs/msg/PoseStamped",
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        "nav_msgs/msg/Path",
    ),
}
"""What can be read of which type of message."""

_PARTS = {
    "image", "image_raw", "image_rect", "image_color", "image_rect_color", "image_mono",
    "camera_info", "compressed", "compressedDepth", "depth", "color", "rgb", "depth_registered",
}  # fmt: skip
"""Parts of a topic's name that say what it is, and not whose."""


def chosen(
    found: Mapping[str, tuple[str, int]], wanted: tuple[BagTopic, ...], vehicle: str
) -> dict[str, BagTopic]:
    """Return the topics to read, by name, with all sources filled in.

    Args:
        found: Type and number of messages, by topic.
        wanted: What the file says; if nothing, topics are taken by type and name.
        vehicle: Source of the truth.

    Raises:
        ReplayError: A wanted topic is not there or of another type; or there is nothing to read.
    """
    there = ", ".join(f"{name} ({type_})" for name, (type_, _) in sorted(found.items()))
    for topic in wanted:
        if topic.topic not in found:
            fit = [f"{k} ({v})" for k, (v, _) in sorted(found.items()) if v in TYPES[topic.use]]
            raise ReplayError(
                f"topics: expected one of the bag's, found {topic.topic!r}"
                f"{suggest(topic.topic, found)}; {topic.use} can be: {', '.join(fit) or 'none'}"
            )
        type_ = found[topic.topic][0]
        if type_ not in TYPES[topic.use]:
            raise ReplayError(
                f"topics: {topic.topic}: expected {' or '.join(TYPES[topic.use])} "
                f"for {topic.use}, found {type_}"
            )
    taken = wanted or _guessed(found)
    if not taken:
        raise ReplayError(f"expected topics of cameras, IMUs or poses, found: {there or 'none'}")
    return {
        topic.topic: BagTopic(
            topic=topic.topic,
            use=topic.use,
            source=topic.source or _source(topic, vehicle),
            frame_id=topic.frame_id,
        )
        for topic in taken
    }


def _guessed(found: Mapping[str, tuple[str, int]]) -> list[BagTopic]:
    taken: list[BagTopic] = []
    truth = False
    for name, (type_, count) in sorted(found.items()):
        use: Use | None = None
        if not count or name.startswith("/visnav/"):
            continue
        if type_ == "sensor_msgs/msg/Image":
            use = "depth" if "depth" in name else "image"
        elif type_ == "sensor_msgs/msg/CompressedImage":
            raw_type, raw_count = found.get(name.rpartition("/")[0], ("", 0))
            if not (raw_type == "sensor_msgs/msg/Image" and raw_count):
                use = "depth" if "depth" in name.lower() else "image"
        elif type_ == "sensor_msgs/msg/CameraInfo":
            use = None if "depth" in name else "camera"
        elif type_ == "sensor_msgs/msg/Imu":
            use = "imu"
        elif type_ == "nav_msgs/msg/Odometry" and not truth:
            use, truth = "odometry", True
        if use is not None and "segmentation" not in name:
            taken.append(BagTopic(topic=name, use=use))
    return taken


def _source(topic: BagTopic, vehicle: str) -> str:
    """Return the source of a topic's events: of a camera, its namespace, below the vehicle."""
    if topic.use in {"odometry", "truth"}:
        return vehicle
    if topic.use == "estimate":
        return topic.topic.strip("/")
    parts = [part for part in topic.topic.split("/") if part]
    if parts and parts[0] == vehicle:
        parts = parts[1:]
    if topic.use != "imu":
        cut = next((n for n, part in enumerate(parts) if part in _PARTS), len(parts))
        parts = parts[:cut]
    return "/".join((vehicle, *(parts or ["camera"])))


LONGEST = 16
"""Transforms between a camera and the body, at most: more would go in circles."""

_HERE: Pose = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))


class Mountings:
    """A tree of fixed transforms, in ROS's axes.

    Args:
        messages: tf2_msgs/TFMessage.
    """

    def __init__(self, messages: Iterable[Any]) -> None:
        self._parents: dict[str, tuple[str, Pose]] = {}
        for message in messages:
            for each in message.transforms:
                t, r = each.transform.translation, each.transform.rotation
                pose = (
                    (float(t.x), float(t.y), float(t.z)),
                    normalize((float(r.w), float(r.x), float(r.y), float(r.z))),
                )
                self._parents[each.child_frame_id] = each.header.frame_id, pose

    def of(self, optical: str, body: str = "base_link") -> Pose | None:
        """Return the pose of an optical frame in the body, FRD; `None` if it is not known."""
        frame, (position, rotation) = optical, _HERE
        for _ in range(LONGEST):
            if frame == body:
                return convert_vector("body", position), convert_rotation(
                    "body", "optical", rotation
                )
            if frame not in self._parents:
                return None
            frame, (offset, turn) = self._parents[frame]
            x, y, z = rotate(turn, position)
            position = (x + offset[0], y + offset[1], z + offset[2])
            rotation = multiply(turn, rotation)
        return None
