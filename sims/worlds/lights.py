"""Lights that change in time, and fog."""

from __future__ import annotations

import zlib
from itertools import pairwise
from typing import Annotated, Any, NamedTuple

import msgspec
import mujoco

from events import Vector3
from events.frames import flip_yz
from runtime.errors import suggest
from runtime.units import Duration
from sims.worlds.curves import interpolated
from sims.worlds.dynamics import Dynamics, Scene

NonNegative = Annotated[float, msgspec.Meta(ge=0)]
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]

HEADLIGHT = "headlight"
"""MuJoCo's name for the light that comes from everywhere, which all worlds have."""


class Changing(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How something changes in time.

    Attributes:
        times: When `factors` hold; in between they change evenly.
        factors: Strengths at these times, of what it is in the world.
        loop: Whether it begins anew after the last time; else the last factor holds.
    """

    times: tuple[Duration, ...] = (Duration(0),)
    factors: tuple[NonNegative, ...] = (1.0,)
    loop: bool = False

    def __post_init__(self) -> None:
        if not self.times or len(self.times) != len(self.factors):
            raise ValueError(
                f"times, factors: expected as many of each, and one at least, found "
                f"{len(self.times)} and {len(self.factors)}"
            )
        if any(after <= before for before, after in pairwise(self.times)):
            raise ValueError(f"times: expected rising ones, found {list(self.times)}")

    def factor(self, seconds: float) -> float:
        """Return the strength at a time."""
        return interpolated(self.times, self.factors, seconds, loop=self.loop, smooth=False)


class LightSpec(Changing, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a light of the world that changes in time.

    Attributes:
        name: The light's name in the world; ``headlight`` for the light that comes from everywhere;
            ``*`` for all of them.
        flicker: Share of its strength by which it flickers, at random but always alike.
        flicker_rate: How often a second it does.
        directions: Directions of its rays at the `times`, north, east, down: a sun that moves.
            Empty for that in the world.
    """

    name: str = "*"
    flicker: Share = 0.0
    flicker_rate: Annotated[float, msgspec.Meta(gt=0)] = 12.0
    directions: tuple[Vector3, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.directions and len(self.directions) != len(self.times):
            raise ValueError(
                f"directions: expected one for each of {len(self.times)} times, "
                f"found {len(self.directions)}"
            )

    def strength(self, seconds: float) -> float:
        """Return its strength at a time, flicker included."""
        step, rest = divmod(seconds * self.flicker_rate, 1.0)
        here, next_ = (zlib.crc32(b"%d" % (step + i)) / 0xFFFFFFFF for i in (0, 1))
        return self.factor(seconds) * (1.0 - self.flicker * (here + rest * (next_ - here)))


class FogSpec(Changing, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the fog.

    Attributes:
        start: Distance at which it begins, metres.
        end: Distance beyond which there is nothing but fog, metres. A factor of 2 halves both.
        colour: Red, green and blue, 0 to 1.
    """

    start: NonNegative = 0.0
    end: Annotated[float, msgspec.Meta(gt=0)] = 30.0
    colour: tuple[Share, Share, Share] = (0.72, 0.75, 0.78)


class LightMotion(NamedTuple):
    """A light's strength and direction at each time.

    Attributes:
        name: Name of the light.
        spec: How it changes.
        colours: What it is in the world: ambient, diffuse, specular.
    """

    name: str
    spec: LightSpec
    colours: tuple[tuple[float, ...], ...]

    @property
    def solid(self) -> bool:
        """Whether vehicles can touch it: never."""
        return False

    def apply(self, model: Any, data: Any, seconds: float) -> None:  # noqa: ARG002
        """Give it the strength and direction of a time."""
        strength = self.spec.strength(seconds)
        colours = [[strength * each for each in colour] for colour in self.colours]
        if self.name == HEADLIGHT:
            light = model.vis.headlight
            light.ambient[:], light.diffuse[:], light.specular[:] = colours
            return
        light = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_LIGHT, self.name)
        model.light_ambient[light], model.light_diffuse[light] = colours[:2]
        model.light_specular[light] = colours[2]
        if self.spec.directions:
            x, y, z = (
                interpolated(self.spec.times, axis, seconds, loop=self.spec.loop, smooth=False)
                for axis in zip(*self.spec.directions, strict=True)
            )
            length = (x * x + y * y + z * z) ** 0.5 or 1.0
            model.light_dir[light] = flip_yz((x / length, y / length, z / length))


class FogMotion(NamedTuple):
    """How thick the fog is at each time."""

    spec: FogSpec

    @property
    def solid(self) -> bool:
        """Whether vehicles can touch it: never."""
        return False

    def apply(self, model: Any, data: Any, seconds: float) -> None:  # noqa: ARG002
        """Make it as thick as it is at a time."""
        factor = max(self.spec.factor(seconds), 1e-3)
        fog = model.vis.map
        fog.fogstart = self.spec.start / factor / model.stat.extent
        fog.fogend = self.spec.end / factor / model.stat.extent


def change_lights(scene: Scene, specs: tuple[LightSpec, ...]) -> Dynamics:
    """Return how lights of a world change.

    Raises:
        ValueError: The world has no such light, or its direction cannot change.
    """
    world: Any = scene.spec
    lights = {light.name: light for light in world.lights if light.name}
    lights[HEADLIGHT] = world.visual.headlight
    motions = []
    for spec in specs:
        if spec.name != "*" and spec.name not in lights:
            raise ValueError(
                f"lights: expected one of {', '.join(lights)} or *, found "
                f'"{spec.name}"{suggest(spec.name, lights)}'
            )
        names = list(lights) if spec.name == "*" else [spec.name]
        if spec.directions and (spec.name == "*" or spec.name == HEADLIGHT):
            raise ValueError(f"lights: directions: expected those of one light, found {spec.name}")
        for name in names:
            light = lights[name]
            colours = tuple(
                tuple(float(each) for each in colour)
                for colour in (light.ambient, light.diffuse, light.specular)
            )
            motions.append(LightMotion(name, spec, colours))
    return Dynamics(tuple(motions))


def add_fog(scene: Scene, spec: FogSpec) -> Dynamics:
    """Put fog into a world, and return how it changes."""
    scene.spec.visual.rgba.fog = [*spec.colour, 1.0]
    return Dynamics((FogMotion(spec),), fog=True)
