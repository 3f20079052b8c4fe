"""Where cameras of a ROS bag sit on the body: from its fixed transforms (``/tf_static``)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from events.frames import convert_rotation, convert_vector
from events.poses import Pose
from events.rotations import multiply, normalize, rotate

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
