"""Response curves by name or from a file: which light becomes which grey level."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from events.photometry import response_light

_GAMMA = 2.2


def read_response(name: str) -> tuple[float, ...]:
    """Return the light of each of the 256 grey levels, as a `CameraAnnouncement` has it.

    Args:
        name: ``srgb``, for which the result is empty; ``linear``; ``gamma``, of 2.2; or the path of
            a ``pcalib.txt`` of TUM's monoVO data set: 256 rising numbers.

    Raises:
        ValueError: The file is missing or holds something else.
    """
    if name == "srgb":
        return ()
    if name in {"linear", "gamma"}:
        curve = np.linspace(0.0, 1.0, 256) ** (_GAMMA if name == "gamma" else 1.0)
        return tuple(curve.tolist())
    try:
        response = tuple(map(float, Path(name).read_text(encoding="utf-8").split()))
        response_light(response or (0.0,))
    except (OSError, ValueError) as error:
        raise ValueError(
            f"response: expected srgb, linear, gamma or a file of 256 rising numbers, found "
            f"{name}: {error}"
        ) from None
    return response


def noise_at(light: npt.NDArray[np.float64], level: int, noise: float, electrons: float) -> float:
    """Return the standard deviation of an image's noise at a grey level, grey levels.

    Args:
        light: Of each grey level, shape (256,).
        level: 1 to 254.
        noise: What is the same at all levels, grey levels.
        electrons: Of a white pixel, for the shot noise; 0 if there is none.
    """
    levels_per_light = 2.0 / (light[level + 1] - light[level - 1])
    shot = levels_per_light * np.sqrt(light[level] / electrons) if electrons else 0.0
    return float(np.hypot(noise, shot))
