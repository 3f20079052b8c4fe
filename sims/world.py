"""What belongs to a world and to no vehicle in it, as a node: wind, moving bodies, lights, fog."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from events import (
    Announcement,
    BodyAnnouncement,
    PoseStamped,
    Wind,
    WindAnnouncement,
)
from runtime import Node, NodeConfig, Output, Tick, every
from runtime.paths import NameOrPath
from sims.shared_world import Inhabitant, join_world
from sims.simulator import Rate
from sims.worlds import Dynamics, Scene, WorldError
from sims.worlds.bodies import BodyMotion, BodySpec, add_bodies
from sims.worlds.lights import FogSpec, LightSpec, add_fog, change_lights
from sims.worlds.wind import WindSpec, check_strength


class WorldConfig(NodeConfig):
    """Settings of a world that belong to no vehicle.

    Attributes:
        world: Name or path of the world, as of a simulator; empty for that which one of the
            vehicles names.
        wind: The wind.
        bodies: Bodies that move by themselves.
        lights: Lights of the world that change in time.
        fog: Fog; none unless it is given.
        rate: Rate at which the true poses of the bodies, and the true wind round each vehicle,
            are sent, Hz.
    """

    world: NameOrPath = ""
    wind: WindSpec = WindSpec()
    bodies: tuple[BodySpec, ...] = ()
    lights: tuple[LightSpec, ...] = ()
    fog: FogSpec | None = None
    rate: Rate = 50


class World(Inhabitant, Node[WorldConfig]):
    """The world in which all vehicles and free cameras of a run are.

    A run without wind, and without anything that moves or changes by itself, needs none.
    """

    flies = True

    body_poses = Output(PoseStamped)
    wind = Output(Wind)

    async def on_startup(self) -> None:
        """Build the world, unless a vehicle before has done so.

        Raises:
            WorldError: There is another node of a world.
        """
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

    def set_wind(self, velocity: tuple[float, float, float]) -> None:
        """Set the mean wind, m/s NED, from the next millisecond on; gusts and turbulence stay.

        Raises:
            ValueError: The settings have no wind that could be changed, or it is too strong.
        """
        check_strength(velocity)
        if self._world.air is None:
            raise ValueError("wind: expected some in the world's settings, found none")
        self._world.air.velocity = velocity
