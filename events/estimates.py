"""What an estimator believes."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import numpy.typing as npt

from events.base import Category, Event, Quaternion, Vector3
from events.checks import check, check_pose
from events.sensors import publish


class PoseEstimate(Event):
    """A body's estimated pose at the time of the data it was computed from.

    Attributes:
        frame_id: Parent frame; an estimator's own origin is ``odom``.
        child_frame_id: The body whose pose it is.
        position: Metres in the parent frame (scale-free for monocular estimators).
        orientation: Rotation from the child to the parent frame.
        covariance: 36 numbers, row-major, (x, y, z, roll, pitch, yaw); empty if unknown.
    """

    category: ClassVar[Category] = Category.ESTIMATE

    frame_id: str = "odom"
    child_frame_id: str = "base_link"
    position: Vector3
    orientation: Quaternion
    covariance: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        check_pose(self, self.position, self.orientation)


class TrackingEvent(Event):
    """Base of what happens to an estimator's tracking."""

    category: ClassVar[Category] = Category.ESTIMATE

    def __post_init__(self) -> None:
        check(self)


class TrackingLost(TrackingEvent):
    """An estimator no longer knows where it is.

    Attributes:
        reason: Why, if known.
    """

    reason: str = ""


class TrackingRegained(TrackingEvent):
    """An estimator knows again where it is."""


class TrackedFeatures(Event, eq=False):
    """What an estimator followed in a picture; `stamp` is the picture's.

    Attributes:
        frame_id: Optical frame of the picture.
        points: float32 pixels, shape (n, 2): column, row (pixel centres are whole numbers).
        inliers: bool, shape (n,): those that agree with the estimated pose.
    """

    category: ClassVar[Category] = Category.ESTIMATE

    frame_id: str
    points: npt.NDArray[np.float32]
    inliers: npt.NDArray[np.bool_]

    def __post_init__(self) -> None:
        check(self)
        publish("TrackedFeatures", "points", self.points, np.float32, {2})
        publish("TrackedFeatures", "inliers", self.inliers, np.bool_, {1})
        if self.points.shape != (len(self.inliers), 2):
            raise TypeError(
                f"TrackedFeatures.points: expected shape ({len(self.inliers)}, 2), as many as "
                f"inliers, found {self.points.shape}"
            )
