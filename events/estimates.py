"""Events of estimators: poses, tracking, features."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import numpy.typing as npt

from events.base import Category, Event, Quaternion, Vector3
from events.checks import check, check_pose
from events.sensors import publish


class PoseEstimate(Event):
    """The estimated pose of a body, at the time of the data from which it was computed.

    `stamp` is that of the image (or other measurement), not of the moment of sending: latency is
    measured as the difference of both.

    Attributes:
        frame_id: Parent frame, with axes north, east, down. It says what is known about the origin,
            and so how the estimate is aligned before it is compared with the ground truth: ``map``
            not at all; ``odom`` (the estimator's own origin), ``odom_1``, … by the first pose. If
            the estimator announced that it is scale-free, the alignment is a similarity, Sim(3).
        child_frame_id: Frame of the body, with axes forward, right, down.
        position: Metres in the parent frame; the estimator's own unit if it is scale-free.
        orientation: Unit quaternion (w, x, y, z), Hamilton's: rotation from the child to the parent
            frame.
        covariance: Covariance of (x, y, z, roll, pitch, yaw), m², m rad and rad², in the parent
            frame as in ROS's ``PoseWithCovariance``: 36 numbers, row by row; empty if unknown.
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
    """Base of the events of an estimator's tracking."""

    category: ClassVar[Category] = Category.ESTIMATE

    def __post_init__(self) -> None:
        check(self)


class TrackingLost(TrackingEvent):
    """An estimator lost track of its pose: from this stamp on it has none.

    Attributes:
        reason: Why, if known.
    """

    reason: str = ""


class TrackingRegained(TrackingEvent):
    """An estimator knows its pose again, from this stamp on."""


class TrackedFeatures(Event, eq=False):
    """The features that an estimator tracked in an image; `stamp` is that of the image.

    Attributes:
        frame_id: Optical frame of the image.
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
