"""Shared world of a run, and the common base of the simulator nodes in it.

What belongs to it and to no vehicle (wind, moving bodies, lights, fog) has a node of its own.
"""

from __future__ import annotations

import asyncio
import functools
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np
import numpy.typing as npt

import events as ev
from events import Announcement, BodyAnnouncement, PoseStamped, Vector3, Wind, WindAnnouncement
from events.frames import rotate_inverse
from runtime import Duration, Node, NodeConfig, Output, Tick, every
from runtime.errors import suggest
from runtime.host import Sibling
from runtime.paths import NameOrPath
from runtime.typed import TypeVar
from sims.cameras import CameraSpec, model_to_bytes
from sims.cameras.packed import Packed, pack, without_looks
from sims.cameras.raster import library_for
from sims.cameras.rig import CameraOutputs, CameraRig
from sims.cameras.stage import RendererName, return_memory
from sims.scans.settings import MeshSpec
from sims.vehicle import Simulation, State
from sims.vehicle.physics import Air
from sims.vehicle.simulation import Influence
from sims.worlds import Dynamics, Scene, WorldError, load_scene
from sims.worlds.bodies import BodyMotion, BodySpec, add_bodies
from sims.worlds.dynamics import FogSpec, LightSpec, WindSpec, add_fog, change_lights

Rate = Annotated[float, msgspec.Meta(gt=0, le=1000)]
Floats = npt.NDArray[np.float64]


class Inhabitant:
    """Mixin of nodes with a part in the world."""

    vehicle: ClassVar[bool] = False  # whether the node is moved by physics
    alone: ClassVar[bool] = False
    """Whether the node has its own world, if `alone` holds for all inhabitants."""

    @classmethod
    @abstractmethod
    def populate(cls, scene: Scene, name: str, config: Any) -> Dynamics:
        """Add a node of this class to a world, and return its self-moving parts."""

    @classmethod
    def sees(cls, config: Any) -> bool:
        """Return whether a node of this class has sensors of surface appearance."""
        return bool(getattr(config, "cameras", ()) or getattr(config, "lidars", ()))

    @classmethod
    def wind_of(cls, config: Any) -> WindSpec | None:  # noqa: ARG003
        """Return the wind of a node of this class; `None` for most."""
        return None


class SharedWorld:
    """Compiled world of a run, its physics, and the data for renderers.

    It outlives a restart of any node: vehicles then are as they were left.

    Args:
        inhabitants: The nodes with a part in the world, in file order.
        bare: Leave out images; also left out if no inhabitant sees.
    """

    model: Any
    dynamics: Dynamics
    simulation: Simulation | None  # physics shared by all vehicles. `None` if there is no vehicle
    air: Air | None  # the wind; `None` if there is none, or no vehicle

    def __init__(self, inhabitants: tuple[Sibling, ...], bare: bool, seed: int) -> None:
        named = [inhabitant for inhabitant in inhabitants if inhabitant.config.world]
        self.name = named[0].config.world if named else "hall"
        self.named_by = named[0].name if named else ""
        self.mesh = named[0].config.mesh if named else MeshSpec()
        self._inhabitants = inhabitants
        self.vehicles = [inhabitant.name for inhabitant in inhabitants if inhabitant.node.vehicle]
        # State of each vehicle and free camera at its start, once that node has started up.
        self.starts: dict[str, State] = {}
        # Gives the state of each free camera at a time (ns); no physics knows it.
        self.free_cameras: dict[str, Callable[[int], State]] = {}
        self._bare = bare or not any(i.node.sees(i.config) for i in inhabitants)
        seeing = [i.config for i in inhabitants if i.node.sees(i.config)]
        draws = {getattr(config, "renderer", "") for config in seeing}
        self._rasterised = "raster" in draws and not self._bare
        # Lidars ask textures how bright they are.
        lidars = any(getattr(config, "lidars", ()) for config in seeing)
        self._shares_texels = draws == {"raster"} and not lidars
        self._images: dict[str, Any] = {}  # of textures of which the model has the name alone
        self._places: Any = None  # the model for processes of the rasteriser
        self._packed: dict[RendererName, Packed] = {}
        self._packing = threading.Lock()
        self._seed = seed
        self._built = False
        self._building = asyncio.Lock()

    def wind_at(self, name: str) -> Vector3:
        """Return the present velocity of the air round a body, m/s NED; zeros without wind."""
        if self.air is None or name not in self.vehicles:
            return (0.0, 0.0, 0.0)
        return self.air.velocity_at(name)

    async def build(self, node: Node[Any]) -> None:
        """Build the world, unless built already with its physics still finite."""
        async with self._building:
            if not self._built or (self.simulation and self.simulation.diverged):
                node.doing = f"building the world {self.name}"
                await node.offload(self._build)
                await node.offload(return_memory)
                self._built, node.doing = True, ""

    @functools.cached_property
    def model_bytes(self) -> bytes:
        """Compiled world for other processes, made at the first request."""
        return model_to_bytes(self.model)

    def packed(self, renderer: RendererName) -> Packed:
        """Return the world for processes in which this renderer draws, made at the first request.

        It is there for as long as this object is. May be called in any thread.

        Raises:
            GraphicsError: The rasteriser is wanted, and was not compiled with the package.
            ValueError: The world has what the renderer does not draw.
        """
        with self._packing:
            if renderer not in self._packed:
                if renderer == "raster":
                    library = library_for(self.model)
                    packed = pack(self._places or self.model, library, self.model, self._images)
                    self._images = {}  # which the file has now
                else:
                    packed = pack(self.model)
                return_memory()
                self._packed[renderer] = packed
            return self._packed[renderer]

    def state_at(self, stamp_ns: int) -> tuple[int, Floats, Floats]:
        """Step the physics up to a time if necessary, and return the world's state.

        Returns:
            The state's time, in real time perhaps a later one; copies of the generalised positions,
            shape (nq,), and velocities, shape (nv,).
        """
        if self.simulation is None:
            return stamp_ns, self.model.qpos0.copy(), np.zeros(self.model.nv)
        self.simulation.advance_to(stamp_ns)
        stamp_ns = max(stamp_ns, self.simulation.time_ns)
        return stamp_ns, *self.simulation.state_at(stamp_ns)

    def remember(self, seconds: float) -> None:
        """Keep the states of the last `seconds` for `past_state`, if any are wanted."""
        if seconds and self.simulation is not None:
            # In real time, they may be asked for later.
            self.simulation.keep(seconds + 1.0)

    def past_state(self, stamp_ns: int) -> Floats:
        """Return the generalised positions at a time not in the future, shape (nq,)."""
        if self.simulation is None:
            return self.state_at(stamp_ns)[1]
        self.simulation.advance_to(stamp_ns)
        return self.simulation.past(stamp_ns)[0].copy()

    def set_wind(self, velocity: Vector3) -> None:
        """Set the mean wind for vehicles, m/s NED, from the next millisecond on; gusts stay."""
        if self.simulation is not None and self.air is None:
            random = np.random.default_rng([self._seed, *b"wind"])
            self.air = Air(self.model, WindSpec(), self.vehicles, random)
            self.simulation.add_influence(self.air)
        if self.air is not None:
            self.air.velocity = velocity

    def geoms_of(self, body: str) -> tuple[int, ...]:
        """Return the numbers of a body's geoms, as in segmentation images."""
        return tuple(np.flatnonzero(self.model.geom_bodyid == self.model.body(body).id).tolist())

    def _build(self) -> None:
        self._images, self._packed = {}, {}
        aside = self._images if self._shares_texels else None
        spec, dynamics = load_scene(self.name, bare=self._bare, mesh=self.mesh, aside=aside)
        wind = None
        for inhabitant in self._inhabitants:
            node: type[Inhabitant] = inhabitant.node
            added = node.populate(Scene(spec, dynamics), inhabitant.name, inhabitant.config)
            dynamics = dynamics.joined(added)
            wind = node.wind_of(inhabitant.config) or wind
        self.model = spec.compile()
        self.__dict__.pop("model_bytes", None)
        self._places = without_looks(spec, self.model) if self._rasterised else None
        self.dynamics = dynamics
        self.simulation = self.air = None
        if self.vehicles:
            influences: list[Influence] = list(dynamics.solid.motions)
            if wind is not None and not wind.still:
                random = np.random.default_rng([self._seed, *b"wind"])
                self.air = Air(self.model, wind, self.vehicles, random)
                influences.append(self.air)
            self.simulation = Simulation(self.model, influences)


async def join_world(node: Any) -> SharedWorld:
    """Return the world of a node, built by the first caller.

    Raises:
        WorldError: The node names another world than the others do, or some of them are in
            another process.
    """
    inhabitants, key = node.siblings(Inhabitant), "world"
    if all(i.node.alone for i in inhabitants):
        inhabitants = tuple(i for i in inhabitants if i.name == node.name)
        key = f"world of {node.name}"
    if absent := [inhabitant.name for inhabitant in inhabitants if not inhabitant.here]:
        raise WorldError(
            "expected all that is in one world in one process, found "
            f"{', '.join(absent)} in another one: name them together after --only"
        )
    world: SharedWorld = node.share(key, lambda: SharedWorld(inhabitants, node.checking, node.seed))
    if node.config.world not in ("", world.name):
        raise WorldError(
            f'world: expected "{world.name}", in which {world.named_by} is, since all vehicles of '
            f'a run share one world, found "{node.config.world}"'
        )
    if node.config.mesh != (world.mesh if node.config.world else MeshSpec()):
        raise WorldError(
            f"mesh: expected the settings of {world.named_by or 'a node'}, which names the world, "
            f"where a node names it too, and else none, found others"
        )
    origins = {i.config.origin for i in inhabitants if hasattr(i.config, "origin")}
    if len(origins) > 1:
        raise WorldError(
            f"origin: expected one for all vehicles of a world, found {sorted(origins)}"
        )
    await world.build(node)
    return world


class WorldConfig(NodeConfig):
    """Settings of a world, apart from its vehicles.

    Attributes:
        world: Name or path of the world, as of a simulator; empty for that of the vehicles.
        mesh: How the world is made of a mesh file; of the node that names the world.
        wind: The wind.
        bodies: Self-moving bodies.
        lights: Lights that change in time.
        fog: Fog; none unless given.
        rate: Rate of the bodies' true poses and of the true wind round each vehicle, Hz.
    """

    world: NameOrPath = ""
    mesh: MeshSpec = MeshSpec()
    wind: WindSpec = WindSpec()
    bodies: tuple[BodySpec, ...] = ()
    lights: tuple[LightSpec, ...] = ()
    fog: FogSpec | None = None
    rate: Rate = 50


class World(Inhabitant, Node[WorldConfig]):
    """World of all vehicles and free cameras of a run.

    A run needs it only for wind, and for parts that move or change by themselves.
    """

    flies = True

    body_poses = Output(PoseStamped)
    wind = Output(Wind)

    async def on_startup(self) -> None:
        """Build the world, or find the built world; `WorldError` beside another such node."""
        first, *others = (world.name for world in self.siblings(World))
        if others and self.name != first:
            raise WorldError(f"expected one node of a world, found {first} besides")
        self._world = await join_world(self)
        own = {f"{self.name}/{spec.name}": spec.kind for spec in self.config.bodies}
        self._kinds = own
        self._bodies = [
            motion
            for motion in self._world.dynamics.motions
            if isinstance(motion, BodyMotion) and motion.name in own
        ]

    @classmethod
    def populate(cls, scene: Scene, name: str, config: Any) -> Dynamics:
        """Put bodies and fog into the world, and have its lights change."""
        added = add_bodies(scene, name, config.bodies).joined(change_lights(scene, config.lights))
        return added if config.fog is None else added.joined(add_fog(scene, config.fog))

    @classmethod
    def wind_of(cls, config: Any) -> WindSpec:
        """Return the wind of the settings."""
        spec: WindSpec = config.wind
        return spec

    def announce(self) -> Iterable[Announcement]:
        """Announce the bodies, and the wind round each vehicle."""
        for body in self._bodies:
            yield BodyAnnouncement(
                stamp=0,
                source=body.name,
                kind=self._kinds[body.name],
                object_ids=self._world.geoms_of(body.name),
            )
        wind = self.config.wind
        for vehicle in self._world.vehicles if not wind.still else ():
            yield WindAnnouncement(
                stamp=0,
                source=f"{self.name}/{vehicle}",
                rate=self.config.rate,
                velocity=wind.velocity,
                turbulence=wind.w20,
            )

    @every(hz="rate")
    def send_truth(self, tick: Tick) -> None:
        """Send the poses of the bodies, and the wind round each vehicle."""
        stamp, world = tick.stamp, self._world
        for body in self._bodies:
            position, orientation = body.pose(stamp * 1e-9)
            self.body_poses.send(
                PoseStamped(
                    stamp=stamp, source=body.name, position=position, orientation=orientation
                )
            )
        if world.air is None or world.simulation is None:
            return
        world.simulation.advance_to(stamp)
        for vehicle in world.vehicles:
            velocity = world.air.velocity_at(vehicle)
            source = f"{self.name}/{vehicle}"
            self.wind.send(Wind(stamp=world.simulation.time_ns, source=source, velocity=velocity))


Latitude = Annotated[float, msgspec.Meta(ge=-90, le=90)]
Longitude = Annotated[float, msgspec.Meta(ge=-180, le=180)]
Count = Annotated[int, msgspec.Meta(ge=1, le=16)]


class SimulatorConfig(NodeConfig):
    """Settings of every simulator.

    Attributes:
        world: Built-in world (``hall``, ``yard``, ``corridor``, ``office``, ``night``, ``forest``,
            ``field``, ``mocap``) or path of an MJCF or mesh file (.glb, .gltf, .obj, .ply, .stl,
            .dae, a Gazebo .world or .sdf); empty for the other vehicles', or ``hall``. In MJCF x is
            north, y west, z up; in all settings and events x is north, y east, z down (NED):
            ``pos="1 2 3"`` is (1, -2, -3) in ``map``.
        mesh: How the world is made of a mesh file; of the node that names the world.
        origin: Where the origin of ``map`` is on the earth: latitude and longitude, degrees north
            and east, and altitude, metres above the WGS 84 ellipsoid, which here is sea level too.
        cameras: The cameras that are carried.
        camera_processes: Number of processes that render.
        render_threads: Threads that draw in each of them; images do not depend on it.
        renderer: ``mujoco``: MuJoCo's, by OpenGL; its pixels depend on the driver. ``raster``: the
            project's own, about twice as quick, with the same bytes on every machine.
        setpoint_timeout: Age beyond which set-points are ignored, but of position or pose.
    """

    world: NameOrPath = ""
    mesh: MeshSpec = MeshSpec()
    origin: tuple[Latitude, Longitude, float] = (47.641468, -122.140165, 122.0)
    cameras: tuple[CameraSpec, ...] = ()
    camera_processes: Count = 2
    render_threads: Count = 1
    renderer: RendererName = "raster"
    setpoint_timeout: Duration = Duration(0.5)  # immutable


C = TypeVar("C", bound=SimulatorConfig, default=SimulatorConfig)


class Simulator(Inhabitant, Node[C], ABC):
    """Base of the simulators' nodes: their common outputs, and the cameras.

    A subclass's `on_startup` calls this one's, compiles the model and starts the rig.
    """

    flies = True

    images = Output(ev.Image)
    depth_images = Output(ev.DepthImage)
    segmentation_images = Output(ev.SegmentationImage)
    camera_poses = Output(ev.PoseStamped)
    transforms = Output(ev.TransformStamped)
    odometry = Output(ev.Odometry)

    @property
    @abstractmethod
    def frame_id(self) -> str:
        """Frame of the cameras' body."""

    @property
    def cameras(self) -> tuple[CameraSpec, ...]:
        """The cameras as they are used."""
        return self.config.cameras

    async def on_startup(self) -> None:
        """Prepare the cameras and the routing of orders."""
        config = self.config
        self._addressee = Addressee(self.name, self.siblings(Simulator), self.sources)
        outputs = CameraOutputs(
            self.images, self.depth_images, self.segmentation_images, self.camera_poses
        )
        self.rig = CameraRig(
            self,
            self.cameras,
            outputs,
            config.camera_processes,
            config.render_threads,
            config.renderer,
        )

    def announce(self) -> Iterable[ev.Announcement]:
        """Announce the cameras."""
        return self.rig.announcements(self.frame_id)

    def _send_state(self, stamp: int, state: State) -> None:
        self.odometry.send(
            ev.Odometry(
                stamp=stamp,
                source=self.name,
                child_frame_id=self.frame_id,
                position=state.position,
                orientation=state.orientation,
                linear_velocity=rotate_inverse(state.orientation, state.velocity),
                angular_velocity=state.angular_velocity,
            )
        )

    def on_change(self, before: Any) -> None:  # noqa: ARG002
        """Deliver images as the changed settings say."""
        self.rig.change(self.cameras)

    async def run(self) -> None:
        """Send the poses of the cameras on the body, once."""
        for mounting in self.rig.transforms(self.frame_id):
            self.transforms.send(mounting)

    async def on_shutdown(self) -> None:
        """Log how many images are missing."""
        self.rig.log_missing()


Order = ev.Command | ev.Setpoint | ev.PathAnnouncement | ev.PilotAnnouncement


class Addressee:
    """Routing of orders to vehicles, or to free cameras if there are none.

    An order that names a vehicle is for that one. One that names none is for the only vehicle of
    the run, and for those whose ports are narrowed to its source.
    """

    def __init__(self, name: str, simulators: Sequence[Sibling], ports: Mapping[str, str]) -> None:
        self._name = name
        self._ports = ports
        self._simulators = simulators
        self._known = [simulator.name for simulator in simulators]
        vehicles = [simulator.name for simulator in simulators if simulator.node.vehicle]
        self._vehicles = vehicles or self._known
        self._refused: set[tuple[str, str]] = set()

    def obeys(self, order: Order, port: str) -> bool:
        """Return whether an order at a port, or a pilot's path, is for this vehicle."""
        narrowed = self._ports.get(port)
        if narrowed and not f"{order.source}/".startswith(f"{narrowed}/"):
            return False
        if order.vehicle:
            return order.vehicle == self._name
        return bool(narrowed) or self._vehicles == [self._name]

    def refusal(self, order: Order) -> str:
        """Return, only of the first vehicle, the reason against an order for nobody, once."""
        key = (order.source, order.vehicle)
        if self._vehicles[0] != self._name or key in self._refused:
            return ""
        reason = "" if not order.vehicle and self._narrowed_to(order.source) else self._fault(order)
        if reason:
            self._refused.add(key)
        return reason

    def complaints(self, pilots: Iterable[ev.PilotAnnouncement]) -> Iterator[str]:
        """Yield errors in the vehicles named by pilots, if this is the first vehicle."""
        for pilot in pilots:
            if reason := self.refusal(pilot):
                yield f"{pilot.source}: vehicle: {reason}"

    def _fault(self, order: Order) -> str:
        if order.vehicle in self._known or (not order.vehicle and len(self._vehicles) < 2):
            return ""
        given = (
            f'"{order.vehicle}"{suggest(order.vehicle, self._known)}' if order.vehicle else "none"
        )
        return f"expected one of {', '.join(self._vehicles)}, found {given}"

    def _narrowed_to(self, source: str) -> bool:
        return any(
            f"{source}/".startswith(f"{narrowed}/")
            for simulator in self._simulators
            for port, narrowed in simulator.sources.items()
            if port in ("commands", "setpoints")
        )
