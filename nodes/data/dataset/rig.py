"""Which sensors a data set is made of, chosen among those that are announced."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from events import Announcement, CameraAnnouncement, ImuAnnouncement
from nodes.vehicles import Vehicles

WORLD_AXES = "world: x north, y west, z up; origin on the ground"
"""The world of a data set, for the heads of its files: z up, as their readers expect it.

Bodies stay FRD and cameras optical, so measurements and mountings stay as they are."""


class Rig(msgspec.Struct, frozen=True):
    """The sensors of one body.

    Attributes:
        body: Source of its odometry.
        cameras: One or more, in the order in which they were announced.
        imu: Its IMU, if it has one.
    """

    body: str
    cameras: tuple[CameraAnnouncement, ...]
    imu: ImuAnnouncement | None


def choose(announcements: Sequence[Announcement], named: str | None) -> Rig:
    """Choose the cameras of one body, and its IMU.

    Args:
        announcements: All there are.
        named: A source to keep to: a camera, or a body; None for the first camera's body.

    Raises:
        ValueError: No such camera gives images.
    """
    announced = [a for a in announcements if isinstance(a, CameraAnnouncement)]
    able = [a for a in announced if {"rgb", "grey"} & {*a.images}]
    cameras = [a for a in able if (_belongs(a, named) if named is not None else not a.undistorted)]
    if not cameras:
        found = ", ".join(f"{a.source} ({', '.join(a.images)})" for a in announced) or "none"
        called = f" called {named}" if named is not None else ""
        raise ValueError(f"expected a camera with rgb or grey images{called}, found {found}")
    vehicles = Vehicles()
    for each in announcements:
        vehicles.announced(each)

    def body_of(source: str) -> str:
        return vehicles.carrier(source) or source.rpartition("/")[0] or source

    body = body_of(cameras[0].source)
    imus = (
        a for a in announcements if isinstance(a, ImuAnnouncement) and body_of(a.source) == body
    )
    twins = cameras[0].undistorted  # either what cameras give, or that without distortion
    return Rig(
        body=body,
        cameras=tuple(
            a for a in cameras if body_of(a.source) == body and bool(a.undistorted) == bool(twins)
        ),
        imu=next(imus, None),
    )


def _belongs(camera: CameraAnnouncement, named: str) -> bool:
    """Tell whether a camera is the named source, below it, or (its grey images) above it."""
    return f"{camera.source}/".startswith(f"{named}/") or named == f"{camera.source}/grey"
