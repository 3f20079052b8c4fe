"""Bags with one topic of poses, in ROS's frames (REP 103), as an estimator sends them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from nodes.trajectory import Trajectory

STORE = get_typestore(Stores.ROS2_JAZZY)
ENU = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])

PATH, POSE = "nav_msgs/msg/Path", "geometry_msgs/msg/PoseStamped"
ODOMETRY = "nav_msgs/msg/Odometry"
COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TYPES = (PATH, POSE, ODOMETRY, COVARIANCE)


def make(type_: str, **fields: Any) -> Any:
    return STORE.types[type_](**fields)


def header(stamp: int, frame_id: str) -> Any:
    seconds, rest = divmod(stamp, 10**9)
    time = make("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)
    return make("std_msgs/msg/Header", stamp=time, frame_id=frame_id)


def pose(position: list[float], quaternion: list[float]) -> Any:
    """Return a pose of a quaternion w, x, y, z."""
    w, x, y, z = quaternion
    return make(
        "geometry_msgs/msg/Pose",
        position=make("geometry_msgs/msg/Point", **dict(zip("xyz", position, strict=True))),
        orientation=make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
    )


def message(type_: str, head: Any, where: Any, child: str) -> Any:
    vector = make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    with_covariance = make(
        "geometry_msgs/msg/PoseWithCovariance", pose=where, covariance=np.zeros(36)
    )
    if type_ == ODOMETRY:
        twist = make("geometry_msgs/msg/Twist", linear=vector, angular=vector)
        moving = make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36))
        fields = {"header": head, "child_frame_id": child, "pose": with_covariance}
        return make(type_, **fields, twist=moving)
    return make(type_, header=head, pose=where if type_ == POSE else with_covariance)


def bag(
    path: Path,
    type_: str,
    poses: Trajectory,
    *,
    frame_id: str = "map",
    child: str = "base_link",
    topic: str = "/slam/poses",
    change: Callable[[int, Any], Any] = lambda _, message: message,
) -> Path:
    """Write a bag of poses NED and FRD (or optical, as the child's name says), as ROS has them."""
    world = ENU if frame_id == "map" else FLIP
    body = np.eye(4) if child.endswith("_optical") else FLIP
    turned = Trajectory.from_matrices(poses.stamps, world @ poses.matrices() @ body)
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection(topic, type_, typestore=STORE)
        writer.add_connection("/rosout", "std_msgs/msg/String", typestore=STORE)
        said: list[Any] = []
        for number, (stamp, position, quaternion) in enumerate(turned.poses(), start=1):
            where = pose(list(position), list(quaternion))
            head = header(stamp, frame_id if type_ != PATH else "")
            content = message(POSE if type_ == PATH else type_, head, where, child)
            content = change(number, content)
            said.append(content)
            if type_ == PATH and (number % 50 == 0 or number == len(poses)):
                content = make(PATH, header=header(stamp, frame_id), poses=list(said))
            elif type_ == PATH:
                continue
            writer.write(connection, 7 + number, STORE.serialize_cdr(content, type_))
    return path
