"""Wind: a mean, discrete gusts, and turbulence after Dryden; SI units, NED.

Source: MIL-F-8785C, "Flying Qualities of Piloted Airplanes" (1980), section 3.7, low altitude.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

import msgspec

from events import Vector3
from runtime.units import Duration

FOOT = 0.3048
KNOT = 0.514444
W20 = {"none": 0.0, "light": 15 * KNOT, "moderate": 30 * KNOT, "severe": 45 * KNOT}
"""Wind at a height of 20 feet by strength of turbulence, m/s."""

STRONGEST = 50.0
"""Limit of mean wind and gusts together, m/s: in 1 ms, more carries a vehicle past a wall."""

LOWEST, HIGHEST = 10 * FOOT, 1000 * FOOT
"""Range of heights of the model, metres; other heights are clipped."""

SLOWEST = 1.0  # least airspeed assumed for turbulence, m/s; at 0 the turbulence would stand still


def check_strength(*velocities: Vector3) -> None:
    """Refuse velocities (m/s) beyond `STRONGEST` together, with a `ValueError`."""
    total = sum(math.hypot(*velocity) for velocity in velocities)
    if not total <= STRONGEST:
        raise ValueError(
            f"velocity: expected up to {STRONGEST:g} m/s, gusts included, since the wind could "
            f"carry a vehicle through walls otherwise, found {total:g} m/s"
        )


class Gust(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Discrete gust of the shape 1 - cos, in addition to the mean wind.

    Attributes:
        velocity: Peak velocity, m/s north, east, down.
        start: Time of its beginning.
        rise: Time of its rise, and of its fall.
        hold: Time at its peak in between.
        period: Time from its beginning to the next; 0 for a single gust.
    """

    velocity: Vector3
    start: Duration = Duration(0)  # immutable
    rise: Duration = Duration(1.0)
    hold: Duration = Duration(0)
    period: Duration = Duration(0)

    def __post_init__(self) -> None:
        if not self.rise:
            raise ValueError("rise: expected a time above 0, found 0")
        if 0 < self.period < 2 * self.rise + self.hold:
            raise ValueError(
                f"period: expected at least the {2 * self.rise + self.hold:g} s that the gust "
                f"takes, found {self.period:g} s"
            )

    def share(self, seconds: float) -> float:
        """Return the gust's strength at a time, 0 to 1."""
        since = seconds - self.start
        if since <= 0.0:
            return 0.0
        if self.period:
            since %= self.period
        rise = min(since, 2 * self.rise + self.hold - since) / self.rise
        return 0.5 * (1.0 - math.cos(math.pi * min(max(rise, 0.0), 1.0)))


class WindSpec(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the wind.

    Attributes:
        velocity: Mean velocity of the air, m/s north, east, down: [5, 0, 0] blows to the north.
        gusts: Discrete gusts.
        turbulence: Strength of Dryden's turbulence (MIL-F-8785C, low altitude): ``none``,
            ``light``, ``moderate``, ``severe``, or the wind at 20 feet, m/s. Its scale depends on a
            vehicle's height above the world's zero and airspeed.
    """

    velocity: Vector3 = (0.0, 0.0, 0.0)
    gusts: tuple[Gust, ...] = ()
    turbulence: (
        Literal["none", "light", "moderate", "severe"]
        | Annotated[float, msgspec.Meta(ge=0, le=STRONGEST)]
    ) = "none"

    def __post_init__(self) -> None:
        check_strength(self.velocity, *(gust.velocity for gust in self.gusts))

    @property
    def w20(self) -> float:
        """Wind at a height of 20 feet for the turbulence, m/s."""
        return W20[self.turbulence] if isinstance(self.turbulence, str) else self.turbulence

    @property
    def still(self) -> bool:
        """Whether there is no wind at all."""
        return not (any(self.velocity) or self.gusts or self.w20)


def scales(height: float, w20: float) -> tuple[Vector3, Vector3]:
    """Return intensities (m/s) and lengths (m) along, across, vertical, by height and wind."""
    height = min(max(height, LOWEST), HIGHEST)
    shape = 0.177 + 0.000823 * height / FOOT
    vertical = 0.1 * w20
    flat = vertical / shape**0.4
    length = height / shape**1.2
    return (flat, flat, vertical), (length, length, height)


class Turbulence:
    """Exactly discretised Dryden filters of white noise, for a place in the air.

    Their states have no unit and are scaled by each height's intensity, so a change of height or
    speed changes only the velocity's scale suddenly.

    Args:
        start: Five numbers, normally distributed, from which the states are drawn.
    """

    NUMBERS = 5  # random numbers per step

    def __init__(self, start: list[float]) -> None:
        u, v1, v2, w1, w2 = start
        # Stationary: variances 1/2 and 1/4 of the two states, covariance 1/4.
        half, quarter = math.sqrt(0.5), math.sqrt(0.125)
        self._u = u
        self._v = (half * v1, quarter * (v1 + v2))
        self._w = (half * w1, quarter * (w1 + w2))

    def step(
        self, seconds: float, speed: float, height: float, w20: float, noise: list[float]
    ) -> Vector3:
        """Return the velocity along, across, vertical (m/s) after some seconds more.

        Args:
            speed: Through the air, metres per second.
            height: Metres above the ground.
            w20: Wind at a height of 20 feet, m/s.
            noise: Five normal numbers.
        """
        sigma, length = scales(height, w20)
        way = max(speed, SLOWEST) * seconds
        keep = math.exp(-way / length[0])
        self._u = keep * self._u + math.sqrt(1.0 - keep * keep) * noise[0]
        self._v = _second_order(self._v, way / length[1], noise[1], noise[2])
        self._w = _second_order(self._w, way / length[2], noise[3], noise[4])
        return sigma[0] * self._u, sigma[1] * _output(self._v), sigma[2] * _output(self._w)


def _second_order(
    state: tuple[float, float], d: float, first: float, second: float
) -> tuple[float, float]:
    """Step x1' = -x1 + n, x2' = -x2 + x1 by d, with white noise n of intensity 1."""
    x1, x2 = state
    keep, gone = math.exp(-d), math.exp(-2.0 * d)
    q11 = 0.5 * (1.0 - gone)
    q12 = 0.25 * (1.0 - gone * (1.0 + 2.0 * d))
    q22 = 0.25 * (1.0 - gone * (1.0 + 2.0 * d + 2.0 * d * d))
    l11 = math.sqrt(q11)
    l21 = q12 / l11
    l22 = math.sqrt(max(q22 - l21 * l21, 0.0))
    return keep * x1 + l11 * first, keep * (d * x1 + x2) + l21 * first + l22 * second


def _output(state: tuple[float, float]) -> float:
    """Return (1 + √3 s) / (1 + s)² of the noise: of variance 1."""
    root = math.sqrt(3.0)
    return root * state[0] + (1.0 - root) * state[1]


def turned(velocity: Vector3, mean: Vector3) -> Vector3:
    """Return a velocity along, across and vertical in ``map``; along north if there is no mean."""
    along, across, down = velocity
    flat = math.hypot(mean[0], mean[1])
    c, s = (mean[0] / flat, mean[1] / flat) if flat > 1e-9 else (1.0, 0.0)
    return c * along - s * across, s * along + c * across, down
