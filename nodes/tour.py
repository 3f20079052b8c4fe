"""A scripted flight: take off, follow waypoints, land, end the run.

`Pilot` is what all such flights have in common; `Tour` follows its path by the vehicle's own
position, `nodes.visual_pilot` by an estimator's.
"""

from __future__ import annotations

import asyncio
import math
from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import Annotated

import msgspec
import numpy as np
from typing_extensions import TypeVar

from events import (
    Announcement,
    Command,
    Hover,
    Land,
    Landed,
    Odometry,
    PathAnnouncement,
    PoseEstimate,
    PositionSetpoint,
    Shutdown,
    TakenOff,
    Takeoff,
    Vector3,
    VehicleAnnouncement,
    VehicleEvent,
)
from nodes.path import Path, plan
from runtime import Duration, Node, NodeConfig, Output, on

Positive = Annotated[float, msgspec.Meta(gt=0)]


class TourConfig(NodeConfig):
    """Settings of a tour.

    Attributes:
        waypoints: Places to pass, metres in ``map`` (x north, y east, z down: heights are
            negative). The tour begins above the place where the vehicle stands.
        speed: Metres per second that it never exceeds.
        acceleration: Metres per second squared, along the path and across it.
        corner: Metres from a waypoint at which its corner is cut.
        turn_time: Seconds over which changes of heading are smoothed.
        rate: Set-points per second.
        wait: Seconds before take-off.
        end_run: Whether the run ends once it has landed.
    """

    waypoints: Annotated[tuple[Vector3, ...], msgspec.Meta(min_length=1)]
    speed: Positive = 1.3
    acceleration: Positive = 1.0
    corner: Positive = 0.8
    turn_time: Duration = Duration(0.5)  # immutable
    rate: Positive = 50
    wait: Duration = Duration(0.5)
    end_run: bool = True


C = TypeVar("C", bound=TourConfig, default=TourConfig)


class Pilot(Node[C], ABC):
    """Base of those who take off, follow a path, land and end the run.

    A subclass calls `see` with what it takes the vehicle's pose to be, and follows the path.
    """

    orders = Output(Command)
    end = Output(Shutdown)

    outcome = "tour flown"
    """Why the run ends, once it has landed."""

    def announce(self) -> Iterable[Announcement]:
        """Say where it will fly."""
        yield PathAnnouncement(stamp=0, source=self.name, waypoints=self.config.waypoints)

    def __init__(self) -> None:
        self.here: Odometry | PoseEstimate | None = None
        self._placed = asyncio.Event()
        self._taken_off = asyncio.Event()
        self._landed = asyncio.Event()
        self._vehicles: list[str] = []

    def on_announcement(self, announcement: Announcement) -> None:
        """Refuse to take several vehicles for one."""
        if not isinstance(announcement, VehicleAnnouncement):
            return
        self._vehicles.append(announcement.source)
        ports = [
            port
            for port, handles in self.declared.handlers.items()
            if port not in self.sources
            and any(issubclass(event, Odometry | VehicleEvent) for event in handles.events)
        ]
        if ports and len(self._vehicles) > 1:
            first = self._vehicles[0]
            line = ", ".join(f'{port} = "{first}"' for port in ports)
            raise ValueError(
                f"of several vehicles, {self.name} was expected to say which it flies, but it "
                f"hears them all: write inputs = {{ {line} }} into its entry, if it is {first}"
            )

    def see(self, here: Odometry | PoseEstimate) -> None:
        """Note where the vehicle is."""
        self.here = here
        self._placed.set()

    @abstractmethod
    async def follow(self, path: Path) -> None:
        """Fly along a path that begins now."""

    @on(TakenOff)
    def taken_off(self, _: TakenOff) -> None:
        """Begin to follow the path."""
        self._taken_off.set()

    @on(Landed)
    def landed(self, _: Landed) -> None:
        """Be done."""
        self._landed.set()

    async def run(self) -> None:
        """Fly the tour."""
        clock, name = self.clock, self.name
        await self._placed.wait()
        await clock.sleep(self.config.wait)
        assert self.here is not None
        height = self.here.position[2] - self.config.waypoints[0][2]
        self.orders.send(Takeoff(stamp=clock.now(), source=name, altitude=max(height, 0.5)))
        await self._taken_off.wait()
        path = await self.offload(self._plan, self.here)
        if path is not None:
            self.log.info("a path of %.1f m in %.1f s", path.length, path.seconds)
            await self.follow(path)
        self.orders.send(Hover(stamp=clock.now(), source=name))
        self.orders.send(Land(stamp=clock.now(), source=name))
        await self._landed.wait()
        self.log.info("landed")
        await clock.sleep(0.5)
        if self.config.end_run:
            self.end.send(Shutdown(stamp=clock.now(), source=name, reason=self.outcome))

    def _plan(self, start: Odometry | PoseEstimate) -> Path | None:
        """Return the path from here; `None` if the only waypoint is where the vehicle is."""
        config = self.config
        w, x, y, z = start.orientation
        points = [start.position]
        for place in config.waypoints:
            if math.dist(points[-1], place) > 0.05:
                points.append(place)
        if len(points) == 1:
            return None
        return plan(
            np.array(points),
            speed=config.speed,
            acceleration=config.acceleration,
            radius=config.corner,
            yaw=math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
            turn_time=config.turn_time,
            step=1 / config.rate,
        )


class Tour(Pilot[TourConfig]):
    """Flies a vehicle along waypoints, looking where it goes."""

    setpoints = Output(PositionSetpoint)

    @on(Odometry)
    def moved(self, event: Odometry) -> None:
        """Note where the vehicle is."""
        self.see(event)

    async def follow(self, path: Path) -> None:
        """Send a place for every moment of the path."""
        begin = self.clock.now()
        rows = zip(
            path.position.tolist(),
            path.velocity.tolist(),
            path.acceleration.tolist(),
            path.yaw.tolist(),
            path.yaw_rate.tolist(),
            strict=True,
        )
        for index, (position, velocity, acceleration, yaw, yaw_rate) in enumerate(rows):
            await self.clock.sleep_until(begin + round(index * path.step * 1e9))
            self.setpoints.send(
                PositionSetpoint(
                    stamp=self.clock.now(),
                    source=self.name,
                    position=tuple(position),
                    velocity=tuple(velocity),
                    acceleration=tuple(acceleration),
                    yaw=yaw,
                    yaw_rate=yaw_rate,
                )
            )
