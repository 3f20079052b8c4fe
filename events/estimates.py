"""Estimates: poses, tracking, features, maps, and scores of them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from events.base import (
    UNIT_TOLERANCE,
    Category,
    Event,
    Quaternion,
    Vector3,
    check,
    check_covariance,
    check_frames,
    check_pose,
    publish,
)


class PoseEstimate(Event, category=Category.ESTIMATE):
    """Estimated pose of a body, at the time of the data used by the estimator.

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
        velocity: Of the body in the parent frame, metres per second; `None` if the estimator does
            not know it.
        covariance: Covariance of (x, y, z, roll, pitch, yaw), m², m rad and rad², in the parent
            frame as in ROS's ``PoseWithCovariance``: 36 numbers, row by row; empty if unknown.
    """

    frame_id: str = "odom"
    child_frame_id: str = "base_link"
    position: Vector3
    orientation: Quaternion
    velocity: Vector3 | None = None
    covariance: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        check_pose(self, self.position, self.orientation)
        check_frames(self, self.frame_id, self.child_frame_id)
        if self.velocity is not None:
            check(self, self.velocity)
        check_covariance(self, "covariance", 6)


class TrajectoryEstimate(Event, category=Category.ESTIMATE, eq=False):
    """Whole trajectory as now seen by an estimator, after loop closures and corrections.

    The last one of a run is judged beside the poses as they were sent (`PoseEstimate`). Frames and
    units are those of the estimator's poses.

    Attributes:
        frame_id: Parent frame, as in `PoseEstimate`.
        child_frame_id: Frame of the body.
        stamps: int64 nanoseconds, strictly rising, shape (n,): as those of the poses.
        positions: float64 metres in the parent frame, shape (n, 3).
        orientations: float64 unit quaternions (w, x, y, z), shape (n, 4).
    """

    frame_id: str = "odom"
    child_frame_id: str = "base_link"
    stamps: npt.NDArray[np.int64]
    positions: npt.NDArray[np.float64]
    orientations: npt.NDArray[np.float64]

    def __post_init__(self) -> None:
        check(self)
        name = type(self).__name__
        publish(name, "stamps", self.stamps, np.int64, {1})
        publish(name, "positions", self.positions, np.float64, {2})
        publish(name, "orientations", self.orientations, np.float64, {2})
        count = len(self.stamps)
        shapes = self.positions.shape, self.orientations.shape
        if shapes != ((count, 3), (count, 4)):
            raise TypeError(
                f"{name}: expected positions of shape ({count}, 3) and orientations of shape "
                f"({count}, 4), as many as stamps, found {shapes[0]} and {shapes[1]}"
            )
        if not np.isfinite(self.positions).all():
            raise ValueError(f"{name}.positions: expected finite numbers, found others")
        norms = np.linalg.norm(self.orientations, axis=1)
        if not (np.abs(norms - 1.0) <= UNIT_TOLERANCE).all():
            raise ValueError(f"{name}.orientations: expected unit quaternions, found others")
        if not (np.diff(self.stamps) > 0).all():
            raise ValueError(f"{name}.stamps: expected them to rise strictly, found others")


class TrackingEvent(Event, category=Category.ESTIMATE):
    """Base of the events of an estimator's tracking."""

    def __post_init__(self) -> None:
        check(self)


class TrackingLost(TrackingEvent):
    """Loss of tracking: from this stamp on, the estimator has no pose.

    Attributes:
        reason: Why, if known.
    """

    reason: str = ""


class TrackingRegained(TrackingEvent):
    """An estimator knows its pose again, from this stamp on."""


class TrackedFeatures(Event, category=Category.ESTIMATE, eq=False):
    """Features tracked by an estimator in an image; `stamp` is the image's.

    Attributes:
        frame_id: Optical frame of the image.
        points: float32 pixels, shape (n, 2): column, row (pixel centres are whole numbers).
        inliers: bool, shape (n,): those that agree with the estimated pose.
    """

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


class Score(Event, category=Category.SCORE):
    """Value of a metric for a single estimate.

    Attributes:
        subject: Source of the estimate.
        metric: ``position_error``, ``rotation_error``, ``ate_rmse`` (so far), …
        value: In `unit`.
        unit: ``m``, ``rad``, ``%``, ``s``, …
    """

    subject: str
    metric: str
    value: float
    unit: str

    def __post_init__(self) -> None:
        check(self)


class PointCloud(Event, category=Category.MAP, eq=False):
    """Points with colours, as ROS's ``sensor_msgs/PointCloud2`` would carry them.

    Attributes:
        frame_id: Frame of the points.
        points: float32 metres, shape (n, 3).
        colors: uint8 red, green, blue, shape (n, 3); shape (0, 3) if there are none.
    """

    frame_id: str = "map"
    points: npt.NDArray[np.float32]
    colors: npt.NDArray[np.uint8]

    def __post_init__(self) -> None:
        check(self)
        publish("PointCloud", "points", self.points, np.float32, {2})
        publish("PointCloud", "colors", self.colors, np.uint8, {2})
