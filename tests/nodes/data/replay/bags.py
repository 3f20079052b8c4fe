"""Small bags of ROS as drivers of real cameras leave them: message by message, with rosbags."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

ROS_2, ROS_1 = get_typestore(Stores.ROS2_JAZZY), get_typestore(Stores.ROS1_NOETIC)
START = 1_700_000_000_000_000_000
STEP = 50_000_000  # ns between two messages of a topic
FRAMES = 3
COLOUR_K = (600.0, 601.0, 31.5, 23.25)
DEPTH_K = (420.0, 420.0, 30.5, 24.5)
SIZE = (64, 48)

Topics = Mapping[str, list[Any]]


def header(frame: str, number: int, store: Any = ROS_2) -> Any:
    seconds, rest = divmod(START + number * STEP, 1_000_000_000)
    stamp = store.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest)
    fields = {"seq": number} if store is ROS_1 else {}
    return store.types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **fields)


def images(
    frame: str,
    encoding: str = "rgb8",
    pixels: npt.NDArray[Any] | None = None,
    size: tuple[int, int] = SIZE,
    store: Any = ROS_2,
) -> list[Any]:
    """Return messages of an image, by default of all zeros."""
    if pixels is None:
        deep = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}.get(encoding, "u1")
        channels = {"rgb8": 3, "bgr8": 3, "yuv422": 2}.get(encoding, 1)
        pixels = np.zeros((size[1], size[0], channels), deep)
    step = pixels.nbytes // pixels.shape[0]
    return [
        store.types["sensor_msgs/msg/Image"](
            header=header(frame, number, store),
            height=pixels.shape[0],
            width=pixels.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=step,
            data=np.frombuffer(pixels.tobytes(), np.uint8),
        )
        for number in range(FRAMES)
    ]


def infos(
    frame: str,
    k: tuple[float, ...] = COLOUR_K,
    d: tuple[float, ...] = (0.0,) * 5,
    p: tuple[float, ...] | None = None,  # fx, fy, cx, cy of the rectified image
    r: npt.NDArray[np.float64] | None = None,
    size: tuple[int, int] = SIZE,
) -> list[Any]:
    """Return messages of a camera's calibration."""
    fx, fy, cx, cy = k
    pfx, pfy, pcx, pcy = p or k
    region = ROS_2.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    return [
        ROS_2.types["sensor_msgs/msg/CameraInfo"](
            header=header(frame, number),
            height=size[1],
            width=size[0],
            distortion_model="plumb_bob",
            d=np.array(d),
            k=np.array([fx, 0, cx, 0, fy, cy, 0, 0, float(fx > 0)]),
            r=np.eye(3).ravel() if r is None else r.ravel(),
            p=np.array([pfx, 0, pcx, 0, 0, pfy, pcy, 0, 0, 0, 1, 0.0]),
            binning_x=0,
            binning_y=0,
            roi=region,
        )
        for number in range(FRAMES)
    ]


def imus(frame: str, count: int = FRAMES, force: tuple[float, ...] = (1.0, 2.0, 3.0)) -> list[Any]:
    types = ROS_2.types
    vector, turn = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    return [
        types["sensor_msgs/msg/Imu"](
            header=header(frame, number),
            orientation=turn(0.0, 0.0, 0.0, 1.0),
            orientation_covariance=np.zeros(9),
            angular_velocity=vector(0.1, 0.2, 0.3),
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=vector(*force),
            linear_acceleration_covariance=np.zeros(9),
        )
        for number in range(count)
    ]


def poses(*quaternions: tuple[float, float, float, float]) -> list[Any]:
    """Return messages of odometry with such orientations (x, y, z, w)."""
    types = ROS_2.types
    vector, turn = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    return [
        types["nav_msgs/msg/Odometry"](
            header=header("odom", number),
            child_frame_id="base_link",
            pose=types["geometry_msgs/msg/PoseWithCovariance"](
                types["geometry_msgs/msg/Pose"](
                    types["geometry_msgs/msg/Point"](float(number), 0.0, 0.0), turn(*quaternion)
                ),
                np.zeros(36),
            ),
            twist=types["geometry_msgs/msg/TwistWithCovariance"](
                types["geometry_msgs/msg/Twist"](vector(0.0, 0.0, 0.0), vector(0.0, 0.0, 0.0)),
                np.zeros(36),
            ),
        )
        for number, quaternion in enumerate(quaternions)
    ]


def fixed(*frames: tuple[str, str, tuple[float, float, float], tuple[float, ...]]) -> list[Any]:
    """Return a message of /tf_static: parent, child, place and rotation (x, y, z, w) of each."""
    types = ROS_2.types
    vector, turn = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    transforms = [
        types["geometry_msgs/msg/TransformStamped"](
            header(parent, 0),
            child,
            types["geometry_msgs/msg/Transform"](vector(*place), turn(*rotation)),
        )
        for parent, child, place, rotation in frames
    ]
    return [types["tf2_msgs/msg/TFMessage"](transforms)]


def write(folder: Path, topics: Topics) -> Path:
    """Return a bag of ROS 2 with these messages, received as stamped."""
    path = folder / "bag"
    with Writer(path, version=9) as writer:
        for topic, messages in topics.items():
            type_ = messages[0].__msgtype__
            connection = writer.add_connection(topic, type_, typestore=ROS_2)
            for number, message in enumerate(messages):
                data = ROS_2.serialize_cdr(message, type_)
                writer.write(connection, START + number * STEP, data)
    return path


def write_ros1(path: Path, topics: Topics) -> Path:
    """Return a bag of ROS 1."""
    with Writer1(path) as writer:
        for topic, messages in topics.items():
            type_ = messages[0].__msgtype__
            connection = writer.add_connection(topic, type_, typestore=ROS_1)
            for number, message in enumerate(messages):
                writer.write(
                    connection, START + number * STEP, ROS_1.serialize_ros1(message, type_)
                )
    return path
