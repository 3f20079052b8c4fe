"""Where the sensors of a rig sit: the transforms that calibration files speak of."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from events import CameraAnnouncement, ImuAnnouncement
from events.poses import inverse, pose_matrix
from nodes.dataset.rig import Rig

Floats = npt.NDArray[np.float64]


def body_frame(imu: ImuAnnouncement) -> str:
    """Return the frame that an IMU is mounted on."""
    return str(getattr(imu, "parent_frame_id", imu.frame_id))


def imu_in_body(imu: ImuAnnouncement | None) -> Floats:
    """Return the IMU's pose in the body's frame, shape (4, 4); the body itself without an IMU."""
    if imu is None or not hasattr(imu, "position"):
        return np.eye(4)
    return pose_matrix(imu.position, getattr(imu, "orientation", (1.0, 0.0, 0.0, 0.0)))


def camera_in_imu(rig: Rig, camera: CameraAnnouncement) -> Floats:
    """Return the pose of a camera's optical frame in the IMU's frame, shape (4, 4).

    Raises:
        ValueError: They are not mounted on one body.
    """
    if rig.imu is not None and body_frame(rig.imu) != camera.parent_frame_id:
        raise ValueError(
            f"{camera.source}: expected a camera mounted on {body_frame(rig.imu)}, as "
            f"{rig.imu.source} is, found one on {camera.parent_frame_id}"
        )
    return inverse(imu_in_body(rig.imu)) @ pose_matrix(camera.position, camera.orientation)


def pair(rig: Rig) -> tuple[CameraAnnouncement, ...]:
    """Return the first stereo pair of a rig, left before right, or its first camera alone."""
    by_source = {camera.source: camera for camera in rig.cameras}
    for camera in rig.cameras:
        if camera.stereo in by_source:
            return by_source[camera.stereo], camera
    return rig.cameras[:1]
