"""A simulated multirotor as a node: what it listens to, what it says, and when.

Physics, control and cameras are pure modules beside this one and in `sims.cameras`.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable
from typing import Annotated, Any, Literal

import msgspec

from events import (
    Announcement,
    Collision,
    Command,
    DepthImage,
    Image,
    Imu,
    ImuAnnouncement,
    Odometry,
    PathAnnouncement,
    PoseStamped,
    SegmentationImage,
    Setpoint,
    TransformStamped,
    VehicleAnnouncement,
    VehicleEvent,
)
from runtime import Duration, Node, NodeConfig, Output, Tick, every, on
from runtime.paths import NameOrPath
from sims.cameras import CameraSpec, add_camera, check_cameras
from sims.cameras.rig import CameraOutputs, CameraRig
from sims.frames import rotate_inverse
from sims.vehicle import (
    STANDING_HEIGHT,
    Autopilot,
    Gains,
    ImuNoise,
    ImuParameters,
    Limits,
    Phase,
    Physics,
    State,
    attach_vehicle,
)
from sims.vehicle.clearance import FALL, Clearance, trouble_at_start, trouble_on_path
from sims.vehicle.physics import Contact
from sims.worlds import load_world

Rate = Annotated[float, msgspec.Meta(gt=0, le=1000)]
Count = Annotated[int, msgspec.Meta(ge=1, le=16)]

FRAME = "base_link"


class MultirotorConfig(NodeConfig):
    """Settings of a multirotor.

    Attributes:
        world: Name of a built-in world, or path of an MJCF file.
        position: Where it stands at the start, x north and y east in metres.
        height: Height of the ground there, metres above the world's zero.
        yaw: Where it looks at the start, degrees clockwise from north.
        control_rate: Hertz of the controller.
        imu_rate: Hertz of the IMU, and of the ground truth, which is also told at each exposure.
        imu: Noise of the IMU.
        cameras: What it carries.
        trigger: ``free``: each camera exposes at its own rate, at equal intervals. ``imu``: the
            next IMU sample after that triggers the exposure, so that image, depth, pose and IMU
            share their stamps; the intervals are equal only if the camera's rate divides the
            IMU's.
        camera_processes: How many processes render.
        render_threads: Threads of the software renderer in each of them.
        setpoint_timeout: After this long a velocity, attitude or rate set-point is void.
        gains: Of the controller.
        limits: Of the controller.
    """

    world: NameOrPath = "hall"
    position: tuple[float, float] = (0.0, 0.0)
    height: float = 0.0
    yaw: float = 0.0
    control_rate: Rate = 400
    imu_rate: Rate = 200
    imu: ImuParameters = ImuParameters()
    cameras: tuple[CameraSpec, ...] = ()
    trigger: Literal["free", "imu"] = "free"
    camera_processes: Count = 2
    render_threads: Count = 1
    setpoint_timeout: Duration = Duration(0.5)  # immutable
    gains: Gains = Gains()
    limits: Limits = Limits()

    def __post_init__(self) -> None:
        check_cameras(self.cameras)
        for camera in self.cameras:
            if self.trigger == "imu" and camera.rate > self.imu_rate:
                raise ValueError(
                    f"cameras: {camera.name}: rate: expected at most the {self.imu_rate:g} Hz of "
                    f'the IMU that triggers it (or trigger = "free"), found {camera.rate:g} Hz'
                )


class Multirotor(Node[MultirotorConfig]):
    """A quadrotor with cameras, an IMU and ground truth, in a MuJoCo world."""

    images = Output(Image)
    depth = Output(DepthImage)
    segmentation = Output(SegmentationImage)
    camera_poses = Output(PoseStamped)
    transforms = Output(TransformStamped)
    imu = Output(Imu)
    odometry = Output(Odometry)
    happenings = Output(VehicleEvent)

    async def on_startup(self) -> None:
        """Build the world, and start what renders it."""
        config = self.config
        self._rig = CameraRig(
            self,
            config.cameras,
            CameraOutputs(self.images, self.depth, self.segmentation, self.camera_poses),
            config.camera_processes,
            config.render_threads,
        )
        north, east = config.position
        self._start = (north, east, -config.height - STANDING_HEIGHT)
        model = await self.offload(self._build)
        self._physics = Physics(model, self.name)
        self._clearance = Clearance(model, self.name)
        await self.offload(self._physics.settle)
        self._autopilot = Autopilot(
            self._physics.parameters,
            config.gains,
            config.limits,
            setpoint_timeout=config.setpoint_timeout,
        )
        self._noise = ImuNoise(config.imu, config.imu_rate, self.rng)
        self._touched: frozenset[str] = frozenset()
        self._refused = ""
        self._told = -1
        self._triggered: list[str] = []
        await self._rig.start(model)
        free = config.trigger == "free"
        if free:  # a picture that comes at once comes after the IMU sample of its stamp
            self.every(config.imu_rate, self.sense, "sense")
        for camera in config.cameras:
            call = self._expose if free else self._trigger
            self.every(camera.rate, functools.partial(call, camera.name), camera.name)
        if not free:
            self.every(config.imu_rate, self.sense, "sense")

    def _build(self) -> Any:
        config = self.config
        world = load_world(config.world, bare=self.checking)
        attach_vehicle(world, self.name, self._start, math.radians(config.yaw))
        for camera in config.cameras:
            add_camera(world, f"{self.name}/{FRAME}", camera, f"{self.name}/")
        return world.compile()

    def announce(self) -> Iterable[Announcement]:
        """Say what vehicle this is and what it senses."""
        parameters, state = self._physics.parameters, self._physics.state()
        yield VehicleAnnouncement(
            stamp=0,
            source=self.name,
            mass=parameters.mass,
            max_thrust=parameters.max_thrust,
            control_rate=self.config.control_rate,
            position=state.position,
            orientation=state.orientation,
        )
        yield ImuAnnouncement(
            stamp=0,
            source=f"{self.name}/imu",
            rate=self.config.imu_rate,
            frame_id=FRAME,
            **msgspec.structs.asdict(self.config.imu),
        )
        yield from self._rig.announcements(FRAME)
        if self.config.trigger == "imu":
            for camera in self.config.cameras:
                periods = self.config.imu_rate / camera.rate
                if not math.isclose(periods, round(periods)):
                    self.log.warning(
                        "%s: %g Hz does not divide the %g Hz of the IMU that triggers it: its "
                        'exposures come at unequal intervals (trigger = "free": at equal ones)',
                        camera.name,
                        camera.rate,
                        self.config.imu_rate,
                    )

    def on_announcement(self, announcement: Announcement) -> None:
        """Refuse a path that cannot be flown, and to share a pilot with another vehicle."""
        if isinstance(announcement, PathAnnouncement):
            self._refuse_path(announcement)
        if not isinstance(announcement, VehicleAnnouncement) or announcement.source == self.name:
            return
        if obeying_all := [port for port in ("command", "setpoint") if port not in self.sources]:
            line = ", ".join(f'{port} = "PILOT"' for port in obeying_all)
            raise ValueError(
                "of several vehicles, each was expected to say which node it obeys, but "
                f"{self.name} obeys them all: write inputs = {{ {line} }} into its entry, "
                "with the name of that node in place of PILOT"
            )

    def _refuse_path(self, announcement: PathAnnouncement) -> None:
        """Raise `ValueError` if this vehicle is to fly a path and cannot."""
        pilot = self.sources.get("setpoint", announcement.source)
        if announcement.source != pilot and not announcement.source.startswith(f"{pilot}/"):
            return
        if trouble_at_start(self._clearance, self._start):  # which `check` tells
            return
        if trouble := trouble_on_path(self._clearance, self._start, announcement.waypoints):
            raise ValueError(trouble)

    def check(self) -> Iterable[str]:
        """Say why it cannot stand where it is to start."""
        if trouble := trouble_at_start(self._clearance, self._start):
            yield f"position: {trouble}"
        elif (fall := self._clearance.ground_below(self._start) or 0.0) > FALL:
            self.log.warning("position, height: it starts %.2g m above the ground, and falls", fall)

    def on_change(self, before: MultirotorConfig) -> None:  # noqa: ARG002
        """Deliver pictures as the settings now say."""
        self._rig.change(self.config.cameras)

    async def run(self) -> None:
        """Say once where the cameras sit."""
        for mounting in self._rig.transforms(FRAME):
            self.transforms.send(mounting)

    @on(Command)
    def command(self, event: Command) -> None:
        """Obey, or say why not."""
        if reason := self._autopilot.command(event):
            self.log.warning("%s refused: %s", type(event).__name__, reason)

    @on(Setpoint)
    def setpoint(self, event: Setpoint) -> None:
        """Follow it; say why not at the first of a row of refused ones."""
        reason = self._autopilot.command(event) or ""
        if reason and reason != self._refused:
            self.log.warning("%s refused: %s", type(event).__name__, reason)
        self._refused = reason

    @every(hz="control_rate")
    def control(self, tick: Tick) -> None:
        """Step the physics up to now, and set the motors."""
        physics, autopilot = self._physics, self._autopilot
        physics.advance_to(tick.stamp)
        touching = physics.touching()
        physics.set_motors(*autopilot.update(tick.stamp, physics.state(), touching))
        for happening in autopilot.take_happenings():
            self.happenings.send(happening(stamp=physics.time_ns, source=self.name))
        if touching and autopilot.phase is not Phase.DISARMED:
            self._look_at_contacts()
        elif not touching:
            self._touched = frozenset()

    def sense(self, tick: Tick) -> None:
        """Measure, tell the truth, and expose the cameras that this triggers."""
        stamp = self._advance(tick)
        # Between two steps the acceleration is constant.
        _, force = self._physics.imu()
        state, qpos, qvel = self._physics.state_at(stamp)
        rates, force = self._noise.add(state.angular_velocity, force)
        self.imu.send(
            Imu(
                stamp=stamp,
                source=f"{self.name}/imu",
                angular_velocity=rates,
                linear_acceleration=force,
            )
        )
        self._tell(stamp, state)
        for camera in self._triggered:
            self._rig.expose(camera, stamp, qpos, qvel)
        self._triggered.clear()

    def _trigger(self, camera: str, _: Tick) -> None:
        self._triggered.append(camera)

    def _expose(self, camera: str, tick: Tick) -> None:
        stamp = self._advance(tick)
        state, qpos, qvel = self._physics.state_at(stamp)
        self._tell(stamp, state)
        self._rig.expose(camera, stamp, qpos, qvel)

    def _advance(self, tick: Tick) -> int:
        """Step the physics up to a tick, and return the stamp of what is then true.

        That is the tick's; in real time, where a later one may have been served before, maybe the
        physics'.
        """
        self._physics.advance_to(tick.stamp)
        return max(tick.stamp, self._physics.time_ns)

    def _tell(self, stamp: int, state: State) -> None:
        """Tell the truth about a time, once."""
        if stamp <= self._told:
            return
        self._told = stamp
        self.odometry.send(
            Odometry(
                stamp=stamp,
                source=self.name,
                position=state.position,
                orientation=state.orientation,
                linear_velocity=rotate_inverse(state.orientation, state.velocity),
                angular_velocity=state.angular_velocity,
            )
        )

    async def on_shutdown(self) -> None:
        """Say which pictures are missing."""
        self._rig.say_what_is_missing()

    def _look_at_contacts(self) -> None:
        contacts = [c for c in self._physics.contacts() if not _stands_on(c)]
        touched = frozenset(c.other for c in contacts)
        for contact in contacts:
            if contact.other not in self._touched:
                self._touched |= {contact.other}
                self.happenings.send(
                    Collision(
                        stamp=self._physics.time_ns,
                        source=self.name,
                        other=contact.other,
                        position=contact.position,
                        normal=contact.normal,
                        speed=contact.speed,
                    )
                )
        self._touched = touched


def _stands_on(contact: Contact) -> bool:
    """Tell whether a contact is but the feet on the ground: pushed up, and gently."""
    return contact.normal[2] < -0.7 and contact.speed < 1.0
