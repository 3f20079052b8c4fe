"""Poses and transforms, and the one place where the frames are defined.

Frames (right-handed, metres, radians):

- ``map``: world, **NED**: x north, y east, z down. The origin is the world's origin on the ground.
- ``base_link``: the vehicle's body, **FRD**: x forward, y right, z down.
- ``<camera>``: a camera's body frame; axes as the body's (x forward, y right, z down).
- ``<camera>_optical``: x right, y down, z forward (REP 103's optical frame).
  The rotation from optical to camera body is ``[[0,0,1],[1,0,0],[0,1,0]]``.

A pose of B in A is the transform that takes coordinates in B to coordinates in A.
ENU/FLU (REP 103) appear only at the edges that need them, such as a ROS bridge.
"""

from __future__ import annotations

from typing import ClassVar

from events.base import Category, Event, Quaternion, Vector3
from events.checks import check, check_pose


class PoseStamped(Event):
    """Where something is, as ROS's ``geometry_msgs/PoseStamped``.

    Attributes:
        frame_id: Parent frame.
        position: Metres in the parent frame.
        orientation: Rotation from ``source``'s frame to the parent frame.
    """

    category: ClassVar[Category] = Category.GEOMETRY

    frame_id: str = "map"
    position: Vector3
    orientation: Quaternion

    def __post_init__(self) -> None:
        check_pose(self, self.position, self.orientation)


class TransformStamped(Event):
    """A child frame's pose in its parent, as ROS's ``geometry_msgs/TransformStamped``.

    Attributes:
        frame_id: Parent frame.
        child_frame_id: Child frame.
        translation: The child's origin, metres in the parent frame.
        rotation: Rotation from the child to the parent frame.
        static: True if it holds for the whole run; then it is sent once.
    """

    category: ClassVar[Category] = Category.GEOMETRY

    frame_id: str
    child_frame_id: str
    translation: Vector3
    rotation: Quaternion
    static: bool = False

    def __post_init__(self) -> None:
        check_pose(self, self.translation, self.rotation)


class Odometry(Event):
    """Pose and twist of a body, as ROS's ``nav_msgs/Odometry``: the twist is in the body frame.

    A simulator sends its ground truth this way.

    Attributes:
        frame_id: Parent frame of the pose.
        child_frame_id: Body frame, in which the twist is given.
        position: Metres in the parent frame.
        orientation: Rotation from the body to the parent frame.
        linear_velocity: Metres per second in the **body** frame.
        angular_velocity: Radians per second in the **body** frame.
    """

    category: ClassVar[Category] = Category.GEOMETRY

    frame_id: str = "map"
    child_frame_id: str = "base_link"
    position: Vector3
    orientation: Quaternion
    linear_velocity: Vector3
    angular_velocity: Vector3

    def __post_init__(self) -> None:
        check_pose(self, self.position, self.orientation)
        check(self, self.linear_velocity, self.angular_velocity)


class Wind(Event):
    """True velocity of the air, for the record: what a vehicle feels at its place.

    Attributes:
        velocity: Metres per second in ``map``: (1, 0, 0) blows towards the north.
    """

    category: ClassVar[Category] = Category.GEOMETRY

    velocity: Vector3

    def __post_init__(self) -> None:
        check(self, self.velocity)
