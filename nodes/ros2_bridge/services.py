"""The services that a bridge offers to ROS 2, as its settings say."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from events import Command, VehicleEvent
from nodes.ros2_bridge.complaints import Complaints
from nodes.ros2_bridge.service_server import ServiceServer
from nodes.ros2_bridge.session import Session
from nodes.ros2_bridge.settings import Ros2BridgeConfig
from nodes.ros2_bridge.simulation_services import SimulationServices
from nodes.ros2_bridge.vehicle_services import VehicleServices
from nodes.ros_messages.services import DEFINITIONS
from nodes.ros_messages.typestore import TypeStore
from runtime import Node


class Services:
    """The services of one bridge.

    Args:
        node: The bridge.
        session: Where requests come from.
        store: Of the types.
        complaints: Notes what is wrong.
        send: Sends a command.
    """

    def __init__(
        self,
        node: Node[Ros2BridgeConfig],
        session: Session,
        store: TypeStore,
        complaints: Complaints,
        send: Callable[[Command], None],
    ) -> None:
        self._node = node
        self._store = store
        self._server = ServiceServer(node, session, store, complaints)
        self._vehicles = VehicleServices(self._server, node, send)

    def declare(self, vehicles: Iterable[str]) -> None:
        """Declare all that are wanted, of these vehicles; called in a thread."""
        for type_, definition in DEFINITIONS.items():
            self._store.add(type_, definition)
        if "simulation" in self._node.config.services:
            SimulationServices(self._server, self._node).declare()
        if "vehicle" in self._node.config.services:
            for vehicle in vehicles:
                self._vehicles.declare(vehicle)

    def told(self, event: VehicleEvent) -> None:
        """Answer who asked a vehicle for what it now says is done."""
        self._vehicles.told(event)

    async def close(self) -> None:
        """Take no more requests, and wait until all answers are sent."""
        self._server.closed = True
        await self._node.offload(self._server.close)
        self._node.log.info("%d requests answered", self._server.answered)
