"""A smooth motion through recorded poses: a penalised B-spline of degree 5.

Knots are equidistant; the third differences of the control points are penalised, which bridges gaps
(P. Eilers, B. Marx, "Flexible smoothing with B-splines and penalties", Statistical Science 1996),
and Huber's weights leave out jumps: a row counts as little as the worse of its position and its
rotation deserves. Positions and sign-continuous quaternions, normalised when they are read, are
fitted alike. All sums are taken in a fixed order, none by `sum` of numbers, which rounds otherwise
from Python 3.12 on, so that every processor and Python gives the same bits.
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
LARGEST_TURN = 0.1  # radians, of the median row
_SPARSE = 1.05  # least interval of the knots, in intervals of the rows
_GAP = 5.0  # intervals of the rows from which a step is a gap
_PENALTY, _HUBER, _ROUNDS = 1e-3, 3.0, 4
_EXACT = 1e-5  # metres or radians, residual that always counts in full
_APART = 0.5  # product of quaternions 120° apart, which no body rotates from row to row
_BURST = 20  # wrong rotations in a row that are recognized as such
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
    turn: float  # median angle of a row's rotation from the curve's, radians
    largest_turn: float
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
        value, slope, bend = _values(
            self._points[first : first + _DEGREE + 1], place - first, self._knots
        )
        x, y, z, w, i, j, k = value
        square = w * w + i * i + j * j + k * k
        length = math.sqrt(square)
        position, orientation = (x, y, z), (w / length, i / length, j / length, k / length)
        if inside != stamp_ns:
            still = (0.0, 0.0, 0.0)
            return Moment(position, orientation, still, still, still, still)
        # 2 q* q' / |q|² of a q of any length has the body's rates, but for its scalar part.
        back = (w, -i, -j, -k)
        vx, vy, vz, *change = slope
        ax, ay, az, *second = bend
        growth, rx, ry, rz = multiply(back, _quaternion(change))
        _, bx, by, bz = multiply(back, _quaternion(second))
        share, growth = 2.0 / square, 2.0 * growth / square
        rx, ry, rz = share * rx, share * ry, share * rz
        return Moment(
            position,
            orientation,
            (vx, vy, vz),
            (ax, ay, az),
            (rx, ry, rz),
            (share * bx - growth * rx, share * by - growth * ry, share * bz - growth * rz),
        )


def continuous(quaternions: Floats) -> Floats:
    """Return quaternions, shape (n, 4), with signs that follow each other.

    A few that are far from those before and after them, as of a tracker that takes a marker for its
    reflection, do not decide about the signs of the rest.
    """
    products = (quaternions[1:] * quaternions[:-1]).sum(axis=1)
    signs = np.where(products < 0.0, -1.0, 1.0)
    after = 0
    for row in np.flatnonzero(abs(products) < _APART).tolist():
        if row < after:
            continue
        later = quaternions[row + 2 : row + 2 + _BURST]
        across = (later * quaternions[row]).sum(axis=1)
        near = np.flatnonzero(abs(across) >= _APART)
        if len(near):
            after = row + 2 + int(near[0])
            signs[after - 1] = signs[row : after - 1].prod() * np.sign(across[near[0]])
    turned = quaternions.copy()
    turned[1:] *= np.cumprod(signs)[:, None]
    return turned


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
    values[:, 3:] = continuous(values[:, 3:])
    whole = float(seconds[-1] - seconds[0])
    count = max(math.floor(whole / max(knots, _SPARSE * interval) + 1e-9), 1)
    spacing = whole / count
    place = (seconds - seconds[0]) / spacing
    first = np.minimum(place.astype(np.intp), count - 1)
    basis = _basis(place - first)
    weights = np.ones(len(rows))
    for _ in range(_ROUNDS):
        points = _solved(basis, first, weights, values, count + _DEGREE)
        fitted = sum(basis[:, k, None] * points[first + k] for k in range(_DEGREE + 1))
        residuals = np.sqrt(((fitted[:, :3] - values[:, :3]) ** 2).sum(axis=1))
        lengths = np.sqrt((fitted[:, 3:] ** 2).sum(axis=1))
        units = fitted[:, 3:] / np.maximum(lengths, 1e-12)[:, None]
        chords = np.sqrt(((units - values[:, 3:]) ** 2).sum(axis=1))
        turns = 2.0 * chords  # angles, if they are small
        weights = np.minimum(_huber(residuals), _huber(turns))
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
        turn=float(np.median(turns)),
        largest_turn=min(4.0 * math.asin(min(float(chords.max()) / 2.0, 1.0)), math.pi),
        reduced=float((weights < 1.0).mean()),
    )
    if report.residual > LARGEST_RESIDUAL:
        raise ValueError(
            f"trajectory: expected rows within {LARGEST_RESIDUAL:g} m of a smooth curve, found "
            f"half of them {report.residual:.3g} m and more beside it"
        )
    if report.turn > LARGEST_TURN or float(lengths.min()) < _APART:
        worst = float(seconds[int(lengths.argmin())])
        raise ValueError(
            "trajectory: expected rotations that follow each other, found jumps, such as at "
            f"{worst:.3g} s"
        )
    return MotionSpline(float(seconds[0]), spacing, points), report


def _huber(residuals: Floats) -> Floats:
    """Return Huber's weights of residuals, by their median."""
    limit = _HUBER * (1.4826 * float(np.median(residuals)) + _EXACT)
    return np.asarray(np.minimum(1.0, limit / np.maximum(residuals, 1e-12)))


def _check(seconds: Floats, values: Floats) -> None:
    if len(seconds) <= _DEGREE:
        raise ValueError(f"trajectory: expected {_DEGREE + 1} poses or more, found {len(seconds)}")
    finite = np.isfinite(seconds) & np.isfinite(values).all(axis=1)
    if not finite.all():
        row = int(finite.argmin()) + 1
        raise ValueError(f"trajectory: expected numbers, found one that is not finite in row {row}")
    steps = np.diff(seconds)
    if not (steps > 0.0).all():
        row = int((steps <= 0.0).argmax())
        raise ValueError(
            f"trajectory: expected rising stamps, found {seconds[row + 1]:.9g} s after "
            f"{seconds[row]:.9g} s"
        )
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


def _values(
    points: list[list[float]], share: float, knots: float
) -> tuple[list[float], list[float], list[float]]:
    """Return six control points' value at a share of an interval, and its derivatives by time."""
    value, slope, bend = [], [], []
    once, twice = 120.0 * knots, 120.0 * knots * knots
    for a, b, c, d, e, f in _PIECES:
        value.append(
            (((((f * share + e) * share + d) * share + c) * share + b) * share + a) / 120.0
        )
        first = (((5.0 * f * share + 4.0 * e) * share + 3.0 * d) * share + 2.0 * c) * share + b
        slope.append(first / once)
        second = ((20.0 * f * share + 12.0 * e) * share + 6.0 * d) * share + 2.0 * c
        bend.append(second / twice)
    columns = list(zip(*points, strict=True))
    values, slopes, bends = (
        [a * p + b * q + c * r + d * s + e * t + f * u for p, q, r, s, t, u in columns]
        for a, b, c, d, e, f in (value, slope, bend)
    )
    return values, slopes, bends


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


def _quaternion(values: list[float]) -> Quaternion:
    return values[0], values[1], values[2], values[3]
