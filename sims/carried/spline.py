"""A smooth motion through recorded poses: a penalised B-spline of degree 5.

Knots are equidistant; the third differences of the control points are penalised, which bridges gaps
(P. Eilers, B. Marx, "Flexible smoothing with B-splines and penalties", Statistical Science 1996),
and Huber's weights leave out jumps. Positions and sign-continuous quaternions, normalised when they
are read, are fitted alike. All sums are taken in a fixed order, so that every processor gives the
same bits.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from events import Quaternion, Vector3
from events.frames import multiply

Floats = npt.NDArray[np.float64]

SLOWEST = 8.0  # least rows per second
LONGEST_GAP = 2.0  # seconds
LARGEST_RESIDUAL = 0.05  # metres, of the median row
_SPARSE = 1.05  # least interval of the knots, in intervals of the rows
_GAP = 5.0  # intervals of the rows from which a step is a gap
_PENALTY, _HUBER, _ROUNDS = 1e-3, 3.0, 4
_DEGREE = 5
_PIECES = (
    (1.0, -5.0, 10.0, -10.0, 5.0, -1.0),
    (26.0, -50.0, 20.0, 20.0, -20.0, 5.0),
    (66.0, 0.0, -60.0, 0.0, 30.0, -10.0),
    (26.0, 50.0, 20.0, -20.0, -20.0, 10.0),
    (1.0, 5.0, 10.0, 10.0, 5.0, -5.0),
    (0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
)
"""Coefficients, times 120, of the uniform B-splines over an interval, by powers of the share of it
that has passed."""


class Moment(NamedTuple):
    """Motion of a body at an instant."""

    position: Vector3  # metres NED
    orientation: Quaternion  # rotation FRD → NED
    velocity: Vector3  # metres per second NED
    acceleration: Vector3  # metres per second squared NED
    angular_velocity: Vector3  # radians per second FRD
    angular_acceleration: Vector3  # radians per second squared FRD


class FitReport(msgspec.Struct, frozen=True):
    """What recorded rows are like, and how far they are from the curve."""

    rows: int
    seconds: float  # from the first row to the last
    interval: float  # of the rows, median, seconds
    knots: float  # interval of the knots, seconds
    gaps: tuple[tuple[float, float], ...]  # begin and length of each, seconds
    residual: float  # median distance of a row from the curve, metres
    largest_residual: float
    reduced: float  # share of the rows that count less than others, 0 to 1


class MotionSpline:
    """Motion along a curve from `start_ns` to `end_ns`; at rest at its ends before and after.

    Args:
        start: Time of the first knot, seconds.
        knots: Interval of the knots, seconds.
        points: Control points: positions and quaternions, shape (intervals + 5, 7).
    """

    def __init__(self, start: float, knots: float, points: Floats) -> None:
        self._start = start
        self._knots = knots
        self._points: list[list[float]] = points.tolist()
        self._last = len(points) - _DEGREE - 1
        self.start_ns = round(start * 1e9)
        self.end_ns = round((start + knots * (self._last + 1)) * 1e9)

    def at(self, stamp_ns: int) -> Moment:
        """Return the motion at a time."""
        inside = min(max(stamp_ns, self.start_ns), self.end_ns)
        place = (inside * 1e-9 - self._start) / self._knots
        first = min(max(math.floor(place), 0), self._last)
        rows = self._points[first : first + _DEGREE + 1]
        value, slope, bend = (
            [
                sum(weight * row[k] for weight, row in zip(weights, rows, strict=True))
                for k in range(7)
            ]
            for weights in _weights(place - first, self._knots)
        )
        x, y, z, *turn = value
        quaternion, change, second = (_quaternion(each[3:]) for each in (value, slope, bend))
        square = sum(q * q for q in turn)
        length = math.sqrt(square)
        w, i, j, k = quaternion
        position, orientation = (x, y, z), (w / length, i / length, j / length, k / length)
        if inside != stamp_ns:
            still = (0.0, 0.0, 0.0)
            return Moment(position, orientation, still, still, still, still)
        # q* q' of a quaternion of any length has the body's rates, but for its scalar part.
        back = (w, -i, -j, -k)
        _, *rates = (2.0 * c / square for c in multiply(back, change))
        growth = 2.0 * sum(a * b for a, b in zip(quaternion, change, strict=True)) / square
        _, *twice = (2.0 * c / square for c in multiply(back, second))
        turning = [b - growth * a for a, b in zip(rates, twice, strict=True)]
        return Moment(
            position, orientation, _vector(slope), _vector(bend), _vector(rates), _vector(turning)
        )


def fit(rows: Floats, knots: float) -> tuple[MotionSpline, FitReport]:
    """Fit a motion to rows, shape (n, 8): seconds, x y z (m NED), w x y z (FRD to NED).

    Args:
        knots: Interval of the knots, seconds; wider if the rows are farther apart.

    Raises:
        ValueError: The rows are no motion that a body can follow.
    """
    seconds, values = rows[:, 0], rows[:, 1:].copy()
    _check(seconds, values)
    steps = np.diff(seconds)
    interval = float(np.median(steps))
    flips = np.cumprod(np.where((values[1:, 3:] * values[:-1, 3:]).sum(axis=1) < 0.0, -1.0, 1.0))
    values[1:, 3:] *= flips[:, None]
    whole = float(seconds[-1] - seconds[0])
    count = max(math.floor(whole / max(knots, _SPARSE * interval) + 1e-9), 1)
    spacing = whole / count
    place = (seconds - seconds[0]) / spacing
    first = np.minimum(place.astype(np.intp), count - 1)
    basis = _basis(place - first)
    weights = np.ones(len(rows))
    for _ in range(_ROUNDS):
        points = _solved(basis, first, weights, values, count + _DEGREE)
        fitted = sum(basis[:, k, None] * points[first + k, :3] for k in range(_DEGREE + 1))
        residuals = np.sqrt(((fitted - values[:, :3]) ** 2).sum(axis=1))
        limit = _HUBER * (1.4826 * float(np.median(residuals)) + 1e-5)
        weights = np.minimum(1.0, limit / np.maximum(residuals, 1e-12))
    report = FitReport(
        rows=len(rows),
        seconds=whole,
        interval=interval,
        knots=spacing,
        gaps=tuple(
            (float(seconds[k]), float(steps[k])) for k in np.flatnonzero(steps > _GAP * interval)
        ),
        residual=float(np.median(residuals)),
        largest_residual=float(residuals.max()),
        reduced=float((weights < 1.0).mean()),
    )
    if report.residual > LARGEST_RESIDUAL:
        raise ValueError(
            f"trajectory: expected rows within {LARGEST_RESIDUAL:g} m of a smooth curve, found "
            f"half of them {report.residual:.3g} m and more beside it"
        )
    return MotionSpline(float(seconds[0]), spacing, points), report


def _check(seconds: Floats, values: Floats) -> None:
    if len(seconds) < 2 or not np.isfinite(values).all():
        raise ValueError(f"trajectory: expected 2 or more finite poses, found {len(seconds)}")
    steps = np.diff(seconds)
    if not (steps > 0.0).all():
        raise ValueError("trajectory: expected rising stamps, found a step back")
    if (rate := 1.0 / float(np.median(steps))) < SLOWEST:
        raise ValueError(
            f"trajectory: expected {SLOWEST:g} rows or more a second, found {rate:.3g}"
        )
    if (gap := float(steps.max())) > LONGEST_GAP:
        begin = float(seconds[int(steps.argmax())])
        raise ValueError(
            f"trajectory: expected no gap of more than {LONGEST_GAP:g} s, found one of {gap:.3g} s "
            f"at {begin:.3f} s"
        )
    if (np.abs((values[:, 3:] * values[:1, 3:]).sum(axis=1)) > 1.0 - 1e-9).all():
        raise ValueError(
            "trajectory: expected a rotation that changes, found the same one in all rows: the "
            "file seems to have no orientations"
        )


def _basis(share: Floats) -> Floats:
    """Return the weights of six control points at shares of an interval, shape (n, 6)."""
    columns = []
    for piece in _PIECES:
        total = np.zeros_like(share)
        for coefficient in reversed(piece):
            total = total * share + coefficient
        columns.append(total / 120.0)
    return np.stack(columns, axis=1)


def _weights(share: float, knots: float) -> tuple[list[float], list[float], list[float]]:
    """Return six control points' weights of the value and of its derivatives by time."""
    value, slope, bend = [], [], []
    for a, b, c, d, e, f in _PIECES:
        value.append((((((f * share + e) * share + d) * share + c) * share + b) * share + a) / 120)
        first = (((5 * f * share + 4 * e) * share + 3 * d) * share + 2 * c) * share + b
        slope.append(first / (120 * knots))
        second = ((20 * f * share + 12 * e) * share + 6 * d) * share + 2 * c
        bend.append(second / (120 * knots * knots))
    return value, slope, bend


def _solved(
    basis: Floats, first: npt.NDArray[np.intp], weights: Floats, values: Floats, count: int
) -> Floats:
    """Return the control points of weighted and penalised least squares, shape (count, 7)."""
    band = np.zeros((count, _DEGREE + 1))  # of the matrix: i, i - k
    right = np.zeros((count, 7))
    for k in range(_DEGREE + 1):
        weighted = weights * basis[:, k]
        for j in range(k + 1):
            band[:, k - j] += np.bincount(first + k, weighted * basis[:, j], count)
        for column in range(7):
            right[:, column] += np.bincount(first + k, weighted * values[:, column], count)
    for shift in range(count - 3):
        for k, a in enumerate((-1.0, 3.0, -3.0, 1.0)):
            for j, b in enumerate((-1.0, 3.0, -3.0, 1.0)[: k + 1]):
                band[shift + k, k - j] += _PENALTY * a * b
    return _cholesky_solved(band.tolist(), right)


def _cholesky_solved(band: list[list[float]], right: Floats) -> Floats:
    """Solve a positive definite band matrix, row i of which has its columns i, i - 1, …."""
    width = len(band[0])
    for i, row in enumerate(band):
        for k in range(min(i, width - 1), -1, -1):  # columns i - k, from the left
            before = band[i - k]
            total = row[k]
            for m in range(1, min(width - k, i - k + 1)):
                total -= row[k + m] * before[m]
            row[k] = math.sqrt(total) if k == 0 else total / before[0]
    columns = []
    for column in right.T.tolist():
        for i, row in enumerate(band):
            total = column[i]
            for k in range(1, min(width, i + 1)):
                total -= row[k] * column[i - k]
            column[i] = total / row[0]
        for i in range(len(band) - 1, -1, -1):
            total = column[i] = column[i] / band[i][0]
            for k in range(1, min(width, i + 1)):
                column[i - k] -= band[i][k] * total
        columns.append(column)
    return np.array(columns).T.copy()


def _vector(values: list[float]) -> Vector3:
    return values[0], values[1], values[2]


def _quaternion(values: list[float]) -> Quaternion:
    return values[0], values[1], values[2], values[3]
