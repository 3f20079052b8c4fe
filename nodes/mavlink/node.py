"""The node: its ports, and the vehicle that it flies."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

from events import (
    Announcement,
    Command,
    EstimatorAnnouncement,
    Odometry,
    PilotAnnouncement,
    PoseEstimate,
    Setpoint,
    VehicleAnnouncement,
    VehicleEvent,
)
from nodes.mavlink.settings import MavlinkConfig
from runtime import Node, Output, Tick, every, on
from runtime.errors import MissingDependencyError
from runtime.extras import install_command

if TYPE_CHECKING:
    from nodes.mavlink.door import Door

RATE = 50.0  # of telemetry, and of set-points on the way to a place, Hz
ORIGIN = (47.397742, 8.545594, 488.0)  # PX4's in simulations, for vehicles that have none


class Mavlink(Node[MavlinkConfig]):
    """A vehicle as MAVSDK and ground stations know it: telemetry, commands, missions, offboard.

    It says to be PX4, whose modes and conventions programs know. MAVLink has no steps: programs act
    when their own clock says so, and so a run with this node does not repeat.
    """

    deterministic = False
    flies = True
    ends_run = "hand"
    commands = Output(Command)
    setpoints = Output(Setpoint)
    estimates = Output(PoseEstimate, when="vision")

    wall: Callable[[], float] = staticmethod(time.monotonic)
    """Real seconds, by which programs are missed."""

    def __init__(self) -> None:
        self._vehicles: list[str] = []
        self._estimators: list[str] = []
        self._door: Door | None = None

    async def on_startup(self) -> None:
        """Open the links."""
        try:
            from nodes.mavlink.door import Door
        except ImportError as error:
            wanted = install_command("mavlink")
            raise MissingDependencyError(f"Mavlink needs pymavlink ({error}): {wanted}") from error
        if not self.checking:
            origins = [getattr(each.config, "origin", None) for each in self.siblings(Node)]
            origin = next(filter(None, origins), ORIGIN)
            now = self.clock.now
            self._door = Door(self.config, origin, self._act, self._see, now, self.log)
            self._door.open()

    def announce(self) -> Iterable[Announcement]:
        """Announce the vehicle to fly, and an estimator outside."""
        vehicle = self.config.vehicle
        yield PilotAnnouncement(stamp=0, source=self.name, vehicle=vehicle)
        if self.config.vision:
            yield EstimatorAnnouncement(
                stamp=0, source=self.name, method="by MAVLink", vehicle=vehicle
            )

    def on_announcement(self, announcement: Announcement) -> None:
        """Find the vehicle; raise `ValueError` if it is ambiguous."""
        if isinstance(announcement, EstimatorAnnouncement):
            self._estimators.append(announcement.source)
        if not isinstance(announcement, VehicleAnnouncement):
            return
        if self.config.vehicle in ("", announcement.source):
            self._vehicles.append(announcement.source)
        if len(self._vehicles) > 1:
            first = self._vehicles[0]
            raise ValueError(
                f"of several vehicles, {self.name} was expected to say which it flies: write "
                f'vehicle = "{first}" into its entry, if it is {first}'
            )

    def check(self) -> Iterable[str]:
        """Say if there is nothing to fly, or time runs away from programs."""
        if not self._vehicles:
            wanted = self.config.vehicle or "a vehicle"
            yield f"expected {wanted} to fly, found none: add one, such as a Multirotor"
        wanted = self.config.telemetry
        if wanted and wanted not in self._estimators:
            there = ", ".join(self._estimators) or "none"
            yield f'telemetry: expected an estimator, found "{wanted}"; there are: {there}'
        speed = self.stepping.target_speed
        if not self.stepping.fixed() and (speed is None or speed > 1.0):
            found = "no limit" if speed is None else f"{speed:g}"
            yield f"expected run.speed = 1.0 or less, for programs keep real time, found {found}"

    @on(Odometry)
    def odometry(self, event: Odometry) -> None:
        """Take note of the true pose."""
        if self._door and not self.config.telemetry and event.source == self._vehicles[0]:
            self._door.vehicle.note(event)

    @on(PoseEstimate)
    def poses(self, event: PoseEstimate) -> None:
        """Take note of the estimated pose."""
        if self._door and event.source == self.config.telemetry:
            self._door.vehicle.note(event)

    @on(VehicleEvent)
    def vehicle_events(self, event: VehicleEvent) -> None:
        """Take note of arming, take-off and landing."""
        if self._door and event.source == self._vehicles[0]:
            self._door.flight.noted(event)

    @every(hz=RATE)
    def go_on(self, tick: Tick) -> None:
        """Send telemetry, and steer."""
        if self._door:
            self._door.update(tick.stamp, self.wall())

    async def on_shutdown(self) -> None:
        """Close the links."""
        if self._door:
            self._door.close()

    def _act(self, kind: Callable[..., Command | Setpoint], **fields: Any) -> None:
        vehicle = self.config.vehicle
        event = kind(stamp=self.clock.now(), source=self.name, vehicle=vehicle, **fields)
        if isinstance(event, Command):
            self.commands.send(event)
        else:
            self.setpoints.send(event)

    def _see(self, **fields: Any) -> None:
        self.estimates.send(PoseEstimate(source=self.name, **fields))
