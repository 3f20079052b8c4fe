"""A vehicle's Cameras as the server's setting `cameras`."""

from __future__ import annotations

from typing import Any

from sims.airsim.server.cameras import default_mount
from sims.airsim.settings.keys import Keys

_DEFAULT_NAMES = ("front_center", "front_right", "front_left", "bottom_center", "back_center")
_TYPES = range(8)
"""Of images that the server takes."""

Table = dict[str, Any]


def cameras(vehicle_name: str, vehicle: Keys, settings: Keys, free: bool) -> list[Table]:
    """Return the cameras of a vehicle; the server knows where AirSim's default ones are.

    Those are among them if ``CameraDefaults`` says how they take images.

    Args:
        vehicle_name: Its name.
        vehicle: With its ``Cameras``.
        settings: The whole file with ``CameraDefaults``.
        free: Whether the vehicle is one of the computer-vision mode.
    """
    defaults = settings.table("CameraDefaults")
    usual = _captures(defaults)
    found: dict[str, Table] = {
        name: {"captures": list(usual.values())} for name in _DEFAULT_NAMES if usual
    }
    for name, keys in vehicle.tables("Cameras"):
        captures = usual | _captures(keys)
        place = dict(zip(("position", "orientation"), default_mount(name, free), strict=True))
        mount = defaults.mount(**place)
        mount |= keys.mount(**(place | mount))
        found[name] = {**mount, "captures": list(captures.values())}
        looks = {(each["width"], each["height"], each["fov"]) for each in captures.values()}
        if len(looks) > 1:
            keys.note("CaptureSettings", "the types of image differ in size or field of view")
        elif 0 in captures and not {1, 2, 3} & set(captures):
            keys.note("CaptureSettings", "depth, which is not listed, has 256×144 pixels of 90°")
        keys.done()
    defaults.mount()  # known, even if no camera asks for it
    defaults.done()
    return [{"name": name, "vehicle": vehicle_name, **each} for name, each in found.items()]


def _captures(keys: Keys) -> dict[int, Table]:
    """Return how images are taken, by type; of equal types the last entry counts."""
    found: dict[int, Table] = {}
    for entry in keys.entries("CaptureSettings"):
        type_ = entry.whole("ImageType", 0)
        size = {"width": entry.whole("Width", 256), "height": entry.whole("Height", 144)}
        found[type_] = {"image_type": type_, **size, "fov": entry.number("FOV_Degrees", 90.0)}
        projection = entry.text("ProjectionMode") or "perspective"
        if projection.casefold() != "perspective":
            raise entry.error("ProjectionMode", f'expected "perspective", found {projection!r:.80}')
        if type_ not in _TYPES:
            entry.note("ImageType", f"ignored: no images of type {type_} are taken")
        entry.done()
    for entry in keys.entries("NoiseSettings"):
        if entry.flag("Enabled"):
            entry.note("", "ignored: images on demand are without errors")
    if keys.table("Gimbal").number("Stabilization", 0.0):
        keys.note("Gimbal", "ignored: cameras turn with their vehicle")
    return {type_: each for type_, each in found.items() if type_ in _TYPES}
