"""What a server says of its vehicle: where it is, its cameras, the noise of its IMU."""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable
from typing import Any, NamedTuple

import msgspec

from events import Quaternion, Vector3
from events.rotations import inverse, multiply, normalize, rotate_inverse
from runtime.errors import ConfigError
from sims.airsim import settings
from sims.airsim.client.conversion import pose_of, vector
from sims.airsim.client.rpc import RpcCallError
from sims.airsim.client.settings import AirsimClientConfig, RemoteCamera
from sims.airsim.structures import CameraInfo, MultirotorState, Pose

Call = Callable[..., Awaitable[Any]]
"""Calls a method of the server with its arguments, and gives the result."""

_KINDS = {0: "rgb", 1: "depth", 5: "segmentation", 7: "segmentation"}


class KnownCamera(NamedTuple):
    """A camera of the server's.

    Attributes:
        name: Its name there.
        images: What is asked for.
        fov: Horizontal field of view, degrees.
        position: On the body, metres FRD.
        orientation: From the camera's axes, forward, right, down, to the body's.
    """

    name: str
    images: tuple[str, ...]
    fov: float
    position: Vector3
    orientation: Quaternion


class Remote(NamedTuple):
    """The server's vehicle.

    Attributes:
        vehicle: Its name there.
        cosys: Whether the server is Cosys-AirSim's.
        state: Its state at the start.
        origin: Origin of its local frame in ``map``, metres NED.
        cameras: Those that images are asked of.
        imu: Noise of its IMU, SI units, named as in `events.ImuAnnouncement`.
        clock_speed: Simulated seconds per real second.
    """

    vehicle: str
    cosys: bool
    state: MultirotorState
    origin: Vector3
    cameras: tuple[KnownCamera, ...]
    imu: dict[str, Any]
    clock_speed: float


async def ask(call: Call, config: AirsimClientConfig, log: Callable[[str], None]) -> Remote:
    """Ask a server for all that is to be announced.

    Raises:
        RpcCallError: The server refused a call.
        ValueError: There is no such vehicle, or an answer cannot be understood.
    """
    version = await call("getServerVersion")
    cosys = config.flavour == "cosys" or (config.flavour == "auto" and version >= 2)
    names = sorted(msgspec.convert(await call("listVehicles"), list[str]))
    vehicle = config.vehicle or min(names, default="")
    if vehicle not in names:
        listed = ", ".join(names) or "none"
        raise ValueError(f'vehicle: expected one of the server\'s ({listed}), found "{vehicle}"')
    said = _read(await call("getSettingsString"), log)
    own: dict[str, Any] = next((n for n in said["nodes"] if n["name"] == vehicle), {})
    captured = {
        each["name"]: {capture["image_type"]: capture for capture in each["captures"]}
        for node in said["nodes"]
        for each in node.get("cameras", ())
        if each["vehicle"] == vehicle
    }
    state = msgspec.convert(await call("getMultirotorState", vehicle), MultirotorState)
    body = Pose(state.kinematics_estimated.position, state.kinematics_estimated.orientation)
    cameras = [
        await _camera(call, each, vehicle, cosys, captured.get(each.name, {}), body)
        for each in config.cameras or _cameras(captured)
    ]
    return Remote(
        vehicle=vehicle,
        cosys=cosys,
        state=state,
        origin=await _origin(call, own, vehicle, cosys, vector(body.position)),
        cameras=tuple(cameras),
        imu=_noise(own),
        clock_speed=said["run"]["speed"],
    )


def _read(text: Any, log: Callable[[str], None]) -> dict[str, Any]:
    """Return what the server's settings would be in a file of ours; nearly nothing if unusable."""
    try:
        if text:
            return settings.read(str(text), "the server's settings", lambda _: None)
    except ConfigError as error:
        log(f"cameras, IMU and place are not taken from the server's settings: {error}")
    return {"run": {"speed": 1.0}, "nodes": []}


def _noise(own: dict[str, Any]) -> dict[str, Any]:
    """Return the noise of a vehicle's IMU: AirSim's usual one if nothing is known."""
    imu = own.get("imu") or settings.read("{}", "", lambda _: None)["nodes"][0]["imu"]
    sensors = ("gyroscope", "accelerometer")
    names = [f"{each}_{what}" for each in sensors for what in ("noise_density", "random_walk")]
    return {name: imu.get(name, 0.0) for name in names}


def _cameras(captured: dict[str, dict[int, Any]]) -> list[RemoteCamera]:
    """Return the cameras of the settings with the kinds they are set to capture, or ``0``."""
    cameras = []
    for name, captures in captured.items():
        kinds: Any = tuple(dict.fromkeys(_KINDS[each] for each in captures if each in _KINDS))
        cameras.append(RemoteCamera(name=name, images=kinds or ("rgb", "depth")))
    return cameras or [RemoteCamera(name="0")]


async def _camera(
    call: Call, wanted: RemoteCamera, vehicle: str, cosys: bool, captures: Any, body: Pose
) -> KnownCamera:
    """Return a camera: its field of view by the settings, since AirSim reports another one."""
    found = await call("simGetCameraInfo", wanted.name, vehicle, *(() if cosys else (False,)))
    info = msgspec.convert(found, CameraInfo)
    (here, turned), (place, turn) = pose_of(body), pose_of(info.pose)
    apart = (place[0] - here[0], place[1] - here[1], place[2] - here[2])
    return KnownCamera(
        wanted.name,
        wanted.images,
        captures.get(0, {}).get("fov", info.fov),
        rotate_inverse(turned, apart),
        normalize(multiply(inverse(turned), turn)),
    )


async def _origin(
    call: Call, own: dict[str, Any], vehicle: str, cosys: bool, local: Vector3
) -> Vector3:
    """Return where a vehicle's local frame is: by where its pawn is, or else by the settings."""
    try:
        found = await call("simGetObjectPose", vehicle, *((True,) if cosys else ()))
        x, y, z = vector(msgspec.convert(found, Pose).position)
        if math.isfinite(x + y + z):
            return x - local[0], y - local[1], z - local[2]
    except (RpcCallError, msgspec.ValidationError):
        pass
    return (*own.get("position", (0.0, 0.0)), -own.get("height", 0.0))
