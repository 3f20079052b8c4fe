"""Offset between the clocks of an estimate and of the truth, found by how they move.

Speeds are the same in any frame: their correlation finds an offset of up to a minute, as of leap
seconds (18 s between GPS and UTC). From there, and from none, it is refined by least squares of the
aligned positions.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.fft import irfft, next_fast_len, rfft

from nodes.judging.evaluation.alignment import umeyama
from nodes.judging.evaluation.metrics import interpolated, rms
from nodes.trajectory import Trajectory, is_sparser

Floats = npt.NDArray[np.float64]
Stamps = npt.NDArray[np.int64]

_RANGE = 60.0  # seconds of offset looked for either way
_LEAST_OVERLAP = 0.5  # share of the rows that has to be left
_ROWS = 1000  # most rows used
_MOST = 4_000_000  # samples of a speed to correlate, at most: eleven hours at 100 Hz
_LEAST_ROWS = 10
_HOLE = 10  # steps of the denser one beyond which it is not interpolated
_STEPS = 12  # most steps of the least squares
_ALIKE = 0.7  # correlation of the speeds from which it is used
_CHANGES = 0.1  # standard deviation of a speed, in shares of its mean, likewise
_BETTER = 0.5  # share of the error that is left where an offset makes a difference


class TimeOffset(msgspec.Struct, frozen=True):
    """Best offset, and the errors without and with it."""

    seconds: float  # to be added to the estimate's stamps
    before: float  # root mean square of aligned positions without it, metres; inf if none overlap
    after: float  # the same with it

    @property
    def matters(self) -> bool:
        """Whether an estimate fits far better with the offset."""
        return abs(self.seconds) > 0.002 and self.after < _BETTER * self.before

    def text(self) -> str:
        """Return a sentence if the offset matters, or else nothing."""
        if not self.matters:
            return ""
        return (
            f"with {self.seconds:+.4f} s added to its stamps it would fit far better "
            f"({self.after:.3g} m instead of {self.before:.3g} m, aligned as a whole): is its "
            "clock the truth's?"
        )


def best_time_offset(
    truth: Trajectory,
    estimate: Trajectory,
    *,
    with_scale: bool = False,
    anywhere: bool = False,
) -> TimeOffset | None:
    """Return the offset with which an estimate fits the truth best; `None` if too little moves.

    Args:
        truth: In its own frame and at its own stamps.
        estimate: Likewise.
        with_scale: Whether the estimate's unit of length is its own.
        anywhere: Whether the two clocks have nothing in common: the offset is looked for from the
            one at which both begin.
    """
    if min(len(truth), len(estimate)) < _LEAST_ROWS:
        return None
    start = float(truth.stamps[0] - estimate.stamps[0]) / 1e9 if anywhere else 0.0
    best = _refined(truth, estimate, start, with_scale)
    guess = _correlated(truth, estimate, start)
    if guess is not None:
        other = _refined(truth, estimate, guess, with_scale)
        if other is not None and (best is None or other[1] < _BETTER * best[1]):
            best = other
    if best is None:
        return None
    without = _fit(truth, estimate, 0.0, with_scale, beside=best[0])
    if without is None and not anywhere:  # the overlap of both offsets is too short
        return None
    return TimeOffset(best[0], math.inf if without is None else without[1], best[1])


def _correlated(truth: Trajectory, estimate: Trajectory, start: float) -> float | None:
    """Return the offset (s) near `start` at which the speeds are most alike, or `None`."""
    step = max(min(truth.step(), estimate.step()), 10_000_000)
    if max(int(np.ptp(trajectory.stamps)) for trajectory in (truth, estimate)) > _MOST * step:
        return None  # as of stamps in another unit
    lengths = []
    for trajectory, shift in ((truth, 0), (estimate, round(start * 1e9))):
        stamps = trajectory.stamps + shift
        grid = np.arange(stamps[0], stamps[-1], step)
        speed = np.diff(interpolated(stamps, trajectory.distances()[:, None], grid)[:, 0])
        if len(speed) < _LEAST_ROWS or not speed.std() > _CHANGES * speed.mean():
            return None
        lengths.append((int(grid[0]), speed - speed.mean()))
    (first, a), (second, b) = lengths
    products = _correlate(a, b)
    squares = _correlate(a * a, np.ones(len(b)))
    squares *= _correlate(np.ones(len(a)), b * b)
    lags = np.arange(-len(b) + 1, len(a))
    overlap = np.minimum(lags + len(b), len(a)) - np.maximum(lags, 0)
    offsets = start + (lags * step + first - second) / 1e9
    possible = (overlap >= _LEAST_OVERLAP * min(len(a), len(b))) & (abs(offsets - start) <= _RANGE)
    likeness = np.where(possible, products / np.sqrt(np.maximum(squares, 1e-12)), -np.inf)
    best = int(np.argmax(likeness))
    return float(offsets[best]) if likeness[best] > _ALIKE else None


def _correlate(a: Floats, b: Floats) -> Floats:
    """Return what `scipy.signal.correlate` does, to the bit; that takes half a second to import."""
    length = len(a) + len(b) - 1
    fast = next_fast_len(length, real=True)
    products: Floats = irfft(rfft(a, fast) * rfft(b[::-1], fast), fast)[:length]
    return products


def _refined(
    truth: Trajectory, estimate: Trajectory, offset: float, with_scale: bool
) -> tuple[float, float] | None:
    """Return the offset (s) of least squares from a first one, and its error (m)."""
    best: tuple[float, float] | None = None
    for _ in range(_STEPS):
        fit = _fit(truth, estimate, offset, with_scale)
        if fit is None or (best is not None and fit[1] >= best[1]):
            break
        best = offset, fit[1]
        if abs(fit[0]) < 1e-6:
            break
        offset += fit[0]
    return best


def _fit(
    truth: Trajectory,
    estimate: Trajectory,
    offset: float,
    with_scale: bool,
    beside: float | None = None,
) -> tuple[float, float] | None:
    """Return the change of an offset (s) by a step of Gauss and Newton, and the error before (m).

    With `beside`, only rows count for which there is a truth with that offset, too. `None` if too
    little of the two is at one time, or lies on a line.
    """
    shift = round(offset * 1e9)
    sparse, dense, sign = (
        (truth, estimate, -1) if is_sparser(truth, estimate) else (estimate, truth, 1)
    )
    rows = sparse.stamps[:: max(len(sparse) // _ROWS, 1)]
    inside = dense.covers(rows + sign * shift, _HOLE * dense.step())
    if beside is not None:
        inside &= dense.covers(rows + sign * round(beside * 1e9), _HOLE * dense.step())
    elif inside.sum() < _LEAST_OVERLAP * len(rows):
        return None
    if inside.sum() < _LEAST_ROWS:
        return None
    rows = rows[inside]
    at = interpolated(sparse.stamps, sparse.positions, rows)
    moved = interpolated(dense.stamps, dense.positions, rows + sign * shift)
    speed = interpolated(dense.stamps, dense.velocities(), rows + sign * shift)
    source, target = (at, moved) if sparse is estimate else (moved, at)
    try:
        rotation, translation, scale = umeyama(source, target, with_scale=with_scale)
    except ValueError:
        return None
    errors = target - (scale * source @ rotation.T + translation)
    if sparse is truth:
        speed = scale * speed @ rotation.T
    energy = float((speed * speed).sum())
    return (-float((speed * errors).sum()) / energy if energy else 0.0), rms(
        np.linalg.norm(errors, axis=1)
    )
