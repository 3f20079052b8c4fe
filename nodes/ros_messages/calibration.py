"""Cameras that ROS has: what their CameraInfo says, as the announcement of a camera."""

from __future__ import annotations

from math import isfinite
from typing import Any

from events import CameraAnnouncement, CameraInfo
from events.frames import OPTICAL_TO_FRD


def camera_announcement(
    message: Any, source: str, images: tuple[str, ...], frame_id: str = ""
) -> CameraAnnouncement:
    """Return the announcement of a camera that looks ahead from the body's origin.

    Args:
        message: A ``sensor_msgs/msg/CameraInfo``.
        source: Of the camera's images.
        images: Which kinds of them there are.
        frame_id: If set, stands in the place of the message's own.

    Raises:
        ValueError: The message is no calibration of a pinhole camera.
    """
    return CameraAnnouncement(
        stamp=0,
        source=source,
        images=images,
        info=camera_info(message),
        rate=30.0,  # nobody says
        latency=0.0,
        frame_id=frame_id or message.header.frame_id,
        parent_frame_id="base_link",
        position=(0.0, 0.0, 0.0),
        orientation=OPTICAL_TO_FRD,
    )


def camera_info(message: Any) -> CameraInfo:
    """Read the intrinsics of a CameraInfo.

    Raises:
        ValueError: It describes no pinhole camera with plumb_bob distortion.
    """
    fx, skew, cx, _, fy, cy, *_ = (float(value) for value in message.k)
    coefficients = tuple(float(value) for value in message.d)
    sizes = 1 <= message.width <= 16384 and 1 <= message.height <= 16384
    finite = isfinite(fx + fy + cx + cy + sum(coefficients))
    if not (sizes and fx > 0.0 and fy > 0.0 and skew == 0.0 and finite):
        raise ValueError(
            f"expected a calibrated camera, found {message.width} x {message.height} pixels "
            f"with K = {message.k.tolist()} and D = {list(coefficients[:8])}"
        )
    part = message.roi.width not in {0, message.width} or message.roi.height not in {
        0,
        message.height,
    }
    if part or message.binning_x > 1 or message.binning_y > 1:
        raise ValueError(
            "expected a calibration of whole images, found binning of "
            f"{message.binning_x} x {message.binning_y} and a region of interest of "
            f"{message.roi.width} x {message.roi.height} pixels"
        )
    plain = not any(coefficients)
    if not (plain or (message.distortion_model == "plumb_bob" and len(coefficients) == 5)):
        raise ValueError(
            f"expected plumb_bob with 5 coefficients, found {message.distortion_model!r:.80} "
            f"with {len(coefficients)}"
        )
    return CameraInfo(
        width=int(message.width),
        height=int(message.height),
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        distortion=(0.0,) * 5 if plain else coefficients,
    )
