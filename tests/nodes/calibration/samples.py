"""Rigs for tests of calibrations."""

from __future__ import annotations

from typing import Any

from events import CameraAnnouncement, CameraInfo, ImuAnnouncement, Vector3
from events.camera_info import DistortionModel
from events.frames import OPTICAL_TO_FRD, from_rpy, multiply
from nodes.data.dataset.recording import Rig

IMU = ImuAnnouncement(
    stamp=0,
    source="drone/imu",
    rate=200.0,
    frame_id="base_link",
    gyroscope_noise_density=1.5e-4,
    gyroscope_random_walk=2e-5,
    accelerometer_noise_density=2e-3,
    accelerometer_random_walk=3e-3,
)

LENSES: dict[str, tuple[DistortionModel, tuple[float, ...]]] = {
    "pinhole": ("plumb_bob", (0.0, 0.0, 0.0, 0.0, 0.0)),
    "radtan4": ("plumb_bob", (-0.28, 0.07, 1e-4, 2e-5, 0.0)),
    "radtan5": ("plumb_bob", (-0.28, 0.07, 1e-4, 2e-5, 0.01)),
    "rational": ("rational_polynomial", (-0.28, 0.07, 1e-4, 2e-5, 0.01, 0.01, 0.02, 0.003)),
    "kb4": ("equidistant", (0.01, -0.02, 0.003, 0.001)),
}


def camera(
    name: str = "left",
    lens: str = "pinhole",
    position: Vector3 = (0.15, 0.02, -0.03),
    images: tuple[str, ...] = ("rgb", "depth"),
    **more: Any,
) -> CameraAnnouncement:
    """Return a camera that looks somewhere, with fx ≠ fy and an odd principal point."""
    model, coefficients = LENSES[lens]
    info = CameraInfo(
        width=640,
        height=480,
        fx=401.25,
        fy=399.5,
        cx=322.1,
        cy=237.7,
        distortion_model=model,
        distortion=coefficients,
    )
    fields: dict[str, Any] = {
        "stamp": 0,
        "source": f"drone/{name}",
        "images": images,
        "info": info,
        "rate": 30.0,
        "latency": 0.04,
        "frame_id": f"drone/{name}_optical",
        "parent_frame_id": "base_link",
        "position": position,
        "orientation": multiply(from_rpy(0.1, -0.5, 0.3), OPTICAL_TO_FRD),
    }
    return CameraAnnouncement(**(fields | more))


def stereo(lens: str = "pinhole", **more: Any) -> Rig:
    """Return a pair of cameras, the right one somewhat turned, and an IMU."""
    turned = multiply(from_rpy(0.11, -0.49, 0.31), OPTICAL_TO_FRD)
    right = camera(
        "right",
        lens,
        (0.14, 0.12, -0.02),
        stereo="drone/left",
        baseline=0.1,
        orientation=turned,
        **more,
    )
    return Rig("drone", (camera("left", lens, **more), right), IMU)
