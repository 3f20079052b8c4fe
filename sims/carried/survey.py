"""What a placed motion is like: how fast, how near to solids, when; in numbers and in words."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import groupby

import msgspec
import numpy as np
import numpy.typing as npt

from events import Vector3
from events.frames import rotate
from sims.carried.clearance import Clearance
from sims.carried.spline import FitReport, MotionSpline

Floats = npt.NDArray[np.float64]

STEP = 20_000_000  # interval of the moments that are looked at, nanoseconds
_SHOWN = 3  # stretches that a warning names


class Nearness(msgspec.Struct, frozen=True):
    """A stretch of a motion near a solid, or the nearest point of all."""

    distance: float  # metres, inside negative
    name: str  # of the solid
    seconds: float  # when it is nearest


class Survey(msgspec.Struct, frozen=True):
    """A motion in figures."""

    speed: float  # greatest, m/s
    acceleration: float  # m/s²
    rate: float  # rad/s
    nearest: Nearness | None  # `None` in an empty world
    near: tuple[Nearness, ...]  # of each stretch within the margin of what stands
    met: tuple[Nearness, ...]  # of each stretch within the margin of what moves by itself


def survey(
    spline: MotionSpline,
    still: Clearance,
    moving: Clearance,
    points: Sequence[Vector3],
    margin: float,
) -> Survey:
    """Return what a motion is like.

    Args:
        points: Points of the body to keep clear, metres FRD.
        margin: Distance of a solid below which a stretch is near it, metres.
    """
    stamps = [*range(spline.start_ns, spline.end_ns, STEP), spline.end_ns]
    moments = [spline.at(stamp) for stamp in stamps]
    places = np.array(
        [[np.add(m.position, rotate(m.orientation, point)) for point in points] for m in moments]
    )
    nearest = _nearest(still, stamps, *still.nearest(places.reshape(-1, 3)))
    met: list[Nearness] = []
    if moving:
        rows = [moving.at(s / 1e9).nearest(p) for s, p in zip(stamps, places, strict=True)]
        distances, geoms = (np.concatenate(parts) for parts in zip(*rows, strict=True))
        met = _nearest(moving, stamps, distances, geoms)
    return Survey(
        speed=max(math.hypot(*moment.velocity) for moment in moments),
        acceleration=max(math.hypot(*moment.acceleration) for moment in moments),
        rate=max(math.hypot(*moment.angular_velocity) for moment in moments),
        nearest=min(nearest, key=lambda nearness: nearness.distance, default=None),
        near=_stretches(nearest, margin),
        met=_stretches(met, margin),
    )


def _nearest(
    clearance: Clearance, stamps: Sequence[int], distances: Floats, geoms: npt.NDArray[np.intp]
) -> list[Nearness]:
    """Return the nearest solid at each time, from those of several points at each."""
    rows = distances.reshape(len(stamps), -1)
    index = np.arange(len(rows)), rows.argmin(axis=1)
    least, solids = rows[index].tolist(), geoms.reshape(rows.shape)[index].tolist()
    names = {geom: clearance.name_of(geom) for geom in set(solids) if geom >= 0}
    return [
        Nearness(distance, names[geom], stamp / 1e9)
        for distance, geom, stamp in zip(least, solids, stamps, strict=True)
        if geom >= 0
    ]


def _stretches(nearest: Iterable[Nearness], margin: float) -> tuple[Nearness, ...]:
    """Return the nearest of each stretch within a margin."""
    groups = groupby(nearest, lambda n: n.distance < margin or n.distance <= 0.0)
    return tuple(min(g, key=lambda n: n.distance) for near, g in groups if near)


def in_words(rows: int, report: FitReport, result: Survey) -> list[str]:
    """Return sentences about recorded rows, their fit, and its motion."""
    gaps = "no gap"
    if report.gaps:
        begin, longest = max(report.gaps, key=lambda gap: gap[1])
        plural = "s" if len(report.gaps) > 1 else ""
        gaps = f"{len(report.gaps)} gap{plural}, up to {longest:.3g} s (at {begin:.3g} s)"
    lines = [
        f"{rows} rows, each {report.interval * 1e3:.3g} ms, {gaps}; "
        f"{report.seconds:.4g} s with the rest before them",
        f"fitted with knots each {report.knots * 1e3:.3g} ms: half of the rows within "
        f"{report.residual * 1e3:.2g} mm and {math.degrees(report.turn):.2g}°, all within "
        f"{report.largest_residual * 1e3:.2g} mm and {math.degrees(report.largest_turn):.2g}°, "
        f"{report.reduced:.1%} of less weight",
        f"at most {result.speed:.3g} m/s, {result.acceleration:.3g} m/s², "
        f"{math.degrees(result.rate):.3g}°/s",
    ]
    if result.nearest is not None:
        near = result.nearest
        lines.append(f"nearest to {near.name}, {near.distance:.2f} m, at {near.seconds:.2f} s")
    return lines


def collision(result: Survey) -> str:
    """Return where the motion is inside something; empty if it is nowhere."""
    inside = [near for near in result.near if near.distance <= 0.0]
    return " and ".join(f"in {near.name} at {near.seconds:.2f} s" for near in inside[:_SHOWN])


def in_time(stretches: Sequence[Nearness]) -> str:
    """Return stretches in words, the first of many; empty if there is none."""
    parts = [
        f"{near.distance:.2g} m from {near.name} at {near.seconds:.2f} s" for near in stretches
    ]
    more = f" and {len(parts) - _SHOWN} times more" if len(parts) > _SHOWN else ""
    return ", ".join(parts[:_SHOWN]) + more
