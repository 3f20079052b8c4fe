"""Scripted flights by the true pose, or an estimator's: take off, follow a path, land, end."""

from __future__ import annotations

import asyncio
import functools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from typing import Annotated, Any

import msgspec
import numpy as np

from events import (
    Announcement,
    Command,
    Hover,
    Land,
    Landed,
    Odometry,
    PathAnnouncement,
    PilotAnnouncement,
    PlannedPose,
    PoseEstimate,
    PositionSetpoint,
    Shutdown,
    TakenOff,
    Takeoff,
    Vector3,
    VehicleAnnouncement,
    VehicleEvent,
    VelocitySetpoint,
)
from events.frames import yaw_of
from nodes.pilots.waypoint_path import (
    Excitation,
    FigureEight,
    Heading,
    WaypointPath,
    excited,
    headed,
    joined,
    plan,
)
from runtime import Duration, Node, NodeConfig, Output, on
from runtime.changeable import Changeable
from runtime.typed import TypeVar

Positive = Annotated[float, msgspec.Meta(gt=0)]


class VehicleControllerConfig(NodeConfig):
    """Settings of any node that flies a vehicle.

    Attributes:
        vehicle: Name of the vehicle to fly; may be left out if there is only one.
    """

    vehicle: str = ""


V = TypeVar("V", bound=VehicleControllerConfig, default=VehicleControllerConfig)
E = TypeVar("E")


class VehicleController(Node[V], ABC):
    """Base of nodes that fly a vehicle; all that they send names it."""

    commands = Output(Command)

    def __init__(self) -> None:
        self._vehicles: list[str] = []  # announced, and maybe the one to fly

    def announce(self) -> Iterable[Announcement]:
        """Announce the vehicle to fly."""
        yield PilotAnnouncement(stamp=0, source=self.name, vehicle=self.config.vehicle)

    def on_announcement(self, announcement: Announcement) -> None:
        """Note a vehicle that may be the one to fly."""
        is_vehicle = isinstance(announcement, VehicleAnnouncement)
        if is_vehicle and self.config.vehicle in ("", announcement.source):
            self._vehicles.append(announcement.source)

    @abstractmethod
    def check(self) -> Iterable[str]:
        """Say what is missing to fly, such as the vehicle."""

    def refuse_several(self, why: str = "") -> None:
        """Raise a `ValueError` if the vehicle is ambiguous."""
        if len(self._vehicles) > 1:
            first = self._vehicles[0]
            raise ValueError(
                f"of several vehicles, {self.name} was expected to say which it flies{why}: write "
                f'vehicle = "{first}" into its entry, if it is {first}'
            )

    def send_command(self, command: type[Command], **fields: Any) -> None:
        """Send a command to the vehicle."""
        self.commands.send(self.made(command, **fields))

    def made(self, event: Callable[..., E], **fields: Any) -> E:
        """Return an event about the vehicle, stamped now."""
        vehicle = self.config.vehicle
        return event(stamp=self.clock.now(), source=self.name, vehicle=vehicle, **fields)


class PilotConfig(VehicleControllerConfig):
    """Settings of a scripted flight.

    Attributes:
        waypoints: Places to pass, metres in ``map`` (x north, y east, z down: heights are
            negative). The path begins above the vehicle. May be left out beside a `figure_eight`.
        laps: How often the waypoints are passed, for long flights.
        speed: Highest speed along the path, metres per second.
        acceleration: Highest acceleration along the path and across it, metres per second squared.
        corner_radius: Distance from a waypoint at which the rounding of its corner begins, metres.
        turn_time: Seconds over which changes of heading are smoothed.
        heading: ``path``: the nose is in the direction of flight. ``fixed``: the heading of the
            start. ``sweep``: it swings about the direction of flight, by 40° and every 6 s.
        excitation: Movement on the spot about all axes before the path, to initialize a
            visual-inertial system; none if not given.
        figure_eight: A figure eight after the waypoints.
        rate: Set-points per second.
        start_delay: Seconds from the first known pose to take-off, at rest.
        end_run: Whether the run ends once the vehicle has landed.
    """

    waypoints: tuple[Vector3, ...] = ()
    laps: Annotated[int, msgspec.Meta(ge=1)] = 1
    speed: Positive = 1.3
    acceleration: Positive = 1.0
    corner_radius: Positive = 0.8
    turn_time: Duration = Duration(0.5)  # immutable
    heading: Heading = "path"
    excitation: Excitation | None = None
    figure_eight: FigureEight | None = None
    rate: Positive = 50
    start_delay: Duration = Duration(0.5)
    end_run: bool = True

    def __post_init__(self) -> None:
        if not self.waypoints and self.figure_eight is None:
            raise ValueError("waypoints: expected at least one, or a figure_eight, found neither")
        if self.laps > 1 and not self.waypoints:
            raise ValueError(f"laps: expected waypoints to pass {self.laps} times, found none")

    def places(self) -> list[Vector3]:
        """Return the places to pass in their order, with all laps."""
        places = [*self.waypoints] * self.laps
        if (figure := self.figure_eight) is not None:
            places += [(x, y, z) for x, y, z in figure.places().tolist() * figure.laps]
        return places

    def legs(self) -> list[Vector3]:
        """Return the ends of all different legs: the places, and the way back to the first."""
        once = [*self.waypoints]
        if self.laps > 1:
            once.append(self.waypoints[0])
        if self.figure_eight is not None:
            once += [(x, y, z) for x, y, z in self.figure_eight.places().tolist()]
        return once


C = TypeVar("C", bound=PilotConfig, default=PilotConfig)

_REMINDER = 5.0  # seconds without a first pose after which that is said


class Pilot(VehicleController[C], ABC):
    """Base of pilots of a scripted flight: take off, follow a path, land, end the run.

    A subclass calls `update_pose` with its vehicle's pose, and implements `follow`.
    """

    flies = True
    ends_run = "plan"
    shutdowns = Output(Shutdown)

    outcome = "flight completed"
    """Why the run ends, once the vehicle has landed."""

    def announce(self) -> Iterable[Announcement]:
        """Announce the vehicle, the places to pass, and the room for the excitation."""
        yield from super().announce()
        excitation = self.config.excitation
        yield PathAnnouncement(
            stamp=0,
            source=self.name,
            vehicle=self.config.vehicle,
            waypoints=tuple(self.config.legs()),
            margin=0.0 if excitation is None else excitation.reach,
        )

    def __init__(self) -> None:
        super().__init__()
        self.pose: Odometry | PoseEstimate | None = None
        self._pose_known = asyncio.Event()
        self._taken_off = asyncio.Event()
        self._landed = asyncio.Event()
        self._open_ports = [
            port
            for port, handles in self.declared.handlers.items()
            if port not in self.sources
            and any(issubclass(event, Odometry | VehicleEvent) for event in handles.events)
        ]

    def on_announcement(self, announcement: Announcement) -> None:
        """Listen to the pilot's vehicle; raise `ValueError` if the vehicle is ambiguous."""
        super().on_announcement(announcement)
        if isinstance(announcement, VehicleAnnouncement) and self._open_ports:
            self.refuse_several(", but it hears them all")
            for port in self._open_ports:
                self.narrow(port, self.config.vehicle or announcement.source)

    def check(self) -> Iterable[str]:
        """Say if there is nothing to fly."""
        if not self._vehicles and not self.senders_of(Odometry, PoseEstimate):
            yield "expected a vehicle to fly, found none: add one, such as a Multirotor"

    def update_pose(self, pose: Odometry | PoseEstimate) -> None:
        """Store the vehicle's pose; the first pose starts the flight."""
        self.pose = pose
        self._pose_known.set()

    @abstractmethod
    async def follow(self, path: WaypointPath) -> None:
        """Fly along a path, starting now."""

    @on(TakenOff, Landed)
    def vehicle_events(self, event: VehicleEvent) -> None:
        """Note a take-off or a landing of the vehicle."""
        (self._taken_off if isinstance(event, TakenOff) else self._landed).set()

    async def run(self) -> None:
        """Take off, follow the path, land, and end the run."""
        clock = self.clock
        await self._pose_known.wait()
        await clock.sleep(self.config.start_delay)
        assert self.pose is not None
        height = self.pose.position[2] - self.config.places()[0][2]
        self.send_command(Takeoff, altitude=max(height, 0.5))
        await self._taken_off.wait()
        path = await self.offload(self._plan, self.pose)
        if path is not None:
            self.log.info("a path of %.1f m in %.1f s", path.length, path.seconds)
            await self.follow(path)
        self.send_command(Hover)
        self.send_command(Land)
        await self._landed.wait()
        self.log.info("landed")
        await clock.sleep(0.5)
        if self.config.end_run:
            end = Shutdown(stamp=clock.now(), source=self.name, reason=self.outcome)
            self.shutdowns.send(end)

    def _plan(self, start: Odometry | PoseEstimate) -> WaypointPath | None:
        """Return the path from here; `None` without any length or excitation."""
        config = self.config
        yaw, step = yaw_of(start.orientation), 1 / config.rate
        parts = []
        if config.excitation is not None:
            parts.append(excited(config.excitation, start.position, yaw, step))
        points = [start.position]
        for place in config.places():
            if math.dist(points[-1], place) > 0.05:
                points.append(place)
        if len(points) > 1:
            path = plan(
                np.array(points),
                speed=config.speed,
                acceleration=config.acceleration,
                radius=config.corner_radius,
                yaw=yaw,
                turn_time=config.turn_time,
                step=step,
            )
            parts.append(headed(path, config.heading, yaw))
        return functools.reduce(joined, parts) if parts else None


class WaypointFollower(Pilot[PilotConfig]):
    """Pilot along waypoints by the true pose, its nose in the direction of flight."""

    setpoints = Output(PositionSetpoint)

    @on(Odometry)
    def odometry(self, event: Odometry) -> None:
        """Note the vehicle's pose."""
        self.update_pose(event)

    async def follow(self, path: WaypointPath) -> None:
        """Send a position set-point for every step of the path."""
        start = self.clock.now()
        for index in range(len(path.position)):
            await self.clock.sleep_until(start + round(index * path.step * 1e9))
            self.setpoints.send(self.made(PositionSetpoint, **path.row(index)))


class VisualPilotConfig(PilotConfig):
    """Settings of a visual pilot, besides those of every scripted flight.

    Attributes:
        gain: Correction for the distance from the path, (m/s)/m.
        yaw_gain: Correction for the error of the heading, (rad/s)/rad.
        max_correction: Highest speed of the correction, metres per second.
        estimate_timeout: Age of the newest estimate beyond which the vehicle stops and waits.
        landing_timeout: Longest wait; then it lands there, and the run ends.
    """

    gain: Changeable[Positive] = 1.0
    yaw_gain: Changeable[Positive] = 1.0
    max_correction: Changeable[Positive] = 0.5
    estimate_timeout: Changeable[Duration] = Duration(0.5)  # immutable
    landing_timeout: Changeable[Duration] = Duration(10.0)


class VisualPilot(Pilot[VisualPilotConfig]):
    """Pilot along waypoints by an estimator's poses.

    Sends velocities in the frame of the vehicle's own heading, so every error of the estimate shows
    in the flight. (The vehicle itself holds its attitude and velocity, by its true state.)
    Waypoints are in the frame of the first estimate; estimates in other frames, as of a restarted
    estimator, are ignored. Without estimates the vehicle hovers; it goes on when they come again,
    and lands when they do not.
    """

    setpoints = Output(VelocitySetpoint)
    plans = Output(PlannedPose)

    def __init__(self) -> None:
        super().__init__()
        self._frame = ""
        self._refused = ""

    @on(PoseEstimate)
    def estimates(self, event: PoseEstimate) -> None:
        """Store an estimated pose in the frame of the flight; ignore poses in other frames."""
        frame = self._frame = self._frame or event.frame_id
        if event.frame_id != frame:
            if event.frame_id != self._refused:
                self._refused = event.frame_id
                text = "%s: expected estimates in %s, found %s: not followed"
                self.log.warning(text, event.source, frame, event.frame_id)
            return
        self.update_pose(event)

    async def run(self) -> None:
        """Fly, and say so if no pose comes to take off by."""
        self.start(self._remind())
        await super().run()

    async def _remind(self) -> None:
        await self.clock.sleep(_REMINDER)
        if self.pose is None:
            who = ", ".join(self.senders_of(PoseEstimate)) or "anybody"
            self.log.warning(
                "no pose from %s for %g s: this pilot waits for the first one to take off, and an "
                "estimator may wait for motion before its first one",
                who,
                _REMINDER,
            )

    async def follow(self, path: WaypointPath) -> None:
        """Send the path's velocity, corrected for the distance of the estimate from the path."""
        clock = self.clock
        step, last = round(path.step * 1e9), len(path.position) - 1
        start = clock.now()
        for index in range(last + 1):
            await clock.sleep_until(start + index * step)
            waited = await self._wait_for_estimate()
            if waited is None:
                return
            start += waited
            x, y, z = path.position[index].tolist()
            yaw = float(path.yaw[index])
            self.plans.send(self.made(PlannedPose, position=(x, y, z), yaw=yaw))
            assert self.pose is not None
            # Compared with the path at the stamp of the image, so that its age does not matter.
            then = min(max(round((self.pose.stamp - start) / step), 0), last)
            config = self.config  # which may change during the flight
            correction = config.gain * (path.position[then] - self.pose.position)
            size = math.hypot(*correction)
            if size > config.max_correction:
                correction *= config.max_correction / size
            north, east, down = (path.velocity[index] + correction).tolist()
            heading = float(path.yaw[then]) - yaw_of(self.pose.orientation)
            yaw_error = math.remainder(heading, math.tau)
            # The estimated heading now: the path's, less the error.
            velocity = _turned((north, east, down), yaw_error - yaw)
            turn = float(path.yaw_rate[index]) + config.yaw_gain * yaw_error
            self.setpoints.send(
                self.made(VelocitySetpoint, frame_id="heading", velocity=velocity, yaw_rate=turn)
            )

    async def _wait_for_estimate(self) -> int | None:
        """Stop while the newest estimate is too old; return that time (ns), `None` if too long."""
        start = self.clock.now()
        assert self.pose is not None
        if start - self.pose.stamp <= self.config.estimate_timeout * 1e9:
            return 0
        self.log.warning(
            "no estimate in %s for %g s: waiting for one", self._frame, self.config.estimate_timeout
        )
        self.send_command(Hover)
        while (now := self.clock.now()) - self.pose.stamp > self.config.estimate_timeout * 1e9:
            if now - start > self.config.landing_timeout * 1e9:
                missed = f"no estimate in {self._frame} for {self.config.landing_timeout:g} s"
                self.log.error("%s: landing", missed)
                self.outcome = f"{missed}: landed"
                return None
            await self.clock.sleep(1 / self.config.rate)
        return self.clock.now() - start


def _turned(vector: Vector3, angle: float) -> Vector3:
    """Return a vector turned about the vertical by an angle, clockwise seen from above."""
    x, y, z = vector
    c, s = math.cos(angle), math.sin(angle)
    return (c * x - s * y, s * x + c * y, z)
