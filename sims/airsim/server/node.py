"""A server for scripts that are written for AirSim: its node.

It stands beside the vehicles in the run's world, reads their true state, and sends them commands
and set-points as any pilot does.
"""

from __future__ import annotations

import asyncio
from typing import Annotated, Any, Literal

import msgspec

from events import Command, Setpoint
from runtime import NodeConfig, Output
from runtime.node import Node
from runtime.paths import NameOrPath
from sims.airsim.server.connection import Connection
from sims.airsim.server.methods import RpcError, Table
from sims.airsim.server.objects import Objects
from sims.airsim.server.session import Session
from sims.airsim.server.time import Time
from sims.airsim.server.vehicles import ServedVehicle
from sims.multirotor import Multirotor
from sims.shared_world import Inhabitant, join_world
from sims.vehicle import Physics
from sims.worlds import Dynamics, Scene

PORTS = "ports of AirSim servers"
"""Name under which nodes of this process share where each server listens, by its name."""


class AirsimServerConfig(NodeConfig):
    """Settings of the server.

    Attributes:
        host: Address to listen on; ``0.0.0.0`` for all of this machine's. Whoever can connect
            can fly.
        port: Port to listen on; 0 for any that is free.
        flavour: Whose clients call: ``airsim`` (1.8.1, and Colosseum's) or ``cosys``
            (Cosys-AirSim 3.5). They differ in the colours' order, among others.
        time: ``running``: time runs, at the run's `speed`. ``paused``: it stands from the start,
            and a script steps it. ``awaited``: it runs only while a client waits for a vehicle.
            With the last two, a script whose only waiting is for replies gives equal runs.
        world: Name or path of the world, as of a simulator; empty for that of the vehicles.
    """

    host: str = "127.0.0.1"
    port: Annotated[int, msgspec.Meta(ge=0, le=65535)] = 41451
    flavour: Literal["airsim", "cosys"] = "airsim"
    time: Literal["running", "paused", "awaited"] = "running"
    world: NameOrPath = ""


class AirsimServer(Inhabitant, Node[AirsimServerConfig]):
    """Lets scripts that were written for AirSim fly the run's vehicles, unchanged.

    It speaks msgpack-rpc on TCP with AirSim's methods; see docs/reference/airsim.md.
    """

    commands = Output(Command)
    setpoints = Output(Setpoint)

    async def on_startup(self) -> None:
        """Join the world, and listen."""
        self.deterministic = self.config.time != "running"  # type: ignore[misc]
        self.world = await join_world(self)
        simulation = self.world.simulation
        self.vehicles: dict[str, ServedVehicle] = {}
        for each in self.siblings(Multirotor):
            assert simulation is not None
            physics = Physics(simulation, each.name)
            self.vehicles[each.name] = ServedVehicle(each.name, physics, self.clock.now)
        self.objects = Objects(self)
        self.table = Table([Session(self), Time(self), self.objects])
        self._connections: set[Connection] = set()
        self._server: asyncio.Server | None = None
        if self.checking:
            return
        config, loop = self.config, asyncio.get_running_loop()
        try:
            self._server = await loop.create_server(self._connect, config.host, config.port)
        except OSError as error:
            raise ValueError(
                f"port: expected one that is free on {config.host}, found {config.port}: {error}"
            ) from None
        self.port = self._server.sockets[0].getsockname()[1]
        self.share(PORTS, dict[str, int])[self.name] = self.port
        self.log.info("AirSim's clients may connect to %s:%d", config.host, self.port)

    async def on_ready(self) -> None:
        """Let time stand from the start, if that is asked for."""
        if self.config.time != "running":
            self.stepping.pause()

    async def on_shutdown(self) -> None:
        """Close all connections."""
        if self._server is not None:
            self._server.close()
        for connection in tuple(self._connections):
            connection.close()

    @classmethod
    def populate(cls, scene: Scene, name: str, config: Any) -> Dynamics:  # noqa: ARG003
        """Leave the world as it is."""
        return Dynamics()

    def find_vehicle(self, name: str) -> ServedVehicle:
        """Return a vehicle; of an empty name the first, by name.

        Raises:
            RpcError: There is none of that name.
        """
        found = self.vehicles.get(name or min(self.vehicles, default=""))
        if found is None:
            raise RpcError(
                f"Vehicle API for '{name}' is not available. This could either because this is "
                "simulation-only API or this vehicle does not exist"
            )
        return found

    def _connect(self) -> Connection:
        return Connection(self.table, self.config.flavour, self.log, self._connections)
