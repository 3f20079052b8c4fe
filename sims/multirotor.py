"""A simulated multirotor as a node: its inputs, outputs and timing."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import events as ev
from events import Vector3
from runtime import Output, Tick, every, on
from sims.cameras import add_camera
from sims.sensors.platform import FRAME, PlatformConfig, SensorPlatform
from sims.sensors.suite import mount_imu
from sims.vehicle import (
    STANDING_HEIGHT,
    Autopilot,
    Gains,
    Limits,
    Phase,
    Physics,
    State,
    attach_vehicle,
)
from sims.vehicle.autopilot import FALL, Clearance, trouble_at_start, trouble_on_path
from sims.vehicle.physics import Contact
from sims.world import Rate, SharedWorld
from sims.worlds import Dynamics, Scene

DEEPEST = 100.0  # greatest depth in a solid without divergence of the physics, metres


class MultirotorConfig(PlatformConfig):
    """Settings of a multirotor, besides those of its sensors.

    Attributes:
        position: Position on the ground at the start: x north and y east, metres.
        height: Height of the ground there, metres above the world's zero.
        yaw: Heading at the start, degrees clockwise from north.
        control_rate: Rate of the controller, Hz.
        gains: Gains of the controller.
        limits: Limits of the controller.
    """

    position: tuple[float, float] = (0.0, 0.0)
    height: float = 0.0
    yaw: float = 0.0
    control_rate: Rate = 400
    gains: Gains = Gains()
    limits: Limits = Limits()


class Multirotor(SensorPlatform[MultirotorConfig]):
    """A quadrotor with cameras, an IMU and ground truth, in a MuJoCo world.

    It obeys commands (`Arm`, `Takeoff`, `Hover`, `Land`, `Disarm`), and follows set-points of
    position, velocity, attitude, body rates or motors while it flies. `Teleport` and `Reset` put it
    somewhere at once. Ground truth is sent as `odometry` and `camera_poses`, without noise. Several
    are in one world: they collide, see one another, and obey what names them.
    """

    vehicle_events = Output(ev.VehicleEvent)

    vehicle = True

    async def join(self, world: SharedWorld) -> Physics:
        """Stand on the ground, at rest, with an autopilot."""
        config = self.config
        self._start = start_of(config)
        assert world.simulation is not None
        self._physics = Physics(world.simulation, self.name)
        self._clearance = Clearance(world.model, self.name)
        if not self._physics.time_ns:
            await self.offload(self._physics.settle)
            world.starts[self.name] = self._physics.state()
        self._autopilot = Autopilot(
            self._physics.parameters,
            config.gains,
            config.limits,
            setpoint_timeout=config.setpoint_timeout,
        )
        self._pilots: list[ev.PilotAnnouncement] = []
        self._touched: frozenset[str] = frozenset()
        self._refused = ""
        return self._physics

    async def on_shutdown(self) -> None:
        """Stop the motors: without a controller the vehicle falls, if others fly on."""
        await super().on_shutdown()
        self._physics.set_motors(0.0, 0.0, 0.0, 0.0)

    @classmethod
    def populate(cls, scene: Scene, name: str, config: Any) -> Dynamics:
        """Put the vehicle, its IMU and its cameras into the world."""
        attach_vehicle(scene.spec, name, start_of(config), math.radians(config.yaw))
        mount_imu(scene.spec, name, config.imu)
        for camera in config.cameras:
            add_camera(scene.spec, f"{name}/{FRAME}", camera, f"{name}/")
        return Dynamics()

    def announce(self) -> Iterable[ev.Announcement]:
        """Announce the vehicle, its sensors and its cameras."""
        parameters, state = self._physics.parameters, self._physics.state()
        yield ev.VehicleAnnouncement(
            stamp=0,
            source=self.name,
            mass=parameters.mass,
            max_thrust=parameters.max_thrust,
            control_rate=self.config.control_rate,
            position=state.position,
            orientation=state.orientation,
        )
        yield from super().announce()

    def on_announcement(self, announcement: ev.Announcement) -> None:
        """Record pilots, and refuse a path the vehicle cannot fly."""
        if isinstance(announcement, ev.PilotAnnouncement):
            self._pilots.append(announcement)
        if not isinstance(announcement, ev.PathAnnouncement):
            return
        if not self._addressee.obeys(announcement, "setpoints"):
            return
        if trouble_at_start(self._clearance, self._start):  # which `check` reports
            return
        if trouble := trouble_on_path(
            self._clearance, self._start, announcement.waypoints, announcement.margin
        ):
            raise ValueError(trouble)

    def check(self) -> Iterable[str]:
        """Return why the vehicle cannot stand at its start, or a pilot's orders are for nobody."""
        yield from self._addressee.complaints(self._pilots)
        if trouble := trouble_at_start(self._clearance, self._start):
            yield f"position: {trouble}"
        elif (fall := self._clearance.ground_below(self._start) or 0.0) > FALL:
            self.log.warning("position, height: it starts %.2g m above the ground, and falls", fall)

    @on(ev.Command)
    def commands(self, event: ev.Command) -> None:
        """Obey a command for this vehicle, or log the reason for refusal."""
        if not self._is_for_this(event, "commands"):
            return
        jumps = isinstance(event, ev.Teleport | ev.Reset)
        if reason := self._autopilot.command(event) or (jumps and self._jump(event)):
            self.log.warning("%s refused: %s", type(event).__name__, reason)

    @on(ev.Setpoint)
    def setpoints(self, event: ev.Setpoint) -> None:
        """Follow a set-point for this vehicle, or log a reason for refusal, each in a row once."""
        if not self._is_for_this(event, "setpoints"):
            return
        reason = self._autopilot.command(event) or ""
        if reason and reason != self._refused:
            self.log.warning("%s refused: %s", type(event).__name__, reason)
        self._refused = reason

    def _jump(self, order: ev.Command) -> str:
        physics, suite = self._physics, self._suite
        physics.advance_to(self.clock.now())
        if isinstance(order, ev.Teleport):
            before, velocities = physics.state(), (order.linear_velocity, order.angular_velocity)
            physics.put(State(order.position, order.orientation, *velocities))
            depth = max((contact.depth for contact in physics.contacts()), default=0.0)
            if depth > DEEPEST:
                physics.put(before)
                return f"position: expected less than {DEEPEST:g} m in things, found {depth:.3g}"
            suite.imu.forget()
        else:
            physics.put(self._world.starts[self.name])
            physics.stop_rotors()
            suite.reset()
            self._send_events()
        self._touched = frozenset()
        return ""

    def _is_for_this(self, order: ev.Command | ev.Setpoint, port: str) -> bool:
        if self._addressee.obeys(order, port):
            return True
        if reason := self._addressee.refusal(order):
            what = type(order).__name__
            self.log.warning("%s of %s refused: vehicle: %s", what, order.source, reason)
        return False

    @every(hz="control_rate")
    def control(self, tick: Tick) -> None:
        """Step the physics up to now, and set the motors."""
        physics, autopilot = self._physics, self._autopilot
        physics.advance_to(tick.stamp)
        touching = physics.touching()
        physics.set_motors(*autopilot.update(tick.stamp, physics.state(), touching))
        self._send_events()
        if touching and autopilot.phase is not Phase.DISARMED:
            self._send_collisions()
        elif not touching:
            self._touched = frozenset()

    def _send_events(self) -> None:
        for event in self._autopilot.take_events():
            self.vehicle_events.send(event(stamp=self._physics.time_ns, source=self.name))

    def _send_collisions(self) -> None:
        contacts = [c for c in self._physics.contacts() if not _stands_on(c)]
        touched = frozenset(c.other for c in contacts)
        for contact in contacts:
            if contact.other not in self._touched:
                self._touched |= {contact.other}
                self.vehicle_events.send(
                    ev.Collision(
                        stamp=self._physics.time_ns,
                        source=self.name,
                        other=contact.other,
                        position=contact.position,
                        normal=contact.normal,
                        speed=contact.speed,
                    )
                )
        self._touched = touched


def start_of(config: MultirotorConfig) -> Vector3:
    """Return where a vehicle's ``base_link`` is at the start, metres NED."""
    north, east = config.position
    return (north, east, -config.height - STANDING_HEIGHT)


def _stands_on(contact: Contact) -> bool:
    return contact.normal[2] < -0.7 and contact.speed < 1.0
