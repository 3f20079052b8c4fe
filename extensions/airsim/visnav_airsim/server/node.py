"""Server for scripts written for AirSim: its node, and its control of time.

It reads the vehicles' true state, and sends them commands and set-points as any pilot does.
"""

from __future__ import annotations

import asyncio
import math
import threading
from collections.abc import Awaitable, Iterable
from fractions import Fraction
from typing import Annotated, Any, Literal, TypeVar

import msgspec

from events import Announcement, CameraAnnouncement, Command, PoseEstimate, Setpoint, VehicleEvent
from runtime import Duration, NodeConfig, Output, Tick, every, on
from runtime.node import Node
from runtime.paths import JsonOrPath, NameOrPath
from runtime.time.clock import SECOND, Clock, Once
from runtime.time.stepping import Stepping
from sims.cameras.stage import RendererName
from sims.computer_vision import FreeCamera
from sims.multirotor import Multirotor
from sims.scans.settings import MeshSpec
from sims.world import Count, Inhabitant, Simulator, join_world
from sims.worlds import Dynamics, Scene
from visnav_airsim.server.cameras import Cameras, Images, ServedCamera
from visnav_airsim.server.connections import Listener, check_address
from visnav_airsim.server.flight import Control, Flight
from visnav_airsim.server.measurements import (
    SAMPLES,
    Estimates,
    Recording,
    RecordingConfig,
    ScriptEstimator,
    Sensors,
)
from visnav_airsim.server.methods import Table, rpc
from visnav_airsim.server.movables import SpareObject, add_movables, spare_objects
from visnav_airsim.server.moves import RATE, Tasks
from visnav_airsim.server.objects import Objects, Scenery
from visnav_airsim.server.vehicles import (
    Collisions,
    Commanded,
    ServedFreeCamera,
    ServedMultirotor,
    ServedVehicle,
    Vehicles,
)

R = TypeVar("R")

PORTS = "ports of AirSim servers"
"""Name of the table of server ports shared in this process, by server name."""
LONGEST_STEP = 1_000_000_000  # seconds, and frames, of a step that a client may ask for
FRAMES_WITHOUT_CAMERAS = 60  # frames per second if no vehicle has a camera


class AirsimServerConfig(NodeConfig):
    """Settings of the server.

    Attributes:
        host: Address to listen on; ``0.0.0.0`` for all of the machine's. Any client can fly.
        port: Port to listen on; 0 for any that is free.
        connections: Clients that may be connected at once.
        flavour: Kind of clients: ``airsim`` (1.8.1, Colosseum) or ``cosys`` (3.5; RGB for BGR, …).
        time: ``running``: at the run's `speed`. ``paused``: from the start, stepped by a script.
            ``awaited``: only while a vehicle does a client's task. The last two give equal runs to
            scripts that wait only for replies; ``awaited``, if each task is waited for before
            anything is asked.
        default_vehicle: Vehicle that an empty name stands for; empty for the first by name.
        abandoned: Real time after which the run ends if time stands since the last client has left.
        world: Name or path of the world, as of a simulator; empty for that of the vehicles.
        mesh: How the world is made of a mesh file; of the node that names the world.
        estimators: Estimators in clients' scripts, whose poses are judged.
        settings: The settings.json for clients: text, or a file; empty to describe the run.
        cameras: Cameras for clients besides the vehicles' and AirSim's default ones.
        camera_processes: Number of processes that render what clients ask for.
        render_threads: Threads of the software renderer in each of them.
        renderer: What draws, as of a simulator.
        lidar_frame: Frame of lidars' points, as AirSim's ``DataFrame``.
        recording: What `startRecording` records.
        sensor_names: Names of vehicles' sensors by those by which scripts call them.
        objects: Objects that clients can bring into the world, and take out again.
        movable: Regular expressions of whole names of geoms and bodies that clients can move.
    """

    host: str = "127.0.0.1"
    port: Annotated[int, msgspec.Meta(ge=0, le=65535)] = 41451
    connections: Annotated[int, msgspec.Meta(ge=1, le=1024)] = 64
    flavour: Literal["airsim", "cosys"] = "airsim"
    time: Literal["running", "paused", "awaited"] = "running"
    default_vehicle: str = ""
    abandoned: Duration = Duration(600.0)  # immutable
    world: NameOrPath = ""
    mesh: MeshSpec = MeshSpec()
    estimators: tuple[ScriptEstimator, ...] = ()
    settings: JsonOrPath = ""
    cameras: tuple[ServedCamera, ...] = ()
    camera_processes: Count = 1
    render_threads: Count = 1
    renderer: RendererName = "raster"
    lidar_frame: Literal["VehicleInertialFrame", "SensorLocalFrame"] = "VehicleInertialFrame"
    recording: RecordingConfig = RecordingConfig()
    sensor_names: dict[str, str] = msgspec.field(default_factory=dict)
    objects: tuple[SpareObject, ...] = ()
    movable: tuple[str, ...] = ()


class AirsimServer(Inhabitant, Node[AirsimServerConfig]):
    """Server for unchanged AirSim scripts to fly the run's vehicles.

    It speaks msgpack-rpc on TCP with AirSim's methods; see docs/methods.md.
    """

    relays_estimates = True
    commands = Output(Command)
    setpoints = Output(Setpoint)
    estimates = Output(PoseEstimate)

    async def on_startup(self) -> None:
        """Join the world, and listen."""
        config, log, now = self.config, self.log, self.clock.now
        if not self.checking:
            check_address(config.host, config.port)  # before the world takes its time
        self.deterministic = config.time != "running"  # type: ignore[misc]
        world = await join_world(self)
        vehicles = Vehicles(world, config.default_vehicle, config.settings, self)
        for cls, served in ((Multirotor, ServedMultirotor), (FreeCamera, ServedFreeCamera)):
            for node in self.siblings(cls):
                vehicles[node.name] = served(node.name, world, node.config, now)

        def drawn_state() -> tuple[int, Any]:
            return vehicles.drawn_state(now())

        carriers = [node for node in self.siblings(Simulator) if node.name in vehicles]
        objects = Objects(world, spare_objects(self.name, config.objects), now, log)
        cameras = Cameras(carriers, config.cameras, world.model, drawn_state, log)
        ids = objects.segmentation_ids
        draw = config.camera_processes, config.render_threads, config.renderer
        images = Images(self, world, cameras, drawn_state, ids, *draw)
        scenery = Scenery(world, vehicles, objects, now, log)
        rates = [
            camera.rate for node in self.siblings(Multirotor) for camera in node.config.cameras
        ]
        rates += [node.config.rate for node in self.siblings(FreeCamera)]
        frame_rate = max(rates, default=FRAMES_WITHOUT_CAMERAS)
        self.vehicles, self.cameras = vehicles, cameras
        self.collisions = Collisions(vehicles, objects.identify)
        self.sensors = Sensors(vehicles, world, config.sensor_names, config.lidar_frame)
        self.recording = Recording(config.recording, self, vehicles, images)
        estimators = config.estimators
        self.script_estimates = Estimates(estimators, vehicles, cameras, now, self._send)
        self.time = Time(config.time, self.clock, self.stepping, frame_rate)
        self.tasks = Tasks(self.clock, self.name, self._send, self.time.reply_for)
        resets = objects.reset, scenery.reset
        self.table = Table(
            [
                vehicles,
                self.time,
                Control(vehicles, self.tasks, self.collisions, *resets),
                Flight(self.tasks),
                self.collisions,
                objects,
                cameras,
                images,
                self.sensors,
                scenery,
                self.recording,
                self.script_estimates,
            ],
            log,
            {
                ServedVehicle: vehicles.find,
                ServedMultirotor: vehicles.find_multirotor,
                Commanded: vehicles.find_commanded,
            },
        )
        if config.time == "running" and not self.checking:
            await images.start()  # simulated time would wait for it later
        self._listener: Listener | None = None
        self._waiting: threading.Timer | None = None
        if self.checking:
            return
        if config.time != "running" and (reason := self.stepping.fixed()):
            raise ValueError(f'time: expected "running", found "{config.time}": {reason}')
        self._listener = Listener(
            config.host, config.port, config.connections, self.log, self._attended
        )
        self.port = self._listener.port
        self.share(PORTS, dict[str, int])[self.name] = self.port

    def announce(self) -> Iterable[Announcement]:
        """Announce the clients' estimators."""
        return self.script_estimates.announce()

    def check(self) -> Iterable[str]:
        """Return errors in the settings' names of vehicles, and in its address."""
        default = self.config.default_vehicle
        if default and default not in self.vehicles:
            yield f'default_vehicle: expected one of {", ".join(self.vehicles)}, found "{default}"'
        if self.checking:  # else it listens there already
            try:
                check_address(self.config.host)
            except ValueError as error:
                yield str(error)

    async def run(self) -> None:
        """Pause time, if so set; then serve clients, present and to come."""
        await self.time.begin()
        assert self._listener is not None  # a run that is only checked has no updates
        self.doing = f"waiting for a client on {self.config.host}:{self.port}"
        self._listener.serve(self.table, self.config.flavour)
        self.log.info("AirSim's clients may connect to %s:%d", self.config.host, self.port)
        await self.recording.begin()

    async def on_shutdown(self) -> None:
        """Close all connections."""
        if self._listener is not None:
            self._listener.close()
        self._attended(True)

    def _attended(self, is_anybody: bool) -> None:
        """Handle whether any client is connected, as without one time might stand for ever."""
        self.doing = ""
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
        """Record the start and stop of motors, and collisions."""
        vehicle = self.vehicles.get(event.source)
        if isinstance(vehicle, ServedMultirotor):
            self.tasks.handle_event(vehicle, event)
            self.collisions.handle_event(vehicle, event)

    @every(hz=RATE)
    def fly(self, tick: Tick) -> None:
        """Send the set-points of the vehicles' tasks, and check the vehicles' contacts."""
        self.tasks.update(tick.stamp)
        self.collisions.watch()

    @classmethod
    def populate(cls, scene: Scene, name: str, config: Any) -> Dynamics:
        """Add objects to the world, and a camera to be moved to each viewpoint."""
        add_movables(scene, name, config.objects, config.movable)
        scene.spec.worldbody.add_camera(name=f"{name}/camera")
        return Dynamics()

    @classmethod
    def sees(cls, config: Any) -> bool:  # noqa: ARG003
        """Return `True`: clients may ask for images."""
        return True

    def on_announcement(self, announcement: Announcement) -> None:
        """Store the announcements of the vehicles' sensors."""
        self.sensors.announced(announcement)
        if isinstance(announcement, CameraAnnouncement):
            self.cameras.announced(announcement)
            self.vehicles.announced(announcement)

    @on(*SAMPLES)
    def samples(self, event: Any) -> None:
        """Store the samples of the vehicles' sensors."""
        self.sensors.add_sample(event)

    def _send(self, event: Command | Setpoint | PoseEstimate) -> None:
        if isinstance(event, Setpoint):
            self.setpoints.send(event)
        elif isinstance(event, Command):
            self.commands.send(event)
        else:
            self.estimates.send(event)


class Time:
    """Pausing and stepping; `frame_rate` is that of the fastest camera, Hz.

    With ``time = "awaited"`` time runs during a vehicle's task (see `reply_for`), unless a client
    has paused it.
    """

    def __init__(self, mode: str, clock: Clock, stepping: Stepping, frame_rate: float) -> None:
        self._clock, self._stepping = clock, stepping
        self._period = SECOND / Fraction(frame_rate).limit_denominator()
        self._awaited, self._paused = mode == "awaited", mode == "paused"
        self._running_tasks = 0

    async def begin(self) -> None:
        """Pause time, unless set to run, until time stands; `CommandError` if out of control."""
        if self._awaited or self._paused:
            self._stepping.pause()
            await self._stepping.stands()

    def reply_for(self, task: asyncio.Future[R]) -> asyncio.Future[R]:
        """Return a future for the reply to a vehicle's task; cancelling it leaves the task.

        With ``time = "awaited"`` time runs until the task is done, and the reply comes once time
        stands at that instant, with all that was due by then done. While another task goes on, the
        reply comes at once.
        """
        if not self._awaited:
            return task
        reply: asyncio.Future[R] = task.get_loop().create_future()
        self._running_tasks += 1
        self._apply()

        def ended(_: asyncio.Future[R]) -> None:
            self._running_tasks -= 1
            self._apply()
            self._stepping.stands().add_done_callback(lambda _: _copy(task, reply))

        task.add_done_callback(ended)
        return reply

    @rpc("simPause")
    def pause(self, is_paused: bool) -> None:
        """Let the run's time stand, or run on; a run in real time cannot be paused."""
        if is_paused:
            self._stepping.pause()
        elif self._stepping.state != "running" and not self._awaited:
            self._stepping.resume()
        self._paused = is_paused
        self._apply()

    @rpc("simIsPaused")
    def is_paused(self) -> bool:
        """Return whether time stands by `simPause` or after a step."""
        return self._stepping.state == "paused" and (self._paused or not self._awaited)

    @rpc("simContinueForTime")
    def continue_for_time(
        self, seconds: Annotated[float, msgspec.Meta(ge=0.0, le=LONGEST_STEP)]
    ) -> Awaitable[None]:
        """Let **simulated** time run for some seconds; reply once time stands."""
        return self._continue(round(seconds * SECOND))

    @rpc("simContinueForFrames")
    def continue_for_frames(
        self, frames: Annotated[int, msgspec.Meta(ge=0, le=LONGEST_STEP)]
    ) -> Awaitable[None]:
        """Let time run for some images of the fastest camera; without any, steps of 1/60 s."""
        now = self._clock.now()
        newest = math.ceil((now + 1) / self._period) - 1  # number of the last image by now, from 0
        return self._continue(max(int((newest + frames) * self._period) - now, 0))

    def _continue(self, ns: int) -> Awaitable[None]:
        if self._awaited and not self._paused:
            over: asyncio.Future[None] = asyncio.get_running_loop().create_future()
            due = self._clock.now() + ns
            self._clock.schedule.add(due, Once(lambda: over.set_result(None)))
            return self.reply_for(over)
        if ns > 0:
            step = self._stepping.step(ns)
        else:
            self._stepping.pause()
            step = self._stepping.stands()
        self._paused = True

        async def stepped() -> None:
            await step

        return stepped()

    def _apply(self) -> None:
        """Run time while a task's reply is owed, else pause; leave a client's pause."""
        if not self._awaited or self._paused:
            return
        if self._running_tasks == 0:
            self._stepping.pause()
        elif self._stepping.state != "running":
            self._stepping.resume()


def _copy(task: asyncio.Future[R], reply: asyncio.Future[R]) -> None:
    if reply.done():
        return
    if task.cancelled():
        reply.cancel()
    elif (error := task.exception()) is not None:
        reply.set_exception(error)
    else:
        reply.set_result(task.result())
