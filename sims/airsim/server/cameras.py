"""The cameras that clients know by name: settings, AirSim's defaults, and what clients change.

A change is the server's only: the cameras of the run's file, their images and announcements stay
as they are. Source of the default mounts: the multirotor's blueprint in AirSim 1.8.1.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from events.base import Vector3
from events.frames import flip_yz, flip_yz_rotation, from_rpy, multiply, normalize, rotate
from sims.airsim.server.methods import RpcError, rpc
from sims.airsim.server.rendering import Eye, Mount
from sims.airsim.server.vehicles import ServedVehicle
from sims.airsim.structures import CameraInfo, Pose, ProjectionMatrix, Quaternionr
from sims.cameras.spec import CameraSpec, Pixels, camera_info, eyes
from sims.cameras.view import View
from sims.simulator import Simulator

if TYPE_CHECKING:
    from sims.airsim.server.node import AirsimServer

FieldOfView = Annotated[float, msgspec.Meta(ge=1.0, le=170.0)]
FARTHEST = 1e6
"""Metres from its vehicle up to which a client may put a camera."""

_DEFAULTS: tuple[tuple[tuple[str, ...], Vector3, Vector3], ...] = (
    (("front_center", "0", "", "fpv"), (0.46, 0.0, 0.0), (0.0, 0.0, 0.0)),
    (("front_right", "1"), (0.46, 0.125, 0.0), (0.0, 0.0, 0.0)),
    (("front_left", "2"), (0.46, -0.125, 0.0), (0.0, 0.0, 0.0)),
    (("bottom_center", "3"), (0.0, 0.0, 0.12), (0.0, -90.0, 0.0)),
    (("back_center", "4"), (-0.46, 0.0, 0.0), (0.0, 0.0, 180.0)),
)
"""Names, position (metres FRD) and orientation (degrees) of the cameras that are always there."""


class Capture(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How a camera takes images of one type.

    Attributes:
        image_type: AirSim's number of the type; see `sims.airsim.server.image_types`.
        width: Width of the images, pixels.
        height: Height of the images, pixels.
        fov: **Horizontal** field of view, degrees.
        projection: Perspective only: orthographic images are not drawn here.
    """

    image_type: Annotated[int, msgspec.Meta(ge=0, le=11)] = 0
    width: Pixels = 256
    height: Pixels = 144
    fov: FieldOfView = 90.0
    projection: Literal["perspective"] = "perspective"


class ServedCamera(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A camera that clients may ask for images, and that renders only then.

    Attributes:
        name: Its name, unique on its vehicle.
        vehicle: The vehicle that carries it; empty for every vehicle.
        position: Position on the body, metres forward, right, down (FRD); by default that of
            AirSim's camera of this name, or the body's origin.
        orientation: Roll, pitch, yaw, degrees, applied yaw first; positive pitch is upwards. By
            default that of AirSim's camera of this name, or forward.
        captures: How it takes each type of image; 256×144 pixels of 90° for others.
    """

    name: str
    vehicle: str = ""
    position: Vector3 | None = None
    orientation: Vector3 | None = None
    captures: tuple[Capture, ...] = ()


class Camera(msgspec.Struct):
    """One camera as clients know it.

    Attributes:
        body: Number of the body that carries it.
        mount: Where on it.
        specs: How it takes images, by their type; those of other types as type -1.
    """

    body: int
    mount: Mount
    specs: dict[int, CameraSpec]

    def eye(self, image_type: int) -> Eye:
        """Return what an image of a type is drawn from."""
        return Eye(self.body, self.mount, self.specs.get(image_type, self.specs[-1]))


def default_mount(name: str, free: bool) -> tuple[Vector3, Vector3]:
    """Return where AirSim's camera of a name is.

    Args:
        name: Any of its names; of one that AirSim does not have, the body's origin, forward.
        free: Whether it is that of the computer-vision mode.

    Returns:
        Position, metres FRD; roll, pitch, yaw, degrees.
    """
    for names, (x, y, z), orientation in _DEFAULTS:
        if name in names:
            return (0.0, y, 0.0) if free else (x, y, z), orientation
    return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)


class Cameras:
    """All cameras of all vehicles, by their names, and the methods that read and change them.

    Attributes:
        largest: Width and height of a buffer in which each of their images can be drawn, pixels.

    Raises:
        ValueError: A camera of the settings is of no vehicle, or is there twice.
    """

    def __init__(self, server: AirsimServer) -> None:
        self._server = server
        self._named: dict[str, dict[str, Camera]] = {}
        carriers = server.siblings(Simulator)
        known = {each.name for each in carriers}
        for entry in server.config.cameras:
            if entry.vehicle not in {"", *known}:
                raise ValueError(
                    f"cameras: {entry.name}: vehicle: expected {' or '.join(sorted(known))}, "
                    f'or "" for all, found "{entry.vehicle}"'
                )
        for each in carriers:
            free = not each.node.vehicle
            body = server.world.model.body(each.name if free else f"{each.name}/base_link").id
            entries = [e for e in server.config.cameras if e.vehicle in {"", each.name}]
            named = cameras_by_name(each.config.cameras, entries, body, free)
            self._named[each.name] = named
            for names, _, _ in _DEFAULTS:
                if given := {e.name for e in (*entries, *each.config.cameras)} & set(names):
                    server.log.info("%s: %s are one camera, %s", each.name, names, min(given))
        specs = [
            s for named in self._named.values() for c in named.values() for s in c.specs.values()
        ]
        width, height = np.max([(1, 1), *(View(camera_info(s)).largest() for s in specs)], axis=0)
        self.largest = int(width), int(height)

    def find(self, vehicle: ServedVehicle, name: str, external: object = False) -> Camera:
        """Return a vehicle's camera.

        Raises:
            RpcError: It has none of that name.
        """
        if external is True:
            raise RpcError("not supported by visnav-runtime: external cameras")
        named = self._named[vehicle.name]
        if name not in named:
            names = ", ".join(f"'{each}'" for each in sorted(named))
            raise RpcError(f"expected a camera of {vehicle.name} ({names}), found '{name}'")
        return named[name]

    def pose(self, vehicle: ServedVehicle, eye: Eye, qpos: npt.NDArray[np.float64]) -> Pose:
        """Return a camera's pose in the vehicle's local frame, x forward, in a state (nq,)."""
        model = self._server.world.model
        start = int(model.jnt_qposadr[model.body_jntadr[eye.body]])
        x, y, z, *turn = qpos[start : start + 7].tolist()
        body = flip_yz_rotation(normalize((turn[0], turn[1], turn[2], turn[3])))
        offset, orientation = rotate(body, eye.mount[0]), multiply(body, eye.mount[1])
        place = tuple(a + b for a, b in zip(flip_yz((x, y, z)), offset, strict=True))
        return Pose(vehicle.local((place[0], place[1], place[2])), Quaternionr(*orientation))

    @rpc("simGetCameraInfo", cosys=2)
    def info(self, camera: str, vehicle: str, external: bool = False) -> CameraInfo:
        """Return true pose, field of view and projection of a camera's scene images."""
        on = self._server.find_vehicle(vehicle)
        eye = self.find(on, camera, external).eye(0)
        info = camera_info(eye.spec)
        tangent, longer = info.width / (2.0 * info.fx), max(info.width, info.height)
        across, down = (longer / (side * tangent) for side in (info.width, info.height))
        first, second = (0.0, across, 0.0, 0.0), (0.0, 0.0, -down, 0.0)
        projection = ProjectionMatrix((first, second, (0.0, 0.0, 0.0, 10.0), (-1.0, 0.0, 0.0, 0.0)))
        _, qpos = self._server.drawn_state()
        fov = eye.spec.fov if eye.spec.intrinsics is None else math.degrees(2 * math.atan(tangent))
        return CameraInfo(self.pose(on, eye, qpos), fov, projection)

    @rpc("simSetCameraPose", cosys=3)
    def set_pose(self, camera: str, pose: Pose, vehicle: str, external: bool = False) -> None:
        """Set a camera's pose relative to its vehicle; images of the run's own nodes stay."""
        position = msgspec.structs.astuple(pose.position)
        turn = msgspec.structs.astuple(pose.orientation)
        if not (all(abs(each) <= FARTHEST for each in (*position, *turn)) and any(turn)):
            raise RpcError(f"expected a rotation, and numbers up to {FARTHEST:g}, found {pose}")
        found = self.find(self._server.find_vehicle(vehicle), camera, external)
        found.mount = position, normalize(turn)

    @rpc("simSetCameraFov", cosys=3)
    def set_fov(self, camera: str, degrees: float, vehicle: str, external: bool = False) -> None:
        """Set the horizontal field of view of all of a camera's images, 1 to 170 degrees."""
        if not 1.0 <= degrees <= 170.0:
            raise RpcError(f"expected a field of view of 1 to 170 degrees, found {degrees}")
        found = self.find(self._server.find_vehicle(vehicle), camera, external)
        found.specs = {
            kind: msgspec.structs.replace(spec, fov=degrees, intrinsics=None)
            for kind, spec in found.specs.items()
        }

    @rpc("simGetDistortionParams", cosys=2)
    def distortion(
        self, camera: str, vehicle: str, external: bool = False
    ) -> tuple[float, float, float, float, float]:
        """Return five zeros, K1, K2, K3, P1 and P2: the images are those of an ideal pinhole."""
        self.find(self._server.find_vehicle(vehicle), camera, external)
        return 0.0, 0.0, 0.0, 0.0, 0.0

    @rpc("simSetDistortionParam", cosys=4)
    def set_distortion(
        self, camera: str, name: str, value: float, vehicle: str, external: bool = False
    ) -> None:
        """Accept zeros and refuse distortion: the images are those of an ideal pinhole."""
        self.find(self._server.find_vehicle(vehicle), camera, external)
        if value != 0.0:
            raise RpcError(f"not supported by visnav-runtime: distortion ({name} = {value})")


def cameras_by_name(
    files: Iterable[CameraSpec], entries: Sequence[ServedCamera], body: int, free: bool
) -> dict[str, Camera]:
    """Return a vehicle's cameras by all their names.

    A camera that has one of the names of one of AirSim's cameras takes its other names over,
    unless they are given, too.

    Args:
        files: Its own cameras.
        entries: Those of the server's settings, which go before its own of the same name.
        body: Number of the body that carries them.
        free: Whether it is that of the computer-vision mode.

    Raises:
        ValueError: Two entries have one name.
    """
    given = {eye.name: camera_of_file(eye, body) for spec in files for eye in eyes(spec)}
    named = {entry.name: _of_entry(entry, body, free) for entry in entries}
    if len(named) < len(entries):
        found = sorted(entry.name for entry in entries)
        raise ValueError(f"cameras: expected names of their own on a vehicle, found {found}")
    given |= named
    cameras = given.copy()
    for names, _, _ in _DEFAULTS:
        first = next((given[name] for name in names if name in given), None)
        camera = first or _of_entry(ServedCamera(name=names[0]), body, free)
        cameras |= {name: camera for name in names if name not in given}
    return cameras


def camera_of_file(spec: CameraSpec, body: int) -> Camera:
    """Return a camera of a vehicle's own settings, without lens and errors, for all types."""
    plain = CameraSpec(
        name=spec.name,
        width=spec.width,
        height=spec.height,
        fov=spec.fov if spec.lens is None else 90.0,
        intrinsics=spec.intrinsics,
        light=spec.light,
    )
    if spec.lens is not None:
        info = camera_info(spec)
        plain = msgspec.structs.replace(plain, intrinsics=(info.fx, info.fy, info.cx, info.cy))
    return Camera(body, _mount(spec.position, spec.orientation), {-1: plain})


def _of_entry(entry: ServedCamera, body: int, free: bool) -> Camera:
    """Return a camera of the server's settings."""
    position, orientation = default_mount(entry.name, free)
    mount = _mount(entry.position or position, entry.orientation or orientation)
    captures = {-1: Capture()} | {each.image_type: each for each in entry.captures}
    return Camera(
        body,
        mount,
        {
            kind: CameraSpec(name="view", width=each.width, height=each.height, fov=each.fov)
            for kind, each in captures.items()
        },
    )


def _mount(position: Vector3, degrees: Vector3) -> Mount:
    roll, pitch, yaw = (math.radians(angle) for angle in degrees)
    return position, from_rpy(roll, pitch, yaw)
