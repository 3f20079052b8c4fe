"""Events and announcements that the tests of the bridge share."""

from __future__ import annotations

import functools
from collections.abc import Callable
from math import sqrt
from typing import Any

import msgspec
import numpy as np

from events import (
    Announcement,
    CameraAnnouncement,
    CameraInfo,
    EstimatorAnnouncement,
    Image,
    ImuAnnouncement,
    Odometry,
    VehicleAnnouncement,
)
from nodes.ros2.messages import outgoing
from nodes.ros2.messages.outgoing import Outgoing
from nodes.ros2.messages.topics import PublishingConfig
from nodes.ros2.messages.typestore import Stamps, TypeStore

S = sqrt(0.5)
EAST = (S, 0.0, 0.0, S)
"""A body (FRD in NED) that looks east."""

DEFAULTS = PublishingConfig()
STAMP = 3_000_000_007


@functools.cache
def store() -> TypeStore:
    """Return the type store, which takes a while to make."""
    return TypeStore()


def message(
    write: Callable[[Outgoing, Any], Any],
    event: Any,
    *announced: Announcement,
    config: PublishingConfig = DEFAULTS,
    **sensors: Announcement,
) -> Any:
    """Return what ROS reads in the message of an event; `sensors` are announced by kind."""
    out = Outgoing(store(), config, Stamps().out)
    for announcement in announced:
        out.announced(announcement)
    for kind, sensor in sensors.items():
        out.sensors[kind, sensor.source] = sensor
    made = write(out, event)
    return store().deserialize(bytes(store().serialize(made)), made.__msgtype__)


def calibration(camera: CameraAnnouncement) -> Any:
    """Return the CameraInfo of a camera's image."""
    taken = msgspec.structs.replace(image(), source=camera.source)
    return message(outgoing.camera_info, taken, camera)


def vehicle() -> VehicleAnnouncement:
    return VehicleAnnouncement(
        stamp=0,
        source="drone",
        mass=1.0,
        max_thrust=20.0,
        control_rate=400.0,
        position=(1.0, 2.0, 0.0),
        orientation=EAST,
    )


def camera(source: str = "drone/camera", parent: str = "base_link") -> CameraAnnouncement:
    return CameraAnnouncement(
        stamp=0,
        source=source,
        images=("rgb", "depth"),
        info=CameraInfo.from_fov(64, 48, 1.5),
        rate=30.0,
        latency=0.0,
        frame_id=f"{source}_optical",
        parent_frame_id=parent,
        position=(0.1, 0.2, 0.3),
        orientation=(0.5, 0.5, 0.5, 0.5),
    )


def imu() -> ImuAnnouncement:
    return ImuAnnouncement(
        stamp=0,
        source="drone",
        rate=200.0,
        frame_id="base_link",
        gyroscope_noise_density=0.001,
        gyroscope_random_walk=0.0,
        accelerometer_noise_density=0.01,
        accelerometer_random_walk=0.0,
    )


def estimator() -> EstimatorAnnouncement:
    return EstimatorAnnouncement(stamp=0, source="vo", method="features")


def odometry(stamp: int = STAMP) -> Odometry:
    return Odometry(
        stamp=stamp,
        source="drone",
        position=(1.0, 2.5, -3.0),
        orientation=EAST,
        linear_velocity=(1.0, 2.0, 3.0),
        angular_velocity=(0.1, 0.2, 0.3),
    )


def image(stamp: int = STAMP, height: int = 48, width: int = 64) -> Image:
    data = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
    return Image(stamp=stamp, source="drone/camera", frame_id="drone/camera_optical", data=data)
