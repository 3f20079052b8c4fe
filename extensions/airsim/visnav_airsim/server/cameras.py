"""Cameras by their names for clients, and the images taken for clients.

A change is the server's only: the cameras of the run's file, their images and announcements stay
as they are. All images of one call show one state, at one time, from its true poses.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable, Iterable, Sequence
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec.structs import astuple

from events import CameraAnnouncement
from events.base import Vector3
from events.frames import (
    OPTICAL_TO_FRD,
    flip_yz,
    flip_yz_rotation,
    from_rpy,
    inverse,
    multiply,
    normalize,
    rotate,
)
from runtime import Worker
from runtime.host import Sibling
from runtime.logs import NodeLogger
from runtime.node import Node
from sims.cameras import GraphicsError
from sims.cameras.optics import Intrinsics
from sims.cameras.spec import CameraSpec, Pixels, camera_info, eyes
from sims.cameras.stage import RendererName
from sims.world import SharedWorld
from visnav_airsim import wire
from visnav_airsim.server.methods import Caller, Flavour, RpcError, rpc
from visnav_airsim.server.rendering import Eye, Form, ImageType, Mount, Renderer, Wanted
from visnav_airsim.server.vehicles import ServedVehicle
from visnav_airsim.settings import DEFAULT_CAMERAS, default_mount
from visnav_airsim.wire import Pose

DrawnState = Callable[[], tuple[int, npt.NDArray[np.float64]]]
"""Function for the world's state to draw now: see `Vehicles.drawn_state`."""

FieldOfView = Annotated[float, msgspec.Meta(ge=1.0, le=170.0)]
FARTHEST = 1e6  # metres from its vehicle up to which a client may put a camera
MOST = 64  # images of one call, and calls that wait for their images at a time
ABANDONED = 8  # calls of clients that have left with more of which the renderer is full
TIMEOUT = 600.0  # real seconds after which the renderer hangs; the longest call takes some 30
LONGEST = 100_000_000  # bytes of all images of one call: Cosys-AirSim's client takes no more


class Capture(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a camera's images of a type.

    Attributes:
        image_type: AirSim's number of the type; see `visnav_airsim.server.rendering`.
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
    """Camera for clients' image requests, rendered only on request.

    Attributes:
        name: Its name, unique on its vehicle.
        vehicle: The vehicle that carries it; empty for every vehicle.
        position: Position on the body, metres FRD; by default that of AirSim's camera of this name,
            or 0.
        orientation: Roll, pitch, yaw, degrees, applied yaw first; positive pitch is upwards. By
            default that of AirSim's camera of this name, or forward.
        captures: Settings of each type of image; 256×144 pixels of 90° for others.
    """

    name: str
    vehicle: str = ""
    position: Vector3 | None = None
    orientation: Vector3 | None = None
    captures: tuple[Capture, ...] = ()


class Camera(msgspec.Struct):
    """Camera of clients: its true calibration, and the announced one."""

    body: int  # number of the body that carries it
    mount: Mount  # where on it
    # How it takes images, by their type; those of other types as type -1.
    specs: dict[int, CameraSpec]
    errs: bool = False  # whether its announced calibration has errors
    announced_mount: Mount | None = None  # in place of `mount`
    announced_intrinsics: Intrinsics | None = None  # in place of those of `specs`

    def eye(self, image_type: int) -> Eye:
        """Return the eye for images of a type."""
        return Eye(self.body, self.mount, self.specs.get(image_type, self.specs[-1]))

    def announced_eye(self, image_type: int) -> Eye:
        """Return the eye for images of a type with the announced calibration."""
        body, mount, spec = self.eye(image_type)
        if self.announced_intrinsics is not None:
            spec = msgspec.structs.replace(spec, intrinsics=self.announced_intrinsics)
        return Eye(body, self.announced_mount or mount, spec)


class Cameras:
    """All vehicles' cameras by name, and the methods to read and change them.

    Raises:
        ValueError: A camera of the settings has no such vehicle, or is there twice.
    """

    def __init__(
        self,
        carriers: Sequence[Sibling],
        entries: Sequence[ServedCamera],
        model: Any,
        drawn_state: DrawnState,
        log: NodeLogger,
    ) -> None:
        self._model, self._drawn_state = model, drawn_state
        self._named: dict[str, dict[str, Camera]] = {}
        vehicles = {carrier.name for carrier in carriers}
        for entry in entries:
            if entry.vehicle not in {"", *vehicles}:
                raise ValueError(
                    f"cameras: {entry.name}: vehicle: expected {' or '.join(sorted(vehicles))}, "
                    f'or "" for all, found "{entry.vehicle}"'
                )
        for carrier in carriers:
            free = not carrier.node.vehicle
            body = model.body(carrier.name if free else f"{carrier.name}/base_link").id
            carrier_entries = [entry for entry in entries if entry.vehicle in {"", carrier.name}]
            named = cameras_by_name(carrier.config.cameras, carrier_entries, body, free)
            self._named[carrier.name] = named
            for names, _, _ in DEFAULT_CAMERAS:
                if shared_names := {
                    e.name for e in (*carrier_entries, *carrier.config.cameras)
                } & set(names):
                    log.info("%s: %s are one camera, %s", carrier.name, names, min(shared_names))
        cameras = (camera for named in self._named.values() for camera in named.values())
        specs = [spec for camera in cameras for spec in camera.specs.values()]
        self.largest = tuple(camera_info(spec) for spec in specs)

    def find(self, vehicle: ServedVehicle, name: str, external: object = False) -> Camera:
        """Return a vehicle's camera by name, or raise `RpcError`."""
        if external is True:
            raise RpcError("not supported by visnav-runtime: external cameras")
        named = self._named[vehicle.name]
        if name not in named:
            names = ", ".join(f"'{other}'" for other in sorted(named))
            raise RpcError(f"expected a camera of {vehicle.name} ({names}), found '{name}'")
        return named[name]

    def announced(self, announcement: CameraAnnouncement) -> None:
        """Store the announced calibration of a camera, if it has errors."""
        vehicle, _, name = announcement.source.partition("/")
        camera = self._named.get(vehicle, {}).get(name)
        if camera is not None and camera.errs:
            turn = multiply(announcement.orientation, inverse(OPTICAL_TO_FRD))
            camera.announced_mount = announcement.position, turn
            camera.announced_intrinsics = (
                announcement.info.fx,
                announcement.info.fy,
                announcement.info.cx,
                announcement.info.cy,
            )

    def pose(self, vehicle: ServedVehicle, eye: Eye, qpos: npt.NDArray[np.float64]) -> Pose:
        """Return a camera's pose in the vehicle's local frame, x forward, in a state (nq,)."""
        model = self._model
        start = int(model.jnt_qposadr[model.body_jntadr[eye.body]])
        x, y, z, *turn = qpos[start : start + 7].tolist()
        body = flip_yz_rotation(normalize((turn[0], turn[1], turn[2], turn[3])))
        offset, orientation = rotate(body, eye.mount[0]), multiply(body, eye.mount[1])
        place = tuple(a + b for a, b in zip(flip_yz((x, y, z)), offset, strict=True))
        return Pose(vehicle.local((place[0], place[1], place[2])), wire.Quaternionr(*orientation))

    @rpc("simGetCameraInfo", cosys=2)
    def info(self, camera: str, vehicle: ServedVehicle, external: bool = False) -> wire.CameraInfo:
        """Return pose, field of view and projection of a camera's scene images, as announced."""
        eye = self.find(vehicle, camera, external).announced_eye(0)
        info = camera_info(eye.spec)
        tangent, longer = info.width / (2.0 * info.fx), max(info.width, info.height)
        across, down = (longer / (side * tangent) for side in (info.width, info.height))
        first, second = (0.0, across, 0.0, 0.0), (0.0, 0.0, -down, 0.0)
        projection = wire.ProjectionMatrix(
            (first, second, (0.0, 0.0, 0.0, 10.0), (-1.0, 0.0, 0.0, 0.0))
        )
        _, qpos = self._drawn_state()
        fov = eye.spec.fov if eye.spec.intrinsics is None else math.degrees(2 * math.atan(tangent))
        return wire.CameraInfo(self.pose(vehicle, eye, qpos), fov, projection)

    @rpc("simSetCameraPose", cosys=3)
    def set_pose(
        self, camera: str, pose: Pose, vehicle: ServedVehicle, external: bool = False
    ) -> None:
        """Set a camera's pose relative to its vehicle; images of the run's own nodes stay."""
        position = astuple(pose.position)
        turn = astuple(pose.orientation)
        if not (all(abs(number) <= FARTHEST for number in (*position, *turn)) and any(turn)):
            raise RpcError(f"expected a rotation, and numbers up to {FARTHEST:g}, found {pose}")
        target = self.find(vehicle, camera, external)
        target.mount, target.announced_mount = (position, normalize(turn)), None

    @rpc("simSetCameraFov", cosys=3)
    def set_fov(
        self, camera: str, degrees: float, vehicle: ServedVehicle, external: bool = False
    ) -> None:
        """Set the horizontal field of view of all of a camera's images, 1 to 170 degrees."""
        if not 1.0 <= degrees <= 170.0:
            raise RpcError(f"expected a field of view of 1 to 170 degrees, found {degrees}")
        target = self.find(vehicle, camera, external)
        target.announced_intrinsics = None
        target.specs = {
            kind: msgspec.structs.replace(spec, fov=degrees, intrinsics=None)
            for kind, spec in target.specs.items()
        }

    @rpc("simGetCurrentFieldOfView", cosys=2)
    def field_of_view(self, camera: str, vehicle: ServedVehicle, external: bool = False) -> str:
        """Return the fields of view of a camera's scene images in words, degrees, as announced."""
        info = camera_info(self.find(vehicle, camera, external).announced_eye(0).spec)
        across, down = (
            math.degrees(2.0 * math.atan(pixels / (2.0 * focal_length)))
            for pixels, focal_length in ((info.width, info.fx), (info.height, info.fy))
        )
        return (  # AirSim's words, from which scripts take the numbers
            f"Current Field Of View:\n\tHorizontal Field Of View: {across:g};"
            f"\n\t Vertical Field Of View: {down:g}"
        )

    @rpc("simGetDistortionParams", cosys=2)
    def distortion(
        self, camera: str, vehicle: ServedVehicle, external: bool = False
    ) -> tuple[float, float, float, float, float]:
        """Return five zeros, K1, K2, K3, P1 and P2: the images are those of an ideal pinhole."""
        self.find(vehicle, camera, external)
        return 0.0, 0.0, 0.0, 0.0, 0.0

    @rpc("simSetDistortionParam", cosys=4)
    def set_distortion(
        self, camera: str, name: str, value: float, vehicle: ServedVehicle, external: bool = False
    ) -> None:
        """Accept zeros and refuse distortion: the images are those of an ideal pinhole."""
        self.find(vehicle, camera, external)
        if value != 0.0:
            raise RpcError(f"not supported by visnav-runtime: distortion ({name} = {value})")


def cameras_by_name(
    files: Iterable[CameraSpec], entries: Sequence[ServedCamera], body: int, free: bool
) -> dict[str, Camera]:
    """Return a vehicle's cameras by all their names; `entries` are the server's, and go first.

    A camera named as one of AirSim's cameras takes its other names over, unless they are given.

    Raises:
        ValueError: Two entries have one name.
    """
    listed = {eye.name: camera_of_file(eye, body) for spec in files for eye in eyes(spec)}
    named = {entry.name: _entry_camera(entry, body, free) for entry in entries}
    if len(named) < len(entries):
        repeated = sorted(entry.name for entry in entries)
        raise ValueError(f"cameras: expected names of their own on a vehicle, found {repeated}")
    listed |= named
    cameras = listed.copy()
    for names, _, _ in DEFAULT_CAMERAS:
        first = next((listed[name] for name in names if name in listed), None)
        camera = first or _entry_camera(ServedCamera(name=names[0]), body, free)
        cameras |= {name: camera for name in names if name not in listed}
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
    return Camera(
        body, _mount(spec.position, spec.orientation), {-1: plain}, spec.wrong is not None
    )


def _entry_camera(entry: ServedCamera, body: int, free: bool) -> Camera:
    position, orientation = default_mount(entry.name, free)
    mount = _mount(entry.position or position, entry.orientation or orientation)
    captures = {-1: Capture()} | {c.image_type: c for c in entry.captures}
    return Camera(
        body,
        mount,
        {
            kind: CameraSpec(name="view", width=c.width, height=c.height, fov=c.fov)
            for kind, c in captures.items()
        },
    )


def _mount(position: Vector3, degrees: Vector3) -> Mount:
    roll, pitch, yaw = (math.radians(angle) for angle in degrees)
    return position, from_rpy(roll, pitch, yaw)


class _Exposure(NamedTuple):
    stamp: int
    qpos: npt.NDArray[np.float64]
    ids: npt.NDArray[np.uint8]
    wanted: list[Wanted]
    responses: list[wire.ImageResponse]  # without images


class Images:
    """Images on clients' requests, with a segmentation ID for each geom, and last for nothing."""

    def __init__(
        self,
        node: Node[Any],
        world: SharedWorld,
        cameras: Cameras,
        drawn_state: DrawnState,
        segmentation_ids: Callable[[], npt.NDArray[np.uint8]],
        processes: int,
        threads: int,
        renderer: RendererName,
    ) -> None:
        self._node, self._world, self._cameras = node, world, cameras
        self._drawn_state, self._segmentation_ids = drawn_state, segmentation_ids
        self._processes, self._threads = processes, threads
        self._draws: RendererName = renderer
        self._renderer: Worker[Renderer] | None = None
        self._starting = asyncio.Lock()
        self._idle = asyncio.Semaphore(processes)
        self._waiting = 0
        self._warned = False

    async def start(self) -> None:
        """Start the renderer, unless already started."""
        async with self._starting:
            if self._renderer is None:
                self._renderer = await self._node.worker(
                    Renderer,
                    await self._node.offload(lambda: self._world.packed(self._draws)),
                    f"{self._node.name}/camera",
                    self._cameras.largest,
                    self._threads,
                    self._world.dynamics,
                    self._draws,
                    processes=self._processes,
                    timeout=TIMEOUT,
                )

    @rpc("simGetImages", cosys=2)
    def get_images(
        self,
        caller: Caller,
        requests: list[wire.ImageRequest],
        vehicle: ServedVehicle,
        external: bool = False,
    ) -> Awaitable[msgspec.Raw]:
        """Return images of a single instant: a common stamp, and the cameras' poses then."""
        return self.capture(requests, vehicle, caller.flavour, external=external)

    @rpc("simGetImage")
    def get_image(
        self,
        caller: Caller,
        camera: str,
        image_type: int,
        vehicle: ServedVehicle,
        external: bool | str = "",
    ) -> Awaitable[bytes]:
        """Return an image as PNG; empty if images of this type are not drawn."""
        caller.flavour = "airsim" if isinstance(external, bool) else "cosys"
        self._cameras.find(vehicle, camera, external)
        requests = [wire.ImageRequest(camera, image_type)]
        if image_type not in ImageType.__members__.values():
            if not self._warned:
                self._node.log.warning("simGetImage: %s", _not_drawn(image_type))
            self._warned, requests = True, []
        exposure = self._expose(requests, vehicle, caller.flavour)

        async def png() -> bytes:
            images = msgspec.msgpack.decode(
                await self._develop(exposure), type=list[wire.ImageResponse]
            )
            return b"".join([image.image_data_uint8 for image in images])

        return png()

    def capture(
        self,
        requests: Sequence[wire.ImageRequest],
        vehicle: ServedVehicle,
        flavour: Flavour = "airsim",  # whose structures, and order of colours, are wanted
        *,
        external: bool = False,  # whether cameras that no vehicle carries are meant: there are none
    ) -> Awaitable[msgspec.Raw]:
        """Capture images of the state at the call, or raise `RpcError`; time continues.

        Returns:
            Awaitable of the structures, encoded.
        """
        return self._develop(self._expose(requests, vehicle, flavour, external))

    def _expose(
        self,
        requests: Sequence[wire.ImageRequest],
        vehicle: ServedVehicle,
        flavour: Flavour,
        external: bool = False,
    ) -> _Exposure:
        if len(requests) > MOST:
            raise RpcError(f"expected at most {MOST} images of one call, found {len(requests)}")
        stamp, qpos = self._drawn_state()
        exposure = _Exposure(stamp, qpos, self._segmentation_ids(), [], [])
        poses: dict[str, Pose] = {}
        length = 0
        for request in requests:
            camera = self._cameras.find(vehicle, request.camera_name, external)
            if request.image_type not in ImageType.__members__.values():
                raise RpcError(_not_drawn(request.image_type))
            eye = camera.eye(request.image_type)
            form: Form = "png" if request.compress else "rgb" if flavour == "cosys" else "bgr"
            form = "float" if request.pixels_as_float else form
            exposure.wanted.append(Wanted(eye, ImageType(request.image_type), form))
            if request.camera_name not in poses:
                poses[request.camera_name] = self._cameras.pose(
                    vehicle, camera.announced_eye(request.image_type), qpos
                )
            pose = poses[request.camera_name]
            width, height = eye.spec.width, eye.spec.height
            length += width * height * (5 if form == "float" else 3)
            fields: dict[str, Any] = {
                "camera_name": request.camera_name,
                "image_type": request.image_type,
                "pixels_as_float": request.pixels_as_float,
                "compress": request.compress,
                "camera_position": pose.position,
                "camera_orientation": pose.orientation,
                "time_stamp": stamp,
                "width": width,
                "height": height,
            }
            exposure.responses.append(
                wire.ImageResponse(**fields)
                if flavour == "airsim"
                else wire.CosysImageResponse(**fields, annotation_name=request.annotation_name)
            )
        if length > LONGEST:
            raise RpcError(f"expected images of at most {LONGEST} bytes, found {length}")
        return exposure

    async def _develop(self, exposure: _Exposure) -> msgspec.Raw:
        abandoned = 0 if self._renderer is None else self._renderer.outstanding()
        if self._waiting >= MOST or abandoned > ABANDONED + self._processes:
            raise RpcError(f"expected at most {MOST} calls that wait for images")
        self._waiting += 1
        try:
            await self.start()
            assert self._renderer is not None
            async with self._idle:
                encoded = msgspec.msgpack.encode(exposure.responses)
                images = await self._renderer.call_untimed(Renderer.answer, *exposure[:4], encoded)
        except GraphicsError as error:
            raise RpcError(str(error)) from None
        finally:
            self._waiting -= 1
        return msgspec.Raw(images.data)


def _not_drawn(image_type: int) -> str:
    return (
        f"not supported by visnav-runtime: images of type {image_type}: expected one of "
        + ", ".join(f"{type_.value} ({type_.name.lower()})" for type_ in ImageType)
    )
