"""Shared world of a run: built once, of all nodes with a part in the world.

What belongs to it and to no vehicle (wind, moving bodies, lights, fog) has a node of its own.
"""

from __future__ import annotations

import asyncio
import functools
from abc import abstractmethod
from collections.abc import Callable, Iterable
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np
import numpy.typing as npt

from events import Announcement, BodyAnnouncement, PoseStamped, Vector3, Wind, WindAnnouncement
from runtime import Node, NodeConfig, Output, Tick, every
from runtime.host import Sibling
from runtime.paths import NameOrPath
from sims.cameras import model_to_bytes
from sims.vehicle import Simulation, State
from sims.vehicle.physics import Air
from sims.vehicle.simulation import Influence
from sims.worlds import Dynamics, Scene, WorldError, load_scene
from sims.worlds.bodies import BodyMotion, BodySpec, add_bodies
from sims.worlds.dynamics import FogSpec, LightSpec, add_fog, change_lights
from sims.worlds.wind import WindSpec

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
        named = [each for each in inhabitants if each.config.world]
        self.name = named[0].config.world if named else "hall"
        self.named_by = named[0].name if named else ""
        self._inhabitants = inhabitants
        self.vehicles = [each.name for each in inhabitants if each.node.vehicle]
        # State of each vehicle and free camera at its start, once that node has started up.
        self.starts: dict[str, State] = {}
        # Gives the state of each free camera at a time (ns); no physics knows it.
        self.free_cameras: dict[str, Callable[[int], State]] = {}
        self._bare = bare or not any(each.node.sees(each.config) for each in inhabitants)
        self._seed = seed
        self._built = False
        self._building = asyncio.Lock()

    async def build(self, node: Node[Any]) -> None:
        """Build the world, unless built already with its physics still finite."""
        async with self._building:
            if not self._built or (self.simulation and self.simulation.diverged):
                node.doing = f"building the world {self.name}"
                await node.offload(self._build)
                self._built, node.doing = True, ""

    @functools.cached_property
    def model_bytes(self) -> bytes:
        """Compiled world for other processes, made at the first request."""
        return model_to_bytes(self.model)

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
        spec, dynamics = load_scene(self.name, bare=self._bare)
        wind = None
        for each in self._inhabitants:
            node: type[Inhabitant] = each.node
            added = node.populate(Scene(spec, dynamics), each.name, each.config)
            dynamics = dynamics.joined(added)
            wind = node.wind_of(each.config) or wind
        self.model = spec.compile()
        self.__dict__.pop("model_bytes", None)
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
    if all(each.node.alone for each in inhabitants):
        inhabitants = tuple(each for each in inhabitants if each.name == node.name)
        key = f"world of {node.name}"
    if absent := [each.name for each in inhabitants if not each.here]:
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
    origins = {each.config.origin for each in inhabitants if hasattr(each.config, "origin")}
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
        wind: The wind.
        bodies: Self-moving bodies.
        lights: Lights that change in time.
        fog: Fog; none unless given.
        rate: Rate of the bodies' true poses and of the true wind round each vehicle, Hz.
    """

    world: NameOrPath = ""
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
        first, *others = (each.name for each in self.siblings(World))
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
