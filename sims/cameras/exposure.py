"""Automatic exposure: exposure time and gain of the next image from the light of the last ones.

Pure computation; the state belongs to the camera's rig (`sims.cameras.rig`), in simulated time.
"""

from __future__ import annotations

import math
from typing import Annotated

import msgspec

from runtime.units import Latency

_MOST = 8.0
"""Factor that one image may ask for, either way: a black one says nothing of how dark it is."""


class AutoExposure(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the automatic exposure, which first makes use of the time and then of the gain.

    Attributes:
        target: Mean light of an image that is well exposed, as a share of white's; in linear
            light, where 0.18 is a middle grey.
        min_exposure: Shortest exposure time.
        max_exposure: Longest exposure time.
        exposure_step: Exposure times are whole multiples of it, as of an image sensor's row time.
        max_gain: Largest factor of the amplifier.
        gain_step: Gains are whole multiples of it, decibels.
        damping: Share of the error (of its logarithm) that stays after each image: 0 is quickest.
        tolerance: Error, as a share of the target, that is left alone.
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
    """Exposure time and gain of one camera, image by image.

    What an image asks for is computed from its own exposure time and gain, so images that come late
    make the control slow, and do not make it oscillate: it never goes beyond what an image
    asked for.

    Args:
        settings: Of the control.
        exposure: Exposure time to begin with, seconds, as far as the settings allow it.
    """

    def __init__(self, settings: AutoExposure, exposure: float) -> None:
        self._settings = settings
        self._product = exposure
        self._seen: list[tuple[int, float, float]] = []  # delivery (ns), product, light

    def delivered(self, stamp: int, exposure: float, gain: float, light: float) -> None:
        """Note a delivered image.

        Args:
            stamp: Time of its delivery, nanoseconds.
            exposure: Its exposure time, seconds.
            gain: Its gain.
            light: Its mean light (`Development.meter`), 0 to 1.
        """
        self._seen.append((stamp, exposure * gain, light))

    def next(self, stamp: int) -> tuple[float, float]:
        """Return exposure time (seconds) and gain of an exposure that begins at a time.

        Args:
            stamp: Nanoseconds; above that of the call before. The last image that was delivered
                *before* it counts, whenever this is called.
        """
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
