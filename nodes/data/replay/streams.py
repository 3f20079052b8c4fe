"""Choice of a foreign bag's topics: one stream of images a camera, and each camera's calibration.

Image topics in one namespace named as image_pipeline's (``image_raw``, ``image_rect_color``, …) are
one camera; of these the unrectified one in colour is taken. A depth image belongs to a camera only
if both are of one frame, one size and one matrix K, as RealSense's ``aligned_depth_to_color`` and
OpenNI's registered depth are; else it is a camera of its own. Layouts: wiki.ros.org/image_pipeline,
image_transport (camera_info beside the image), github.com/IntelRealSense/realsense-ros,
stereolabs.com/docs/ros2 (ZED), docs.luxonis.com (OAK).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from events import CameraInfo
from nodes.data.replay.reader import BagTopic, Use
from nodes.ros2.messages.images import COLOUR_ENCODINGS, DEPTH_ENCODINGS
from nodes.ros2.messages.incoming import camera_info

_IMAGE, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_INFO, _IMU, _ODOMETRY = (
    "sensor_msgs/msg/CameraInfo",
    "sensor_msgs/msg/Imu",
    "nav_msgs/msg/Odometry",
)
GUESSED = {_IMAGE, _COMPRESSED, _INFO, _IMU, _ODOMETRY}  # types of topics taken by themselves

_PARTS = {
    "camera_info", "compressed", "compressedDepth", "depth", "color", "rgb", "depth_registered",
}  # fmt: skip
"""Parts of topic names for the kind of data, not its source; with `_OF_PIPELINE`."""
_OF_PIPELINE = re.compile(r"image(_(raw|rect|rectified|color|colour|mono|gr[ae]y))*")
"""Last parts of topics of one camera, as drivers and image_proc name them."""
_TRANSPORTS = {"compressed", "compressedDepth"}

SameFrame = Callable[[str, str], bool]  # whether two frames are at one place, as far as is known


def topic_in(bag: Iterable[str], name: str) -> str:
    """Return a bag's topic by its name with or without the leading slash, else `name`."""
    topics = set(bag)
    return next((topic for topic in (name, f"/{name}", name.lstrip("/")) if topic in topics), name)


def source_of(topic: str, use: str, vehicle: str) -> str:
    """Return the source of a topic's events: of a camera, its namespace, below the vehicle."""
    if use in {"odometry", "truth"}:
        return vehicle
    if use == "estimate":
        return topic.strip("/")
    parts = [part for part in topic.split("/") if part]
    if parts and parts[0] == vehicle:
        parts = parts[1:]
    if use != "imu":
        kinds = (part in _PARTS or _OF_PIPELINE.fullmatch(part) is not None for part in parts)
        parts = parts[: next((n for n, kind in enumerate(kinds) if kind), len(parts))]
    return "/".join((vehicle, *(parts or ["camera"])))


def is_rectified(topic: str) -> bool:
    """Return whether a topic's name says that its images are without distortion."""
    return "rect" in base_of(topic).rpartition("/")[2]


def calibration(message: Any, topic: str) -> CameraInfo:
    """Return the intrinsics of an image topic by its CameraInfo; a `ValueError` if it has none.

    K and D are of images as they were taken, the left of P is of rectified ones.
    """
    info = camera_info(message)
    p = [float(value) for value in message.p]
    if not is_rectified(topic) or not (p[0] > 0.0 and p[5] > 0.0):
        return info
    return CameraInfo(width=info.width, height=info.height, fx=p[0], fy=p[5], cx=p[2], cy=p[6])


class Streams(NamedTuple):
    """Topics to read, with their sources; a sentence on each; reasons for topics left out."""

    topics: list[BagTopic]
    notes: list[str]
    left_out: list[str]


class _Images(NamedTuple):
    topic: str
    depth: bool
    camera: str  # what all topics of one camera share: a namespace, or the topic's own name
    encoding: str  # or format
    message: Any
    info_topic: str  # of its camera_info; empty if there is none
    info: CameraInfo | None  # None if there is none, or one without calibration
    frame: str

    @property
    def grey(self) -> bool:
        return self.encoding.startswith(("mono", "8UC1"))

    @property
    def size(self) -> tuple[int, int]:
        """Width and height; 0 of a compressed image."""
        return getattr(self.message, "width", 0), getattr(self.message, "height", 0)

    @property
    def rank(self) -> tuple[bool, bool, bool, bool, str]:
        """Order of preference among topics of one camera: the least is taken."""
        last = base_of(self.topic).rpartition("/")[2]
        mosaic = self.encoding.startswith("bayer")
        packed = self.topic != base_of(self.topic)
        return is_rectified(self.topic), "mono" in last or self.grey, mosaic, packed, self.topic


def guess(
    topics: Mapping[str, tuple[str, int]],  # type and number of messages, by topic
    firsts: Mapping[str, Any],  # first message of each topic of `GUESSED`
    vehicle: str,
    same_frame: SameFrame,
    calibrated: Mapping[str, CameraInfo],  # by topic, in the place of their camera_info
) -> Streams:
    """Choose topics by types, names, encodings and calibrations."""
    result = Streams([], [], [])
    images: list[_Images] = []
    truth = ""
    for name, (type_, _) in sorted(topics.items()):
        if name not in firsts or name.startswith("/visnav/") or "segmentation" in name:
            continue
        if type_ in {_IMAGE, _COMPRESSED}:
            images += _images(name, type_, topics, firsts, calibrated, result.left_out)
        elif type_ == _IMU and (half := _other_half(name, topics)):
            result.left_out.append(
                f"{name}: left out: with {half} it is half an IMU each, as of realsense2_camera "
                "without unite_imu_method; record it united to have it"
            )
        elif type_ == _IMU:
            topic = BagTopic(topic=name, use="imu", source=source_of(name, "imu", vehicle))
            result.topics.append(topic)
            result.notes.append(f"{name}: IMU {topic.source}")
        elif type_ == _ODOMETRY and not truth:
            truth = name
            result.topics.append(BagTopic(topic=name, use="odometry", source=vehicle))
            result.notes.append(f"{name}: true poses of {vehicle}")
        elif type_ == _ODOMETRY:
            result.notes.append(
                f"{name}: not read, as {truth} is taken for the truth; name it in topics to have it"
            )
    _add_cameras(_one_per_camera(images, result.notes), vehicle, same_frame, result)
    return result


def _other_half(name: str, topics: Mapping[str, tuple[str, int]]) -> str:
    """Return the topic of the gyroscope beside an accelerometer's, or the reverse, else ''.

    Both have the type of a whole IMU, with zeros for what they do not measure.
    """
    parts = name.split("/")
    for part_name, twin_name in (("accel", "gyro"), ("gyro", "accel")):
        twin = "/".join(twin_name if part == part_name else part for part in parts)
        if part_name in parts and topics.get(twin, ("", 0))[0] == _IMU:
            return twin
    return ""


def _images(
    name: str,
    type_: str,
    topics: Mapping[str, tuple[str, int]],
    firsts: Mapping[str, Any],
    calibrated: Mapping[str, CameraInfo],
    left_out: list[str],
) -> list[_Images]:
    """Return an image topic, or nothing if its encoding is none that can be read."""
    message, base = firsts[name], base_of(name)
    if type_ == _COMPRESSED:
        if getattr(firsts.get(base), "encoding", "") in (*COLOUR_ENCODINGS, *DEPTH_ENCODINGS):
            return []  # the same images
        encoding = str(message.format)
        depth = "compressedDepth" in encoding or encoding.startswith(DEPTH_ENCODINGS)
    else:
        encoding = str(message.encoding)
        depth = encoding in DEPTH_ENCODINGS
        if not depth and encoding not in COLOUR_ENCODINGS:
            left_out.append(
                f"{name}: left out: its encoding {encoding!r:.40} cannot be read; convert it to "
                "rgb8, mono8, a Bayer pattern, 16UC1 or 32FC1 to have it"
            )
            return []
    space, _, last = base.rpartition("/")
    camera_topic = f"{base}/camera_info"
    shared_topic = f"{space}/camera_info"
    pipeline = _OF_PIPELINE.fullmatch(last) is not None
    every = {base_of(other) for other, (t, n) in topics.items() if t in {_IMAGE, _COMPRESSED} and n}
    alone = pipeline or sum(other.rpartition("/")[0] == space for other in every) == 1
    info_topic = (
        camera_topic
        if camera_topic in firsts
        else shared_topic
        if shared_topic in firsts and alone
        else ""
    )
    info = calibrated.get(base)
    if info is None and info_topic:
        try:
            info = calibration(firsts[info_topic], name)
        except ValueError as error:
            left_out.append(
                f"{info_topic}: left out: {error}: {name} has no calibration; give one by the "
                "setting calibration"
            )
    frame = firsts[info_topic].header.frame_id if info_topic else message.header.frame_id
    return [
        _Images(
            topic=name,
            depth=depth,
            camera=space if pipeline else base,
            encoding=encoding,
            message=message,
            info_topic=info_topic if info and base not in calibrated else "",
            info=info,
            frame=frame.lstrip("/"),
        )
    ]


def _one_per_camera(images: list[_Images], notes: list[str]) -> list[_Images]:
    """Return the preferred topic of each camera and kind; the others are noted."""
    groups: dict[tuple[str, bool], list[_Images]] = {}
    for image in images:
        groups.setdefault((image.camera, image.depth), []).append(image)
    chosen = []
    for group in groups.values():
        first, *rejected = sorted(group, key=lambda image: image.rank)
        chosen.append(first)
        for image in rejected:
            kind = "rectified images" if is_rectified(image.topic) else "images"
            notes.append(
                f"{image.topic}: not read: {kind} of the same camera as {first.topic}, which is; "
                "to have these instead, name them in topics"
            )
    return sorted(chosen, key=lambda image: (image.depth, image.grey, image.topic))


def _add_cameras(
    chosen: list[_Images], vehicle: str, same_frame: SameFrame, result: Streams
) -> None:
    sources: dict[str, str] = {}  # of image topics
    depths: set[str] = set()  # sources that have depth
    for image in chosen:
        paired, reason = (None, "") if not image.depth else _camera_of(image, chosen, same_frame)
        if paired is not None and sources[paired.topic] in depths:
            result.notes.append(
                f"{image.topic}: not read: {sources[paired.topic]} has depth already; to have this "
                "instead, name it in topics"
            )
            continue
        if paired is not None:
            source = sources[paired.topic]
            depths.add(source)
        else:
            source = source_of(image.topic, "image", vehicle)
            for longer in (image.camera, base_of(image.topic)):
                if source in sources.values():  # another camera's
                    source = source_of(longer, "imu", vehicle)
            sources[image.topic] = source
        use: Use = "depth" if image.depth else "image"
        result.topics.append(BagTopic(topic=image.topic, use=use, source=source))
        if paired is not None:
            result.notes.append(f"{image.topic}: depth of {source}, as {paired.topic}{reason}")
            continue
        calibration = (
            f"calibration {image.info_topic}" if image.info_topic else "without a calibration"
        )
        if image.info and not image.info_topic:
            calibration = "calibration of the settings"
        if image.info_topic and is_rectified(image.topic):
            calibration += " (P, rectified)"
        result.notes.append(
            f"{image.topic}: {use} of {source} ({image.encoding}), {calibration}{reason}"
        )
        if image.info_topic:
            result.topics.append(BagTopic(topic=image.info_topic, use="camera", source=source))


def _camera_of(
    depth: _Images, chosen: list[_Images], same_frame: SameFrame
) -> tuple[_Images | None, str]:
    """Return the camera whose pixels a depth image's are, and why it is so, or why none is."""
    reasons = []
    for camera in chosen:
        if camera.depth:
            continue
        if camera.frame != depth.frame and not same_frame(camera.frame, depth.frame):
            reasons.append(f"{camera.topic} is of the frame {camera.frame!r}, not {depth.frame!r}")
        elif (wrong := _difference(camera, depth)) is not None:
            reasons.append(f"{camera.topic} {wrong}")
        elif camera.info and depth.info:
            return camera, ": one frame, size and K"
        else:
            return camera, ": one frame and size; one of them has no K to compare"
    return None, f"; no camera's own depth: {'; '.join(reasons)}" if reasons else ""


def _difference(camera: _Images, depth: _Images) -> str | None:
    """Return how two calibrations, or two sizes, differ; None if they do not."""
    if camera.info is None or depth.info is None:
        if 0 in (*camera.size, *depth.size) or camera.size == depth.size:
            return None
        return f"has {camera.size} pixels, not {depth.size}"
    camera_size, depth_size = ((i.width, i.height) for i in (camera.info, depth.info))
    if camera_size != depth_size:
        return (
            f"has {camera_size[0]} x {camera_size[1]} pixels, not {depth_size[0]} x {depth_size[1]}"
        )
    k, d = ([i.fx, i.fy, i.cx, i.cy] for i in (camera.info, depth.info))
    if np.allclose(k, d, rtol=1e-3, atol=0.1):
        return None
    return f"has another K: {_numbers(k)}, not {_numbers(d)}"


def _numbers(values: list[float]) -> str:
    return " ".join(f"{value:.2f}" for value in values)


def base_of(topic: str) -> str:
    """Return a topic without the transport at its end."""
    base, _, last = topic.rpartition("/")
    return base if last in _TRANSPORTS else topic
