"""A trajectory that is a topic of a bag: its messages, in our frames (`ros_messages.incoming`).

Of a ``nav_msgs/msg/Path``, which each time holds all poses so far, the last message counts.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from events import PoseEstimate
from events.frames import Axes, axes_of
from nodes.data.replay.bag_topics import chosen
from nodes.data.replay.rosbag import open_bag, readable
from nodes.data.replay.settings import BagTopic
from nodes.judging.evaluation.record import EstimatorRecord
from nodes.ros2.messages.incoming import READERS, MessageContext
from nodes.ros2.messages.typestore import Bag
from nodes.trajectory import Trajectory

_PATH, _POSE = "nav_msgs/msg/Path", "geometry_msgs/msg/PoseStamped"
_NEVER = 1 << 62  # stands for the stamp of a message that has none


def read_topic(path: Path, topic: str) -> tuple[Trajectory, Axes, EstimatorRecord]:
    """Read the poses of a topic: frames with z up get z down, those of cameras stay optical.

    Returns:
        The poses that count, the kind of their child frame (a pose that names none is of a body),
        and the record, which has counted the others.

    Raises:
        ValueError: It cannot be read, or holds something else; the message names the pose.
    """
    record, child = EstimatorRecord(), ""
    with readable(path), contextlib.closing(open_bag(path)) as bag:
        chosen(bag.topics(), (BagTopic(topic=topic, use="estimate"),), "")
        for number, (type_, message) in enumerate(_poses(bag, topic), start=1):
            try:
                event = _estimate(type_, message)
            except ValueError as error:
                raise ValueError(f"{path}:{topic}: pose {number}: {error}") from None
            child = child or event.child_frame_id
            record.add(event, None)
    if not len(record):
        raise ValueError(f"{path}:{topic}: expected poses, found none")
    return record.rows.trajectory(), axes_of(child), record


def _poses(bag: Bag, topic: str) -> Iterator[tuple[str, Any]]:
    """Yield the messages with one pose each, and their types."""
    path = bag.topics()[topic][0] == _PATH
    for _, type_, _, message in bag.messages([topic], newest=path):
        if not path:
            yield type_, message
        for pose in message.poses if path else ():
            pose.header.frame_id = pose.header.frame_id or message.header.frame_id
            yield _POSE, pose


def _estimate(type_: str, message: Any) -> PoseEstimate:
    q = (message.pose if type_ == _POSE else message.pose.pose).orientation
    length = float(np.linalg.norm([q.w, q.x, q.y, q.z]))
    if not abs(length - 1.0) < 0.01:
        raise ValueError(f"expected a quaternion of length 1, found one of length {length:.6g}")
    event = READERS[type_, "estimate"](message, MessageContext(source="bag", now=_NEVER))
    assert isinstance(event, PoseEstimate)
    # A run begins at 0; a node that forgets the stamp sends many of these, which are counted.
    return msgspec.structs.replace(event, stamp=0) if event.stamp == _NEVER else event
