"""A lidar's settings and pattern: where its rays go, and when."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from events import LidarAnnouncement
from sims.sensors.sensor import Mounted, Name, NonNegative, Positive, SensorSpec

Floats = npt.NDArray[np.float64]
Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]

PRISMS = (121.57, -77.73)
"""Turns per second of the two prisms of a solid-state lidar, as of a Livox Mid-40: together they
draw a rosette that is never the same twice."""


class LidarSpec(SensorSpec, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a lidar: without errors by default, with errors as its settings say.

    AirSim's ``PointsPerSecond`` is `channels` · `columns` · `rate`.

    Attributes:
        name: Name of the sensor, unique on its body.
        rate: Turns per second (AirSim: ``RotationsPerSecond``).
        pattern: ``spinning``: rings, column by column, clockwise seen from above. ``solid_state``:
            a rosette in the field of view that does not repeat, as two turning prisms draw it.
        channels: Rays that are sent at a time, the uppermost first (AirSim:
            ``NumberOfChannels``).
        columns: Times in a turn at which they are sent.
        azimuths: First and last direction, degrees clockwise from ahead (AirSim:
            ``HorizontalFOVStart`` and ``End``). A spinning lidar is blind for the rest of the turn.
        elevations: Lowest and highest direction, degrees above the sensor's x-y plane (AirSim:
            ``VerticalFOVLower`` and ``Upper``).
        min_range: Metres; what is nearer gives no point.
        max_range: Metres; what is farther gives no point (AirSim: ``Range``).
        noise: Standard deviation of the white noise along the ray, metres.
        dropout: Share of rays that give no point, at random.
        min_intensity: What returns less light than this gives no point.
        full_range: Metres up to which a white surface that faces the sensor has intensity 1; beyond
            it the intensity falls with the square of the range.
    """

    name: Name
    rate: Annotated[float, msgspec.Meta(gt=0.0, le=100.0)] = 10.0
    pattern: Literal["spinning", "solid_state"] = "spinning"
    channels: Annotated[int, msgspec.Meta(ge=1, le=256)] = 16
    columns: Annotated[int, msgspec.Meta(ge=1, le=65536)] = 1024
    azimuths: tuple[float, float] = (0.0, 360.0)
    elevations: tuple[float, float] = (-15.0, 15.0)
    min_range: NonNegative = 0.1
    max_range: Positive = 100.0
    noise: NonNegative = 0.0
    dropout: Share = 0.0
    min_intensity: Share = 0.0
    full_range: Positive = 20.0

    def __post_init__(self) -> None:
        first, last = self.azimuths
        low, high = self.elevations
        if not 0.0 < last - first <= 360.0:
            raise ValueError(
                f"{self.name}: azimuths: expected up to 360 degrees from the first to the last, "
                f"found {first:g} to {last:g}"
            )
        if not -90.0 <= low <= high <= 90.0:
            raise ValueError(
                f"{self.name}: elevations: expected the lowest and the highest, from -90 to 90 "
                f"degrees, found {low:g} and {high:g}"
            )
        if self.max_range <= self.min_range:
            raise ValueError(
                f"{self.name}: max_range: expected more than the {self.min_range:g} m of "
                f"min_range, found {self.max_range:g} m"
            )


class Pattern(NamedTuple):
    """The rays of one turn.

    Attributes:
        directions: Unit vectors in the sensor's frame (FRD), shape (columns, channels, 3).
        times: Seconds after the turn's start, not falling, shape (columns,).
    """

    directions: Floats
    times: Floats


def pattern_of(spec: LidarSpec, start: float) -> Pattern:
    """Return the rays of the turn that begins at a time, seconds."""
    low, high = np.radians(spec.elevations)
    first, last = np.radians(spec.azimuths)
    share = np.arange(spec.columns) / spec.columns
    if spec.pattern == "spinning":
        turn = (first + share * (last - first))[:, None]
        elevation = np.linspace(high, low, spec.channels)[None, :]
        times = share * (last - first) / (2.0 * math.pi * spec.rate)
    else:
        times = share / spec.rate
        apart = np.arange(spec.channels) * 2.0 * math.pi / spec.channels
        one, other = (2.0 * math.pi * rate * (start + times)[:, None] for rate in PRISMS)
        across = (np.cos(one + apart) + np.cos(other)) / 2.0
        upwards = (np.sin(one + apart) + np.sin(other)) / 2.0
        turn = (first + last) / 2.0 + across * (last - first) / 2.0
        elevation = (low + high) / 2.0 + upwards * (high - low) / 2.0
    x, y, z = np.broadcast_arrays(
        np.cos(elevation) * np.cos(turn), np.cos(elevation) * np.sin(turn), -np.sin(elevation)
    )
    return Pattern(np.stack([x, y, z], axis=-1), times)


class Lidar(Mounted[LidarSpec]):
    """A lidar on a body; its turns are scanned by `sims.sensors.scanner`."""

    announced = LidarAnnouncement

    def also_announced(self) -> dict[str, Any]:
        """Return the field of view in radians."""
        low, high = (math.radians(angle) for angle in self.spec.elevations)
        first, last = (math.radians(angle) for angle in self.spec.azimuths)
        return {"elevations": (low, high), "horizontal_fov": last - first}
