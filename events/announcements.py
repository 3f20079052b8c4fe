"""What a node will provide, sent once before the first event.

Bridges build publishers from these, estimators their calibration, reports their tables.
"""

from __future__ import annotations

from typing import ClassVar

from events.base import Category, Event, Quaternion, Vector3
from events.checks import check, check_pose
from events.sensors import CameraInfo


class Announcement(Event):
    """Base of all announcements; `source` names what is announced."""

    category: ClassVar[Category] = Category.ANNOUNCEMENT

    def __post_init__(self) -> None:
        check(self)


class VehicleAnnouncement(Announcement):
    """A vehicle that takes set-points.

    Attributes:
        mass: Kilograms.
        max_thrust: Newtons, all motors together.
        control_rate: Hertz of its controller.
        position: Where it stands at the start, metres in ``map``.
        orientation: Rotation from body to ``map`` at the start.
    """

    mass: float
    max_thrust: float
    control_rate: float
    position: Vector3
    orientation: Quaternion

    def __post_init__(self) -> None:
        check_pose(self, self.position, self.orientation)
        check(self, (self.mass, self.max_thrust, self.control_rate))


class CameraAnnouncement(Announcement):
    """A camera and its place on a body.

    Attributes:
        images: What it gives: ``rgb``, ``grey``, ``depth``, ``segmentation``.
        info: Intrinsics; the same for all its images.
        rate: Frames per second.
        latency: Seconds from exposure to delivery.
        frame_id: Optical frame, as in its images.
        parent_frame_id: Frame it is mounted on; ``map`` for a free camera.
        position: The camera in the parent frame, metres.
        orientation: Rotation from the **optical** frame to the parent frame.
    """

    images: tuple[str, ...]
    info: CameraInfo
    rate: float
    latency: float
    frame_id: str
    parent_frame_id: str
    position: Vector3
    orientation: Quaternion

    def __post_init__(self) -> None:
        check_pose(self, self.position, self.orientation)
        check(self, (self.rate, self.latency, 0.0))


class ImuAnnouncement(Announcement):
    """An IMU and its noise model (continuous-time densities, as in Kalibr's files).

    Attributes:
        rate: Hertz.
        frame_id: Frame of the measurements.
        gyroscope_noise_density: rad/s/√Hz.
        gyroscope_random_walk: rad/s²/√Hz.
        accelerometer_noise_density: m/s²/√Hz.
        accelerometer_random_walk: m/s³/√Hz.
    """

    rate: float
    frame_id: str
    gyroscope_noise_density: float
    gyroscope_random_walk: float
    accelerometer_noise_density: float
    accelerometer_random_walk: float


class PathAnnouncement(Announcement):
    """Where a pilot is about to fly; a simulator refuses what is not free.

    Attributes:
        waypoints: Places to pass in this order, metres in ``map``; at first the vehicle climbs from
            where it stands to the height of the first one.
    """

    waypoints: tuple[Vector3, ...]


class EstimatorAnnouncement(Announcement):
    """Something that will send pose estimates; `source` is theirs.

    Attributes:
        method: What it is, in a word or two: ``features``, ``ORB-SLAM3 rgbd``.
        scale_free: True if its unit of length is its own (monocular).
    """

    method: str
    scale_free: bool = False
