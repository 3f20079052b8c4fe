"""What an estimator believes."""

from __future__ import annotations

from typing import ClassVar

from events.base import Category, Event, Quaternion, Vector3


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


class TrackingLost(Event):
    """An estimator no longer knows where it is.

    Attributes:
        reason: Why, if known.
    """

    category: ClassVar[Category] = Category.ESTIMATE

    reason: str = ""


class TrackingRegained(Event):
    """An estimator knows again where it is."""

    category: ClassVar[Category] = Category.ESTIMATE
