"""A scripted flight and estimates of it, as events."""

from __future__ import annotations

import math
from functools import cache

from events import (
    EstimatorAnnouncement,
    Event,
    Odometry,
    PoseEstimate,
    TrackingLost,
    TrackingRegained,
    Vector3,
    VehicleAnnouncement,
)

MS = 1_000_000
SECOND = 1000 * MS


def place(stamp: int) -> Vector3:
    """Where the vehicle is: a circle of 2 m radius, once round in 10 s."""
    angle = 2 * math.pi * stamp / (10 * SECOND)
    return (2 * math.sin(angle), 2 - 2 * math.cos(angle), -1.5)


def heading(stamp: int) -> tuple[float, float, float, float]:
    half = math.pi * stamp / (10 * SECOND)
    return (math.cos(half), 0.0, 0.0, math.sin(half))


def truth(seconds: float) -> list[Event]:
    """200 Hz of truth."""
    return list(_truth(seconds))


@cache
def _truth(seconds: float) -> tuple[Event, ...]:
    return tuple(
        Odometry(
            stamp=stamp,
            source="drone",
            position=place(stamp),
            orientation=heading(stamp),
            linear_velocity=(0.0, 0.0, 0.0),
            angular_velocity=(0.0, 0.0, 0.0),
        )
        for stamp in range(0, round(seconds * SECOND) + 1, 5 * MS)
    )


def estimate(
    stamp: int,
    *,
    error: Vector3 = (0.0, 0.0, 0.0),
    scale: float = 1.0,
    frame_id: str = "map",
    source: str = "est",
) -> PoseEstimate:
    x, y, z = place(stamp)
    return PoseEstimate(
        stamp=stamp,
        source=source,
        frame_id=frame_id,
        position=(scale * x + error[0], scale * y + error[1], scale * z + error[2]),
        orientation=heading(stamp),
    )


def announced(scale_free: bool = False, source: str = "est") -> list[Event]:
    return [
        VehicleAnnouncement(
            stamp=0,
            source="drone",
            mass=1.0,
            max_thrust=20.0,
            control_rate=400,
            position=place(0),
            orientation=(1.0, 0.0, 0.0, 0.0),
        ),
        EstimatorAnnouncement(stamp=0, source=source, method="test", scale_free=scale_free),
    ]


def lost(stamp: int) -> TrackingLost:
    return TrackingLost(stamp=stamp, source="est", reason="dark")


def regained(stamp: int) -> TrackingRegained:
    return TrackingRegained(stamp=stamp, source="est")
