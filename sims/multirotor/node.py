"""A simulated multirotor as a node: what it listens to, what it says, and when.

Physics, control and cameras are pure modules beside this one and in `sims.cameras`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Annotated, Any

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
    PoseStamped,
    SegmentationImage,
    Setpoint,
    TransformStamped,
    VehicleAnnouncement,
    VehicleEvent,
)
from runtime import Duration, Node, NodeConfig, Output, Tick, every, on
from sims.cameras import CameraSpec, add_camera
from sims.cameras.rig import CameraOutputs, CameraRig
from sims.frames import rotate_inverse
from sims.multirotor import (
    STANDING_HEIGHT,
    Autopilot,
    Gains,
    ImuNoise,
    ImuParameters,
    Limits,
    Phase,
    Physics,
    attach_vehicle,
)
from sims.multirotor.physics import Contact
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
        imu_rate: Hertz of IMU and ground truth. Exposures fall on IMU samples, as with cameras
            that an IMU triggers, so that image, depth, pose and IMU share their stamps.
        imu: Noise of the IMU.
        cameras: What it carries.
        camera_processes: How many processes render.
        render_threads: Threads of the software renderer in each of them.
        setpoint_timeout: After this long a velocity, attitude or rate set-point is void.
        gains: Of the controller.
        limits: Of the controller.
    """

    world: str = "hall"
    position: tuple[float, float] = (0.0, 0.0)
    height: float = 0.0
    yaw: float = 0.0
    control_rate: Rate = 400
    imu_rate: Rate = 200
    imu: ImuParameters = ImuParameters()
    cameras: tuple[CameraSpec, ...] = ()
    camera_processes: Count = 2
    render_threads: Count = 1
    setpoint_timeout: Duration = Duration(0.5)  # immutable
    gains: Gains = Gains()
    limits: Limits = Limits()


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
        model = await self.offload(self._build)
        self._physics = Physics(model, self.name)
        self._autopilot = Autopilot(
            self._physics.parameters,
            config.gains,
            config.limits,
            setpoint_timeout=config.setpoint_timeout,
        )
        self._noise = ImuNoise(config.imu, config.imu_rate, self.rng)
        self._touched: frozenset[str] = frozenset()
        self._refused = ""
        self._to_expose: list[str] = []
        await self._rig.start(model)
        for camera in config.cameras:
            self.every(camera.rate, self._trigger(camera.name), camera.name)

    def _build(self) -> Any:
        config = self.config
        world = load_world(config.world)
        north, east = config.position
        start = (north, east, -config.height - STANDING_HEIGHT)
        attach_vehicle(world, self.name, start, math.radians(config.yaw))
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

    @every(hz="imu_rate")
    def sense(self, tick: Tick) -> None:
        """Measure, tell the truth, and expose the cameras whose time has come."""
        physics = self._physics
        physics.advance_to(tick.stamp)
        stamp = physics.time_ns
        rates, force = self._noise.add(*physics.imu())
        self.imu.send(
            Imu(
                stamp=stamp,
                source=f"{self.name}/imu",
                angular_velocity=rates,
                linear_acceleration=force,
            )
        )
        state = physics.state()
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
        for camera in self._to_expose:
            self._rig.expose(camera, stamp, physics.qpos(), physics.data.qvel.copy())
        self._to_expose.clear()

    async def on_shutdown(self) -> None:
        """Say which pictures are missing."""
        self._rig.say_what_is_missing()

    def _trigger(self, camera: str) -> Any:
        def trigger(_: Tick) -> None:
            self._to_expose.append(camera)

        return trigger

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
