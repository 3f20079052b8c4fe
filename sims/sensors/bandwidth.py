"""Low-pass filter of a sensor: what changes quickly arrives weaker, and everything later."""

from __future__ import annotations

import math

from events import Vector3


class LowPass:
    """Butterworth filter of second order, of unit gain at rest.

    By the bilinear transform with the corner in its place (A. Oppenheim, R. Schafer, *Discrete-time
    signal processing*, 3rd edition, section 7.2). Slow motion is delayed by √2/(2π·bandwidth).

    Args:
        bandwidth: Frequency at which half of the power is left, Hz, below half of `rate`.
        rate: Samples per second.
    """

    def __init__(self, bandwidth: float, rate: float) -> None:
        tangent = math.tan(math.pi * bandwidth / rate)
        scale = 1.0 / (1.0 + math.sqrt(2.0) * tangent + tangent**2)
        self._forward = tangent**2 * scale
        self._back = (
            2.0 * (1.0 - tangent**2) * scale,
            -(1.0 - math.sqrt(2.0) * tangent + tangent**2) * scale,
        )
        self._past: list[tuple[Vector3, Vector3]] = []  # samples and their filtered values

    def __call__(self, sample: Vector3) -> Vector3:
        """Return the next filtered sample; before the first one nothing has changed."""
        if not self._past:
            self._past = [(sample, sample)] * 2
        (last, filtered), (second, before) = self._past
        a, (b, c) = self._forward, self._back
        x, y, z = (
            a * (new + 2.0 * old + older) + b * near + c * far
            for new, old, older, near, far in zip(
                sample, last, second, filtered, before, strict=True
            )
        )
        self._past = [(sample, (x, y, z)), self._past[0]]
        return x, y, z
