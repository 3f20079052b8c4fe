"""Rows of a motion, eased in from rest, and put to a place in a world."""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
import numpy as np
import numpy.typing as npt

from events import Vector3
from sims.carried.clearance import Clearance
from sims.carried.spline import continuous

Floats = npt.NDArray[np.float64]

EASE = 1.0  # seconds from rest to full speed
ENOUGH = 1.5  # metres of clearance of which more is not looked for


class Placement(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Place of a motion in a world.

    Attributes:
        position: Where it starts, metres in ``map`` (NED).
        heading: Angle by which it is turned, degrees clockwise from above.
        scale: Factor of its lengths; rotations and times stay.
    """

    position: Vector3
    heading: float = 0.0
    scale: Annotated[float, msgspec.Meta(gt=0.0)] = 1.0


def eased(rows: Floats, rest: float) -> Floats:
    """Return rows that rest at their first pose, and take `EASE` seconds to their speed.

    Args:
        rows: Seconds, x y z, w x y z, shape (n, 8).
        rest: Seconds; 0 leaves the rows as they are.
    """
    seconds = rows[:, 0] - rows[0, 0]
    if not rest or seconds[-1] < EASE:
        return rows
    interval = float(np.median(np.diff(seconds)))
    count = math.ceil(rest / interval - 1e-9)
    still = np.arange(count) * (rest / count)
    share = np.arange(0.0, 1.0, min(interval / EASE, 1.0))
    square = share * share  # not a power, whose last bits are the processor's
    # The speed's share is 10 s³ - 15 s⁴ + 6 s⁵; its integral has passed half of `EASE` at the end.
    passed = EASE * square * square * (2.5 + share * (-3.0 + share))
    values = rows[:, 1:].copy()
    values[:, 3:] = continuous(values[:, 3:])
    slow = np.stack([np.interp(passed, seconds, column) for column in values.T], axis=1)
    slow[:, 3:] /= np.sqrt((slow[:, 3:] ** 2).sum(axis=1))[:, None]
    later = seconds > EASE / 2.0 + interval / 2.0
    return np.vstack(
        [
            np.column_stack([still, np.tile(values[0], (len(still), 1))]),
            np.column_stack([rest + share * EASE, slow]),
            np.column_stack([rest + EASE / 2.0 + seconds[later], values[later]]),
        ]
    )


def placed(rows: Floats, placement: Placement) -> Floats:
    """Return rows that start at a place, turned and scaled about it."""
    turned, angle = rows.copy(), math.radians(placement.heading)
    away = (rows[:, 1:4] - rows[0, 1:4]) * placement.scale
    cosine, sine = math.cos(angle), math.sin(angle)
    turned[:, 1] = placement.position[0] + cosine * away[:, 0] - sine * away[:, 1]
    turned[:, 2] = placement.position[1] + sine * away[:, 0] + cosine * away[:, 1]
    turned[:, 3] = placement.position[2] + away[:, 2]
    half = np.array((math.cos(angle / 2.0), 0.0, 0.0, math.sin(angle / 2.0)))
    turned[:, 4:] = products(half, rows[:, 4:])
    return turned


def products(first: Floats, second: Floats) -> Floats:
    """Return products of quaternions w x y z, shape (n, 4), or (4,) for one with all."""
    w, x, y, z = np.moveaxis(first, -1, 0)
    a, b, c, d = np.moveaxis(second, -1, 0)
    return np.stack(
        [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ],
        axis=-1,
    )


def find_place(rows: Floats, clearance: Clearance) -> Placement:
    """Return the place of a motion with the greatest clearance, up to `ENOUGH`, near the origin.

    Turns of 30°, and shifts of half a metre or a 24th of the room, are tried inside the box of the
    world's solids; then finer shifts and turns about the best of them.

    Raises:
        ValueError: There is no free place.
    """
    low, high = clearance.bounds()
    grid = _Grid(clearance, low, high)
    coarse, path = _thinned(rows, 40), _thinned(rows, 400)
    candidates: list[tuple[float, Placement]] = []
    for heading in range(0, 360, 30):
        turned = Placement(position=(0.0, 0.0, 0.0), heading=float(heading))
        points = placed(coarse, turned)[:, 1:4]
        least, most = low - points.min(axis=0), high - points.max(axis=0)
        if (least > most).any():
            continue
        steps = np.maximum((most - least) / (24, 24, 8), 0.5)
        ranges = [np.arange(a, b + 1e-9, s) for a, b, s in zip(least, most, steps, strict=True)]
        shifts = np.stack(np.meshgrid(*ranges, indexing="ij"), axis=-1).reshape(-1, 3)
        scores = _score(grid.least(points, shifts), shifts)
        for index in np.argsort(-scores, kind="stable")[:2].tolist():
            x, y, z = shifts[index].tolist()
            place = msgspec.structs.replace(turned, position=(x, y, z))
            candidates.append((float(scores[index]), place))
    candidates.sort(key=lambda candidate: -candidate[0])
    refined = [_refined(path, place, clearance) for _, place in candidates[:6]]
    free = [candidate for candidate in refined if candidate[0] > 0.0]
    if not free:
        x, y, z = np.ptp(rows[:, 1:4], axis=0).tolist()
        raise ValueError(
            f"place: expected room for a motion of {x:.3g} x {y:.3g} x {z:.3g} m in the world, "
            "found none: try a scale, or a larger world"
        )
    return max(free, key=lambda candidate: candidate[1])[2]


def _thinned(rows: Floats, count: int) -> Floats:
    return rows[np.linspace(0, len(rows) - 1, min(len(rows), count)).astype(np.intp)]


def _score(room: Floats, shifts: Floats) -> Floats:
    """Return the clearance, a little less far from the origin; rounded, so that ties are ties."""
    away = np.sqrt((shifts**2).sum(axis=-1))
    return np.asarray(np.round(np.minimum(room, ENOUGH) - 1e-3 * away, 6))


def _refined(
    path: Floats, place: Placement, clearance: Clearance
) -> tuple[float, float, Placement]:
    """Return clearance, score and place of the best of finer shifts and turns."""
    low, high = clearance.bounds()
    room, score, best = -math.inf, -math.inf, place
    for step, turn in ((0.25, 8.0), (0.125, 4.0), (0.0625, 2.0)):
        place = best
        for angle in (0.0, turn, -turn):
            if angle and room >= ENOUGH:
                break
            turned = _turned(path, place, angle)
            points = placed(path, turned)[:, 1:4] - turned.position
            least, most = low - points.min(axis=0), high - points.max(axis=0)
            shifts = turned.position + step * (np.array([*np.ndindex(3, 3, 3)]) - 1.0)
            shifts = np.clip(shifts, least, np.maximum(least, most))
            rooms = clearance.distances((shifts[:, None] + points).reshape(-1, 3))
            rooms = rooms.reshape(len(shifts), -1).min(axis=1)
            scores = _score(rooms, shifts)
            index = int(scores.argmax())
            if scores[index] > score:
                x, y, z = shifts[index].tolist()
                room, score = float(rooms[index]), float(scores[index])
                best = msgspec.structs.replace(turned, position=(x, y, z))
    return room, score, best


def _turned(path: Floats, place: Placement, angle: float) -> Placement:
    """Return a place turned by an angle, degrees, about the middle of the motion."""
    turned = msgspec.structs.replace(place, heading=place.heading + angle)
    before, after = (
        (points.min(axis=0) + points.max(axis=0)) / 2.0
        for points in (placed(path, pose)[:, 1:4] for pose in (place, turned))
    )
    x, y, z = (place.position + before - after).tolist()
    return msgspec.structs.replace(turned, position=(x, y, z))


class _Grid:
    """Clearance at the points of a grid, for a first look at many places.

    There is none out of doors, if the world's origin is indoors.
    """

    def __init__(self, clearance: Clearance, low: Floats, high: Floats) -> None:
        self._low = low
        self._step = max(0.25, float(((high - low).prod() / 1e5) ** (1.0 / 3.0)))
        counts = np.ceil((high - low) / self._step).astype(np.intp) + 1
        ranges = [a + self._step * np.arange(n) for a, n in zip(low, counts, strict=True)]
        points = np.stack(np.meshgrid(*ranges, indexing="ij"), axis=-1)
        self._rooms = clearance.distances(points.reshape(-1, 3)).reshape(counts)
        knee = float(high[2]) - 0.5
        if clearance.covered((0.0, 0.0, knee)):
            for (i, j), x, y in zip(
                np.ndindex(*counts[:2]), *points[:, :, 0, :2].reshape(-1, 2).T.tolist(), strict=True
            ):
                if not clearance.covered((x, y, knee)):
                    self._rooms[i, j] = -1.0

    def least(self, points: Floats, shifts: Floats) -> Floats:
        """Return the least clearance of points, shape (n, 3), at each shift, shape (m, 3)."""
        least = np.full(len(shifts), np.inf)
        last = np.array(self._rooms.shape) - 1
        for point in points:
            place = np.rint((shifts + point - self._low) / self._step).astype(np.intp)
            x, y, z = np.clip(place, 0, last).T
            least = np.minimum(least, self._rooms[x, y, z])
        return least
