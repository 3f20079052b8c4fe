"""Kalibr's calibration of a replayed rig: where cameras and IMU are, and what noise has the IMU.

A chain speaks of its IMU, so that is where the body is unless the recording says where the IMU is
in it. Events of an IMU in ROS's axes have turned ones here, by half a turn about x.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np

from events import CameraAnnouncement, ImuAnnouncement
from events.frames import OPTICAL_TO_FRD, axes_of
from events.geometry import Floats, Pose, pose_matrix, pose_tuples
from nodes.data.replay.folders import as_pair
from nodes.data.replay.reader import ReplayConfig, ReplayError
from nodes.kalibr import Chain, KalibrCamera, read_chain

_HALF_TURN = np.diag([1.0, -1.0, -1.0, 1.0])


def chain_of(config: ReplayConfig) -> Chain | None:
    """Return the calibration that the settings name; a `ReplayError` if it cannot be read."""
    if not config.calibration:
        return None
    try:
        return read_chain([Path(path) for path in config.calibration])
    except ValueError as error:
        raise ReplayError(f"calibration: {error}") from None


def imu_in_body(imu: ImuAnnouncement | None) -> Floats:
    """Return the transform from the axes of an IMU's messages to the body, (4, 4).

    Without an IMU, those of a body of ROS's (forward, left, up).
    """
    if imu is None:
        return _HALF_TURN
    turned = _HALF_TURN if axes_of(imu.frame_id) == "body" else np.eye(4)
    return np.asarray(pose_matrix(imu.position, imu.orientation) @ turned)


def mountings(chain: Chain, imu: Floats, first: Pose | None = None) -> list[Pose]:
    """Return where each camera's optical frame is in the body.

    Args:
        imu: Transform from the IMU of the chain to the body, (4, 4).
        first: Pose of the first camera if the chain names no IMU; looking ahead from the body's
            origin if None.
    """
    ahead = pose_matrix(*(first or ((0.0, 0.0, 0.0), OPTICAL_TO_FRD)))
    return [
        pose_tuples(ahead @ camera.in_first if camera.in_imu is None else imu @ camera.in_imu)
        for camera in chain.cameras
    ]


def with_noise(imu: ImuAnnouncement, chain: Chain) -> ImuAnnouncement:
    """Return an IMU with the noise, and the rate, that its calibration says, if it does."""
    noise = chain.imu
    if noise is None:
        return imu
    return msgspec.structs.replace(
        imu,
        rate=noise.rate or imu.rate,
        gyroscope_noise_density=noise.gyroscope_noise_density,
        gyroscope_random_walk=noise.gyroscope_random_walk,
        accelerometer_noise_density=noise.accelerometer_noise_density,
        accelerometer_random_walk=noise.accelerometer_random_walk,
    )


def as_pairs(cameras: Sequence[CameraAnnouncement]) -> list[CameraAnnouncement]:
    """Return cameras, of which two that follow each other and stand side by side are a pair."""
    paired = list(cameras)
    for number in range(1, len(paired)):
        left, right = paired[number - 1 : number + 1]
        paired[number] = right if left.stereo else as_pair(left, right)
    return paired


def check_size(camera: KalibrCamera, size: Sequence[int], name: str) -> None:
    """Raise a `ReplayError` unless a camera's images have the size (width, height) it is of."""
    if (camera.info.width, camera.info.height) != tuple(size):
        raise ReplayError(
            f"{name}: expected images of {camera.info.width} x {camera.info.height} pixels, as the "
            f"calibration of {camera.name} is of, found {size[0]} x {size[1]}"
        )
