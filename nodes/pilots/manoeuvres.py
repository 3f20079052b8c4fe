"""Manoeuvres that a scripted flight can be given: excitation, a figure eight, a sweeping heading.

Pure numpy; `nodes.pilots.pilot` puts them together with the path through the waypoints.
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
import numpy as np

from events import Vector3
from nodes.pilots.waypoint_path import Floats, WaypointPath, timed
from runtime import Duration

Positive = Annotated[float, msgspec.Meta(gt=0)]
Heading = Literal["path", "fixed", "sweep"]

_SWEEP_ANGLE, _SWEEP_PERIOD = np.radians(40.0), 6.0
"""Radians to each side, and seconds, of a sweeping heading."""

_MOST = 4.0
"""Acceleration up to which a multirotor follows an excitation closely, m/s²."""


class Excitation(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Movement on the spot about all axes, after take-off.

    It makes scale, gravity and biases observable to a visual-inertial system.

    Attributes:
        duration: How long it takes.
        amplitude: Greatest distance from the place along each axis, metres. The vehicle rolls and
            pitches as the accelerations ask for.
        frequency: Frequency of the movement north, Hz; those east, down and about the vertical are
            1.3, 0.8 and 0.6 times as high, so that the axes move independently.
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
        """Distance from the place, along each axis, that the vehicle stays within, metres."""
        return 1.25 * self.amplitude + 0.15


class FigureEight(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A figure eight, flown after the waypoints; it begins and ends in its centre.

    The curve is the lemniscate of Gerono: x = length/2 · sin t, y = width/2 · sin 2t.

    Attributes:
        centre: Where it crosses itself, metres in ``map``.
        length: Extent along its axis, metres.
        width: Extent across its axis, metres.
        rise: Height by which one loop's end is above the centre, and the other's below, metres.
        direction: Direction of its axis, degrees clockwise from north.
        laps: How many times it is flown.
    """

    centre: Vector3
    length: Positive = 4.0
    width: Positive = 2.5
    rise: float = 0.0
    direction: float = 0.0
    laps: Annotated[int, msgspec.Meta(ge=1, le=100)] = 1

    def places(self) -> Floats:
        """Return the places of one lap, metres in ``map``, shape (65, 3); the last is the first."""
        t = np.linspace(0.0, 2.0 * np.pi, 65)
        along, across = self.length / 2.0 * np.sin(t), self.width / 2.0 * np.sin(2.0 * t)
        c, s = np.cos(np.radians(self.direction)), np.sin(np.radians(self.direction))
        offset = [c * along - s * across, s * along + c * across, -self.rise * np.sin(t)]
        places: Floats = np.asarray(self.centre) + np.stack(offset, axis=1)
        return places


def excited(excitation: Excitation, place: Vector3, yaw: float, step: float) -> WaypointPath:
    """Return the excitation as a path that begins and ends at rest at a place, with a heading."""
    seconds = np.arange(0.0, excitation.duration + step / 2.0, step)
    ramp = min(2.0, excitation.duration / 3.0)  # seconds in which it swells, and fades
    share = np.clip(np.minimum(seconds, seconds[-1] - seconds) / ramp, 0.0, 1.0)
    swell = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    phase = 2.0 * np.pi * excitation.frequency * seconds
    north, east, down, turn = (np.sin(ratio * phase) * swell for ratio in (1.0, 1.3, 0.8, 0.6))
    moves = excitation.amplitude * np.stack([north, east, down], axis=1)
    return timed(np.asarray(place) + moves, yaw + np.radians(excitation.yaw) * turn, step)


def headed(path: WaypointPath, heading: Heading, yaw: float) -> WaypointPath:
    """Return a path with another heading.

    Args:
        path: The path; its heading is the direction of flight.
        heading: ``path``: that one. ``fixed``: `yaw` all the way. ``sweep``: to both sides of the
            direction of flight, 40° within 6 s.
        yaw: Heading at the start, radians.
    """
    if heading == "path":
        return path
    if heading == "fixed":
        return timed(path.position, np.full_like(path.yaw, yaw), path.step)
    seconds = np.arange(len(path.yaw)) * path.step
    swell = np.clip(np.minimum(seconds, seconds[-1] - seconds), 0.0, 1.0)
    sweep = _SWEEP_ANGLE * swell * np.sin(2.0 * np.pi / _SWEEP_PERIOD * seconds)
    return timed(path.position, path.yaw + sweep, path.step)


def joined(first: WaypointPath, second: WaypointPath) -> WaypointPath:
    """Return two paths of one step, the second of which begins where the first one ends."""
    fields = ("position", "velocity", "acceleration", "yaw", "yaw_rate")
    parts = {name: np.concatenate([getattr(p, name) for p in (first, second)]) for name in fields}
    return WaypointPath(step=first.step, **parts)
