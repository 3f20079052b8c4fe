"""What a server says of its vehicle, as a simulator would announce it."""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable
from typing import Any, NamedTuple

import msgspec

import events as ev
from events.frames import OPTICAL_TO_FRD, inverse, multiply, normalize, rotate_inverse
from runtime.errors import ConfigError
from sims.airsim import settings
from sims.airsim.client.conversion import odometry, pose_of, vector
from sims.airsim.client.images import ImageSet, Wanted, decode, requests
from sims.airsim.client.rpc import RpcCallError
from sims.airsim.client.settings import AirsimClientConfig, RemoteCamera
from sims.airsim.structures import CameraInfo, MultirotorState, Pose

Call = Callable[..., Awaitable[Any]]
"""Calls a method of the server with its arguments, and gives the result."""

FRAME = "base_link"
_KINDS = {0: "rgb", 1: "depth", 5: "segmentation", 7: "segmentation"}
_MASS, _THRUST = 1.0, 4 * 4.18
"""Kilograms and newtons of AirSim's default quadrotor, for which no method asks."""


class Remote(NamedTuple):
    """The server's vehicle.

    Attributes:
        vehicle: Its name there.
        cosys: Whether the server is Cosys-AirSim's.
        origin: Origin of its local frame in ``map``, metres NED.
        clock_speed: Simulated seconds per real second.
        wanted: What is asked for at each request for images.
        first: The images of the first one.
        announcements: The vehicle, its IMU, and then its cameras by their names.
    """

    vehicle: str
    cosys: bool
    origin: ev.Vector3
    clock_speed: float
    wanted: tuple[Wanted, ...]
    first: ImageSet
    announcements: tuple[ev.Announcement, ...]
    cameras: dict[str, ev.CameraAnnouncement]


async def ask(
    call: Call, config: AirsimClientConfig, name: str, log: Callable[[str], None]
) -> Remote:
    """Ask a server for all that a node of a name is to announce.

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
    kinematics = state.kinematics_estimated
    body = pose_of(Pose(kinematics.position, kinematics.orientation))
    origin = await _origin(call, own, vehicle, cosys, body[0])
    place = odometry(0, name, state, origin)
    announced = ev.VehicleAnnouncement(
        stamp=0,
        source=name,
        mass=_MASS,
        max_thrust=_THRUST,
        control_rate=config.control_rate,
        position=place.position,
        orientation=place.orientation,
    )
    imu = ev.ImuAnnouncement(
        stamp=0, source=name, rate=config.imu_rate, frame_id=FRAME, **_noise(own)
    )
    wished = config.cameras or _cameras(captured)
    wanted = tuple((each.name, kind) for each in wished for kind in each.images)
    taken = await call("simGetImages", *requests(wanted, vehicle, cosys))
    first = decode(taken, wanted, not cosys)
    cameras = {}
    for each in wished:
        found = await call("simGetCameraInfo", each.name, vehicle, *(() if cosys else (False,)))
        info = msgspec.convert(found, CameraInfo)
        height, width = first.images[each.name, each.images[0]].shape[:2]
        # By the settings: AirSim reports another one.
        fov = math.radians(captured.get(each.name, {}).get(0, {}).get("fov", info.fov))
        (x, y, z), turn = pose_of(info.pose)
        apart = x - body[0][0], y - body[0][1], z - body[0][2]
        cameras[each.name] = ev.CameraAnnouncement(
            stamp=0,
            source=f"{name}/{each.name}",
            images=each.images,
            # AirSim's users have the centre at W/2, from the image's corner. Here whole
            # coordinates are those of pixels' centres: the same point is at (W - 1)/2.
            info=ev.CameraInfo.from_fov(width, height, fov),
            rate=config.image_rate,
            latency=0.0,
            frame_id=f"{name}/{each.name}_optical",
            parent_frame_id=FRAME,
            position=rotate_inverse(body[1], apart),
            orientation=normalize(multiply(multiply(inverse(body[1]), turn), OPTICAL_TO_FRD)),
        )
    return Remote(
        vehicle,
        cosys,
        origin,
        said["run"]["speed"],
        wanted,
        first,
        (announced, imu, *cameras.values()),
        cameras,
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


async def _origin(
    call: Call, own: dict[str, Any], vehicle: str, cosys: bool, local: ev.Vector3
) -> ev.Vector3:
    """Return where a vehicle's local frame is: by where its pawn is, or else by the settings."""
    try:
        found = await call("simGetObjectPose", vehicle, *((True,) if cosys else ()))
        x, y, z = vector(msgspec.convert(found, Pose).position)
        if math.isfinite(x + y + z):
            return x - local[0], y - local[1], z - local[2]
    except (RpcCallError, msgspec.ValidationError):
        pass
    return (*own.get("position", (0.0, 0.0)), -own.get("height", 0.0))
