"""Effects on images: response curve, defocus, motion blur, and automatic exposure."""

from __future__ import annotations

import math
import zlib
from pathlib import Path
from typing import Annotated

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from events.camera_info import response_light
from runtime.units import Latency

_GAMMA = 2.2


def read_response(name: str) -> tuple[float, ...]:
    """Return the light of the 256 grey levels, as in `CameraAnnouncement.response`.

    Args:
        name: ``srgb`` (an empty result), ``linear``, ``gamma`` (of 2.2), or the path of a
            ``pcalib.txt`` of TUM's monoVO data set: 256 rising numbers.

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
        noise: Common to all levels, grey levels.
        electrons: Of a white pixel, for the shot noise; 0 for none.
    """
    levels_per_light = 2.0 / (light[level + 1] - light[level - 1])
    shot = levels_per_light * np.sqrt(light[level] / electrons) if electrons else 0.0
    return float(np.hypot(noise, shot))


Image = npt.NDArray[np.uint16]  # codes of linear light, shape (height, width, 3) or (height, width)
MOST = 9  # most renderings of an exposure: each costs as much as an image without motion blur


def defocused(image: Image, sigma: float) -> Image:
    """Return the image seen through a lens whose point spread is a Gaussian of `sigma` pixels."""
    if sigma <= 0.0:
        return image
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), dtype=np.uint16)


def moments(exposure: float, shift: float) -> list[float]:
    """Return the moments to draw for motion blur, seconds from the middle of the exposure.

    They are the middles of an odd number of equal parts of it, about a pixel of motion apart.

    Args:
        exposure: Seconds that the shutter is open.
        shift: Pixels by which the image moves meanwhile.
    """
    count = 2 * math.ceil((min(shift, MOST) - 1.0) / 2.0) + 1 if shift > 1.0 else 1
    return [exposure * ((k + 0.5) / count - 0.5) for k in range(count)]


def generator(seed: int, camera: str, stamp_ns: int) -> np.random.Generator:
    """Return the generator of an exposure's noise, the same in every process."""
    words = (seed, zlib.crc32(camera.encode()), stamp_ns)
    return np.random.default_rng([word & 0xFFFF_FFFF_FFFF_FFFF for word in words])


def grey_of(rgb: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return the luma (BT.601) of a colour image, shape (height, width)."""
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


_MOST = 8.0  # largest correction factor per image, either way: black gives no measure of darkness


class AutoExposure(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of automatic exposure, first by exposure time and then by gain.

    Attributes:
        target: Mean light of a well-exposed image, a share of white's in linear light; 0.18: grey.
        min_exposure: Shortest exposure time.
        max_exposure: Longest exposure time.
        exposure_step: Step of the exposure time, such as an image sensor's row time.
        max_gain: Largest factor of the amplifier.
        gain_step: Step of the gain, decibels.
        damping: Share of the error (of its logarithm) left after each image: 0 is quickest.
        tolerance: Error, as a share of the target, left uncorrected.
    """

    target: Annotated[float, msgspec.Meta(ge=0.01, le=0.9)] = 0.18
    min_exposure: Latency = Latency(20e-6)  # immutable
    max_exposure: Latency = Latency(10e-3)
    exposure_step: Latency = Latency(10e-6)
    max_gain: Annotated[float, msgspec.Meta(ge=1.0, le=1000.0)] = 8.0
    gain_step: Annotated[float, msgspec.Meta(gt=0.0, le=6.0)] = 0.5
    damping: Annotated[float, msgspec.Meta(ge=0.0, le=0.95)] = 0.5
    tolerance: Annotated[float, msgspec.Meta(ge=0.0, le=0.5)] = 0.03

    def __post_init__(self) -> None:
        if not 0.0 < self.exposure_step <= self.min_exposure <= self.max_exposure:
            raise ValueError(
                "exposure_step, min_exposure, max_exposure: expected 0 < step ≤ min ≤ max, found "
                f"{self.exposure_step:g} s, {self.min_exposure:g} s, {self.max_exposure:g} s"
            )


class ExposureControl:
    """Automatic exposure time and gain of a camera, image by image.

    What an image asks for is computed from its own exposure time and gain: late images slow the
    control, but it never goes beyond an image's request.
    """

    def __init__(self, settings: AutoExposure, exposure: float) -> None:
        self._settings = settings
        self._product = exposure
        self._seen: list[tuple[int, float, float]] = []  # delivery (ns), product, light

    def delivered(self, stamp: int, exposure: float, gain: float, light: float) -> None:
        """Note an image delivered at a stamp (ns): exposure (s), gain, mean light (0 to 1)."""
        self._seen.append((stamp, exposure * gain, light))

    def next(self, stamp: int) -> tuple[float, float]:
        """Return exposure time (s) and gain at a rising stamp (ns), by the last image before."""
        settings = self._settings
        before = [seen for seen in self._seen if seen[0] < stamp]
        if before:
            self._seen = self._seen[len(before) :]
            _, product, light = before[-1]
            ratio = settings.target / max(light, settings.target / _MOST)
            error = math.log(product * max(ratio, 1.0 / _MOST) / self._product)
            if abs(error) > settings.tolerance:
                self._product *= math.exp((1.0 - settings.damping) * error)
        steps = int(settings.max_exposure / settings.exposure_step + 1e-9)
        least = math.ceil(settings.min_exposure / settings.exposure_step - 1e-9)
        longest = steps * settings.exposure_step
        most = longest * settings.max_gain
        self._product = min(max(self._product, least * settings.exposure_step), most)
        rows = max(round(min(self._product, longest) / settings.exposure_step), least)
        decibels = 20.0 * math.log10(max(self._product / longest, 1.0))
        largest = math.floor(20.0 * math.log10(settings.max_gain) / settings.gain_step + 1e-9)
        decibels = min(round(decibels / settings.gain_step), largest) * settings.gain_step
        return rows * settings.exposure_step, 10.0 ** (decibels / 20.0)
