"""PX4 in the loop, as a node: its filter and controllers fly the simulated vehicle."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from events import (
    Announcement,
    Arm,
    Command,
    Disarm,
    FluidPressure,
    Imu,
    ImuAnnouncement,
    MagneticField,
    MotorSetpoint,
    NavSatFix,
    PilotAnnouncement,
    VehicleAnnouncement,
)
from nodes.mavlink.settings import Px4Config
from runtime import Input, Node, Output, on
from runtime.errors import MissingDependencyError
from runtime.extras import install_command

if TYPE_CHECKING:
    from nodes.mavlink.hil import Wire

LEVEL = (1.0, 0.0, 0.0, 0.0)


class Px4(Node[Px4Config]):
    """PX4 by its simulator interface, in lockstep: time waits for the answer to each IMU sample.

    PX4 connects to `port`, gets the vehicle's IMU, magnetometer, barometer and satellite fixes, and
    drives the motors. Until its first answer it is free to be silent, and time runs as real time.
    """

    deterministic = False
    flies = True
    imu = Input(Imu)
    commands = Output(Command)
    setpoints = Output(MotorSetpoint)

    def __init__(self) -> None:
        self._vehicles: list[str] = []
        self._imus: list[ImuAnnouncement] = []
        self._wire: Wire | None = None
        self._field: MagneticField | None = None
        self._pressure: FluidPressure | None = None
        self._fix: NavSatFix | None = None
        self._armed = False

    async def on_startup(self) -> None:
        """Listen for PX4."""
        try:
            from nodes.mavlink.hil import Wire
        except ImportError as error:
            wanted = install_command("mavlink")
            raise MissingDependencyError(f"Px4 needs pymavlink ({error}): {wanted}") from error
        if self.checking:
            return
        host, port = self.config.host, self.config.port
        try:
            self._wire = Wire(host, port)
        except OSError as error:
            raise ValueError(f"expected {host}:{port} free, found: {error.strerror}") from None
        self.log.info("PX4 may connect to %s:%d", *self._wire.address)

    def announce(self) -> Iterable[Announcement]:
        """Announce the vehicle to fly."""
        yield PilotAnnouncement(stamp=0, source=self.name, vehicle=self.config.vehicle)

    def on_announcement(self, announcement: Announcement) -> None:
        """Find the vehicle and its IMU."""
        if isinstance(announcement, VehicleAnnouncement):
            if self.config.vehicle in ("", announcement.source):
                self._vehicles.append(announcement.source)
        elif isinstance(announcement, ImuAnnouncement):
            self._imus.append(announcement)

    def check(self) -> Iterable[str]:
        """Say what is missing, or cannot be what PX4 expects."""
        if len(self._vehicles) != 1:
            found = ", ".join(self._vehicles) or "none"
            yield f"expected one vehicle whose motors to drive, found {found}: set vehicle"
        for each in self._imus:
            if each.orientation != LEVEL:
                yield f"expected an IMU along the body's axes, found {each.source} turned"
        if not self._imus:
            yield "expected an IMU, found none: add one to the vehicle"

    @on(MagneticField)
    def fields(self, event: MagneticField) -> None:
        """Note the newest, for the next sample."""
        self._field = event

    @on(FluidPressure)
    def pressures(self, event: FluidPressure) -> None:
        """Note the newest, for the next sample."""
        self._pressure = event

    @on(NavSatFix)
    def fixes(self, event: NavSatFix) -> None:
        """Note the newest, for the next sample."""
        self._fix = event

    async def run(self) -> None:
        """Give each sample to PX4, and its answer to the motors."""
        from nodes.mavlink.hil import motors, satellites, sensors

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
        """Hang up."""
        if self._wire is not None:
            self._wire.close()

    def _obey(self, armed: bool, commands: tuple[float, ...]) -> None:
        stamp, source, vehicle = self.clock.now(), self.name, self.config.vehicle
        if armed != self._armed:
            self._armed = armed
            self.log.info("PX4 has %s", "armed" if armed else "disarmed")
            kind = Arm if armed else Disarm
            self.commands.send(kind(stamp=stamp, source=source, vehicle=vehicle))
        if armed:
            m1, m2, m3, m4 = commands
            self.setpoints.send(
                MotorSetpoint(
                    stamp=stamp, source=source, vehicle=vehicle,
                    motor1=m1, motor2=m2, motor3=m3, motor4=m4,
                )
            )  # fmt: skip
