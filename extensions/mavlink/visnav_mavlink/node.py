"""The nodes, without MAVLink's library, which may not be there: their settings and ports."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Annotated, Any

import msgspec

from events import (
    Announcement,
    Arm,
    Command,
    Disarm,
    EstimatorAnnouncement,
    FluidPressure,
    Imu,
    ImuAnnouncement,
    MagneticField,
    MotorSetpoint,
    NavSatFix,
    Odometry,
    PoseEstimate,
    Quaternion,
    Setpoint,
    VehicleEvent,
)
from nodes.pilots.pilot import VehicleController, VehicleControllerConfig
from runtime import Duration, Input, Node, Output, Tick, every, on
from runtime.errors import MissingDependencyError
from visnav_mavlink.settings import RATE, MavlinkConfig

if TYPE_CHECKING:
    from visnav_mavlink.endpoint import MavlinkEndpoint
    from visnav_mavlink.links import Wire


ORIGIN = (47.397742, 8.545594, 488.0)  # PX4's in simulations, for vehicles that have none
LEVEL = (1.0, 0.0, 0.0, 0.0)


class Mavlink(VehicleController[MavlinkConfig]):
    """A vehicle as MAVSDK and ground stations know it: telemetry, commands, missions, offboard.

    It says to be PX4, whose modes and conventions programs know. MAVLink has no steps: programs act
    when their own clock says so, and so a run with this node does not repeat.
    """

    deterministic = False
    flies = True
    ends_run = "hand"
    relays_estimates = True
    setpoints = Output(Setpoint)
    estimates = Output(PoseEstimate, when="vision")

    wall: Callable[[], float] = staticmethod(time.monotonic)
    """Real seconds, by which programs are missed."""

    def __init__(self) -> None:
        super().__init__()
        self._estimators: list[str] = []
        self._imus: dict[str, Quaternion] = {}  # orientation in the body, by source
        self._endpoint: MavlinkEndpoint | None = None

    async def on_startup(self) -> None:
        """Open the links."""
        _expect_library("Mavlink")
        if self.checking:
            return
        from visnav_mavlink.endpoint import MavlinkEndpoint

        origins = [getattr(node.config, "origin", None) for node in self.siblings(Node)]
        origin = next(filter(None, origins), ORIGIN)
        self._endpoint = MavlinkEndpoint(
            self.config, origin, self._act, self._publish_pose, self.clock.now, self.log
        )
        self._endpoint.open()

    def announce(self) -> Iterable[Announcement]:
        """Announce the vehicle to fly, and an estimator outside."""
        yield from super().announce()
        if self.config.vision:
            yield EstimatorAnnouncement(
                stamp=0, source=self.name, method="by MAVLink", vehicle=self.config.vehicle
            )

    def on_announcement(self, announcement: Announcement) -> None:
        """Find the vehicle; raise `ValueError` if it is ambiguous."""
        super().on_announcement(announcement)
        self.refuse_several()
        if isinstance(announcement, EstimatorAnnouncement):
            self._estimators.append(announcement.source)
        if isinstance(announcement, ImuAnnouncement):
            self._imus[announcement.source] = announcement.orientation

    def check(self) -> Iterable[str]:
        """Yield an error if there is nothing to fly, or if time is faster than real time."""
        if not self._vehicles:
            expected = self.config.vehicle or "a vehicle"
            yield f"expected {expected} to fly, found none: add one, such as a Multirotor"
        expected = self.config.telemetry
        if expected and expected not in self._estimators:
            listed = ", ".join(self._estimators) or "none"
            yield f'telemetry: expected an estimator, found "{expected}"; there are: {listed}'
        speed = self.stepping.target_speed
        if not self.stepping.fixed() and (speed is None or speed > 1.0):
            limit = "no limit" if speed is None else f"{speed:g}"
            yield f"expected run.speed = 1.0 or less, for programs keep real time, found {limit}"

    @on(Odometry)
    def odometry(self, event: Odometry) -> None:
        """Store the true pose."""
        if self._endpoint and not self.config.telemetry and event.source == self._vehicles[0]:
            self._endpoint.vehicle.set_pose(event)

    @on(Imu, MagneticField, FluidPressure)
    def samples(self, event: Imu | MagneticField | FluidPressure) -> None:
        """Store the samples of the vehicle's sensors."""
        if self._endpoint and self._is_aboard(event.source):
            self._endpoint.vehicle.add_sample(event)

    @on(PoseEstimate)
    def poses(self, event: PoseEstimate) -> None:
        """Store the estimated pose."""
        if self._endpoint and event.source == self.config.telemetry:
            self._endpoint.vehicle.set_pose(event)

    @on(VehicleEvent)
    def vehicle_events(self, event: VehicleEvent) -> None:
        """Handle arming, take-off and landing."""
        if self._endpoint and event.source == self._vehicles[0]:
            self._endpoint.flight.handle_event(event)

    async def on_ready(self) -> None:
        """Store the orientation of the vehicle's IMU."""
        for source, orientation in self._imus.items():
            if self._endpoint and self._is_aboard(source):
                self._endpoint.vehicle.imu_orientation = orientation

    @every(hz=RATE)
    def go_on(self, tick: Tick) -> None:
        """Send telemetry, and steer."""
        if self._endpoint:
            self._endpoint.update(tick.stamp, self.wall())

    async def on_end(self) -> None:
        """Report how many poses came from outside."""
        if self._endpoint and (text := self._endpoint.finish()):
            self.note_environment(f"{self.name}: poses from outside", text)

    async def on_shutdown(self) -> None:
        """Close the links."""
        if self._endpoint:
            self._endpoint.close()

    def _is_aboard(self, source: str) -> bool:
        return f"{source}/".startswith(f"{self._vehicles[0]}/")

    def _act(self, kind: Callable[..., Command | Setpoint], **fields: Any) -> None:
        event = self.made(kind, **fields)
        if isinstance(event, Command):
            self.commands.send(event)
        else:
            self.setpoints.send(event)

    def _publish_pose(self, **fields: Any) -> None:
        self.estimates.send(PoseEstimate(source=self.name, **fields))


class Px4Config(VehicleControllerConfig):
    """Settings of PX4 in the loop.

    Attributes:
        vehicle: Vehicle whose motors it drives; may be left out if there is only one.
        host: Address to listen on.
        port: Port to listen on, where PX4 looks for its simulator.
        start: Real time in which PX4 must have connected.
        answer: Real time in which it must have answered; simulated time waits for it.
    """

    host: str = "127.0.0.1"
    port: Annotated[int, msgspec.Meta(ge=0, le=65535)] = 4560
    start: Duration = Duration(60.0)  # immutable
    answer: Duration = Duration(10.0)


class Px4(VehicleController[Px4Config]):
    """PX4 by its simulator interface, in lockstep: time waits for the answer to each IMU sample.

    PX4 connects to `port`, gets the vehicle's IMU, magnetometer, barometer and satellite fixes, and
    drives the motors. Until its first answer it is free to be silent, and time runs as real time.
    """

    deterministic = False
    flies = True
    imu = Input(Imu)
    setpoints = Output(MotorSetpoint)

    def __init__(self) -> None:
        super().__init__()
        self._imus: list[ImuAnnouncement] = []
        self._wire: Wire | None = None
        self._field: MagneticField | None = None
        self._pressure: FluidPressure | None = None
        self._fix: NavSatFix | None = None
        self._armed = False

    async def on_startup(self) -> None:
        """Listen for PX4."""
        _expect_library("Px4")
        if self.checking:
            return
        from visnav_mavlink.links import Wire

        host, port = self.config.host, self.config.port
        try:
            self._wire = Wire(host, port)
        except OSError as error:
            raise ValueError(f"expected {host}:{port} free, found: {error.strerror}") from None
        self.log.info("PX4 may connect to %s:%d", *self._wire.address)

    def on_announcement(self, announcement: Announcement) -> None:
        """Find the vehicle and its IMU."""
        super().on_announcement(announcement)
        if isinstance(announcement, ImuAnnouncement):
            self._imus.append(announcement)

    def check(self) -> Iterable[str]:
        """Yield an error for each missing part, and for each that PX4 does not expect."""
        if len(self._vehicles) != 1:
            names = ", ".join(self._vehicles) or "none"
            yield f"expected one vehicle whose motors to drive, found {names}: set vehicle"
        for imu in self._imus:
            if imu.orientation != LEVEL:
                yield f"expected an IMU along the body's axes, found {imu.source} turned"
        if not self._imus:
            yield "expected an IMU, found none: add one to the vehicle"

    @on(MagneticField)
    def fields(self, event: MagneticField) -> None:
        """Store the newest, for the next sample."""
        self._field = event

    @on(FluidPressure)
    def pressures(self, event: FluidPressure) -> None:
        """Store the newest, for the next sample."""
        self._pressure = event

    @on(NavSatFix)
    def fixes(self, event: NavSatFix) -> None:
        """Store the newest, for the next sample."""
        self._fix = event

    async def run(self) -> None:
        """Send each sample to PX4, and its answer to the motors."""
        from visnav_mavlink.links import motors, satellites, sensors

        assert self._wire is not None
        wire, config = self._wire, self.config
        self.doing = "waiting for PX4 on {}:{}".format(*wire.address)
        await self.offload(wire.accept, config.start)
        self.doing = ""
        async for sample in self.imu:
            messages = [sensors(sample, self._field, self._pressure)]
            if self._fix is not None:
                messages.append(satellites(self._fix))
            self._field = self._pressure = self._fix = None
            answer = await self.offload(wire.exchange, messages, config.answer)
            if answer is not None:
                self._obey(*motors(answer))

    async def on_shutdown(self) -> None:
        """Close the connection."""
        if self._wire is not None:
            self._wire.close()

    def _obey(self, armed: bool, commands: tuple[float, ...]) -> None:
        if armed != self._armed:
            self._armed = armed
            self.log.info("PX4 has %s", "armed" if armed else "disarmed")
            self.send_command(Arm if armed else Disarm)
        if armed:
            m1, m2, m3, m4 = commands
            self.setpoints.send(
                self.made(MotorSetpoint, motor1=m1, motor2=m2, motor3=m3, motor4=m4)
            )


def _expect_library(node: str) -> None:
    """Raise a `MissingDependencyError` if MAVLink's library cannot be imported."""
    try:
        import visnav_mavlink.links  # noqa: F401
    except ImportError as error:
        command = "pip install ./extensions/mavlink"
        raise MissingDependencyError(f"{node} needs pymavlink ({error}): {command}") from error
