"""Vehicle of an AirSim server: requests at the start, measurements, and orders.

Events are made of its local NED, into ``map``, or a `ValueError` if no finite number or rotation.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
from msgspec.structs import astuple

import events as ev
from events.frames import (
    OPTICAL_TO_FRD,
    inverse,
    multiply,
    normalize,
    rotate,
    rotate_inverse,
    yaw_of,
)
from runtime import Duration, NodeConfig
from runtime.errors import ConfigError
from visnav_airsim import settings
from visnav_airsim.client.connection import (
    Connection,
    ImageSet,
    RpcCallError,
    Wanted,
    decode,
    requests,
)
from visnav_airsim.wire import CameraInfo, CollisionInfo, ImuData, MultirotorState, Pose, YawMode

Rate = Annotated[float, msgspec.Meta(gt=0, le=1000)]
Kind = Literal["rgb", "depth", "segmentation"]
Call = Callable[..., Awaitable[Any]]

FRAME = "base_link"
_KINDS = {0: "rgb", 1: "depth", 5: "segmentation", 7: "segmentation"}
# Kilograms and newtons of AirSim's default quadrotor, for which no method asks.
_MASS, _THRUST = 1.0, 4 * 4.18
# Velocity towards a set-point of position, for each metre that it is away (1/s), and at most.
_PULL, _FASTEST = 1.0, 5.0
_LONGEST_LANDING = 3600.0  # seconds: at AirSim's 0.2 m/s, a limit of 60 s ends it 12 m below

_PHASES: dict[type[ev.Command], tuple[set[str], str]] = {
    ev.Arm: ({"disarmed"}, "armed"),
    ev.Takeoff: ({"disarmed", "armed"}, "taking off"),
    ev.Hover: ({"taking off", "flying", "landing"}, "flying"),
    ev.Land: ({"taking off", "flying"}, "landing"),
    ev.Disarm: ({"armed", "taking off", "flying", "landing"}, "disarmed"),
}  # in which phases a command is taken, and to which it leads


class RemoteCamera(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A camera of the server's vehicle; its size, field of view and mount come from the server.

    Attributes:
        name: As the server has it: ``0``, ``front_center``.
        images: Kinds asked for; segmentation as "infrared", whose grey level is the object's ID.
    """

    name: Annotated[str, msgspec.Meta(min_length=1)]
    images: tuple[Kind, ...] = ("rgb", "depth")

    def __post_init__(self) -> None:
        if not self.images or len(set(self.images)) != len(self.images):
            raise ValueError(f"images: expected one or more kinds, each once, found {self.images}")


class AirsimClientConfig(NodeConfig):
    """Settings of the client.

    Attributes:
        host: Where the server is.
        port: The server's.
        vehicle: Name that the vehicle has there; empty for the first by name.
        flavour: Kind of server: ``airsim`` (and Colosseum's), ``cosys``, or ``auto``, by its
            version.
        cameras: Cameras asked for images; if empty, those of the server's settings, or ``0``.
        image_rate: Sets of images per second; in real time at most so many.
        imu_rate: Samples of the IMU and of the true state per second; in lockstep also steps.
        control_rate: Rate at which the newest set-point is sent, Hz.
        takeover: Take API control and pass on commands and set-points; else somebody else flies.
        setpoint_timeout: Age beyond which a set-point is ignored, unless it is one of position.
        start_timeout: Real time in which the server has to answer at the start, and after a loss.
        call_timeout: Real time without a reply after which a call's connection is replaced.
        on_loss: What follows when a connection is lost: the run stops, or goes on with a new one.
    """

    host: str = "127.0.0.1"
    port: Annotated[int, msgspec.Meta(ge=1, le=65535)] = 41451
    vehicle: str = ""
    flavour: Literal["auto", "airsim", "cosys"] = "auto"
    cameras: tuple[RemoteCamera, ...] = ()
    image_rate: Rate = 20
    imu_rate: Rate = 100
    control_rate: Rate = 50
    takeover: bool = True
    setpoint_timeout: Duration = Duration(0.5)  # immutable
    start_timeout: Duration = Duration(30.0)
    call_timeout: Duration = Duration(10.0)
    on_loss: Literal["stop", "reconnect"] = "stop"


class Remote(NamedTuple):
    """The server's vehicle, in the form of a simulator's announcements."""

    vehicle: str  # its name on the server
    cosys: bool  # whether the server is Cosys-AirSim's
    origin: ev.Vector3  # of its local frame in ``map``, metres NED
    clock_speed: float  # simulated seconds per real second
    wanted: tuple[Wanted, ...]  # what is asked for at each request for images
    first: ImageSet  # the images of the first one
    announcements: tuple[ev.Announcement, ...]  # the vehicle, its IMU, and then its cameras
    cameras: dict[str, ev.CameraAnnouncement]  # by their names


async def fetch_remote(
    call: Call, config: AirsimClientConfig, name: str, log: Callable[[str], None]
) -> Remote:
    """Fetch from a server everything a node of this name announces.

    Raises:
        RpcCallError: The server refused a call.
        ValueError: There is no such vehicle, or an answer is invalid.
    """
    version = await call("getServerVersion")
    cosys = config.flavour == "cosys" or (config.flavour == "auto" and version >= 2)
    names = sorted(msgspec.convert(await call("listVehicles"), list[str]))
    vehicle = config.vehicle or min(names, default="")
    if vehicle not in names:
        listed = ", ".join(names) or "none"
        raise ValueError(f'vehicle: expected one of the server\'s ({listed}), found "{vehicle}"')
    settings = _read(await call("getSettingsString"), log)
    vehicle_node: dict[str, Any] = next((n for n in settings["nodes"] if n["name"] == vehicle), {})
    captured = {
        camera["name"]: {capture["image_type"]: capture for capture in camera["captures"]}
        for node in settings["nodes"]
        for camera in node.get("cameras", ())
        if camera["vehicle"] == vehicle
    }
    state = msgspec.convert(await call("getMultirotorState", vehicle), MultirotorState)
    kinematics = state.kinematics_estimated
    body = pose_of(Pose(kinematics.position, kinematics.orientation))
    origin = await _origin(call, vehicle_node, vehicle, cosys, body[0])
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
        stamp=0, source=name, rate=config.imu_rate, frame_id=FRAME, **_noise(vehicle_node)
    )
    wished = config.cameras or _cameras(captured)
    wanted = tuple((camera.name, kind) for camera in wished for kind in camera.images)
    responses = await call("simGetImages", *requests(wanted, vehicle, cosys))
    first = decode(responses, wanted, not cosys)
    cameras = {}
    for camera in wished:
        reply = await call("simGetCameraInfo", camera.name, vehicle, *(() if cosys else (False,)))
        info = msgspec.convert(reply, CameraInfo)
        height, width = first.images[camera.name, camera.images[0]].shape[:2]
        # By the settings: AirSim reports another one.
        fov = math.radians(captured.get(camera.name, {}).get(0, {}).get("fov", info.fov))
        (x, y, z), turn = pose_of(info.pose)
        apart = x - body[0][0], y - body[0][1], z - body[0][2]
        cameras[camera.name] = ev.CameraAnnouncement(
            stamp=0,
            source=f"{name}/{camera.name}",
            images=camera.images,
            # AirSim's users have the centre at W/2, from the image's corner. Here whole
            # coordinates are those of pixels' centres: the same point is at (W - 1)/2.
            info=ev.CameraInfo.from_fov(width, height, fov),
            rate=config.image_rate,
            latency=0.0,
            frame_id=f"{name}/{camera.name}_optical",
            parent_frame_id=FRAME,
            position=rotate_inverse(body[1], apart),
            orientation=normalize(multiply(multiply(inverse(body[1]), turn), OPTICAL_TO_FRD)),
        )
    return Remote(
        vehicle,
        cosys,
        origin,
        settings["run"]["speed"],
        wanted,
        first,
        (announced, imu, *cameras.values()),
        cameras,
    )


def _read(text: Any, log: Callable[[str], None]) -> dict[str, Any]:
    """Return the server's settings as a file of ours; nearly empty if unusable."""
    try:
        if text:
            return settings.read(str(text), "the server's settings", lambda _: None)
    except ConfigError as error:
        log(f"cameras, IMU and place are not taken from the server's settings: {error}")
    return {"run": {"speed": 1.0}, "nodes": []}


def _noise(vehicle_node: dict[str, Any]) -> dict[str, Any]:
    imu = vehicle_node.get("imu") or settings.read("{}", "", lambda _: None)["nodes"][0]["imu"]
    sensors = ("gyroscope", "accelerometer")
    names = [
        f"{sensor}_{quantity}"
        for sensor in sensors
        for quantity in ("noise_density", "random_walk")
    ]
    return {name: imu.get(name, 0.0) for name in names}


def _cameras(captured: dict[str, dict[int, Any]]) -> list[RemoteCamera]:
    """Return the cameras of the settings with the kinds they are set to capture, or ``0``."""
    cameras = []
    for name, captures in captured.items():
        kinds: Any = tuple(dict.fromkeys(_KINDS[kind] for kind in captures if kind in _KINDS))
        cameras.append(RemoteCamera(name=name, images=kinds or ("rgb", "depth")))
    return cameras or [RemoteCamera(name="0")]


async def _origin(
    call: Call, vehicle_node: dict[str, Any], vehicle: str, cosys: bool, local: ev.Vector3
) -> ev.Vector3:
    """Return where a vehicle's local frame is: by where its pawn is, or else by the settings."""
    try:
        reply = await call("simGetObjectPose", vehicle, *((True,) if cosys else ()))
        x, y, z = astuple(msgspec.convert(reply, Pose).position)
        if math.isfinite(x + y + z):
            return x - local[0], y - local[1], z - local[2]
    except (RpcCallError, msgspec.ValidationError):
        pass
    return (*vehicle_node.get("position", (0.0, 0.0)), -vehicle_node.get("height", 0.0))


def pose_of(pose: Pose, origin: ev.Vector3 = (0.0, 0.0, 0.0)) -> tuple[ev.Vector3, ev.Quaternion]:
    """Return a pose in the types of events, translated by its frame's `origin`."""
    (x, y, z), turn = astuple(pose.position), astuple(pose.orientation)
    return (x + origin[0], y + origin[1], z + origin[2]), normalize(turn)


def odometry(stamp: int, source: str, reply: MultirotorState, origin: ev.Vector3) -> ev.Odometry:
    """Return the true state of a vehicle."""
    state = reply.kinematics_estimated
    position, orientation = pose_of(Pose(state.position, state.orientation), origin)
    return ev.Odometry(
        stamp=stamp,
        source=source,
        position=position,
        orientation=orientation,
        linear_velocity=rotate_inverse(orientation, astuple(state.linear_velocity)),
        angular_velocity=astuple(state.angular_velocity),
    )


def imu(stamp: int, source: str, sample: ImuData) -> ev.Imu:
    """Return a sample of the IMU."""
    turn, force = astuple(sample.angular_velocity), astuple(sample.linear_acceleration)
    return ev.Imu(stamp=stamp, source=source, angular_velocity=turn, linear_acceleration=force)


def camera_pose(stamp: int, source: str, pose: Pose, origin: ev.Vector3) -> ev.PoseStamped:
    """Return the pose of a camera's optical frame."""
    position, turn = pose_of(pose, origin)
    orientation = normalize(multiply(turn, OPTICAL_TO_FRD))
    return ev.PoseStamped(stamp=stamp, source=source, position=position, orientation=orientation)


def collision(
    stamp: int, source: str, info: CollisionInfo, origin: ev.Vector3, vehicle: ev.Odometry
) -> ev.Collision:
    """Return a collision; its speed is the vehicle's against the normal."""
    normal, place = astuple(info.normal), Pose(info.impact_point)
    velocity = rotate(vehicle.orientation, vehicle.linear_velocity)
    return ev.Collision(
        stamp=stamp,
        source=source,
        other=info.object_name,
        position=pose_of(place, origin)[0],
        normal=normal,
        speed=max(-sum(a * b for a, b in zip(normal, velocity, strict=True)), 0.0),
    )


class Orders:
    """Orders to a vehicle, and their progress.

    Phases and refusals are those of `sims.vehicle.Autopilot`, for the same pilot. A take-off is
    AirSim's, then a climb to the altitude. A set-point holds on the server for three periods.
    """

    def __init__(
        self,
        connection: Connection,
        vehicle: str,  # name of the vehicle on the server
        flying: bool,  # whether it is in the air already
        timeout: int,  # age at which set-points end, ns; those of position hold
        period: float,  # seconds between two calls of `obey`
        refused: Callable[[str], None],  # called with each refusal of the server
    ) -> None:
        self.phase = "flying" if flying else "disarmed"
        self._connection, self._vehicle, self._refused = connection, vehicle, refused
        self._timeout, self._duration = timeout, 3.0 * period
        self._queue: list[ev.Command] = []
        self._setpoint: ev.Setpoint | None = None
        self._task: asyncio.Future[Any] | None = None
        """The take-off or landing whose reply is to come."""

    def accept(self, order: ev.Command | ev.Setpoint) -> str:
        """Store an order for the next `obey`; return the reason for refusal, else empty."""
        if isinstance(order, ev.Setpoint):
            allowed, then = {"armed", "flying"}, "flying"
        else:
            allowed, then = _PHASES.get(type(order), (set[str](), ""))
        if self.phase not in allowed:
            return self.phase
        if isinstance(order, ev.Setpoint):
            self._setpoint = order
        else:
            self._setpoint = None
            if isinstance(order, ev.Takeoff) and self.phase == "disarmed":
                self._queue.append(ev.Arm(stamp=order.stamp, source=order.source))
            self._queue.append(order)
        self.phase = then
        return ""

    def resume(self) -> None:
        """Resume on a new connection, without the reply to a task sent before."""
        self._task = None
        if self.phase == "landing":
            self._queue.append(ev.Land(stamp=0, source=""))

    async def obey(self, now: int, pose: ev.Odometry) -> list[type[ev.VehicleEvent]]:
        """Pass on new orders, and return new events; `OSError` without connection."""
        happened: list[type[ev.VehicleEvent]] = []
        queue, self._queue = self._queue, []
        for order in queue:
            self._task = None
            match order:
                case ev.Arm() | ev.Disarm():
                    happened += await self._arm(isinstance(order, ev.Arm))
                case ev.Takeoff():
                    x, y, z = pose.position
                    self._setpoint = ev.PositionSetpoint(
                        stamp=now,
                        source=order.source,
                        position=(x, y, z - order.altitude),
                        yaw=yaw_of(pose.orientation),
                    )
                    self._task = self._send("takeoff", 20.0)
                case ev.Land():
                    self._task = self._send("land", _LONGEST_LANDING)
                case _:
                    self._send("hover")
        if self._task is not None:
            await self._connection.settle()  # if it ended before now, its reply is here then
            if self._task.done():
                happened += await self._ended(self._task)
        elif self.phase == "taking off" and _has_arrived(self._setpoint, pose):
            self.phase = "flying"
            happened.append(ev.TakenOff)
        if self._setpoint is not None and self._task is None:
            lasting = isinstance(self._setpoint, ev.PositionSetpoint)
            if lasting or now - self._setpoint.stamp <= self._timeout:
                self._send(*move(self._setpoint, pose, self._duration))
                await self._connection.settle()  # before time goes on, it is with the server
        elif queue:
            await self._connection.settle()
        return happened

    async def _ended(self, task: asyncio.Future[Any]) -> list[type[ev.VehicleEvent]]:
        """Handle the end of a task: stop the motors after a landing."""
        self._task = None
        if self.phase != "landing":
            return []
        if task.exception() is not None:
            self.phase = "flying"
        elif task.result() is True:
            self.phase = "disarmed"
            return [ev.Landed, *await self._arm(False)]
        else:  # another client's command came between
            self._task = self._send("land", _LONGEST_LANDING)
        return []

    async def _arm(self, arm: bool) -> list[type[ev.VehicleEvent]]:
        try:
            if await self._connection.call("armDisarm", arm, self._vehicle) is not True:
                self._refused(f"armDisarm: {arm}")
        except RpcCallError as error:
            self._refused(f"armDisarm: {error}")
        return [ev.Armed if arm else ev.Disarmed]

    def _send(self, method: str, *arguments: Any) -> asyncio.Future[Any]:
        """Send a task; its reply comes at its end, and an error goes to `refused`."""
        task = self._connection.send(method, *arguments, self._vehicle)

        def report_error(done: asyncio.Future[Any]) -> None:
            if isinstance(error := done.exception(), RpcCallError):
                self._refused(f"{method}: {error}")

        task.add_done_callback(report_error)
        return task


def move(setpoint: ev.Setpoint, pose: ev.Odometry, duration: float) -> tuple[Any, ...]:
    """Return method and arguments, without the vehicle's name, to follow a set-point (s)."""
    match setpoint:
        case ev.PositionSetpoint():
            difference = [a - b for a, b in zip(setpoint.position, pose.position, strict=True)]
            pull = _PULL * min(1.0, _FASTEST / max(_PULL * math.hypot(*difference), 1e-9))
            velocity = [f + pull * d for f, d in zip(setpoint.velocity, difference, strict=True)]
            mode = YawMode(False, math.degrees(setpoint.yaw))
            return ("moveByVelocity", *velocity, duration, 0, mode)
        case ev.VelocitySetpoint():
            method = "moveByVelocity" + ("BodyFrame" if setpoint.frame_id == "heading" else "")
            mode = YawMode(True, math.degrees(setpoint.yaw_rate))
            return (method, *setpoint.velocity, duration, 0, mode)
        case ev.AttitudeSetpoint():
            w, x, y, z = setpoint.orientation
            roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
            pitch = math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x))))
            angles = roll, pitch, yaw_of(setpoint.orientation)
            return ("moveByRollPitchYawThrottle", *angles, setpoint.thrust, duration)
        case ev.BodyRateSetpoint():
            rates = setpoint.angular_velocity
            return ("moveByAngleRatesThrottle", *rates, setpoint.thrust, duration)
    raise ValueError(f"{type(setpoint).__name__} is no set-point of a multirotor")


def _has_arrived(setpoint: ev.Setpoint | None, pose: ev.Odometry) -> bool:
    assert isinstance(setpoint, ev.PositionSetpoint)
    velocity = rotate(pose.orientation, pose.linear_velocity)
    return abs(setpoint.position[2] - pose.position[2]) < 0.1 and math.hypot(*velocity) < 0.2
