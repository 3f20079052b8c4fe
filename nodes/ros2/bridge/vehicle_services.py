"""Services that arm, disarm, take off and land: ``std_srvs/Trigger``, for each vehicle."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any, NamedTuple

import events
from events import Command, VehicleEvent
from nodes.ros2.bridge.service_server import ServiceServer
from nodes.ros2.messages.services import TRIGGER
from nodes.ros2.messages.topics import ros_name


class _Order(NamedTuple):
    """What is sent, what the vehicle says when it is done, and within how many seconds.

    It is superfluous if the vehicle is armed (true), or if it is not (false).
    """

    command: type[Command]
    done: type[VehicleEvent]
    limit: float
    superfluous: bool | None = None


_ORDERS = {
    "arm": _Order(events.Arm, events.Armed, 1.0, superfluous=True),
    "disarm": _Order(events.Disarm, events.Disarmed, 1.0, superfluous=False),
    "take_off": _Order(events.Takeoff, events.TakenOff, 60.0),
    "land": _Order(events.Land, events.Landed, 300.0, superfluous=False),
}


class VehicleServices:
    """Sends commands to vehicles, and waits until they are carried out."""

    def __init__(self, server: ServiceServer, send: Callable[[Command], None]) -> None:
        self._server = server
        self._node = server.node
        self._send = send
        self._armed: dict[str, bool] = {}
        """Of vehicles of which it is known."""
        self._waiting: set[tuple[str, type[VehicleEvent], asyncio.Future[None]]] = set()

    def declare(self, vehicle: str) -> None:
        """Declare the services of a vehicle; called in any thread."""
        if not self._node.restarts:
            self._armed[vehicle] = False
        for name, order in _ORDERS.items():

            async def serve(_: Any, order: _Order = order) -> dict[str, Any]:
                success, message = await self._give(vehicle, order)
                return {"success": success, "message": message}

            self._server.declare(f"{ros_name(vehicle)}/{name}", TRIGGER, serve)

    def told(self, event: VehicleEvent) -> None:
        """Note what a vehicle says has happened."""
        if isinstance(event, events.Armed | events.Disarmed):
            self._armed[event.source] = isinstance(event, events.Armed)
        for vehicle, done, waiter in self._waiting:
            if vehicle == event.source and isinstance(event, done) and not waiter.done():
                waiter.set_result(None)

    async def _give(self, vehicle: str, order: _Order) -> tuple[bool, str]:
        """Return whether a command was carried out, and what there is to say of it."""
        if self._armed.get(vehicle) is order.superfluous is not None:
            return True, f"{vehicle} is {'armed' if order.superfluous else 'disarmed'} already"
        waiter = asyncio.get_running_loop().create_future()
        waiting = (vehicle, order.done, waiter)
        self._waiting.add(waiting)
        try:
            now, source = self._node.clock.now(), self._node.name
            self._send(order.command(stamp=now, source=source, vehicle=vehicle))
            if self._node.stepping.state == "paused":  # whoever asked is the one who steps
                return True, f"{order.command.__name__} is sent; time stands"
            async with asyncio.timeout(order.limit):
                await waiter
        except TimeoutError:
            name, done = order.command.__name__, order.done.__name__
            return False, f"{vehicle} did not say {done} within {order.limit:g} s of {name}"
        finally:
            self._waiting.discard(waiting)
        return True, order.done.__name__
