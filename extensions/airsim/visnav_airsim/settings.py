"""AirSim's settings.json as a configuration of ours.

Source of keys and defaults: AirLib's ``common/AirSimSettings.hpp`` in AirSim 1.8.1. Where its
sensors' defaults differ from ours, they are AirSim's; docs/how-to/sensors.md compares the two.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable
from pathlib import Path, PurePath
from typing import Any

from events import Vector3
from visnav_airsim.keys import Keys, parse

Table = dict[str, Any]

_CAMERA, _DRONE = "ComputerVision", "SimpleFlight"
_REFUSED = {
    "px4multirotor": "PX4 would have to run beside it",
    "arducopter": "ArduPilot would have to run beside it",
    "arducoptersolo": "ArduPilot would have to run beside it",
    "physxcar": "cars are not simulated",
    "ardurover": "cars are not simulated",
}
_EYE_HEIGHT = 1.5  # metres above the ground of a computer-vision camera, if not said
_MOST_COLUMNS = 2**16  # of a lidar's turn
_IMAGE_TYPES = range(8)  # that the server takes

DEFAULT_CAMERAS: tuple[tuple[tuple[str, ...], Vector3, Vector3], ...] = (
    (("front_center", "0", "", "fpv"), (0.46, 0.0, 0.0), (0.0, 0.0, 0.0)),
    (("front_right", "1"), (0.46, 0.125, 0.0), (0.0, 0.0, 0.0)),
    (("front_left", "2"), (0.46, -0.125, 0.0), (0.0, 0.0, 0.0)),
    (("bottom_center", "3"), (0.0, 0.0, 0.12), (0.0, -90.0, 0.0)),
    (("back_center", "4"), (-0.46, 0.0, 0.0), (0.0, 0.0, 180.0)),
)
"""Names, position (metres FRD) and orientation (degrees) of the built-in cameras.
Source: the multirotor's blueprint in AirSim 1.8.1.
"""

GRAVITY = 9.80665
# By AirSim's SensorType: our settings, what differs from our defaults, and the names of numbers.
_SETTINGS = dict(
    enumerate(["barometer", "imu", "gnss", "magnetometer", "range_finders", "lidars"], start=1)
)
_DIFFERENT: dict[int, Table] = {1: {"model": "airsim"}, 4: {"model": "airsim"}, 5: {"noise": 0.2}}
_NUMBERS = {
    1: {"PressureFactorSigma": "drift", "PressureFactorTau": "drift_time"}
    | {"UncorrelatedNoiseSigma": "noise"},
    3: {"EphInitial": "eph_initial", "EphFinal": "eph_final", "EphMin3d": "eph_min_3d"}
    | {"EphTimeConstant": "eph_time_constant", "EPH_TimeConstant": "eph_time_constant"},
    4: {"NoiseSigma": "noise", "NoiseBias": "bias", "ScaleFactor": "scale_factor"},
    5: {"MinDistance": "min_range", "MaxDistance": "max_range"},
    6: {"Range": "max_range"},
}  # keys and our names of numbers; UpdateFrequency and times are all sensors'
_COSYS = dict(
    enumerate(["echo", "lidar on a GPU; 6 is a lidar", "template", "UWB", "Wi-Fi"], start=7)
)  # by SensorType, sensors that Cosys-AirSim adds
_UNITS = {"NoiseSigma": 1e-4, "NoiseBias": 1e-4}  # Gauss in tesla


def default_mount(name: str, free: bool) -> tuple[Vector3, Vector3]:
    """Return position (m FRD) and roll, pitch, yaw (degrees) of AirSim's camera; else 0."""
    for names, (x, y, z), orientation in DEFAULT_CAMERAS:
        if name in names:
            return (0.0, y, 0.0) if free else (x, y, z), orientation
    return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)


def read(text: str, path: str, warn: Callable[[str], None], world: str = "hall") -> Table:
    """Return AirSim's settings as the content of an equivalent TOML file.

    Args:
        path: Its name, for messages.
        warn: Called with a line on each oddity, and each setting not honoured.

    Raises:
        ConfigError: It is no JSON, or a value's type or request is not supported.
    """
    name = Path(path).name
    document, strict, oddities = parse(text, name)
    notes = [f"{name}: {oddity}" for oddity in oddities]
    table = _configuration(Keys(document, f"{name}: ", notes), strict, world)
    for line in dict.fromkeys(notes):
        warn(line)
    return table


def _configuration(keys: Keys, text: str, world: str) -> Table:
    mode = keys.text("SimMode") or "Multirotor"
    if mode not in {"Multirotor", _CAMERA}:
        raise keys.error("SimMode", f'expected "Multirotor" or "{_CAMERA}", found {mode!r:.80}')
    version = keys.number("SettingsVersion", keys.number("SettingdVersion", 1.2))
    if version < 1.2:
        keys.add_note("SettingsVersion", f"{version:g} is read as if it were 1.2")
    speed = keys.positive("ClockSpeed", 1.0)
    if speed > 1.0 and speed != int(speed):
        keys.add_note("ClockSpeed", f"AirSim takes {speed:g} as {int(speed)}; here it is {speed:g}")
    server: Table = {
        "name": "airsim",
        "type": "AirsimServer",
        "host": keys.text("LocalHostIp") or "127.0.0.1",
        "port": keys.whole("ApiServerPort", 41451),
        "settings": text,
        "sensor_names": {},
        "cameras": [],
    }
    if "Recording" in keys:
        server["recording"] = _recording(keys.table("Recording"))
    nodes = [*_vehicles(keys, mode, world, server), server]
    wind = keys.table("Wind")
    if any(velocity := wind.numbers("X Y Z")):
        nodes.append({"name": "world", "type": "World", "wind": {"velocity": velocity}})
    wind.done()
    keys.done()
    names = server["sensor_names"]
    server["sensor_names"] = {name: names[name] for name in names if name not in {"", names[name]}}
    for key in ("sensor_names", "cameras"):
        if not server[key]:
            del server[key]
    return {"run": {"name": "airsim", "clock": "lockstep", "speed": speed}, "nodes": nodes}


def _vehicles(keys: Keys, mode: str, world: str, server: Table) -> list[Table]:
    """Return the nodes of all vehicles, sorted by name; of their cameras the server is told."""
    point = keys.table("OriginGeopoint")
    defaults = {"Latitude": 47.641468, "Longitude": -122.140165, "Altitude": 122.0}
    origin = [point.number(key, default) for key, default in defaults.items()]
    point.done()
    tables = list(keys.tables("Vehicles"))
    if not tables:
        name = _CAMERA if mode == _CAMERA else _DRONE
        tables = [(name, Keys({"VehicleType": name}, "", []))]
    nodes: list[Table] = []
    for name, vehicle in tables:
        camera = _is_camera(vehicle, mode)
        node = {"name": name, **_place(vehicle, camera), "world": world, "origin": origin}
        if camera:
            _add_sensor_notes(vehicle, keys)
        else:
            node |= _sensors(vehicle, keys, server)
        served = _cameras(name, vehicle, keys, camera)
        if vehicle.flag("AutoCreate", True):
            nodes.append(node)
            server["cameras"] += served
            if vehicle.flag("IsFpvVehicle"):
                server["default_vehicle"] = name
        vehicle.done()
    places = [(node["position"], node.get("height")) for node in nodes]
    for node, place in zip(nodes, places, strict=True):
        if places.count(place) > 1:
            keys.add_note(f"Vehicles.{node['name']}", "another vehicle starts at the same place")
    if not nodes:
        raise keys.error("Vehicles", "expected one with AutoCreate at least, found none")
    return nodes


def _is_camera(vehicle: Keys, mode: str) -> bool:
    type_ = vehicle.text("VehicleType", _CAMERA if mode == _CAMERA else "")
    if (folded := type_.casefold()) not in {_CAMERA.casefold(), _DRONE.casefold()}:
        reason = f": {_REFUSED[folded]}" if folded in _REFUSED else ""
        raise vehicle.error(
            "VehicleType", f'expected "{_DRONE}" or "{_CAMERA}", found {type_!r:.80}{reason}'
        )
    if mode == _CAMERA and folded != mode.casefold():
        vehicle.add_note("VehicleType", f"in the mode {_CAMERA} it is a camera that does not fly")
    return mode == _CAMERA or folded == _CAMERA.casefold()


def _place(vehicle: Keys, camera: bool) -> Table:
    """Return type and start of a vehicle; the world's origin is where AirSim's player starts."""
    x, y = vehicle.numbers("X Y")
    roll, pitch, yaw = vehicle.numbers("Roll Pitch Yaw")
    if camera:
        position = [x, y, vehicle.number("Z", -_EYE_HEIGHT)]
        type_ = "FreeCamera"
        return {"type": type_, "position": position, "orientation": [roll, pitch, yaw]}
    height = 0.0 - vehicle.number("Z", 0.0)
    return {"type": "Multirotor", "position": [x, y], "height": height, "yaw": yaw}


def _recording(keys: Keys) -> Table:
    """Return the server's setting; recordings stay in the run's folder."""
    folder_name = keys.text("Folder") or "recording"
    folder = re.sub(r"[^\w-]", "_", PurePath(folder_name).name, flags=re.ASCII) or "recording"
    if folder != folder_name:
        keys.add_note("Folder", f'it is "{folder}" in the run\'s folder')
    recording: Table = {
        "enabled": keys.flag("Enabled"),
        "on_move": keys.flag("RecordOnMove"),
        "interval": keys.positive("RecordInterval", 0.05),
        "folder": folder,
    }
    for entry in keys.entries("Cameras"):
        image = {
            "camera": entry.text("CameraName", "0"),
            "image_type": entry.whole("ImageType", 0),
            "pixels_as_float": entry.flag("PixelsAsFloat"),
            "compress": entry.flag("Compress", True),
            "vehicle": entry.text("VehicleName"),
        }
        recording.setdefault("images", []).append(image)
        entry.done()
    keys.done()
    return recording


def _cameras(vehicle_name: str, vehicle: Keys, settings: Keys, free: bool) -> list[Table]:
    """Return a vehicle's Cameras as the server's setting `cameras`; `free` without a vehicle.

    AirSim's default ones are among them only if ``CameraDefaults`` says how they take images.
    """
    defaults = settings.table("CameraDefaults")
    usual = _captures(defaults)
    cameras: dict[str, Table] = {
        names[0]: {"captures": list(usual.values())} for names, _, _ in DEFAULT_CAMERAS if usual
    }
    for name, keys in vehicle.tables("Cameras"):
        captures = usual | _captures(keys)
        place = dict(zip(("position", "orientation"), default_mount(name, free), strict=True))
        mount = defaults.mount(**place)
        mount |= keys.mount(**(place | mount))
        cameras[name] = {**mount, "captures": list(captures.values())}
        looks = {(c["width"], c["height"], c["fov"]) for c in captures.values()}
        if len(looks) > 1:
            keys.add_note("CaptureSettings", "the types of image differ in size or field of view")
        elif 0 in captures and not {1, 2, 3} & set(captures):
            keys.add_note(
                "CaptureSettings", "depth, which is not listed, has 256×144 pixels of 90°"
            )
        keys.done()
    defaults.mount()  # read, even if no camera uses it
    defaults.done()
    return [{"name": name, "vehicle": vehicle_name, **camera} for name, camera in cameras.items()]


def _captures(keys: Keys) -> dict[int, Table]:
    """Return how images are taken, by type; of equal types the last entry counts."""
    captures: dict[int, Table] = {}
    for entry in keys.entries("CaptureSettings"):
        type_ = entry.whole("ImageType", 0)
        size = {"width": entry.whole("Width", 256), "height": entry.whole("Height", 144)}
        captures[type_] = {"image_type": type_, **size, "fov": entry.number("FOV_Degrees", 90.0)}
        projection = entry.text("ProjectionMode") or "perspective"
        if projection.casefold() != "perspective":
            raise entry.error("ProjectionMode", f'expected "perspective", found {projection!r:.80}')
        if type_ not in _IMAGE_TYPES:
            entry.add_note("ImageType", f"ignored: no images of type {type_} are taken")
        entry.done()
    for entry in keys.entries("NoiseSettings"):
        if entry.flag("Enabled"):
            entry.add_note("", "ignored: images on demand are without errors")
    if keys.table("Gimbal").number("Stabilization", 0.0):
        keys.add_note("Gimbal", "ignored: cameras turn with their vehicle")
    return {type_: capture for type_, capture in captures.items() if type_ in _IMAGE_TYPES}


def _sensors(vehicle: Keys, settings: Keys, server: dict[str, Any]) -> dict[str, Any]:
    """Return a multirotor's sensors; add `sensor_names` and `lidar_frame` to the server.

    A listed sensor, even if not enabled, replaces the default ones of its type: a barometer, an
    IMU, a satellite receiver and a magnetometer, or those of ``DefaultSensors``.
    """
    usual: Iterable[tuple[str, Keys]] = settings.tables("DefaultSensors")
    if "DefaultSensors" not in settings:
        builtin = ({"SensorType": type_, "Enabled": True} for type_ in (1, 2, 3, 4))
        usual = (("", Keys(table, "", [])) for table in builtin)
        server["sensor_names"]["gps"] = "gnss"
    listed = list(_known_types(vehicle.tables("Sensors")))
    types = {type_ for _, _, type_ in listed}
    sensors: dict[str, Any] = {}
    for name, keys, type_ in [*listed, *(s for s in _known_types(usual) if s[2] not in types)]:
        setting, enabled = _SETTINGS[type_], keys.flag("Enabled")
        if "Enabled" not in keys:
            keys.add_note("", "ignored: a sensor is off unless Enabled is true")
        elif enabled and type_ >= 5:
            node_name = re.sub(r"\W", "_", name, flags=re.ASCII) or "_"
            if type_ == 6 and (frame := keys.text("DataFrame")):
                server["lidar_frame"] = frame
            sensors.setdefault(setting, []).append({"name": node_name} | _sensor(keys, type_))
            server["sensor_names"][name] = node_name
        elif enabled and setting not in sensors:
            sensors[setting] = _sensor(keys, type_)
            server["sensor_names"][name] = setting
        elif enabled:
            keys.add_note("", f"ignored: a vehicle has one {setting}")
    return {"imu": _imu(Keys({}, "", []))} | sensors  # it always has one


def _add_sensor_notes(vehicle: Keys, settings: Keys) -> None:
    """Add notes for sensors that a camera without a vehicle does not have."""
    for keys, key in ((vehicle, "Sensors"), (settings, "DefaultSensors")):
        names = [name for name, sensor in keys.tables(key) if sensor.flag("Enabled")]
        if names:
            keys.add_note(
                key,
                f"ignored: {', '.join(names)}: a vehicle of the type {_CAMERA} has cameras and no "
                f"other sensor, as in AirSim 1.8.1; one of the type {_DRONE} has them",
            )


def _known_types(listed: Iterable[tuple[str, Keys]]) -> Iterable[tuple[str, Keys, int]]:
    for name, keys in listed:
        if (type_ := keys.whole("SensorType", 0)) in _SETTINGS:
            yield name, keys, type_
        else:
            called = f" ({_COSYS[type_]})" if type_ in _COSYS else ""
            keys.add_note("SensorType", f"ignored: no sensor of type {type_}{called} is simulated")


def _sensor(keys: Keys, type_: int) -> dict[str, Any]:
    sensor: dict[str, Any] = {**_DIFFERENT.get(type_, {}), **keys.mount()}
    common = {"UpdateFrequency": "rate"} if type_ not in {2, 6} else {}
    for key, setting in (_NUMBERS.get(type_, {}) | common).items():
        if (value := keys.number(key, None)) is not None:
            sensor[setting] = value * _UNITS.get(key, 1.0)
    for key, setting in (("UpdateLatency", "latency"), ("StartupDelay", "startup_delay")):
        if type_ != 2 and (value := keys.number(key, None)) is not None:
            sensor[setting] = f"{value!r}s"
    if type_ == 2:
        sensor |= _imu(keys)
    if type_ == 6:
        sensor |= _lidar(keys)
    keys.done()
    return sensor


def _imu(keys: Keys) -> dict[str, Any]:
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
    if "MeasurementsPerCycle" in keys:  # Cosys-AirSim's
        if not 1 <= (columns := keys.whole("MeasurementsPerCycle", 512)) <= _MOST_COLUMNS:
            raise keys.error(
                "MeasurementsPerCycle", f"expected 1 to {_MOST_COLUMNS}, found {columns}"
            )
        if "PointsPerSecond" in keys:
            keys.add_note("PointsPerSecond", "ignored: MeasurementsPerCycle is given, too")
        last = keys.number("HorizontalFOVEnd", 360.0) % 360
    noise = keys.number("MinNoiseStandardDeviation", 0.0) if keys.flag("GenerateNoise") else 0.0
    if noise and keys.number("NoiseDistanceScale", 1.0) != 1.0:
        keys.add_note("NoiseDistanceScale", "ignored: the noise is the same at all distances")
    return {
        "channels": keys.whole("NumberOfChannels", 16),
        "rate": turns,
        "columns": max(round(min(columns, _MOST_COLUMNS)), 1),
        "azimuths": [first, last + 360 * (last <= first)],
        "elevations": [min(low, high), max(low, high)],
        **({"noise": abs(noise)} if noise else {}),
    }
