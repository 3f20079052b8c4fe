"""The services that a bridge offers to ROS 2, as its settings say."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from events import Command
from nodes.ros2.bridge.service_server import ServiceServer
from nodes.ros2.bridge.simulate_steps import SimulateSteps
from nodes.ros2.bridge.simulation_services import SimulationServices
from nodes.ros2.bridge.vehicle_services import VehicleServices
from nodes.ros2.messages.services import DEFINITIONS


class Services(ServiceServer):
    """The services of one bridge; of vehicles they send commands by `send`."""

    def __init__(self, send: Callable[[Command], None], *server: Any) -> None:
        super().__init__(*server)
        self._vehicles = VehicleServices(self, send)
        self.told = self._vehicles.told

    def offer(self, vehicles: Iterable[str]) -> None:
        """Declare all that are wanted, of these vehicles; called in a thread."""
        for type_, definition in DEFINITIONS.items():
            self.store.add(type_, definition)
        if "simulation" in self.node.config.services:
            simulation = SimulationServices(self)
            SimulateSteps(self, simulation).declare()
            simulation.declare()
        if "vehicle" in self.node.config.services:
            for vehicle in vehicles:
                self._vehicles.declare(vehicle)
