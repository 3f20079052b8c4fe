"""Commands and phases of a vehicle: arming, take-off, flight, landing.

A pure state machine on top of the cascade in `control`. It never looks at a clock: time comes with
each update.

    phase       on                      goes to       and sends
    DISARMED    Arm                     ARMED         Armed
    DISARMED    Takeoff                 TAKING_OFF    Armed
    ARMED       Takeoff                 TAKING_OFF
    ARMED       a set-point             FLYING
    TAKING_OFF  the altitude reached    FLYING        TakenOff
    TAKING_OFF  Hover                   FLYING
    TAKING_OFF  Land                    LANDING
    FLYING      Land                    LANDING
    LANDING     Hover                   FLYING
    LANDING     the ground felt         DISARMED      Landed, Disarmed
    TAKING_OFF  Teleport                FLYING
    LANDING     Teleport                FLYING
    (all)       Disarm, Reset           DISARMED      Disarmed

Disarm stops the motors in every phase, in the air too. Whoever flies and is teleported holds the
place where it is then.
"""

from __future__ import annotations

import enum
from math import sqrt

from events import (
    Arm,
    Armed,
    AttitudeSetpoint,
    BodyRateSetpoint,
    Disarm,
    Disarmed,
    Event,
    Hover,
    Land,
    Landed,
    MotorSetpoint,
    PositionSetpoint,
    Reset,
    TakenOff,
    Takeoff,
    Teleport,
    Vector3,
    VehicleEvent,
    VelocitySetpoint,
)
from events.frames import yaw_of
from sims.vehicle.control import Controller, Motors, fault
from sims.vehicle.gains import Gains, Limits
from sims.vehicle.model import VehicleParameters
from sims.vehicle.physics import State

_STOPPED: Motors = (0.0, 0.0, 0.0, 0.0)
_IDLE: Motors = (0.05, 0.05, 0.05, 0.05)

_FIRST_DT = 0.0025
"""Seconds assumed before the first update, when there is no last one to count from."""


class Phase(enum.Enum):
    """Phases of a flight."""

    DISARMED = enum.auto()
    ARMED = enum.auto()
    TAKING_OFF = enum.auto()
    FLYING = enum.auto()
    LANDING = enum.auto()


FARTHEST, FASTEST, FASTEST_TURN = 1e4, 50.0, 50.0
"""Most that a vehicle may be teleported with: m, m/s, rad/s; physics would not bear much more."""


def teleport_fault(event: Teleport) -> str | None:
    """Return what is wrong with a `Teleport`, None if nothing is."""
    for field, limit, unit in (
        ("position", FARTHEST, "m"),
        ("linear_velocity", FASTEST, "m/s"),
        ("angular_velocity", FASTEST_TURN, "rad/s"),
    ):
        found = getattr(event, field)
        if max(map(abs, found)) > limit:
            return f"Teleport.{field}: expected numbers up to {limit:g} {unit}, found {found}"
    return None


_NO_SETPOINTS = {
    Phase.DISARMED: "disarmed",
    Phase.TAKING_OFF: "taking off",
    Phase.LANDING: "landing",
}


class Autopilot:
    """Turns commands into motor commands, at the rate of its updates.

    The rules, beyond the table above:

    - A set-point is refused while disarmed, and during take-off and landing: set-points are sent
      many times a second, and those under way must not undo a command that was sent once.
      `Hover` ends either manoeuvre, `Land` ends a take-off; then set-points count again.
    - Armed on the ground, a set-point starts the flight, without a `TakenOff`.
    - A velocity, attitude, body-rate or motor set-point whose stamp is older than
      `setpoint_timeout` is replaced by `Hover`: with a lost link the vehicle must not fly on. A
      position set-point holds for ever, since it ends at a position.
    - `Land` stops first, then goes down at `descent`.

    Args:
        parameters: Parameters of the vehicle.
        gains: Gains of the cascade.
        limits: Limits of the flight.
        setpoint_timeout: Age at which such set-points end, seconds.
        climb: Metres per second during take-off.
        descent: Metres per second during landing.

    Attributes:
        phase: Present phase of the flight.
    """

    def __init__(
        self,
        parameters: VehicleParameters,
        gains: Gains | None = None,
        limits: Limits | None = None,
        *,
        setpoint_timeout: float = 0.5,
        climb: float = 1.0,
        descent: float = 0.5,
    ) -> None:
        self.phase = Phase.DISARMED
        self._controller = Controller(parameters, gains, limits)
        self._timeout_ns = round(setpoint_timeout * 1e9)
        self._climb = climb
        self._descent = descent
        self._events: list[type[VehicleEvent]] = []
        self._order: Event | None = None
        self._expires_ns: int | None = None
        self._last_ns: int | None = None
        # Take-off: where it goes up, how far it is told to be by now, and how fast.
        self._place: Vector3 = (0.0, 0.0, 0.0)
        self._yaw = 0.0
        self._to_climb = 0.0
        self._speed = 0.0
        # Landing: whether it has stopped and goes down, and since when it stands on something.
        self._descending = False
        self._standing_ns: int | None = None

    def command(self, event: Event) -> str | None:
        """Take an order or a set-point; it acts with the next update.

        Returns:
            None if it is obeyed, else why not.
        """
        reason = self._refusal(event)
        if reason is None:
            self._accept(event)
        return reason

    def update(self, stamp_ns: int, state: State, touching: bool) -> Motors:
        """Return the motor commands for now.

        Args:
            stamp_ns: Nanoseconds on the run's clock; not before the last update's.
            state: State of the vehicle at that time.
            touching: Whether it touches anything.
        """
        last = self._last_ns
        self._last_ns = stamp_ns
        dt = _FIRST_DT if last is None or stamp_ns <= last else (stamp_ns - last) * 1e-9
        phase = self.phase
        if phase is Phase.DISARMED:
            return _STOPPED
        if self._order is not None:
            self._begin(self._order, state)
            self._order = None
        if phase is Phase.FLYING:
            if self._expires_ns is not None and stamp_ns > self._expires_ns:
                self._expires_ns = None
                self._controller.brake(state)
        elif phase is Phase.ARMED:
            return _IDLE
        elif phase is Phase.TAKING_OFF:
            self._take_off(state, dt)
        elif self._land(stamp_ns, state, touching):
            return _STOPPED
        return self._controller.update(state, dt)

    def take_events(self) -> list[type[VehicleEvent]]:
        """Return what has happened since the last call (`Armed`, `TakenOff`, …), oldest first."""
        events = self._events
        if events:
            self._events = []
        return events

    def _refusal(self, event: Event) -> str | None:
        """Return why a command is not obeyed now, None if it is."""
        phase = self.phase
        grounded = phase in (Phase.DISARMED, Phase.ARMED)
        reason = None
        match event:
            case (
                PositionSetpoint()
                | VelocitySetpoint()
                | AttitudeSetpoint()
                | BodyRateSetpoint()
                | MotorSetpoint()
            ):
                reason = _NO_SETPOINTS.get(phase) or fault(event)
            case Arm():
                reason = "already armed" if phase is not Phase.DISARMED else None
            case Disarm():
                reason = "already disarmed" if phase is Phase.DISARMED else None
            case Takeoff():
                if not grounded:
                    reason = "already in the air"
                elif not event.altitude > 0.0:
                    reason = f"Takeoff.altitude: expected a number > 0, found {event.altitude}"
            case Land():
                if grounded:
                    reason = "not in the air"
                elif phase is Phase.LANDING:
                    reason = "already landing"
            case Hover():
                reason = "not in the air" if grounded else None
            case Teleport():
                reason = teleport_fault(event)
            case Reset():
                reason = None
            case _:
                reason = f"{type(event).__name__} is no command of a vehicle"
        return reason

    def _accept(self, event: Event) -> None:
        match event:
            case Arm():
                self._arm()
                return
            case Disarm():
                self._disarm()
                return
            case Reset():
                if self.phase is not Phase.DISARMED:
                    self._disarm()
                return
            case Teleport():
                self._controller.reset()
                if self.phase in (Phase.DISARMED, Phase.ARMED):
                    return
                self.phase = Phase.FLYING
            case Takeoff():
                if self.phase is Phase.DISARMED:
                    self._arm()
                self.phase = Phase.TAKING_OFF
            case Land():
                self.phase = Phase.LANDING
            case _:
                self.phase = Phase.FLYING
        self._order = event

    def _arm(self) -> None:
        self.phase = Phase.ARMED
        self._controller.reset()
        self._events.append(Armed)

    def _disarm(self) -> None:
        self.phase = Phase.DISARMED
        self._order = None
        self._events.append(Disarmed)

    def _begin(self, order: Event, state: State) -> None:
        """Start what was ordered from where the vehicle is now."""
        self._expires_ns = None
        match order:
            case PositionSetpoint():
                self._controller.follow(order, state)
            case VelocitySetpoint() | AttitudeSetpoint() | BodyRateSetpoint() | MotorSetpoint():
                self._controller.follow(order, state)
                self._expires_ns = order.stamp + self._timeout_ns
            case Takeoff():
                self._yaw = yaw_of(state.orientation)
                self._to_climb = order.altitude
                self._speed = 0.0
                x, y, z = state.position
                self._place = (x, y, z - order.altitude)
            case Land():
                self._descending = False
                self._standing_ns = None
                self._controller.brake(state)
            case Hover() | Teleport():
                self._controller.brake(state)

    def _take_off(self, state: State, dt: float) -> None:
        """Move the place to be at up, gently at both ends."""
        acceleration = self._climb  # reaches the climb speed in a second
        self._speed = min(
            self._speed + acceleration * dt,
            self._climb,
            sqrt(2.0 * acceleration * self._to_climb),
        )
        self._to_climb = max(0.0, self._to_climb - self._speed * dt)
        x, y, z = self._place
        self._controller.hold((x, y, z + self._to_climb), (0.0, 0.0, -self._speed), self._yaw)
        vx, vy, vz = state.velocity
        if (
            abs(state.position[2] - z) < 0.1
            and self._to_climb < 0.1
            and vx * vx + vy * vy + vz * vz < 0.2 * 0.2
        ):
            self._controller.hold(self._place, (0.0, 0.0, 0.0), self._yaw)
            self.phase = Phase.FLYING
            self._events.append(TakenOff)

    def _land(self, stamp_ns: int, state: State, touching: bool) -> bool:
        """Stop, go down, and return True once the vehicle stands and is disarmed."""
        vx, vy, vz = state.velocity
        if not self._descending and vx * vx + vy * vy < 0.2 * 0.2:
            self._descending = True
            self._controller.brake(state, self._descent)
        if not touching or abs(vz) > 0.1:
            self._standing_ns = None
        elif self._standing_ns is None:
            self._standing_ns = stamp_ns
        elif stamp_ns - self._standing_ns >= 200_000_000:
            self._events.append(Landed)
            self._disarm()
            return True
        return False
