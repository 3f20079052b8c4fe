"""Poses and transforms, and the single definition of the frames.

Frames (right-handed, metres, radians):

- ``map``: world, **NED**: x north, y east, z down. The origin is the world's origin on the ground.
- ``base_link``: the vehicle's body, **FRD**: x forward, y right, z down.
- ``<camera>``: a camera's body frame; axes as the body's (x forward, y right, z down).
- ``<camera>_optical``: x right, y down, z forward (REP 103's optical frame).
  The rotation from optical to camera body is ``[[0,0,1],[1,0,0],[0,1,0]]``.

A pose of B in A is the transform that takes coordinates in B to coordinates in A: a position and an
orientation, or a matrix of shape (4, 4). ENU/FLU (REP 103) appear only at the edges that need them,
such as a ROS bridge.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from events.base import Category, Event, Quaternion, Vector3, check, check_pose
from events.frames import inverse as inverse_rotation
from events.frames import multiply, rotate


class PoseStamped(Event, category=Category.GEOMETRY):
    """Where something is, as ROS's ``geometry_msgs/PoseStamped``.

    Attributes:
        frame_id: Parent frame.
        position: Metres in the parent frame.
        orientation: Rotation from ``source``'s frame to the parent frame.
    """

    frame_id: str = "map"
    position: Vector3
    orientation: Quaternion

    def __post_init__(self) -> None:
        check_pose(self, self.position, self.orientation)


class TransformStamped(Event, category=Category.GEOMETRY):
    """A child frame's pose in its parent, as ROS's ``geometry_msgs/TransformStamped``.

    Attributes:
        frame_id: Parent frame.
        child_frame_id: Child frame.
        translation: The child's origin, metres in the parent frame.
        rotation: Rotation from the child to the parent frame.
        static: True if it holds for the whole run; then it is sent once.
    """

    frame_id: str
    child_frame_id: str
    translation: Vector3
    rotation: Quaternion
    static: bool = False

    def __post_init__(self) -> None:
        check_pose(self, self.translation, self.rotation)


class Odometry(Event, category=Category.GEOMETRY):
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

    frame_id: str = "map"
    child_frame_id: str = "base_link"
    position: Vector3
    orientation: Quaternion
    linear_velocity: Vector3
    angular_velocity: Vector3

    def __post_init__(self) -> None:
        check_pose(self, self.position, self.orientation)
        check(self, self.linear_velocity, self.angular_velocity)


class Wind(Event, category=Category.GEOMETRY):
    """True velocity of the air at a vehicle's position, for the record.

    Attributes:
        velocity: Metres per second in ``map``: (1, 0, 0) blows towards the north.
    """

    velocity: Vector3

    def __post_init__(self) -> None:
        check(self, self.velocity)


Floats = npt.NDArray[np.float64]

Pose = tuple[Vector3, Quaternion]
"""Position (metres) and orientation (w, x, y, z) in the parent frame."""


def pose_matrix(position: Vector3, orientation: Quaternion) -> Floats:
    """Return a pose (metres; w, x, y, z) as the transform from child to parent, shape (4, 4)."""
    from scipy.spatial.transform import Rotation  # a second, which not all who need events have

    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(orientation, scalar_first=True).as_matrix()
    matrix[:3, 3] = position
    return matrix


def pose_tuples(matrix: npt.NDArray[Any]) -> Pose:
    """Return a transform, shape (4, 4), as position (metres) and orientation (w ≥ 0, x, y, z)."""
    from scipy.spatial.transform import Rotation

    x, y, z = matrix[:3, 3].tolist()
    quaternion = Rotation.from_matrix(matrix[:3, :3]).as_quat(canonical=True, scalar_first=True)
    qw, qx, qy, qz = quaternion.tolist()
    return (x, y, z), (qw, qx, qy, qz)


def inverse(matrix: Floats) -> Floats:
    """Return the inverse of a rigid transform, shape (4, 4)."""
    result = np.eye(4)
    result[:3, :3] = matrix[:3, :3].T
    result[:3, 3] = -matrix[:3, :3].T @ matrix[:3, 3]
    return result


def relative(base: Pose, pose: Pose) -> Pose:
    """Return a pose relative to `base`; both are given in the same parent frame."""
    (bx, by, bz), (px, py, pz) = base[0], pose[0]
    back = inverse_rotation(base[1])
    return rotate(back, (px - bx, py - by, pz - bz)), multiply(back, pose[1])
