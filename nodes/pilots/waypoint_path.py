"""Timed paths: rounded corners, limited speed and acceleration, smooth heading, excitation."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from events import Vector3
from runtime import Duration
from runtime.portable import directions, gaussian, sines

Floats = npt.NDArray[np.float64]

_SPACING = 0.02  # spacing of the points of a computed path, metres
_REST = 1.0  # seconds at rest at both ends, lest smoothing cut the path short or start with a jerk


_COLUMNS = ("position", "velocity", "acceleration", "yaw", "yaw_rate")
"""Columns of a `WaypointPath`."""


class WaypointPath(msgspec.Struct, frozen=True, eq=False):
    """A path with a position and a heading for each moment, at regular steps."""

    step: float  # seconds between two rows
    position: Floats  # metres, shape (n, 3)
    velocity: Floats  # metres per second, shape (n, 3)
    acceleration: Floats  # metres per second squared, shape (n, 3)
    yaw: Floats  # radians, continuous (not wrapped), shape (n,)
    yaw_rate: Floats  # radians per second, shape (n,)

    def row(self, index: int) -> dict[str, Any]:
        """Return position, velocity, … of a row: tuples and numbers, by name."""
        values = {name: getattr(self, name)[index].tolist() for name in _COLUMNS}
        return {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}

    @property
    def seconds(self) -> float:
        """Duration of the path, seconds."""
        return (len(self.position) - 1) * self.step

    @property
    def length(self) -> float:
        """Length of the path, metres."""
        return float(np.linalg.norm(np.diff(self.position, axis=0), axis=1).sum())


def plan(
    waypoints: Floats,  # metres in ``map``, shape (n, 3), n ≥ 2, no two neighbours alike
    *,
    speed: float,  # highest, metres per second
    acceleration: float,  # metres per second squared, along the path and across it
    radius: float,  # metres from a corner at which its rounding begins, at most
    yaw: float,  # heading at the start, radians
    turn_time: float,  # seconds over which the direction of flight is smoothed to the heading
    step: float,  # seconds between rows
) -> WaypointPath:
    """Return a path along straight lines between waypoints, at rest at both ends."""
    points, along = _resample(_round_corners(waypoints, radius), _SPACING)
    pace = _speeds(points, along, speed, acceleration)
    # Time at each point: each stretch at the mean of its ends' speeds.
    time = np.concatenate([[0.0], np.cumsum(np.diff(along) / ((pace[1:] + pace[:-1]) / 2))])
    moving = np.interp(np.arange(0.0, time[-1], step), time, along)
    before = np.zeros(round(_REST / step))
    # At the end, too, until the heading is reached.
    after = np.full(round(max(2 * turn_time, _REST) / step), along[-1])
    arc = np.concatenate([before, moving, after])
    arc = _smooth(arc, round(0.3 / step))
    position = np.stack([np.interp(arc, along, axis) for axis in points.T], axis=1)
    position = np.apply_along_axis(_smooth, 0, position, round(0.3 / step))
    velocity = np.gradient(position, step, axis=0)
    heading = _headings(velocity, yaw)
    return timed(position, _smooth(heading, round(turn_time / step)), step)


def timed(position: Floats, yaw: Floats, step: float) -> WaypointPath:
    """Return the path of positions and headings at regular steps, with their derivatives."""
    velocity = np.gradient(position, step, axis=0)
    return WaypointPath(
        step=step,
        position=position,
        velocity=velocity,
        acceleration=np.gradient(velocity, step, axis=0),
        yaw=yaw,
        yaw_rate=np.gradient(yaw, step),
    )


def _round_corners(points: Floats, radius: float) -> Floats:
    """Replace each corner by a quadratic Bézier curve inside the corner."""
    rounded = [points[:1]]
    for before, corner, after in zip(points, points[1:], points[2:], strict=False):
        ends = []
        for other in (before, after):
            way = other - corner
            distance = math.hypot(*way)
            ends.append(corner + way * min(radius, distance / 2) / distance)
        t = np.linspace(0.0, 1.0, 33)[:, None]
        rounded.append((1 - t) ** 2 * ends[0] + 2 * t * (1 - t) * corner + t**2 * ends[1])
    rounded.append(points[-1:])
    return np.concatenate(rounded)


def _resample(points: Floats, spacing: float) -> tuple[Floats, Floats]:
    """Return points at equal distances along the path, and those distances."""
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    keep = np.concatenate([[True], np.diff(along) > 0])
    at = np.linspace(0.0, along[-1], max(int(along[-1] / spacing), 2))
    return np.stack([np.interp(at, along[keep], axis) for axis in points[keep].T], axis=1), at


def _speeds(points: Floats, along: Floats, speed: float, acceleration: float) -> Floats:
    """Return the highest speed at each point within both limits, forwards and back."""
    tangent = np.gradient(points, along, axis=0)
    curvature = np.linalg.norm(np.gradient(tangent, along, axis=0), axis=1)
    limit = np.minimum(speed, np.sqrt(acceleration / np.maximum(curvature, 1e-6)))
    limit[0] = limit[-1] = 0.05  # nearly: at 0 the first step would take for ever
    for order in (range(1, len(limit)), range(len(limit) - 2, -1, -1)):
        for i in order:
            before = i - 1 if order.step > 0 else i + 1
            reach = np.sqrt(limit[before] ** 2 + 2 * acceleration * abs(along[i] - along[before]))
            limit[i] = min(limit[i], reach)
    return np.asarray(limit)


def _headings(velocity: Floats, yaw: float) -> Floats:
    """Return the direction of flight, kept from before where the path hardly moves."""
    moving = np.hypot(velocity[:, 0], velocity[:, 1]) > 0.2
    heading = directions(velocity)
    last = np.maximum.accumulate(np.where(moving, np.arange(len(moving)), -1))
    held = np.where(last >= 0, heading[last], yaw)
    return np.unwrap(np.concatenate([[yaw], held]))[1:]


def _smooth(values: Floats, width: int) -> Floats:
    """Average over a Gaussian window of `width` rows, holding the ends."""
    if width < 1:
        return values
    reach = 3 * width
    return gaussian(np.pad(values, reach, mode="edge"), width, reach)


Positive = Annotated[float, msgspec.Meta(gt=0)]
Heading = Literal["path", "fixed", "sweep"]

_SWEEP_ANGLE, _SWEEP_PERIOD = np.radians(40.0), 6.0  # of a sweep: radians to each side, seconds
_MOST = 4.0  # highest acceleration for a multirotor to follow an excitation closely, m/s²


class Excitation(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Movement on the spot about all axes, after take-off.

    Makes scale, gravity and biases observable to a visual-inertial system.

    Attributes:
        duration: How long it takes.
        amplitude: Greatest distance from the place along each axis, metres.
        frequency: Frequency of the movement north, Hz; those east, down and about the vertical are
            1.3, 0.8 and 0.6 times as high.
        yaw: Greatest change of the heading, degrees.
    """

    duration: Duration = Duration(6.0)  # immutable
    amplitude: Annotated[float, msgspec.Meta(gt=0.0, le=2.0)] = 0.25
    frequency: Annotated[float, msgspec.Meta(gt=0.0, le=2.0)] = 0.4
    yaw: Annotated[float, msgspec.Meta(ge=0.0, le=180.0)] = 30.0

    def __post_init__(self) -> None:
        if not 3.0 <= self.duration <= 60.0:
            raise ValueError(f"duration: expected 3 to 60 s, found {self.duration:g} s")
        peak = self.amplitude * (2.0 * np.pi * 1.3 * self.frequency) ** 2
        if peak > _MOST:
            raise ValueError(
                f"amplitude, frequency: expected at most {_MOST:g} m/s² of acceleration by both "
                f"together, found {peak:.1f} m/s²"
            )

    @property
    def reach(self) -> float:
        """Greatest distance of the vehicle from its place along each axis, metres."""
        return 1.25 * self.amplitude + 0.15


class FigureEight(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A figure eight after the waypoints, from its centre and back to its centre.

    The curve is the lemniscate of Gerono: x = length/2 · sin t, y = width/2 · sin 2t.

    Attributes:
        centre: Crossing of the curve, metres in ``map``.
        length: Extent along its axis, metres.
        width: Extent across its axis, metres.
        rise: Height of one loop's end above the centre, and the other's below, metres.
        direction: Direction of its axis, degrees clockwise from north.
        laps: Number of laps.
    """

    centre: Vector3
    length: Positive = 4.0
    width: Positive = 2.5
    rise: float = 0.0
    direction: float = 0.0
    laps: Annotated[int, msgspec.Meta(ge=1, le=100)] = 1

    def places(self) -> Floats:
        """Return the places of a lap, metres in ``map``, shape (65, 3); the last is the first."""
        t = np.linspace(0.0, 2.0 * np.pi, 65)
        along, across = self.length / 2.0 * sines(t), self.width / 2.0 * sines(2.0 * t)
        c, s = math.cos(math.radians(self.direction)), math.sin(math.radians(self.direction))
        offset = [c * along - s * across, s * along + c * across, -self.rise * sines(t)]
        places: Floats = np.asarray(self.centre) + np.stack(offset, axis=1)
        return places


def excited(excitation: Excitation, place: Vector3, yaw: float, step: float) -> WaypointPath:
    """Return the excitation as a path, at rest at `place` with heading `yaw` at both ends."""
    seconds = np.arange(0.0, excitation.duration + step / 2.0, step)
    ramp = min(2.0, excitation.duration / 3.0)  # seconds in which it swells, and fades
    share = np.clip(np.minimum(seconds, seconds[-1] - seconds) / ramp, 0.0, 1.0)
    swell = share * share * share * (10.0 - 15.0 * share + 6.0 * share * share)
    phase = 2.0 * np.pi * excitation.frequency * seconds
    north, east, down, turn = (sines(ratio * phase) * swell for ratio in (1.0, 1.3, 0.8, 0.6))
    moves = excitation.amplitude * np.stack([north, east, down], axis=1)
    return timed(np.asarray(place) + moves, yaw + np.radians(excitation.yaw) * turn, step)


def headed(path: WaypointPath, heading: Heading, yaw: float) -> WaypointPath:
    """Return a path with another heading.

    Args:
        heading: ``path``: the direction of flight. ``fixed``: `yaw`. ``sweep``: 40° to both sides
            of the direction, within 6 s.
        yaw: Heading at the start, radians.
    """
    if heading == "path":
        return path
    if heading == "fixed":
        return timed(path.position, np.full_like(path.yaw, yaw), path.step)
    seconds = np.arange(len(path.yaw)) * path.step
    swell = np.clip(np.minimum(seconds, seconds[-1] - seconds), 0.0, 1.0)
    sweep = _SWEEP_ANGLE * swell * sines(2.0 * np.pi / _SWEEP_PERIOD * seconds)
    return timed(path.position, path.yaw + sweep, path.step)


def joined(first: WaypointPath, second: WaypointPath) -> WaypointPath:
    """Join two paths of equal step; the second begins at the end of the first."""
    both = first, second
    parts = {name: np.concatenate([getattr(path, name) for path in both]) for name in _COLUMNS}
    return WaypointPath(step=first.step, **parts)
