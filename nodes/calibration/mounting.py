"""Where the sensors of a rig sit: the transforms that calibration files speak of."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from events import CameraAnnouncement
from events.poses import inverse, pose_matrix
from nodes.dataset.rig import Rig

Floats = npt.NDArray[np.float64]


def camera_in_imu(rig: Rig, camera: CameraAnnouncement) -> Floats:
    """Return the pose of a camera's optical frame in the IMU's frame (or the body's), shape (4, 4).

    Raises:
        ValueError: They are not mounted on one body.
    """
    if rig.imu is not None and rig.imu.parent_frame_id != camera.parent_frame_id:
        raise ValueError(
            f"{camera.source}: expected a camera mounted on {rig.imu.parent_frame_id}, as "
            f"{rig.imu.source} is, found one on {camera.parent_frame_id}"
        )
    in_body = pose_matrix(camera.position, camera.orientation)
    if rig.imu is None:
        return in_body
    return inverse(pose_matrix(rig.imu.position, rig.imu.orientation)) @ in_body


def pair(rig: Rig) -> tuple[CameraAnnouncement, ...]:
    """Return the first stereo pair of a rig, left before right, or its first camera alone."""
    by_source = {camera.source: camera for camera in rig.cameras}
    for camera in rig.cameras:
        if camera.stereo in by_source:
            return by_source[camera.stereo], camera
    return rig.cameras[:1]
