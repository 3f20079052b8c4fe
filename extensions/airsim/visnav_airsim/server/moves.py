"""Clients' tasks for vehicles: a single task each, 50 times a second of simulated time.

A task is pure: time and state (``map``, radians) come in, set-points go out. The rules are
AirSim's; docs/methods.md has the differences. Methods that start a task are in `flight`.
"""

from __future__ import annotations

import asyncio
import bisect
import functools
import itertools
import math
from collections.abc import Callable, Sequence
from math import pi
from typing import NamedTuple

import events as ev
from events import Vector3
from events.frames import from_rpy, yaw_of
from runtime.time.clock import SECOND, Clock
from sims.vehicle import State, VehicleParameters
from visnav_airsim.server.vehicles import ServedMultirotor, ServedVehicle

RATE = 50  # updates of each task in a simulated second
HOVER_AFTER = 60_000_000  # ns after a task's last order at which the vehicle holds its place
HOVER_THROTTLE = 9.80665 / (4.0 * 4.18)
"""Hover throttle of AirSim's quadrotor: 1 kg on four rotors of 4.18 N."""

Reply = asyncio.Future[bool]
Order = Callable[..., ev.Command | ev.Setpoint]
"""Factory of an order, from a stamp, a source and the vehicle's name."""
Thrust = Callable[[State], float]  # gives the thrust, 0 to 1 of what all motors can give together
CLOSE = 0.5  # metres from the end within which a vehicle is not steered along the path any more
_WINDOW = 64  # segments ahead among which the vehicle's place is sought, which bounds the work
_SPACING = 0.05  # metres below which the next corner of a path is left out
_STILL = 0.05  # m/s that count as none
_SLOW = 0.2  # m/s with which a path may end: what comes next begins where it ended
_SETTLING = 5  # updates without progress near the end after which a path has ended
_STUCK = 5 * RATE  # updates without progress after which a path has failed
_GAIN = 1.5  # vertical velocity per metre of error, 1/s
_LIFT_GAIN = 4.0  # vertical acceleration per error in velocity, 1/s
_YAW_GAIN = 3.0  # yaw rate per angle of error, 1/s
_FASTEST = 6.0  # m/s at which a height is gone to, as AirSim's controller limits it


class Task(NamedTuple):
    """Task of a vehicle, pure: time and state come in, an order goes out."""

    # Called with the seconds since the start and the vehicle's state in ``map``; returns what to
    # send, `None` for nothing, or how the task has ended.
    steer: Callable[[float, State], Order | bool | None]
    limit: float = math.inf  # seconds at which it ends at the latest
    at_limit: bool = True  # how it has ended then


class Tasks:
    """Running task of each vehicle. A new task ends the older with result `False`.

    Orders are set-points and commands. `HOVER_AFTER` a task's last order, the vehicle is told to
    hover. Disarming ends a task: with `True` if the vehicle was landing.
    """

    def __init__(
        self,
        clock: Clock,
        source: str,
        send: Callable[[ev.Command | ev.Setpoint], None],
        reply_for: Callable[[Reply], Reply],  # returns a task's reply; see `Time.reply_for`
    ) -> None:
        self._clock, self._source, self._send, self._reply_for = clock, source, send, reply_for
        self._slots: dict[str, _Slot] = {}

    def order(self, vehicle: ServedVehicle, order: Order) -> None:
        """Send a command or a set-point to a vehicle, obeyed at once."""
        self._send(order(stamp=self._clock.now(), source=self._source, vehicle=vehicle.name))

    def start(self, vehicle: ServedMultirotor, task: Task) -> Reply:
        """Start a task, arming stopped motors, in place of another; return the reply to come."""
        slot = self._slots.setdefault(vehicle.name, _Slot(vehicle))
        slot.finish(False)
        slot.result = result = asyncio.get_running_loop().create_future()
        if not task.limit > 0.0:
            slot.finish(task.at_limit)
            return self._reply_for(result)
        slot.task, slot.started = task, self._clock.now()
        if not vehicle.motors_on:
            vehicle.motors_on = True
            self._order(slot, ev.Arm)
        elif slot.is_landing:  # until it hovers, it would refuse set-points
            self._order(slot, ev.Hover)
        return self._reply_for(result)

    def cancel(self, vehicle: ServedVehicle) -> None:
        """End the task of a vehicle, if any, with result `False`."""
        if slot := self._slots.get(vehicle.name):
            slot.finish(False)

    def handle_event(self, vehicle: ServedMultirotor, event: ev.VehicleEvent) -> None:
        """Update the state of a vehicle's motors from an event."""
        if isinstance(event, ev.Armed):
            vehicle.motors_on = True
        elif isinstance(
            event, ev.Disarmed
        ):  # its task ends with the next update, unless armed again
            vehicle.motors_on = False
            if slot := self._slots.get(vehicle.name):
                slot.ordered = None

    def update(self, stamp: int) -> None:
        """Send the next set-points of all tasks."""
        for slot in self._slots.values():
            if not slot.vehicle.motors_on:
                slot.finish(slot.is_landing)
                slot.is_landing = False
            if slot.task is not None:
                self._steer(slot, slot.task, stamp)
            is_over = slot.ordered is not None and stamp - slot.ordered >= HOVER_AFTER
            if is_over and not (slot.task and slot.is_landing):
                self._order(slot, ev.Hover)

    def _steer(self, slot: _Slot, task: Task, stamp: int) -> None:
        elapsed = (stamp - slot.started) / SECOND
        if elapsed >= task.limit:
            slot.finish(task.at_limit)
            return
        order = task.steer(elapsed, slot.vehicle.state())
        if isinstance(order, bool):
            slot.finish(order)
        elif order is not None:
            self._order(slot, order)

    def _order(self, slot: _Slot, order: Order) -> None:
        stamp = self._clock.now()
        event = order(stamp=stamp, source=self._source, vehicle=slot.vehicle.name)
        slot.is_landing = isinstance(event, ev.Land)
        slot.ordered = stamp if slot.is_landing or isinstance(event, ev.Setpoint) else None
        self._send(event)


class _Slot:
    def __init__(self, vehicle: ServedMultirotor) -> None:
        self.vehicle = vehicle
        self.task: Task | None = None
        self.result: asyncio.Future[bool] | None = None
        self.started = 0
        # When it was sent what it still follows; `None` if it hovers, or stands.
        self.ordered: int | None = None
        self.is_landing = False

    def finish(self, succeeded: bool) -> None:
        """End the task, if any."""
        if self.result is not None and not self.result.done():
            self.result.set_result(succeeded)
        self.task = self.result = None


def lookahead_of(lookahead: float, adaptive: float, velocity: float) -> float:
    """Return the look-ahead distance (m), by default for a negative one; `ValueError` for zero."""
    if lookahead == 0.0:
        raise ValueError("lookahead distance cannot be 0")
    if lookahead > 0.0:
        return lookahead
    return max(velocity * 0.02 * (30.0 if adaptive > 0.0 else 40.0), 0.75)


def braked(velocity: float, remaining: float) -> float:
    """Return the speed (m/s), falling to 1 m/s by 3 m/s² (AirSim brakes later, and overshoots)."""
    return min(velocity, math.sqrt(1.0 + 2.0 * 3.0 * max(remaining - CLOSE, 0.0)))


class PathFollower:
    """A vehicle's progress along a path, never backwards, and the point running ahead.

    "Pure pursuit" (R. C. Coulter, CMU-RI-TR-92-01, 1992), with look-ahead and end as in AirSim's
    ``moveOnPath``.

    Args:
        path: Corners, metres; at least one. The first is where the vehicle starts.
        lookahead: Metres along the path from the vehicle's place to the lookahead point.
    """

    def __init__(self, path: Sequence[Vector3], lookahead: float) -> None:
        corners = [path[0]]
        for point in path[1:-1]:
            if math.dist(point, corners[-1]) >= _SPACING:
                corners.append(point)
        if len(path) > 1:
            corners.append(path[-1])
        self._corners = corners
        steps = itertools.starmap(math.dist, itertools.pairwise(corners))
        self._along = [0.0, *itertools.accumulate(steps)]
        self._lookahead = lookahead
        self.length = self._along[-1]  # of the path, metres
        self.progress = 0.0  # metres along the path up to the point next to the vehicle
        self.is_last = False  # whether the lookahead point is at the end of the path

    def advance(self, position: Vector3) -> Vector3:
        """Advance by a vehicle's position (m), and return the lookahead point."""
        self._advance_progress(position)
        ahead = min(self.progress + self._lookahead, self.length)
        # Round a sharp corner, it may be where the vehicle is already: then it runs on, up to 5 m.
        for _ in range(50):
            if ahead >= self.length or math.dist(self._at(ahead), position) >= CLOSE:
                break
            ahead = min(ahead + 0.1, self.length)
        self.is_last = ahead >= self.length
        return self._at(ahead)

    def _advance_progress(self, position: Vector3) -> None:
        along, corners = self._along, self._corners
        first = max(bisect.bisect_right(along, self.progress) - 1, 0)
        farthest = self.progress + 2.0 * max(self._lookahead, CLOSE)
        nearest = math.inf
        closest = self.progress
        for index in range(first, min(first + _WINDOW, len(corners) - 1)):
            start, length = along[index], along[index + 1] - along[index]
            if start > farthest:
                break
            if length <= 0.0:
                continue
            a, b = corners[index], corners[index + 1]
            inner = sum((q - p) * (r - p) for p, q, r in zip(a, b, position, strict=True))
            place = start + min(max(inner / length, 0.0), length)
            place = min(max(place, self.progress), farthest)
            apart = math.dist(self._at(place), position)
            if apart < nearest:
                nearest, closest = apart, place
        self.progress = closest

    def _at(self, place: float) -> Vector3:
        """Return the point at some metres along the path."""
        along, corners = self._along, self._corners
        index = min(bisect.bisect_right(along, place), len(along) - 1) - 1
        if index < 0 or along[index + 1] <= along[index]:
            return corners[-1]
        share = min((place - along[index]) / (along[index + 1] - along[index]), 1.0)
        x, y, z = (p + share * (q - p) for p, q in zip(*corners[index : index + 2], strict=True))
        return x, y, z


class Heading:
    """Direction of the view during a move.

    Args:
        follows: Look where the vehicle goes (AirSim's ``ForwardOnly``) plus the angle, unless a
            rate.
        is_rate: Whether the angle is a rate, in radians per second.
    """

    def __init__(self, follows: bool = False, is_rate: bool = True, angle: float = 0.0) -> None:
        self._follows, self._is_rate, self._angle = follows, is_rate, angle

    def rate(self, state: State, x: float, y: float) -> float:
        """Return the yaw rate (rad/s) for a vehicle moving along (x, y)."""
        if self._is_rate:
            return self._angle
        if self._follows and math.hypot(x, y) <= CLOSE:
            return 0.0
        course = math.atan2(y, x) if self._follows else 0.0
        return _YAW_GAIN * wrapped(course + self._angle - yaw_of(state.orientation))


def by_velocity(velocity: Vector3, heading: Heading, duration: float) -> Task:
    """Move at a velocity (m/s) for some seconds."""
    x, y, _ = velocity
    return Task(lambda _, state: _velocity(velocity, heading.rate(state, x, y)), duration)


def by_velocity_at(x: float, y: float, height: float, heading: Heading, duration: float) -> Task:
    """Move at a horizontal velocity (m/s), and at a height (z, m), for some seconds."""

    def steer(_: float, state: State) -> Order:
        return _velocity((x, y, _to_height(state, height)), heading.rate(state, x, y))

    return Task(steer, duration, duration > 0.0)


def along_path(
    path: Sequence[Vector3], speed: float, lookahead: float, heading: Heading, timeout: float
) -> Task:
    """Fly along a path (m) from its first point, where the vehicle is, to its last.

    It has succeeded when progress has stopped within 0.5 m of the end at hardly any speed; failed
    after 5 s without progress elsewhere (where AirSim waits for the timeout), or at the timeout.
    """
    follower, least, idle = PathFollower(path, lookahead), min(_STILL, 0.1 * speed) / RATE, 0

    def steer(_: float, state: State) -> Order | bool:
        nonlocal idle
        before = follower.progress
        target = follower.advance(state.position)
        x, y, z = (a - b for a, b in zip(target, state.position, strict=True))
        apart, remaining = math.hypot(x, y, z), follower.length - follower.progress
        is_near = follower.is_last and apart <= CLOSE
        idle = idle + 1 if follower.progress - before <= least else 0
        is_there = is_near or not remaining
        is_slow = math.hypot(*state.velocity) <= _SLOW
        if idle > (_SETTLING if is_there and is_slow else _STUCK):
            return is_there
        share = 0.0 if is_near else braked(speed, remaining) / max(apart, CLOSE)
        down = _to_height(state, target[2], speed) if abs(z) <= CLOSE else z * share
        return _velocity((x * share, y * share, down), heading.rate(state, x, y))

    return Task(steer, timeout, at_limit=False)


def landing(timeout: float) -> Task:
    """Descend at 0.2 m/s until stopped for 0.2 s, then stop the motors."""
    idle = 0

    def steer(_: float, state: State) -> Order | None:
        nonlocal idle
        if idle > 10:
            return None
        idle = idle + 1 if state.velocity[2] <= _STILL else 0
        return ev.Land if idle > 10 else _velocity((0.0, 0.0, 0.2), 0.0)

    return Task(steer, timeout, at_limit=False)


def to_yaw(place: Vector3, yaw: float, margin: float, timeout: float) -> Task:
    """Hold a place (m), and turn to a yaw (rad), to within a margin (rad)."""

    def steer(_: float, state: State) -> Order | bool:
        error = abs(wrapped(yaw - yaw_of(state.orientation)))
        if error <= margin and abs(state.angular_velocity[2]) <= 0.01:
            return True
        return functools.partial(ev.PositionSetpoint, position=place, yaw=wrapped(yaw))

    return Task(steer, timeout, at_limit=False)


def by_yaw_rate(place: Vector3, yaw: float, rate: float, duration: float) -> Task:
    """Hold a place (m), and turn from a yaw at a rate (rad/s) for some seconds."""
    turn = functools.partial(ev.PositionSetpoint, position=place, yaw_rate=rate)
    return Task(
        lambda elapsed, _: functools.partial(turn, yaw=wrapped(yaw + rate * elapsed)), duration
    )


def by_attitude(
    roll: float, pitch: float, yaw: float, yaw_rate: float, thrust: Thrust, duration: float
) -> Task:
    """Hold an attitude, whose yaw turns on at a rate (rad/s), for some seconds."""

    def steer(elapsed: float, state: State) -> Order:
        attitude = from_rpy(roll, pitch, yaw + yaw_rate * elapsed)
        return functools.partial(ev.AttitudeSetpoint, orientation=attitude, thrust=thrust(state))

    return Task(steer, duration)


def by_rates(rates: Vector3, thrust: Thrust, duration: float) -> Task:
    """Turn at body rates (rad/s) for some seconds."""
    order = functools.partial(ev.BodyRateSetpoint, angular_velocity=rates)
    return Task(lambda _, state: functools.partial(order, thrust=thrust(state)), duration)


def at_height(parameters: VehicleParameters, height: float) -> Thrust:
    """Return the thrust function to bring a vehicle to a height (z, m), and hold there."""

    def thrust(state: State) -> float:
        down = _LIFT_GAIN * (_to_height(state, height) - state.velocity[2])
        _, x, y, _ = state.orientation
        upright = max(1.0 - 2.0 * (x * x + y * y), 0.3)  # the part of it against the weight
        share = parameters.hover_thrust * (1.0 - down / parameters.gravity) / upright
        return min(max(share, 0.0), 1.0)

    return thrust


def share_of(parameters: VehicleParameters, throttle: float) -> float:
    """Return the share of our motors' thrust for AirSim's throttle: as a multiple of weight."""
    return min(max(throttle, 0.0), 1.0) * parameters.hover_thrust / HOVER_THROTTLE


def wrapped(angle: float) -> float:
    """Return an angle in [-π, π)."""
    return (angle + pi) % (2.0 * pi) - pi


def _velocity(velocity: Vector3, yaw_rate: float) -> Order:
    return functools.partial(ev.VelocitySetpoint, velocity=velocity, yaw_rate=yaw_rate)


def _to_height(state: State, height: float, fastest: float = _FASTEST) -> float:
    """Return the vertical velocity (m/s, down) towards a height (z, m)."""
    return min(max(_GAIN * (height - state.position[2]), -fastest), fastest)
