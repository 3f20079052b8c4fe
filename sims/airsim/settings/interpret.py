"""What AirSim's settings mean as a configuration of ours.

Source of keys and defaults: AirLib's ``common/AirSimSettings.hpp`` in AirSim 1.8.1.
"""

from __future__ import annotations

import re
from pathlib import PurePath
from typing import Any

from sims.airsim.settings.cameras import cameras
from sims.airsim.settings.keys import Keys
from sims.airsim.settings.sensors import sensors

_CAMERA, _DRONE = "ComputerVision", "SimpleFlight"
_REFUSED = {
    "px4multirotor": "PX4 would have to run beside it",
    "arducopter": "ArduPilot would have to run beside it",
    "arducoptersolo": "ArduPilot would have to run beside it",
    "physxcar": "cars are not simulated",
    "ardurover": "cars are not simulated",
}
_EYE_HEIGHT = 1.5
"""Metres above the ground at which a camera of the computer-vision mode is, if not said."""

Table = dict[str, Any]


def interpret(keys: Keys, text: str, world: str) -> Table:
    """Return the table of a file of ours.

    Args:
        keys: The settings.
        text: The same as JSON, for clients that ask for it.
        world: Name or path of the world.

    Raises:
        ConfigError: A value is of the wrong type, or asks for what is not simulated here.
    """
    mode = keys.text("SimMode") or "Multirotor"
    if mode not in {"Multirotor", _CAMERA}:
        raise keys.error("SimMode", f'expected "Multirotor" or "{_CAMERA}", found {mode!r:.80}')
    version = keys.number("SettingsVersion", keys.number("SettingdVersion", 1.2))
    if version < 1.2:
        keys.note("SettingsVersion", f"{version:g} is read as if it were 1.2")
    speed = keys.positive("ClockSpeed", 1.0)
    if speed > 1.0 and speed != int(speed):
        keys.note("ClockSpeed", f"AirSim takes {speed:g} as {int(speed)}; here it is {speed:g}")
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
    names = {name: ours for name, ours in server["sensor_names"].items() if name not in {"", ours}}
    server["sensor_names"] = names
    for empty in [key for key, value in server.items() if value in ({}, [])]:
        del server[empty]
    return {"run": {"name": "airsim", "clock": "lockstep", "speed": speed}, "nodes": nodes}


def _vehicles(keys: Keys, mode: str, world: str, server: Table) -> list[Table]:
    """Return the nodes of all vehicles, sorted by name; of their cameras the server is told."""
    point = keys.table("OriginGeopoint")
    latitude, longitude = (
        point.number("Latitude", 47.641468),
        point.number("Longitude", -122.140165),
    )
    common: Table = {
        "world": world,
        "origin": [latitude, longitude, point.number("Altitude", 122.0)],
    }
    point.done()
    given = list(keys.tables("Vehicles"))
    if not given:
        name = _CAMERA if mode == _CAMERA else _DRONE
        given = [(name, Keys({"VehicleType": name}, "", []))]
    nodes: list[Table] = []
    for name, vehicle in given:
        camera = _is_camera(vehicle, mode)
        node = {"name": name, **_place(vehicle, camera), **common}
        if not camera:
            node |= sensors(vehicle, keys, server)
        served = cameras(name, vehicle, keys, camera)
        if vehicle.flag("AutoCreate", True):
            nodes.append(node)
            server["cameras"] += served
            if vehicle.flag("IsFpvVehicle"):
                server["default_vehicle"] = name
        vehicle.done()
    places = [(node["position"], node.get("height")) for node in nodes]
    for node, place in zip(nodes, places, strict=True):
        if places.count(place) > 1:
            keys.note(f"Vehicles.{node['name']}", "another vehicle starts at the same place")
    if not nodes:
        raise keys.error("Vehicles", "expected one with AutoCreate at least, found none")
    return nodes


def _is_camera(vehicle: Keys, mode: str) -> bool:
    """Return whether a vehicle is a camera of the computer-vision mode."""
    type_ = vehicle.text("VehicleType", _CAMERA if mode == _CAMERA else "")
    if (folded := type_.casefold()) not in {_CAMERA.casefold(), _DRONE.casefold()}:
        reason = f": {_REFUSED[folded]}" if folded in _REFUSED else ""
        raise vehicle.error(
            "VehicleType", f'expected "{_DRONE}" or "{_CAMERA}", found {type_!r:.80}{reason}'
        )
    if mode == _CAMERA and folded != mode.casefold():
        vehicle.note("VehicleType", f"in the mode {_CAMERA} it is a camera that does not fly")
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
    given = keys.text("Folder") or "recording"
    folder = re.sub(r"[^\w-]", "_", PurePath(given).name, flags=re.ASCII) or "recording"
    if folder != given:
        keys.note("Folder", f'it is "{folder}" in the run\'s folder')
    found: Table = {
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
        found.setdefault("images", []).append(image)
        entry.done()
    keys.done()
    return found
