"""A vehicle's Sensors as settings of a multirotor; docs/how-to/sensors.md compares the two.

Where AirSim's defaults differ from ours, they are AirSim's.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from typing import Any

from sims.airsim.settings.keys import Keys

GRAVITY = 9.80665

_OURS = dict(
    enumerate(["barometer", "imu", "gnss", "magnetometer", "range_finders", "lidars"], start=1)
)
"""Names of our settings by AirSim's SensorType."""

_BASE: dict[int, dict[str, Any]] = {
    1: {"model": "airsim"},
    4: {"model": "airsim"},
    5: {"noise": 0.2},
}
"""What differs from our defaults."""

_NUMBERS = {
    1: {"PressureFactorSigma": "drift", "PressureFactorTau": "drift_time"}
    | {"UncorrelatedNoiseSigma": "noise"},
    3: {"EphInitial": "eph_initial", "EphFinal": "eph_final", "EphMin3d": "eph_min_3d"}
    | {"EphTimeConstant": "eph_time_constant", "EPH_TimeConstant": "eph_time_constant"},
    4: {"NoiseSigma": "noise", "NoiseBias": "bias", "ScaleFactor": "scale_factor"},
    5: {"MinDistance": "min_range", "MaxDistance": "max_range"},
    6: {"Range": "max_range"},
}
"""Keys and our names of numbers; UpdateFrequency and times are all sensors'."""

_UNITS = {"NoiseSigma": 1e-4, "NoiseBias": 1e-4}
"""Gauss in tesla."""


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
        setting, enabled = _OURS[type_], keys.flag("Enabled")
        if "Enabled" not in keys:
            keys.note("", "ignored: a sensor is off unless Enabled is true")
        elif enabled and type_ >= 5:
            ours = re.sub(r"\W", "_", name, flags=re.ASCII) or "_"
            if type_ == 6 and (frame := keys.text("DataFrame")):
                server["lidar_frame"] = frame
            found.setdefault(setting, []).append({"name": ours} | _settings(keys, type_))
            server["sensor_names"][name] = ours
        elif enabled and setting not in found:
            found[setting] = _settings(keys, type_)
            server["sensor_names"][name] = setting
        elif enabled:
            keys.note("", f"ignored: a vehicle has one {setting}")
    return {"imu": _imu(Keys({}, "", []))} | found  # it always has one


def _known(listed: Iterable[tuple[str, Keys]]) -> Iterable[tuple[str, Keys, int]]:
    for name, keys in listed:
        if (type_ := keys.whole("SensorType", 0)) in _OURS:
            yield name, keys, type_
        else:
            keys.note("SensorType", f"ignored: no sensor of type {type_} is simulated")


def _settings(keys: Keys, type_: int) -> dict[str, Any]:
    found: dict[str, Any] = {**_BASE.get(type_, {}), **keys.mount()}
    common = {"UpdateFrequency": "rate"} if type_ not in {2, 6} else {}
    for key, ours in (_NUMBERS.get(type_, {}) | common).items():
        if (value := keys.number(key, None)) is not None:
            found[ours] = value * _UNITS.get(key, 1.0)
    for key, ours in (("UpdateLatency", "latency"), ("StartupDelay", "startup_delay")):
        if type_ != 2 and (value := keys.number(key, None)) is not None:
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
