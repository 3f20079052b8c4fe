"""What a program is told about the run's cameras and IMU: the JSON text of WELCOME."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec

from events import CameraAnnouncement, ImuAnnouncement
from events.poses import pose_matrix


def describe(
    cameras: Sequence[tuple[CameraAnnouncement, Sequence[str]]],
    imu: ImuAnnouncement | None,
    clock: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the description of a run: the announcements' fields, and transforms to the body (FRD).

    Args:
        cameras: Each with the kinds of image that will be sent of it (``rgb8``, ``depth32f``, …).
        imu: The IMU whose samples will be sent.
        clock: ``kind`` of the run's clock (``lockstep`` or ``real``), and what else is known.
    """
    return {
        "clock": dict(clock),
        "cameras": [
            {**_sensor(camera, "body_from_camera"), "images": list(kinds)}
            for camera, kinds in cameras
        ],
        "imu": _sensor(imu, "body_from_imu") if imu else None,
    }


def _sensor(sensor: CameraAnnouncement | ImuAnnouncement, transform: str) -> dict[str, Any]:
    matrix = pose_matrix(sensor.position, sensor.orientation).tolist()
    return {**msgspec.to_builtins(sensor), transform: matrix}
