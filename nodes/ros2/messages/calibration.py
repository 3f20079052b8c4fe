"""What a CameraInfo says of a camera that is announced, and the other way round."""

from __future__ import annotations

from math import isfinite
from typing import Any

import numpy as np
import numpy.typing as npt

from events import CameraAnnouncement, CameraInfo
from events.camera_info import COEFFICIENTS
from events.frames import OPTICAL_TO_FRD


def projection_matrix(camera: CameraAnnouncement) -> npt.NDArray[np.float64]:
    """Return P, shape (3, 4): K, and of a stereo rig's right camera -fx times its baseline."""
    info = camera.info
    return np.column_stack([info.matrix(), [0.0 - info.fx * camera.baseline, 0.0, 0.0]])


def camera_announcement(
    message: Any, source: str, images: tuple[str, ...], frame_id: str = ""
) -> CameraAnnouncement:
    """Return the announcement of a camera that looks ahead from the body's origin.

    Args:
        message: A ``sensor_msgs/msg/CameraInfo``.
        images: Which kinds of them there are.
        frame_id: If set, stands in the place of the message's own.

    Raises:
        ValueError: The message is no calibration of a camera.
    """
    info = camera_info(message)
    return CameraAnnouncement(
        stamp=0,
        source=source,
        images=images,
        info=info,
        rate=30.0,  # nobody says
        latency=0.0,
        baseline=abs(float(message.p[3])) / info.fx,
        frame_id=frame_id or message.header.frame_id,
        parent_frame_id="base_link",
        position=(0.0, 0.0, 0.0),
        orientation=OPTICAL_TO_FRD,
    )


def camera_info(message: Any) -> CameraInfo:
    """Read the intrinsics of a CameraInfo.

    Raises:
        ValueError: It describes no camera with a distortion that `CameraInfo` knows.
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
    model = message.distortion_model
    if not any(coefficients) and model != "equidistant":
        model, coefficients = "plumb_bob", (0.0,) * 5
    expected = COEFFICIENTS.get(model, 0)
    # plumb_bob of four has no k3; OpenCV's rational model may have more, of a thin prism and tilt.
    coefficients += (0.0,) * (expected - len(coefficients) if len(coefficients) == 4 else 0)
    if not expected or len(coefficients) < expected or any(coefficients[expected:]):
        known = ", ".join(f"{name} with {count}" for name, count in COEFFICIENTS.items())
        raise ValueError(
            f"expected one of {known} coefficients, found {model!r:.80} with {len(message.d)}"
        )
    return CameraInfo(
        width=int(message.width),
        height=int(message.height),
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        distortion_model=model,
        distortion=coefficients[:expected],
    )
