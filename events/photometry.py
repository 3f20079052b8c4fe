"""From grey levels to light and back: response curves and vignettes, as cameras announce them.

Light is a share of what makes a pixel white (255) in the middle of the image.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from events.camera_info import CameraInfo

Floats = npt.NDArray[np.float64]


def srgb_light() -> Floats:
    """Return the light of each of the 256 grey levels of sRGB (IEC 61966-2-1), shape (256,)."""
    levels = np.arange(256) / 255.0
    return np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)


def response_light(response: tuple[float, ...]) -> Floats:
    """Return the light of each of the 256 grey levels, shape (256,), from 0 to 1.

    Args:
        response: As in `CameraAnnouncement`, 256 rising numbers; empty stands for sRGB's.

    Raises:
        ValueError: They are not 256, or do not rise.
    """
    if not response:
        return srgb_light()
    light = np.array(response, dtype=np.float64)
    if light.shape != (256,) or not (np.diff(light) > 0.0).all():
        raise ValueError(
            f"response: expected 256 numbers, each above the one before, found {light.size}"
            + (" that do not rise" if light.size == 256 else "")
        )
    return np.asarray((light - light[0]) / (light[-1] - light[0]))


def vignette_map(info: CameraInfo, vignette: tuple[float, ...]) -> Floats:
    """Return the share of the light that reaches each pixel, shape (height, width).

    Args:
        info: The camera.
        vignette: Coefficients a1, a2, … of ``1 + a1 r² + a2 r⁴ + …``, where r is the distance from
            the principal point in halves of the image's diagonal.
    """
    half = np.hypot(info.width, info.height) / 2.0
    across = (np.arange(info.width) - info.cx) / half
    down = (np.arange(info.height) - info.cy) / half
    share = np.polynomial.Polynomial((1.0, *vignette))(across**2 + down[:, None] ** 2)
    return np.asarray(share)
