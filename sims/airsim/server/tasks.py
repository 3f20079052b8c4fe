"""Runs the tasks that clients give to vehicles: one each, 50 times a second of simulated time.

What a task does is in `moves`; which methods start one is in `flight`.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

from events import Arm, Armed, Command, Disarmed, Hover, Land, Setpoint, VehicleEvent
from runtime.time.schedule import SECOND
from sims.airsim.server.methods import RpcError
from sims.airsim.server.vehicles import ServedMultirotor
from sims.vehicle import State

if TYPE_CHECKING:
    from sims.airsim.server.node import AirsimServer

Reply = asyncio.Future[bool]

RATE = 50
"""Updates of each task in a simulated second."""
HOVER_AFTER = 60_000_000
"""Nanoseconds after a task's last order at which the vehicle stops and holds its place."""

Order = Callable[..., Command | Setpoint]
"""Makes what is sent to the vehicle of a stamp, a source and the vehicle's name."""


class Task(NamedTuple):
    """What a vehicle is to do; it is pure: time and state come in, an order goes out.

    Attributes:
        steer: Called with the seconds since the start and the vehicle's state in ``map``; returns
            what to send, `None` for nothing, or how the task has ended.
        limit: Seconds at which it ends at the latest.
        at_limit: How it has ended then.
    """

    steer: Callable[[float, State], Order | bool | None]
    limit: float = math.inf
    at_limit: bool = True


class Tasks:
    """The running task of each vehicle. A new one ends the older, whose result is `False`.

    A task reaches its vehicle by set-points and commands only. After its last order has stood for
    `HOVER_AFTER`, the vehicle is told to hover. A task ends when its vehicle is disarmed: with
    `True` if it was landing.
    """

    def __init__(self, server: AirsimServer) -> None:
        self._server = server
        self._slots: dict[str, _Slot] = {}

    def commanded(self, name: str) -> ServedMultirotor:
        """Return a vehicle that clients may command.

        Raises:
            RpcError: They may not, where AirSim would do nothing, or wait for ever; or there is
                none of that name.
        """
        vehicle = self._server.find_multirotor(name)
        if not vehicle.api_control:
            raise RpcError(
                f"vehicle '{vehicle.name}' is not under API control: call enableApiControl first"
            )
        if not vehicle.armed:
            raise RpcError(f"vehicle '{vehicle.name}' is disarmed: call armDisarm first")
        return vehicle

    def start(self, vehicle: ServedMultirotor, task: Task) -> Reply:
        """Start a task now, and return the reply to come; its first order is the next update's.

        The older task of the vehicle, if any, is cancelled first. A vehicle whose motors are
        stopped is armed; whether the client may is asked before.
        """
        slot = self._slots.setdefault(vehicle.name, _Slot(vehicle))
        slot.finish(False)
        slot.result = result = asyncio.get_running_loop().create_future()
        if not task.limit > 0.0:
            slot.finish(task.at_limit)
            return self._server.time.owed(result)
        slot.task, slot.started = task, self._server.clock.now()
        if not vehicle.motors_on:
            vehicle.motors_on = True
            self._send(slot, Arm)
        elif slot.is_landing:  # until it hovers, it would refuse set-points
            self._send(slot, Hover)
        return self._server.time.owed(result)

    def cancel(self, vehicle: str) -> None:
        """End the task of a vehicle, if it has one; its result is `False`."""
        if slot := self._slots.get(vehicle):
            slot.finish(False)

    def note(self, event: VehicleEvent) -> None:
        """Take notice of what happened to a vehicle."""
        vehicle = self._server.vehicles.get(event.source)
        if not isinstance(vehicle, ServedMultirotor):
            return
        if isinstance(event, Armed):
            vehicle.motors_on = True
        elif isinstance(event, Disarmed):  # its task ends with the next update, unless armed again
            vehicle.motors_on = False
            if slot := self._slots.get(vehicle.name):
                slot.ordered = None

    def update(self, stamp: int) -> None:
        """Let all tasks steer."""
        for slot in self._slots.values():
            if not slot.vehicle.motors_on:
                slot.finish(slot.is_landing)
                slot.is_landing = False
            if slot.task is not None:
                self._steer(slot, slot.task, stamp)
            is_over = slot.ordered is not None and stamp - slot.ordered >= HOVER_AFTER
            if is_over and not (slot.task and slot.is_landing):
                self._send(slot, Hover)

    def _steer(self, slot: _Slot, task: Task, stamp: int) -> None:
        elapsed = (stamp - slot.started) / SECOND
        if elapsed >= task.limit:
            slot.finish(task.at_limit)
            return
        order = task.steer(elapsed, slot.vehicle.state())
        if isinstance(order, bool):
            slot.finish(order)
        elif order is not None:
            self._send(slot, order)

    def _send(self, slot: _Slot, order: Order) -> None:
        server = self._server
        stamp = server.clock.now()
        event = order(stamp=stamp, source=server.name, vehicle=slot.vehicle.name)
        if isinstance(event, Setpoint):
            slot.ordered = stamp
            server.setpoints.send(event)
            return
        slot.is_landing = isinstance(event, Land)
        slot.ordered = stamp if slot.is_landing else None
        server.commands.send(event)


class _Slot:
    """What is known of one vehicle's tasks."""

    def __init__(self, vehicle: ServedMultirotor) -> None:
        self.vehicle = vehicle
        self.task: Task | None = None
        self.result: asyncio.Future[bool] | None = None
        self.started = 0
        self.ordered: int | None = None
        """When it was sent what it still follows; `None` if it hovers, or stands."""
        self.is_landing = False

    def finish(self, succeeded: bool) -> None:
        """End the task, if there is one."""
        if self.result is not None and not self.result.done():
            self.result.set_result(succeeded)
        self.task = self.result = None
