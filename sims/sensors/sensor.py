"""Common base of all sensors but cameras: settings, place, source, truth."""

from __future__ import annotations

import math
import zlib
from abc import ABC, abstractmethod
from typing import Annotated, Any, ClassVar, Generic, NamedTuple, TypeVar

import msgspec
import numpy as np

from events import Announcement, Event, Quaternion, Vector3
from events.frames import from_rpy
from runtime.units import Duration, Latency

NonNegative = Annotated[float, msgspec.Meta(ge=0.0)]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]
Name = Annotated[str, msgspec.Meta(min_length=1, pattern="^[A-Za-z0-9_]+$")]


class Mount(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where a sensor is on its body.

    Attributes:
        position: Position on the body, metres forward, right, down (FRD) of its centre of mass.
        orientation: Roll, pitch, yaw of the sensor in the body's frame, degrees, applied yaw first
            (Z-Y-X). Positive pitch is upwards: -90 looks straight down.
    """

    position: Vector3 = (0.0, 0.0, 0.0)
    orientation: Vector3 = (0.0, 0.0, 0.0)

    @property
    def rotation(self) -> Quaternion:
        """Rotation from the sensor's frame to the body."""
        roll, pitch, yaw = (math.radians(angle) for angle in self.orientation)
        return from_rpy(roll, pitch, yaw)


class SensorSpec(Mount, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of every sensor.

    Attributes:
        rate: Measurements per second (AirSim: ``UpdateFrequency``).
        latency: Time from a measurement to its delivery (AirSim: ``UpdateLatency``).
        startup_delay: Time from the start to the first measurement (AirSim: ``StartupDelay``).
    """

    rate: Annotated[float, msgspec.Meta(gt=0, le=1000)] = 50.0
    latency: Latency = Latency(0)  # immutable
    startup_delay: Latency = Latency(0)


class Truth(NamedTuple):
    """True state of a sensor's body at an instant."""

    stamp: int
    position: Vector3  # metres NED
    orientation: Quaternion  # rotation FRD → NED
    velocity: Vector3  # metres per second NED
    qpos: Any  # the world's generalised positions, shape (nq,), for sensors of the surroundings


class Place(NamedTuple):
    """Source, frame and geographic origin of a sensor."""

    source: str  # source of its measurements: ``drone/barometer``
    parent_frame_id: str
    origin: tuple[float, float, float]
    """Latitude and longitude (degrees) and altitude (metres) of the origin of ``map``."""


S = TypeVar("S", bound=Mount)


class Mounted(Generic[S]):
    """A sensor on a body."""

    announced: ClassVar[type[Announcement]]
    """Announcement type; its fields named like settings take the settings' values."""

    def __init__(self, spec: S, place: Place) -> None:
        self.spec = spec
        self.place = place

    @property
    def source(self) -> str:
        """Source of the measurements, and name of their frame."""
        return self.place.source

    def also_announced(self) -> dict[str, Any]:
        """Return the announcement's fields not found among the settings."""
        return {}

    def announcement(self) -> Any:
        """Return the announcement of the sensor."""
        fields = {
            name: getattr(self.spec, name)
            for name in self.announced.__struct_fields__
            if hasattr(self.spec, name)
        }
        fields |= {k: float(v) for k, v in fields.items() if isinstance(v, Duration)}
        fields |= {
            "stamp": 0,
            "source": self.source,
            "frame_id": self.source,
            "parent_frame_id": self.place.parent_frame_id,
            "orientation": self.spec.rotation,
        }
        return self.announced(**(fields | self.also_announced()))


class Sensor(Mounted[S], ABC):
    """Model of a sensor: from the truth to measurements, at its rate."""

    port: ClassVar[str]  # output of the vehicle's node for the measurements

    def __init__(self, spec: S, place: Place, random: np.random.Generator) -> None:
        super().__init__(spec, place)
        self.random = random

    @abstractmethod
    def measure(self, truth: Truth) -> Event:
        """Return the next measurement."""


class GaussMarkov:
    """A first-order Gauss-Markov process, sampled at equal intervals, from zero at the start.

    Args:
        sigma: Standard deviation that it tends to; of AirSim's, the factor of its input.
        tau: Time constant, seconds; 0 is a process that stays zero.
        airsim: AirSim's recursion, with an input weighted by 1 - e^(-dt/τ), not √(1 - e^(-2 dt/τ)):
            its deviation tends to σ √(dt / 2τ) only.
    """

    def __init__(
        self, sigma: float, tau: float, dt: float, size: int = 1, *, airsim: bool = False
    ) -> None:
        self._keep = math.exp(-dt / tau) if tau > 0.0 else 0.0
        self._input = 1.0 - self._keep if airsim else math.sqrt(1.0 - self._keep**2)
        self._input *= sigma if tau > 0.0 else 0.0
        self.value = np.zeros(size)

    def step(self, random: np.random.Generator) -> Any:
        """Return the next values, shape (size,)."""
        self.value = self._keep * self.value + self._input * random.standard_normal(len(self.value))
        return self.value


def generator_of(parent: np.random.Generator, name: str) -> np.random.Generator:
    """Return a generator seeded by node and sensor name; the parent's state stays."""
    entropy = parent.bit_generator.seed_seq.entropy  # type: ignore[attr-defined]
    return np.random.default_rng([*entropy, zlib.crc32(name.encode())])
