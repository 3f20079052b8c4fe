"""A server for scripts that are written for AirSim: its node.

It stands beside the vehicles in the run's world, reads their true state, and sends them commands
and set-points as any pilot does.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterable
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from events import Announcement, Command, PoseEstimate, Setpoint, VehicleEvent
from runtime import Duration, NodeConfig, Output, Tick, every, on
from runtime.node import Node
from runtime.paths import JsonOrPath, NameOrPath
from sims.airsim.server.accepted import Accepted
from sims.airsim.server.cameras import Cameras, ServedCamera
from sims.airsim.server.collisions import Collisions
from sims.airsim.server.control import Control
from sims.airsim.server.estimates import Estimates, ScriptEstimator
from sims.airsim.server.flight import Flight
from sims.airsim.server.images import Images
from sims.airsim.server.listener import Listener
from sims.airsim.server.methods import Table
from sims.airsim.server.movables import SpareObject, add_movables
from sims.airsim.server.objects import Objects
from sims.airsim.server.recording import Recording, RecordingConfig
from sims.airsim.server.scenery import Scenery
from sims.airsim.server.segmentation import Segmentation
from sims.airsim.server.sensors import SAMPLES, Sensors
from sims.airsim.server.session import Session
from sims.airsim.server.state import VehicleState
from sims.airsim.server.tasks import RATE, Tasks
from sims.airsim.server.time import Time
from sims.airsim.server.vehicles import ServedFreeCamera, ServedMultirotor, ServedVehicle, Vehicles
from sims.computer_vision import FreeCamera
from sims.multirotor import Multirotor
from sims.simulator import Count
from sims.world import Inhabitant, join_world
from sims.worlds import Dynamics, Scene

PORTS = "ports of AirSim servers"
"""Name under which nodes of this process share where each server listens, by its name."""


class AirsimServerConfig(NodeConfig):
    """Settings of the server.

    Attributes:
        host: Address to listen on; ``0.0.0.0`` for all of this machine's. Whoever can connect
            can fly.
        port: Port to listen on; 0 for any that is free.
        connections: Clients that may be connected at once.
        flavour: Whose clients call: ``airsim`` (1.8.1, and Colosseum's) or ``cosys``
            (Cosys-AirSim 3.5). They differ in the colours' order, among others.
        time: ``running``: time runs, at the run's `speed`. ``paused``: it stands from the start,
            and a script steps it. ``awaited``: it runs only while a vehicle does what a client
            has told it to. With the last two, a script whose only waiting is for replies gives
            equal runs; with ``awaited``, if it waits for each task before it asks for anything.
        default_vehicle: Name of the vehicle that an empty name stands for; empty for the first by
            name.
        abandoned: Real time after which the run ends if time stands since the last client has
            left.
        world: Name or path of the world, as of a simulator; empty for that of the vehicles.
        estimators: Estimators in clients' scripts, whose poses are judged.
        settings: The settings.json that clients get when they ask for it: its text, or a file;
            empty for one that says what runs.
        cameras: Cameras that clients may ask for images, besides those of the vehicles, and
            AirSim's default ones.
        camera_processes: Number of processes that render what clients ask for.
        render_threads: Threads of the software renderer in each of them.
        lidar_frame: Frame of lidars' points, as AirSim's ``DataFrame``.
        recording: What `startRecording` records.
        sensor_names: Names of vehicles' sensors by those by which scripts call them.
        objects: Objects that clients can bring into the world, and take out again.
        movable: Regular expressions: the geoms and bodies of the world, by their whole names,
            that clients can move.
    """

    host: str = "127.0.0.1"
    port: Annotated[int, msgspec.Meta(ge=0, le=65535)] = 41451
    connections: Annotated[int, msgspec.Meta(ge=1, le=1024)] = 64
    flavour: Literal["airsim", "cosys"] = "airsim"
    time: Literal["running", "paused", "awaited"] = "running"
    default_vehicle: str = ""
    abandoned: Duration = Duration(600.0)  # immutable
    world: NameOrPath = ""
    estimators: tuple[ScriptEstimator, ...] = ()
    settings: JsonOrPath = ""
    cameras: tuple[ServedCamera, ...] = ()
    camera_processes: Count = 1
    render_threads: Count = 1
    lidar_frame: Literal["VehicleInertialFrame", "SensorLocalFrame"] = "VehicleInertialFrame"
    recording: RecordingConfig = RecordingConfig()
    sensor_names: dict[str, str] = msgspec.field(default_factory=dict)
    objects: tuple[SpareObject, ...] = ()
    movable: tuple[str, ...] = ()


class AirsimServer(Inhabitant, Node[AirsimServerConfig]):
    """Lets scripts that were written for AirSim fly the run's vehicles, unchanged.

    It speaks msgpack-rpc on TCP with AirSim's methods; see docs/reference/airsim.md.
    """

    commands = Output(Command)
    setpoints = Output(Setpoint)
    estimates = Output(PoseEstimate)

    async def on_startup(self) -> None:
        """Join the world, and listen."""
        self.deterministic = self.config.time != "running"  # type: ignore[misc]
        self.world = await join_world(self)
        self.vehicles = Vehicles(self.world, self.config.default_vehicle)
        for cls, served in ((Multirotor, ServedMultirotor), (FreeCamera, ServedFreeCamera)):
            for each in self.siblings(cls):
                vehicle = served(each.name, self.world, each.config, self.clock.now)
                self.vehicles[each.name] = vehicle
        self.collisions = Collisions(self)
        self.objects = Objects(self)
        self.cameras = Cameras(self)
        self.segmentation = Segmentation(self)
        self.images = Images(self)
        self.sensors = Sensors(self)
        self.scenery = Scenery(self)
        self.recording = Recording(self)
        self.script_estimates = Estimates(self)
        self.time = Time(self)
        self.tasks = Tasks(self)
        self.table = Table(
            [
                Session(self),
                self.time,
                Control(self),
                VehicleState(self),
                self.collisions,
                self.objects,
                self.cameras,
                self.segmentation,
                self.images,
                self.sensors,
                self.scenery,
                Accepted(self),
                self.recording,
                self.script_estimates,
                Flight(self),
            ]
        )
        if self.config.time == "running" and not self.checking:
            await self.images.start()  # simulated time would wait for it later
        self._listener: Listener | None = None
        self._waiting: threading.Timer | None = None
        if self.checking:
            return
        config = self.config
        if config.time != "running" and (reason := self.stepping.fixed()):
            raise ValueError(f'time: expected "running", found "{config.time}": {reason}')
        self._listener = Listener(
            config.host, config.port, config.connections, self.log, self._attended
        )
        self.port = self._listener.port
        self.share(PORTS, dict[str, int])[self.name] = self.port

    def announce(self) -> Iterable[Announcement]:
        """Announce the estimators that clients will be."""
        return self.script_estimates.announce()

    def check(self) -> Iterable[str]:
        """Return what is wrong with the vehicles that the settings name."""
        default = self.config.default_vehicle
        if default and default not in self.vehicles:
            yield f'default_vehicle: expected one of {", ".join(self.vehicles)}, found "{default}"'

    async def run(self) -> None:
        """Serve those who have connected and will; first, let time stand, if it is to."""
        await self.time.begin()
        assert self._listener is not None  # a run that is only checked has no updates
        self._listener.serve(self.table, self.config.flavour)
        self.log.info("AirSim's clients may connect to %s:%d", self.config.host, self.port)
        await self.recording.begin()

    async def on_shutdown(self) -> None:
        """Close all connections."""
        if self._listener is not None:
            self._listener.close()
        self._attended(True)

    def _attended(self, is_anybody: bool) -> None:
        """Take note of whether any client is there, without whom time might stand for ever."""
        if self._waiting is not None:
            self._waiting.cancel()
            self._waiting = None
        awaited, seconds = self.config.time == "awaited", self.config.abandoned
        if is_anybody or (self.stepping.state == "running" and not awaited):
            return
        self.log.warning(
            "time stands, or will, and no client is left to let it run: the run ends in %g s of "
            "real time unless one comes (abandoned)",
            seconds,
        )
        # Real seconds: the loop's own timers are simulated, and stand.
        call = asyncio.get_running_loop().call_soon_threadsafe
        self._waiting = threading.Timer(seconds, call, [self._give_up])
        self._waiting.daemon = True
        self._waiting.start()

    def _give_up(self) -> None:
        if self.stepping.state == "running":  # a vehicle is on its way still
            self._attended(False)
        else:
            self.stop(f"no client came for {self.config.abandoned:g} s while time stood")

    @on(VehicleEvent)
    def vehicle_events(self, event: VehicleEvent) -> None:
        """Take notice of motors that start or stop, and of collisions."""
        self.tasks.note(event)
        self.collisions.note(event)

    @every(hz=RATE)
    def fly(self, tick: Tick) -> None:
        """Let the vehicles' tasks steer, and look what the vehicles touch."""
        self.tasks.update(tick.stamp)
        self.collisions.watch()

    @classmethod
    def populate(cls, scene: Scene, name: str, config: Any) -> Dynamics:
        """Put a camera into the world that is moved to where one is needed, and objects."""
        add_movables(scene, name, config.objects, config.movable)
        scene.spec.worldbody.add_camera(name=f"{name}/camera")
        return Dynamics()

    @classmethod
    def sees(cls, config: Any) -> bool:  # noqa: ARG003
        """Return that its clients may ask for images."""
        return True

    def on_announcement(self, announcement: Announcement) -> None:
        """Take note of the vehicles' sensors."""
        self.sensors.announced(announcement)

    @on(*SAMPLES)
    def samples(self, event: Any) -> None:
        """Take note of the vehicles' samples."""
        self.sensors.note(event)

    def find_vehicle(self, name: str) -> ServedVehicle:
        """Return a multirotor or a free camera; see `Vehicles.find`."""
        return self.vehicles.find(name)

    def find_multirotor(self, name: str) -> ServedMultirotor:
        """Return a multirotor; see `Vehicles.find_multirotor`."""
        return self.vehicles.find_multirotor(name)

    def order(
        self, kind: type[Command] | type[Setpoint], vehicle: ServedVehicle, **fields: Any
    ) -> None:
        """Send a command or a set-point to a vehicle, which obeys it at once."""
        event = kind(stamp=self.clock.now(), source=self.name, vehicle=vehicle.name, **fields)
        if isinstance(event, Setpoint):
            self.setpoints.send(event)
        else:
            self.commands.send(event)

    def drawn_state(self) -> tuple[int, npt.NDArray[np.float64]]:
        """Return the world's state as it is to be drawn now: time (ns), and positions.

        These are of the last whole millisecond, so exactly the state that methods tell of; in them
        free cameras are where they have been put, if only just now. Shape (nq,), a copy.
        """
        return self.vehicles.drawn_state(self.clock.now())
