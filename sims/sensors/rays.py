"""Ray casting in a world, and range finders."""

from __future__ import annotations

import math
from typing import Annotated, Any, NamedTuple

import msgspec
import mujoco
import numpy as np
import numpy.typing as npt

from events import Quaternion, Range
from events.frames import flip_yz, flip_yz_rotation, multiply, rotate
from events.sensors import SENSOR_KINDS
from sims.ray_casting import cast_rays
from sims.sensors.sensor import Name, NonNegative, Place, Positive, Sensor, SensorSpec, Truth
from sims.worlds import Dynamics

Floats = npt.NDArray[np.float64]

DRAWN = np.array([1, 1, 1, 0, 0, 0], np.uint8)  # groups of geoms visible to cameras


class Hits(NamedTuple):
    """Intersections of rays from a common origin."""

    distances: Floats  # metres; ``inf`` for those that meet nothing. Shape (n,)
    geoms: npt.NDArray[np.int32]  # numbers of the geoms, or -1. Shape (n,)
    normals: Floats  # unit vectors out of the surfaces, in the rays' axes (NWU). Shape (n, 3)


class Rays:
    """Ray casting in a model, state by state; its dynamics change lights and colours of it.

    Args:
        body: Name of the body whose geoms rays pass through.
    """

    def __init__(self, model: Any, dynamics: Dynamics, body: str) -> None:
        self.model = model
        self.data: Any = mujoco.MjData(model)
        self._dynamics = dynamics
        self._body = int(model.body(body).id)

    def look(self, qpos: Floats, seconds: float) -> None:
        """Set the world to generalised positions, shape (nq,), and a time."""
        self.data.qpos[:] = qpos
        self._dynamics.apply(self.model, self.data, seconds)
        mujoco.mj_kinematics(self.model, self.data)

    def cast(
        self,
        origin: Floats,
        directions: Floats,
        reach: float,
        groups: npt.NDArray[np.uint8] = DRAWN,
    ) -> Hits:
        """Cast rays from a point, shape (3,), along unit vectors, (n, 3); NWU, metres.

        What is see-through, or masked out by a texture's alpha, is met as if it were solid.
        """
        distances, geoms, normals = cast_rays(
            self.model, self.data, origin, directions, groups, self._body
        )
        distances[(geoms < 0) | (distances > reach)] = np.inf
        return Hits(distances, geoms, normals)


class RangeFinderSpec(SensorSpec, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a range finder, pointing along its x axis.

    Attributes:
        name: Name of the sensor, unique on its body.
        noise: Standard deviation of the white noise, metres (AirSim: always 0.2).
        min_range: Metres; below it the range is ``-inf`` (AirSim: ``MinDistance``, only reported).
        max_range: Metres; beyond it the range is ``inf`` (AirSim: ``MaxDistance``, reported).
        field_of_view: Angle of the cone in which the nearest surface counts, degrees: 25 rays, as
            of ultrasound; 0: a single ray, as of a laser.
    """

    name: Name
    noise: NonNegative = 0.02
    min_range: NonNegative = 0.2
    max_range: Positive = 40.0
    field_of_view: Annotated[float, msgspec.Meta(ge=0.0, le=90.0)] = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.max_range <= self.min_range:
            raise ValueError(
                f"{self.name}: max_range: expected more than the {self.min_range:g} m of "
                f"min_range, found {self.max_range:g} m"
            )


def cone(angle: float) -> Floats:
    """Return unit vectors about the x axis, shape (n, 3): 1, or 25 over a cone (rad)."""
    rows = [(1.0, 0.0, 0.0)]
    if angle > 0.0:
        for radius, count in ((angle / 4.0, 8), (angle / 2.0, 16)):
            for turn in np.arange(count) * 2.0 * math.pi / count:
                y, z = math.sin(radius) * math.cos(turn), math.sin(radius) * math.sin(turn)
                rows.append((math.cos(radius), y, z))
    return np.array(rows)


class RangeFinder(Sensor[RangeFinderSpec]):
    """Distance to the nearest surface in the cone."""

    kind = SENSOR_KINDS["range"]

    def __init__(
        self, spec: RangeFinderSpec, place: Place, random: np.random.Generator, rays: Rays
    ) -> None:
        super().__init__(spec, place, random)
        self._rays = rays
        self._cone = cone(math.radians(spec.field_of_view))

    def measure(self, truth: Truth) -> Range:
        """Return the next range."""
        spec = self.spec
        turn = multiply(truth.orientation, spec.rotation)
        place = np.add(truth.position, rotate(truth.orientation, spec.position)).tolist()
        self._rays.look(truth.qpos, truth.stamp / 1e9)
        directions = self._cone @ _matrix(flip_yz_rotation(turn)).T
        hits = self._rays.cast(np.array(flip_yz(tuple(place))), directions, spec.max_range)
        noise = spec.noise * float(self.random.standard_normal())
        distance = float(hits.distances.min()) + noise
        if distance > spec.max_range:
            distance = math.inf
        elif distance < spec.min_range:
            distance = -math.inf
        return Range(
            stamp=truth.stamp,
            source=self.source,
            frame_id=self.source,
            range=distance,
            field_of_view=math.radians(spec.field_of_view),
            min_range=spec.min_range,
            max_range=spec.max_range,
        )

    def also_announced(self) -> dict[str, Any]:
        """Return the cone in radians."""
        return {"field_of_view": math.radians(self.spec.field_of_view)}


def _matrix(rotation: Quaternion) -> Floats:
    return np.array([rotate(rotation, axis) for axis in ((1, 0, 0), (0, 1, 0), (0, 0, 1))]).T
