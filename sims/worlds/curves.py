"""Curves in time: what a body's path, a light's strength and a fog's density have in common."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from events import Vector3

_YAW_STEP = 0.02
"""Seconds between the headings that are worked out beforehand."""

_TURN = 0.25
"""Seconds over which changes of heading are smoothed (standard deviation)."""


def within(seconds: float, times: Sequence[float], loop: bool) -> float:
    """Return a time within a curve's: the end holds, or the beginning comes again."""
    first, last = times[0], times[-1]
    if loop and last > first and seconds > first:
        return first + (seconds - first) % (last - first)
    return min(max(seconds, first), last)


def interpolated(
    times: Sequence[float], values: Sequence[float], seconds: float, *, loop: bool, smooth: bool
) -> float:
    """Return a curve's value at a time, between its knots linear or with rest at each of them."""
    seconds = within(seconds, times, loop)
    after = min(bisect_right(times, seconds), len(times) - 1)
    if after == 0:
        return values[0]
    before = after - 1
    share = (seconds - times[before]) / (times[after] - times[before])
    if smooth:
        share *= share * (3.0 - 2.0 * share)
    return values[before] + share * (values[after] - values[before])


class Path(NamedTuple):
    """A smooth way through places, with the heading of its direction.

    Attributes:
        times: When it is at each place, seconds, rising.
        cubics: For each stretch the coefficients of (t - its start)³, ², ¹ and ⁰, each (x, y, z).
        yaws: Headings, radians, at equal steps from the first time to the last.
        loop: Whether it begins anew when it is over; else its end holds.
    """

    times: tuple[float, ...]
    cubics: tuple[Any, ...]
    yaws: tuple[float, ...]
    loop: bool

    def at(self, seconds: float) -> tuple[Vector3, float]:
        """Return the place and the heading (radians) at a time."""
        seconds = within(seconds, self.times, self.loop)
        stretch = min(bisect_right(self.times, seconds), len(self.times) - 1) - 1
        t = seconds - self.times[stretch]
        a, b, c, d = self.cubics[stretch]
        x, y, z = (((p * t + q) * t + r) * t + s for p, q, r, s in zip(a, b, c, d, strict=True))
        step, rest = divmod((seconds - self.times[0]) / _YAW_STEP, 1.0)
        here = min(int(step), len(self.yaws) - 2)
        yaw = self.yaws[here] + rest * (self.yaws[here + 1] - self.yaws[here])
        return (x, y, z), yaw


def path_through(
    places: Sequence[Vector3], times: Sequence[float], *, loop: bool, yaw: float
) -> Path:
    """Return a cubic spline through places, at rest at its ends, or periodic.

    Args:
        places: At least two; of a loop the last one is the first.
        times: When it is to be at each, seconds, rising.
        loop: Whether it goes on for ever.
        yaw: Heading until it first moves, radians.
    """
    spline = CubicSpline(times, places, bc_type="periodic" if loop else "clamped")
    at = np.arange(times[0], times[-1] + 2 * _YAW_STEP, _YAW_STEP)
    velocity = spline(np.minimum(at, times[-1]), 1)
    moving = np.hypot(velocity[:, 0], velocity[:, 1]) > 0.02
    last = np.maximum.accumulate(np.where(moving, np.arange(len(at)), -1))
    if loop and moving.any():  # what stands at the beginning has come from the end
        last = np.where(last < 0, int(np.flatnonzero(moving)[-1]), last)
    heading = np.arctan2(velocity[:, 1], velocity[:, 0])
    yaws = np.unwrap(np.where(last >= 0, heading[last], yaw))
    cubics: Any = spline.c.transpose(1, 0, 2).tolist()
    return Path(
        tuple(float(t) for t in times),
        tuple(tuple(tuple(row) for row in stretch) for stretch in cubics),
        tuple(_smoothed(yaws, loop).tolist()),
        loop,
    )


def _smoothed(
    yaws: np.ndarray[tuple[int], np.dtype[np.float64]], loop: bool
) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Average headings over a Gaussian window; a loop goes on as it began, with its turns."""
    width = _TURN / _YAW_STEP
    reach = min(math.ceil(3 * width), len(yaws) - 1)
    window = np.exp(-0.5 * (np.arange(-reach, reach + 1) / width) ** 2)
    if loop:
        turns = yaws[-1] - yaws[0]
        turns = round(turns / math.tau) * math.tau
        before, after = yaws[-reach - 1 : -1] - turns, yaws[1 : reach + 1] + turns
        padded = np.unwrap(np.concatenate([before, yaws, after]))
    else:
        padded = np.pad(yaws, reach, mode="edge")
    return np.convolve(padded, window / window.sum(), mode="valid")
