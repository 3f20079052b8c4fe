"""What a placed motion is like: how fast, how near to solids, when; in numbers and in words."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import msgspec
import numpy as np
import numpy.typing as npt

from events import Vector3
from events.frames import rotate
from sims.carried.clearance import Clearance
from sims.carried.spline import FitReport, MotionSpline

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
    near: tuple[Nearness, ...]  # of each stretch within the margin, in time


def survey(
    spline: MotionSpline, clearance: Clearance, points: Sequence[Vector3], margin: float
) -> Survey:
    """Return what a motion is like.

    Args:
        points: Points of the body to keep clear, metres FRD.
        margin: Distance of a solid below which a stretch is near it, metres.
    """
    stamps = [*range(spline.start_ns, spline.end_ns, STEP), spline.end_ns]
    moments = [spline.at(stamp) for stamp in stamps]
    places = np.array(
        [
            np.add(moment.position, rotate(moment.orientation, point))
            for moment in moments
            for point in points
        ]
    )
    distances, geoms = clearance.nearest(places)
    rows = distances.reshape(len(moments), len(points))
    which = rows.argmin(axis=1)
    least = rows[np.arange(len(rows)), which]
    touched = geoms.reshape(rows.shape)[np.arange(len(rows)), which]

    def nearness(begin: int, end: int) -> Nearness:
        index = begin + int(least[begin:end].argmin())
        name = clearance.name_of(int(touched[index]))
        return Nearness(float(least[index]), name, stamps[index] / 1e9)

    return Survey(
        speed=max(math.hypot(*moment.velocity) for moment in moments),
        acceleration=max(math.hypot(*moment.acceleration) for moment in moments),
        rate=max(math.hypot(*moment.angular_velocity) for moment in moments),
        nearest=nearness(0, len(rows)) if np.isfinite(least).any() else None,
        near=tuple(
            nearness(begin, end) for begin, end in _stretches((least < margin) | (least <= 0.0))
        ),
    )


def _stretches(mask: npt.NDArray[np.bool_]) -> Iterable[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(mask, prepend=False, append=False)).tolist()
    return zip(edges[::2], edges[1::2], strict=True)


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
        f"{report.residual * 1e3:.2g} mm, all within {report.largest_residual * 1e3:.2g} mm, "
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


def approaches(result: Survey) -> str:
    """Return where the motion is within the margin of something; empty if it is nowhere."""
    parts = [
        f"{near.distance:.2g} m from {near.name} at {near.seconds:.2f} s" for near in result.near
    ]
    more = f" and {len(parts) - _SHOWN} times more" if len(parts) > _SHOWN else ""
    return ", ".join(parts[:_SHOWN]) + more
