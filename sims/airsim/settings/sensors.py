"""A vehicle's Sensors as settings of a multirotor; docs/how-to/sensors.md compares the two.

Where AirSim's defaults differ from ours, they are AirSim's.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from sims.airsim.settings.keys import Keys

GRAVITY = 9.80665
_RATES = {"UpdateFrequency": ("rate", 1.0)}
_TIMES = {"UpdateLatency": "latency", "StartupDelay": "startup_delay"}


class Kind(NamedTuple):
    """A sensor that both have.

    Attributes:
        ours: Name of our setting.
        base: What differs from our defaults.
        numbers: Key to our name and the factor to our unit.
        many: Whether a vehicle may have several, which have names.
    """

    ours: str
    base: Mapping[str, Any] = {}
    numbers: Mapping[str, tuple[str, float]] = {}
    many: bool = False


KINDS = {
    1: Kind(
        "barometer",
        {"model": "airsim"},
        {
            "PressureFactorSigma": ("drift", 1.0),
            "PressureFactorTau": ("drift_time", 1.0),
            "UncorrelatedNoiseSigma": ("noise", 1.0),
        }
        | _RATES,
    ),
    2: Kind("imu"),
    3: Kind(
        "gnss",
        {},
        {
            "EphInitial": ("eph_initial", 1.0),
            "EphFinal": ("eph_final", 1.0),
            "EphMin3d": ("eph_min_3d", 1.0),
            "EphTimeConstant": ("eph_time_constant", 1.0),
            "EPH_TimeConstant": ("eph_time_constant", 1.0),
        }
        | _RATES,
    ),
    4: Kind(
        "magnetometer",
        {"model": "airsim"},
        {
            "NoiseSigma": ("noise", 1e-4),
            "NoiseBias": ("bias", 1e-4),
            "ScaleFactor": ("scale_factor", 1.0),
        }
        | _RATES,
    ),
    5: Kind(
        "range_finders",
        {"noise": 0.2},
        {"MinDistance": ("min_range", 1.0), "MaxDistance": ("max_range", 1.0)} | _RATES,
        many=True,
    ),
    6: Kind("lidars", {}, {"Range": ("max_range", 1.0)}, many=True),
}
"""By AirSim's SensorType."""


def sensors(vehicle: Keys, settings: Keys, server: dict[str, Any]) -> dict[str, Any]:
    """Return the settings of a multirotor's sensors, and add what the server is to know of them.

    One that is listed, even if it is not enabled, replaces the default ones of its type.

    Args:
        vehicle: With its ``Sensors``.
        settings: The whole file with ``DefaultSensors``, if it replaces the built-in defaults: a
            barometer, an IMU, a satellite receiver and a magnetometer.
        server: Gets `sensor_names`, where AirSim's are not ours, and `lidar_frame`.
    """
    usual: Iterable[tuple[str, Keys]] = settings.tables("DefaultSensors")
    if "DefaultSensors" not in settings:
        builtin = ({"SensorType": type_, "Enabled": True} for type_ in (1, 2, 3, 4))
        usual = (("", Keys(table, "", [])) for table in builtin)
        server["sensor_names"]["gps"] = "gnss"
    listed = list(_known(vehicle.tables("Sensors")))
    types = {type_ for _, _, type_ in listed}
    found: dict[str, Any] = {}
    for name, keys, type_ in [*listed, *(each for each in _known(usual) if each[2] not in types)]:
        kind, enabled = KINDS[type_], keys.flag("Enabled")
        if "Enabled" not in keys:
            keys.note("", "ignored: a sensor is off unless Enabled is true")
        elif enabled and kind.many:
            ours = re.sub(r"\W", "_", name, flags=re.ASCII) or "_"
            if type_ == 6 and (frame := keys.text("DataFrame")):
                server["lidar_frame"] = frame
            found.setdefault(kind.ours, []).append({"name": ours} | _settings(keys, type_))
            server["sensor_names"][name] = ours
        elif enabled and kind.ours not in found:
            found[kind.ours] = _settings(keys, type_)
            server["sensor_names"][name] = kind.ours
        elif enabled:
            keys.note("", f"ignored: a vehicle has one {kind.ours}")
    return {"imu": _imu(Keys({}, "", []))} | found  # it always has one


def _known(listed: Iterable[tuple[str, Keys]]) -> Iterable[tuple[str, Keys, int]]:
    for name, keys in listed:
        if (type_ := keys.whole("SensorType", 0)) in KINDS:
            yield name, keys, type_
        else:
            keys.note("SensorType", f"ignored: no sensor of type {type_} is simulated")


def _settings(keys: Keys, type_: int) -> dict[str, Any]:
    kind = KINDS[type_]
    found = dict(kind.base) | keys.mount()
    for key, (ours, factor) in kind.numbers.items():
        if (value := keys.number(key, None)) is not None:
            found[ours] = value * factor
    for key, ours in _TIMES.items():
        if (value := keys.number(key, None)) is not None:
            found[ours] = f"{value!r}s"
    if type_ == 2:
        found |= _imu(keys)
    if type_ == 6:
        found |= _lidar(keys)
    keys.done()
    return found


def _imu(keys: Keys) -> dict[str, Any]:
    """Return the IMU's noise densities, and random walks from bias stability and its time."""

    def density(key: str, default: float) -> float:
        return abs(keys.number(key, default))

    def stability(key: str, default: float, seconds: float) -> float:
        return density(key, default) / math.sqrt(keys.positive(f"{key}Tau", seconds))

    degree = math.radians(1.0)
    noise = {
        "gyroscope_noise_density": density("AngularRandomWalk", 0.3) * degree / 60,
        "gyroscope_random_walk": stability("GyroBiasStability", 4.6, 500.0) * degree / 3600,
        "accelerometer_noise_density": density("VelocityRandomWalk", 0.24) * 1e-3 * GRAVITY,
        "accelerometer_random_walk": stability("AccelBiasStability", 36.0, 800.0) * 1e-6 * GRAVITY,
    }
    return noise if keys.flag("GenerateNoise", True) else {"ideal": True}  # Cosys-AirSim's key


def _lidar(keys: Keys) -> dict[str, Any]:
    channels, turns = keys.positive("NumberOfChannels", 16), keys.positive("RotationsPerSecond", 10)
    first = keys.number("HorizontalFOVStart", 0.0) % 360
    last = keys.number("HorizontalFOVEnd", 359.0) % 360
    low, high = keys.number("VerticalFOVLower", -45.0), keys.number("VerticalFOVUpper", -15.0)
    columns = keys.positive("PointsPerSecond", 1e5) / channels / turns
    return {
        "channels": keys.whole("NumberOfChannels", 16),
        "rate": turns,
        "columns": max(round(min(columns, 2**16)), 1),
        "azimuths": [first, last + 360 * (last <= first)],
        "elevations": [min(low, high), max(low, high)],
    }
