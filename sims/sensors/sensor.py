"""Sensors but cameras: their common base, and barometer, magnetometer and GNSS receiver."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from math import acos, asin, atan, cos, exp, radians, sin, sqrt, tan
from typing import Annotated, Any, ClassVar, Generic, Literal, NamedTuple, TypeVar

import msgspec
import numpy as np

import events as ev
from events import Announcement, Event, Quaternion, Vector3
from events.frames import IDENTITY, cross, from_rpy, multiply, rotate, rotate_inverse, to_geodetic
from events.sensors import SENSOR_KINDS, SensorKind
from runtime.errors import MissingDependencyError
from runtime.extras import install_command
from runtime.sensors import other_sensors
from runtime.units import Duration, Latency
from sims.calibration import MountingError
from sims.mounting import Matrix, apply_matrix

NonNegative = Annotated[float, msgspec.Meta(ge=0.0)]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]
Name = Annotated[str, msgspec.Meta(min_length=1, pattern="^[A-Za-z0-9_]+$")]


class Mount(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where a sensor is on its body.

    Attributes:
        position: Position on the body, metres forward, right, down (FRD) of its centre of mass.
        orientation: Roll, pitch, yaw of the sensor in the body's frame, degrees, applied yaw first
            (Z-Y-X). Positive pitch is upwards: -90 looks straight down.
        T_BS: In place of both, the transform from the sensor's own axes (forward, right, down if
            `orientation` is 0) to the body: four rows of four numbers, or ``{ rows, cols, data }``
            as in a sensor.yaml of EuRoC's.
    """

    position: Vector3 = (0.0, 0.0, 0.0)
    orientation: Vector3 = (0.0, 0.0, 0.0)
    T_BS: Matrix | None = None

    def __post_init__(self) -> None:
        apply_matrix(self, IDENTITY)

    @property
    def rotation(self) -> Quaternion:
        """Rotation from the sensor's frame to the body."""
        roll, pitch, yaw = (math.radians(angle) for angle in self.orientation)
        return from_rpy(roll, pitch, yaw)

    @property
    def wrong(self) -> MountingError | None:
        """Errors of the announced calibration; `None` if it is exact."""
        return None


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
    angular_velocity: Vector3  # radians per second FRD
    qpos: Any  # the world's generalised positions, shape (nq,), for sensors of the surroundings
    wind: Vector3 = (0.0, 0.0, 0.0)  # of the air round the body, metres per second NED


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
    """Model of a sensor: from the truth to measurements, at its rate.

    A class of which a vehicle has one or none is in `SENSORS`, or an entry point of the group
    ``visnav.sensors``.
    """

    kind: ClassVar[SensorKind]  # its name, its events and its output
    spec_type: ClassVar[type[SensorSpec]]  # its table in the vehicle's settings
    meaning: ClassVar[str]  # of that table, for the documentation of the settings

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if "kind" in vars(cls):
            cls.announced = cls.kind.announcement

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


def check_drift(drift: float, seconds: float, setting: str = "drift_time") -> None:
    """Raise a `ValueError` for a drift without a time constant."""
    if drift and not seconds:
        raise ValueError(f"{setting}: expected more than 0 s with a drift, found 0 s")


_SEA_LEVEL = 101325.0
_RADIUS = 6378.137  # radius of the earth in AirSim, kilometres


class BarometerSpec(SensorSpec, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a barometer; by default those of AirSim's.

    Attributes:
        noise: Standard deviation of the white noise, pascal (AirSim: ``UncorrelatedNoiseSigma``).
            At sea level 12 Pa are a metre.
        drift: Standard deviation of the drifting relative error (AirSim: ``PressureFactorSigma``).
        drift_time: Time constant of the drift, above 0 if there is one (AirSim:
            ``PressureFactorTau``).
        model: ``gauss_markov``: the drift tends to its standard deviation, of 185 Pa with these
            defaults. ``airsim``: AirSim's recursion, which at 50 Hz tends to 0.3 Pa.
    """

    noise: NonNegative = 2.7
    drift: NonNegative = 0.001825
    drift_time: Duration = Duration(3600)  # immutable
    model: Literal["gauss_markov", "airsim"] = "gauss_markov"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_drift(self.drift, self.drift_time)


def pressure_at(altitude: float) -> float:
    """Return the pressure (Pa) of the standard atmosphere (ISA) up to 11 km above sea level."""
    return float(_SEA_LEVEL * (288.15 / temperature_at(altitude)) ** -5.255877)


def temperature_at(altitude: float) -> float:
    """Return the temperature (K) of the standard atmosphere up to 11 km above sea level."""
    kilometres = altitude / 1e3
    geopotential = _RADIUS * kilometres / (_RADIUS + kilometres)
    return 288.15 - 6.5 * geopotential


def altitude_at(pressure: float) -> float:
    """Return the pressure altitude of a barometer with QNH 1013.25 hPa, metres."""
    return float((1.0 - (pressure / _SEA_LEVEL) ** 0.190284) * 145366.45 * 0.3048)


class Barometer(Sensor[BarometerSpec]):
    """Pressure at the sensor's place."""

    kind, spec_type = SENSOR_KINDS["barometer"], BarometerSpec
    meaning = "The barometer; none if it is not set. ``{}`` is one with all its defaults."

    def __init__(self, spec: BarometerSpec, place: Place, random: np.random.Generator) -> None:
        super().__init__(spec, place, random)
        airsim = spec.model == "airsim"
        self._drift = GaussMarkov(spec.drift, spec.drift_time, 1.0 / spec.rate, airsim=airsim)

    def measure(self, truth: Truth) -> ev.FluidPressure:
        """Return the next pressure."""
        spec = self.spec
        down = truth.position[2] + rotate(truth.orientation, spec.position)[2]
        factor = 1.0 + float(self._drift.step(self.random)[0])
        noise = spec.noise * float(self.random.standard_normal())
        return ev.FluidPressure(
            stamp=truth.stamp,
            source=self.source,
            fluid_pressure=pressure_at(self.place.origin[2] - down) * factor + noise,
            variance=spec.noise**2,
        )

    def also_announced(self) -> dict[str, Any]:
        """Return the altitude of the origin."""
        return {"altitude": self.place.origin[2]}


Geodetic = tuple[float, float, float]


class MagnetometerSpec(SensorSpec, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a magnetometer; by default the noise of AirSim's in the World Magnetic Model.

    Attributes:
        noise: Standard deviation of each axis' white noise, tesla (AirSim: ``NoiseSigma``, gauss).
        bias: Greatest bias of each axis, tesla, drawn once and evenly (AirSim: ``NoiseBias``).
        scale_factor: Factor on the field (AirSim: ``ScaleFactor``).
        model: ``wmm``: the World Magnetic Model. ``airsim``: AirSim's dipole, which near Seattle is
            off by 7 degrees in declination and 13 in inclination.
        year: Date of the World Magnetic Model: 2026.5 is the middle of 2026.
    """

    noise: NonNegative = 5e-7
    bias: NonNegative = 0.0
    scale_factor: Positive = 1.0
    model: Literal["wmm", "airsim"] = "wmm"
    year: Annotated[float, msgspec.Meta(ge=2010.0, le=2030.0)] = 2026.0


def world_field(place: Geodetic, year: float) -> Vector3:
    """Return the field of the World Magnetic Model (NCEI and BGS) at a place, tesla NED.

    Raises:
        MissingDependencyError: pygeomag is not installed.
    """
    try:
        from pygeomag import GeoMag  # a tenth of a second that only magnetometers need
    except ImportError:
        raise MissingDependencyError(
            f"a magnetometer's World Magnetic Model needs pygeomag: {install_command('wmm')}"
        ) from None
    five_years = min(5 * int(year // 5), 2025)
    latitude, longitude, altitude = place
    field = GeoMag(base_year=five_years).calculate(latitude, longitude, altitude / 1e3, year)
    return (field.x * 1e-9, field.y * 1e-9, field.z * 1e-9)


def dipole_field(place: Geodetic) -> Vector3:
    """Return AirSim's field at a place, tesla NED: a dipole whose pole is at 80.31° N, 72.62° W.

    AirSim's ``EarthUtils::getMagField``, with latitudes in the place of colatitudes as there.
    """
    latitude, longitude, altitude = radians(place[0]), radians(place[1]), place[2]
    pole, meridian = radians(80.31), radians(-72.62)
    turn = longitude - meridian
    cosine = cos(latitude) * cos(pole) + sin(latitude) * sin(pole) * cos(turn)
    colatitude = acos(cosine)
    radius = 6378137.0
    strength = 3.12e-5 * (radius / (radius + altitude)) ** 3 * sqrt(1.0 + 3.0 * cosine**2)
    dip = atan(2.0 / tan(colatitude))
    side = sin(turn) if cosine > sin(pole) * sin(latitude) else cos(turn)
    declination = asin(side * cos(pole) / sin(colatitude))
    level = strength * cos(dip)
    return (level * cos(declination), level * sin(declination), strength * sin(dip))


class Magnetometer(Sensor[MagnetometerSpec]):
    """The field at the origin, the same in the whole world."""

    kind, spec_type = SENSOR_KINDS["magnetometer"], MagnetometerSpec
    meaning = "The magnetometer; none if it is not set."

    def __init__(self, spec: MagnetometerSpec, place: Place, random: np.random.Generator) -> None:
        super().__init__(spec, place, random)
        airsim = spec.model == "airsim"
        self.field = dipole_field(place.origin) if airsim else world_field(place.origin, spec.year)
        """Tesla NED."""
        self._bias = random.uniform(-1.0, 1.0, 3) * spec.bias

    def measure(self, truth: Truth) -> ev.MagneticField:
        """Return the next field."""
        spec = self.spec
        true = rotate_inverse(multiply(truth.orientation, spec.rotation), self.field)
        noise = spec.noise * self.random.standard_normal(3)
        x, y, z = (np.multiply(true, spec.scale_factor) + noise + self._bias).tolist()
        return ev.MagneticField(
            stamp=truth.stamp, source=self.source, frame_id=self.source, magnetic_field=(x, y, z)
        )

    def also_announced(self) -> dict[str, Any]:
        """Return the field."""
        return {"field": self.field}


class GnssSpec(SensorSpec, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a GNSS receiver; the defaults are AirSim's GPS, free of errors.

    Attributes:
        horizontal_noise: Standard deviation of the white noise, north and east, metres.
        vertical_noise: Standard deviation of the white noise, down, metres.
        horizontal_drift: Standard deviation of the slow error, north and east, metres.
        vertical_drift: Standard deviation of the slow error, down, metres.
        drift_time: Time constant of the slow error, a first-order Gauss-Markov process; above 0 if
            there is one.
        velocity_noise: Standard deviation of the velocity's white noise, metres per second.
        eph_initial: Reported uncertainty (`position_covariance` only) at the start, metres (AirSim:
            ``EphInitial`` and ``EpvInitial``).
        eph_final: Final reported uncertainty, metres (AirSim: ``EphFinal``, ``EpvFinal``).
        eph_time_constant: Time constant of the decay between them (AirSim: ``EPH_TimeConstant``).
        eph_min_3d: Largest uncertainty of a fix with status 0, metres (AirSim: ``EphMin3d``).
    """

    latency: Latency = Latency(0.2)  # immutable
    startup_delay: Latency = Latency(1.0)
    horizontal_noise: NonNegative = 0.0
    vertical_noise: NonNegative = 0.0
    horizontal_drift: NonNegative = 0.0
    vertical_drift: NonNegative = 0.0
    drift_time: Duration = Duration(60.0)
    velocity_noise: NonNegative = 0.0
    eph_initial: NonNegative = 100.0
    eph_final: NonNegative = 0.1
    eph_time_constant: Duration = Duration(0.9)
    eph_min_3d: Positive = 3.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_drift(self.horizontal_drift or self.vertical_drift, self.drift_time)


class Gnss(Sensor[GnssSpec]):
    """Position and velocity of the antenna."""

    kind, spec_type = SENSOR_KINDS["gnss"], GnssSpec
    meaning = "The satellite receiver; none if it is not set."

    def __init__(self, spec: GnssSpec, place: Place, random: np.random.Generator) -> None:
        super().__init__(spec, place, random)
        self._drift = GaussMarkov(1.0, spec.drift_time, 1.0 / spec.rate, 3)
        self._noises = np.array([spec.horizontal_noise] * 2 + [spec.vertical_noise])
        self._drifts = np.array([spec.horizontal_drift] * 2 + [spec.vertical_drift])

    def measure(self, truth: Truth) -> ev.NavSatFix:
        """Return the next fix."""
        spec = self.spec
        numbers = self.random.standard_normal((2, 3))
        error = self._noises * numbers[0] + self._drifts * self._drift.step(self.random)
        lever = rotate(truth.orientation, spec.position)
        north, east, down = (np.add(truth.position, lever) + error).tolist()
        latitude, longitude, altitude = to_geodetic((north, east, down), self.place.origin)
        velocity = np.array(truth.velocity)
        if any(spec.position):  # to add zeros would change the sign of -0.0
            velocity += rotate(truth.orientation, cross(truth.angular_velocity, spec.position))
        vx, vy, vz = (velocity + spec.velocity_noise * numbers[1]).tolist()
        shown = self._uncertainty(truth.stamp / 1e9)
        covariance = np.diag(shown**2 + self._noises**2 + self._drifts**2)
        return ev.NavSatFix(
            stamp=truth.stamp,
            source=self.source,
            latitude=latitude,
            longitude=longitude,
            altitude=altitude,
            position_covariance=tuple(covariance.ravel().tolist()),
            velocity=(vx, vy, vz),
            status=0 if shown <= spec.eph_min_3d else -1,
        )

    def also_announced(self) -> dict[str, Any]:
        """Return the place of the origin."""
        return dict(zip(("latitude", "longitude", "altitude"), self.place.origin, strict=True))

    def _uncertainty(self, seconds: float) -> float:
        """Return AirSim's eph (and epv): a first-order lag."""
        spec = self.spec
        if not spec.eph_time_constant:
            return spec.eph_final
        left = exp(-seconds / spec.eph_time_constant)
        return spec.eph_final + (spec.eph_initial - spec.eph_final) * left


SENSORS: tuple[type[Sensor[Any]], ...] = (Barometer, Gnss, Magnetometer)
"""Sensors of which a vehicle has one or none, in the order of its settings."""


def all_sensors() -> tuple[type[Sensor[Any]], ...]:
    """Return `SENSORS`, and those of other packages."""
    return (*SENSORS, *other_sensors())
