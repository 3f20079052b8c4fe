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
place where it is then. Whether places and paths are free is checked in the world before a run; they
are metres NED, of the origin of ``base_link``.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from math import sqrt
from typing import Any, get_args

import mujoco
import numpy as np

import events as ev
from events import Vector3
from events.frames import flip_yz, yaw_of
from sims.ray_casting import cast_ray
from sims.vehicle.control import Controller, Motors, Setpoint, fault
from sims.vehicle.physics import State
from sims.vehicle.position import Gains, Limits
from sims.vehicle.simulation import STANDING_HEIGHT, VehicleParameters, mover_of, name_of

_STOPPED: Motors = (0.0, 0.0, 0.0, 0.0)
_IDLE: Motors = (0.05, 0.05, 0.05, 0.05)

_FIRST_DT = 0.0025  # time step assumed at the first update, seconds


class Phase(enum.Enum):
    """Phases of a flight."""

    DISARMED = enum.auto()
    ARMED = enum.auto()
    TAKING_OFF = enum.auto()
    FLYING = enum.auto()
    LANDING = enum.auto()


FARTHEST, FASTEST, FASTEST_TURN = 1e4, 50.0, 50.0
"""Limits of a teleport: m, m/s, rad/s; the physics would not bear much more."""


def teleport_fault(event: ev.Teleport) -> str | None:
    """Return the error in a `Teleport`, or None."""
    for field, limit, unit in (
        ("position", FARTHEST, "m"),
        ("linear_velocity", FASTEST, "m/s"),
        ("angular_velocity", FASTEST_TURN, "rad/s"),
    ):
        vector = getattr(event, field)
        if max(map(abs, vector)) > limit:
            return f"Teleport.{field}: expected numbers up to {limit:g} {unit}, found {vector}"
    return None


_ON_GROUND = (Phase.DISARMED, Phase.ARMED)
_BUSY = {
    Phase.DISARMED: "disarmed",
    Phase.TAKING_OFF: "taking off",
    Phase.LANDING: "landing",
}
_REFUSALS: dict[type[ev.Event], dict[Phase, str]] = {
    ev.Arm: dict.fromkeys(set(Phase) - {Phase.DISARMED}, "already armed"),
    ev.Disarm: {Phase.DISARMED: "already disarmed"},
    ev.Takeoff: dict.fromkeys(set(Phase) - {*_ON_GROUND}, "already in the air"),
    ev.Land: dict.fromkeys(_ON_GROUND, "not in the air") | {Phase.LANDING: "already landing"},
    ev.Hover: dict.fromkeys(_ON_GROUND, "not in the air"),
    ev.Teleport: {},
    ev.Reset: {},
    **dict.fromkeys(get_args(Setpoint), _BUSY),
}
"""Orders that a vehicle knows, and why it refuses them in some phases."""


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
    """

    def __init__(
        self,
        parameters: VehicleParameters,
        gains: Gains | None = None,
        limits: Limits | None = None,
        *,
        setpoint_timeout: float = 0.5,  # age at which such set-points end, seconds
        climb: float = 1.0,  # metres per second during take-off
        descent: float = 0.5,  # metres per second during landing
    ) -> None:
        self.phase = Phase.DISARMED
        self._controller = Controller(parameters, gains, limits)
        self._timeout_ns = round(setpoint_timeout * 1e9)
        self._climb = climb
        self._descent = descent
        self._events: list[type[ev.VehicleEvent]] = []
        self._order: ev.Event | None = None
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

    def command(self, event: ev.Event) -> str | None:
        """Take an order or a set-point for the next update, or return the reason for refusal."""
        reason = self._refusal(event)
        if reason is None:
            self._accept(event)
        return reason

    def update(self, stamp_ns: int, state: State, touching: bool) -> Motors:
        """Return the motor commands at a run's time (ns) not before the last update's."""
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

    def take_events(self) -> list[type[ev.VehicleEvent]]:
        """Return the events since the last call (`Armed`, `TakenOff`, …), oldest first."""
        events = self._events
        if events:
            self._events = []
        return events

    def _refusal(self, event: ev.Event) -> str | None:
        """Return the reason to refuse a command now, or None."""
        if type(event) not in _REFUSALS:
            return f"{type(event).__name__} is no command of a vehicle"
        if reason := _REFUSALS[type(event)].get(self.phase):
            return reason
        if isinstance(event, Setpoint):
            return fault(event)
        if isinstance(event, ev.Takeoff) and not event.altitude > 0.0:
            return f"Takeoff.altitude: expected a number > 0, found {event.altitude}"
        return teleport_fault(event) if isinstance(event, ev.Teleport) else None

    def _accept(self, event: ev.Event) -> None:
        match event:
            case ev.Arm():
                self._arm()
            case ev.Disarm() | ev.Reset():
                if self.phase is not Phase.DISARMED:
                    self._disarm()
            case ev.Teleport():
                self._controller.reset()
                if self.phase not in _ON_GROUND:
                    self.phase, self._order = Phase.FLYING, event
            case ev.Takeoff():
                if self.phase is Phase.DISARMED:
                    self._arm()
                self.phase, self._order = Phase.TAKING_OFF, event
            case ev.Land():
                self.phase, self._order = Phase.LANDING, event
            case _:
                self.phase, self._order = Phase.FLYING, event

    def _arm(self) -> None:
        self.phase = Phase.ARMED
        self._controller.reset()
        self._events.append(ev.Armed)

    def _disarm(self) -> None:
        self.phase = Phase.DISARMED
        self._order = None
        self._events.append(ev.Disarmed)

    def _begin(self, order: ev.Event, state: State) -> None:
        self._expires_ns = None
        if isinstance(order, Setpoint):
            self._controller.follow(order, state)
            if not isinstance(order, ev.PositionSetpoint):
                self._expires_ns = order.stamp + self._timeout_ns
        match order:
            case ev.Takeoff():
                self._yaw = yaw_of(state.orientation)
                self._to_climb = order.altitude
                self._speed = 0.0
                x, y, z = state.position
                self._place = (x, y, z - order.altitude)
            case ev.Land():
                self._descending = False
                self._standing_ns = None
                self._controller.brake(state)
            case ev.Hover() | ev.Teleport():
                self._controller.brake(state)

    def _take_off(self, state: State, dt: float) -> None:
        acceleration = self._climb  # reaches the climb speed in a second
        self._speed = min(
            self._speed + acceleration * dt, self._climb, sqrt(2.0 * acceleration * self._to_climb)
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
            self._events.append(ev.TakenOff)

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
            self._events.append(ev.Landed)
            self._disarm()
            return True
        return False


DEPTH = 0.02  # tolerated depth in a solid, metres: standing feet, a brushing propeller
FALL = 0.05  # greatest height above the ground of a standing vehicle, metres
_SOLIDS = np.array([1, 0, 0, 0, 0, 0], np.uint8)  # groups of geoms hit by rays: 0 alone


class Clearance:
    """Obstacles to a vehicle, at a place or on a straight line."""

    def __init__(self, model: mujoco.MjModel, name: str) -> None:
        self._model = model
        self._data: Any = mujoco.MjData(model)
        self._body = model.body(f"{name}/base_link").id
        pose = int(model.joint(f"{name}/free").qposadr[0])
        self._place = self._data.qpos[pose : pose + 3]
        mujoco.mj_fwdPosition(model, self._data)
        self._movers = [mover_of(model, geom) for geom in range(model.ngeom)]
        solid = (model.geom_contype | model.geom_conaffinity) != 0
        # Group 1: what a ray must not hit, which is only to be seen or moves.
        self._no_hits = np.where(solid & (np.array(self._movers) == ""), 0, 1)

    def at(self, place: Vector3, *, now: bool = False) -> str:
        """Return the obstacle's name for a level vehicle at a place (m NED); empty for none.

        Args:
            now: At the start, when other vehicles and self-moving bodies are where they begin.
        """
        self._place[:] = flip_yz(place)
        mujoco.mj_fwdPosition(self._model, self._data)
        contact, body_of = self._data.contact, self._model.geom_bodyid
        deepest, name = 0.0, ""
        for pair, distance in zip(contact.geom.tolist(), contact.dist.tolist(), strict=True):
            own = [geom for geom in pair if body_of[geom] == self._body]
            other = pair[0] if own[-1:] == pair[1:] else pair[1]
            if len(own) != 1 or (self._movers[other] and not now):
                continue
            if distance < min(deepest, 0.0 if self._movers[other] else -DEPTH):
                deepest = distance
                name = self._name_of(other)
        return name

    def between(self, start: Vector3, end: Vector3) -> str:
        """Return the name of the first solid on a line; empty for none."""
        geom, _ = self._ray(start, [b - a for a, b in zip(start, end, strict=True)])
        return "" if geom is None else self._name_of(geom)

    def ground_below(self, place: Vector3) -> float | None:
        """Return metres down to the next solid from a vehicle's feet; `None` if there is none."""
        _, distance = self._ray(place, (0.0, 0.0, 1e4))
        return None if distance is None else distance - STANDING_HEIGHT

    def _ray(self, start: Vector3, way: Sequence[float]) -> tuple[int | None, float | None]:
        length = math.hypot(*way)
        if length < 1e-6:
            return None, None
        x, y, z = (component / length for component in way)
        origin, direction = np.array(flip_yz(start)), np.array(flip_yz((x, y, z)))
        groups = self._model.geom_group.copy()
        self._model.geom_group[:] = self._no_hits
        try:
            distance, geom = cast_ray(
                self._model, self._data, origin, direction, _SOLIDS, self._body
            )
        finally:
            self._model.geom_group[:] = groups
        return (None, None) if geom < 0 or distance >= length else (geom, distance)

    def _name_of(self, geom: int) -> str:
        model = self._model
        if self._movers[geom]:
            return self._movers[geom]
        kind = "the ground" if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE else ""
        name = name_of(model, geom)
        if kind and name and name != "world":
            return f"{kind} ({name})"
        return kind or name or f"geom {geom}"


def trouble_at_start(world: Clearance, place: Vector3) -> str:
    """Return the reason against starting at a position; empty if free."""
    if obstacle := world.at(place, now=True):
        return f"expected a free place to start at, found {show(place)} in {obstacle}"
    if world.ground_below(place) is None:
        return f"expected ground below the start, found none at {show(place)}: outside the world"
    return ""


def trouble_on_path(
    world: Clearance, start: Vector3, waypoints: Iterable[Vector3], margin: float = 0.0
) -> str:
    """Return the reason against flying from point to point; empty if free.

    Args:
        start: Position of the vehicle, which first climbs to the height of the first waypoint.
        margin: Metres that it moves to and fro along each axis before it sets off.
    """
    return next(_troubles(world, start, tuple(waypoints), margin), "")


def _troubles(
    world: Clearance, start: Vector3, waypoints: Sequence[Vector3], margin: float
) -> Iterator[str]:
    for number, place in enumerate(waypoints):
        if obstacle := world.at(place):
            down = ": heights are negative, z is down" if obstacle.startswith("the ground") else ""
            where = f"waypoints[{number}]: expected a free place"
            yield f"{where}, found {show(place)} in {obstacle}{down}"
    if not waypoints:
        return
    above = (start[0], start[1], waypoints[0][2])
    for axis in range(3) if margin else ():
        for side in (-margin, margin):
            x, y, z = (value + side * (k == axis) for k, value in enumerate(above))
            if obstacle := world.at((x, y, z)):
                yield (
                    f"excitation: expected {margin:g} m of free room about {show(above)}, found "
                    f"{obstacle} at {show((x, y, z))}"
                )
    for number, (before, place) in enumerate(pairwise([start, above, *waypoints])):
        if obstacle := world.between(before, place):
            yield (
                f"waypoints[{max(number - 1, 0)}]: expected a free way there, found {obstacle} "
                f"between {show(before)} and {show(place)}"
            )


def show(place: Vector3) -> str:
    """Return a place in the notation of a configuration file."""
    return f"[{', '.join(f'{component + 0.0:g}' for component in place)}]"
