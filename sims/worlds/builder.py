"""Builder of worlds: boxes, cylinders, walls, arches and crowns, as on a floor plan.

The world here is MuJoCo's: x north, y **west**, z up (NWU), metres. A thing that can be hit is two
geoms: `<name>` is the solid (a primitive, group 3, not drawn), `<name>.look` the textured surface
(a mesh, group 0, meets nothing). They coincide.
"""

from __future__ import annotations

import functools
import math
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from events.base import Vector3
from events.frames import from_rpy
from sims.worlds import surfaces
from sims.worlds.decals import tile
from sims.worlds.materials import Canvas, sky
from sims.worlds.surfaces import FACES, STEP, Draw, Surface, Window, own_generator, texture

LOOK_GROUP, SOLID_GROUP = 0, 3
Vector = tuple[float, float, float]


class Material(NamedTuple):
    """A texture in the model."""

    name: str
    width: float
    height: float
    # Pieces that are cut out of it start at a multiple of this, metres down: a course of bricks.
    module: float = 0.0


WHOLE: Window = (0.0, 0.0, 1.0, 1.0)


def sides(
    half: tuple[float, float], middle: tuple[float, float] = (0.0, 0.0)
) -> Iterator[tuple[str, tuple[float, float], float, float]]:
    """Yield name, foot position, facing (degrees) and width of a room's four walls."""
    (x, y), (u, v) = half, middle
    yield "wall_north", (u + x, v), 180.0, 2.0 * y
    yield "wall_south", (u - x, v), 0.0, 2.0 * y
    yield "wall_east", (u, v - y), 90.0, 2.0 * x
    yield "wall_west", (u, v + y), -90.0, 2.0 * x


def add_material(world: mujoco.MjSpec, name: str, **look: Any) -> None:
    """Add a material to a world, with the texture of the same name."""
    material = world.add_material(name=name, **look)
    textures = list(material.textures)
    textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    material.textures = textures


class Builder:
    """Builder of a world: materials, surfaces, lights and solids.

    Args:
        name: Name of the model, which its random numbers depend on.
        bare: Leave out the images, which take seconds to draw.
        world: Name of the world whose textures these are; the model's, if empty.
    """

    def __init__(self, name: str, seed: int, bare: bool = False, world: str = "") -> None:
        self._world, self._seed, self._bare = world or name, seed, bare
        self.random = np.random.default_rng([seed, len(name), *name.encode()])
        self.spec = mujoco.MjSpec()
        self.spec.modelname = name
        # A light shade everywhere, so that nothing is black.
        self.spec.visual.headlight.diffuse = [0.0, 0.0, 0.0]
        self.spec.visual.headlight.specular = [0.0, 0.0, 0.0]
        self.spec.visual.quality.shadowsize = 0
        self.spec.visual.quality.offsamples = 0

    def _texture(
        self, name: str, draw: Draw, shape: tuple[int, int], density: float, kind: Any
    ) -> tuple[int, int]:
        random = own_generator(self._world, self._seed, name, self.random)
        if self._bare:
            image = np.zeros((6, 1, 3), np.uint8)  # as a skybox has it, which is six squares
        else:
            canvas = Canvas(shape, random, density)
            image = texture(self._world, self._seed, name, draw, canvas)
        height, width = image.shape[:2]
        added = self.spec.add_texture(name=name, type=kind, width=width, height=height, nchannel=3)
        added.data = image.tobytes()
        return width, height

    def material(
        self,
        name: str,
        draw: Draw,
        shape: tuple[int, int],
        density: float,
        *,
        module: float = 0.0,
        glow: float = 0.0,
        **options: Any,
    ) -> Material:
        """Add a material, drawn on a canvas of a shape (pixels) and density (pixels per metre).

        Args:
            glow: Light that it emits, 0 to 1.
            options: Further arguments of `draw`.
        """
        drawn, kind = functools.partial(draw, **options), mujoco.mjtTexture.mjTEXTURE_2D
        width, height = self._texture(name, drawn, shape, density, kind)
        add_material(self.spec, name, specular=0.05, shininess=0.1, reflectance=0.0, emission=glow)
        return Material(name, width / density, height / density, module)

    def sky(self, night: bool = False) -> None:
        """Add a sky: the six faces of a cube, stacked in OpenGL's order."""
        drawn = functools.partial(sky, night=night)
        self._texture("sky", drawn, (384, 384), 1.0, mujoco.mjtTexture.mjTEXTURE_SKYBOX)

    def cut(self, material: Material, width: float, height: float) -> Window:
        """Return a piece of a material, metres, from a random place, or the whole."""
        width, height = min(width, material.width), min(height, material.height)
        left = self.random.uniform(0.0, material.width - width)
        top = self.random.uniform(0.0, material.height - height)
        if material.module > 0.0:
            top = math.floor(top / material.module) * material.module
        across, down = material.width, material.height
        return left / across, top / down, (left + width) / across, (top + height) / down

    def look(
        self,
        name: str,
        surface: Surface,
        material: Material,
        place: Vector,
        turn: float = 0.0,
        tilt: float = 0.0,
    ) -> None:
        """Add a drawn surface without collisions."""
        self.mesh(name, surface)
        self.hang(name, name, material, self.spec.worldbody, place, turn, tilt)

    def mesh(self, name: str, surface: Surface) -> None:
        """Add a surface for repeated use by `hang`."""
        self.spec.add_mesh(
            name=name,
            uservert=surface.points.ravel(),
            usernormal=surface.normals.ravel(),
            usertexcoord=surface.texture.ravel(),
            userface=surface.faces.ravel(),
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
        )

    def moving(self, name: str) -> Any:
        """Add a self-moving body to hang surfaces on; its weight does not matter."""
        return self.spec.worldbody.add_body(
            name=name, mocap=True, mass=1.0, inertia=[1.0, 1.0, 1.0], explicitinertial=True
        )

    def hang(
        self,
        name: str,
        mesh: str,
        material: Material,
        body: Any,
        place: Vector = (0.0, 0.0, 0.0),
        turn: float = 0.0,
        tilt: float = 0.0,
    ) -> None:
        """Hang a surface of `mesh` on a body: drawn, without collisions."""
        body.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=mesh,
            material=material.name,
            pos=place,
            quat=from_rpy(0.0, math.radians(tilt), math.radians(turn)),
            contype=0,
            conaffinity=0,
            group=LOOK_GROUP,
        )

    def solid(
        self,
        name: str,
        kind: Any,
        size: Sequence[float],
        place: Vector,
        turn: float = 0.0,
        tilt: float = 0.0,
        roll: float = 0.0,
    ) -> None:
        """Add a primitive for collisions, not drawn; `size` is MuJoCo's (half lengths)."""
        quat = np.empty(4)
        mujoco.mju_mulQuat(
            quat,
            np.asarray(from_rpy(0.0, math.radians(tilt), math.radians(turn))),
            np.array([math.cos(roll / 2), math.sin(roll / 2), 0.0, 0.0]),
        )
        self.spec.worldbody.add_geom(
            name=name,
            type=kind,
            size=[*size, 0.0, 0.0][:3],
            pos=place,
            quat=quat,
            group=SOLID_GROUP,
            rgba=[0.6, 0.6, 0.6, 1.0],
        )

    def light(
        self,
        name: str,
        place: Vector,
        colour: Vector,  # strength in red, green, blue
        *,
        towards: Vector = (0.0, 0.0, -1.0),
        sun: bool = False,
        fall_off: float = 0.0,  # 1/m² in 1 / (1 + fall_off r²)
        cone: float = 0.0,  # degrees to each side of its direction that it reaches; 0: to all sides
    ) -> None:
        """Add a light."""
        kind = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL if sun else mujoco.mjtLightType.mjLIGHT_POINT
        if cone:
            kind = mujoco.mjtLightType.mjLIGHT_SPOT
        light = self.spec.worldbody.add_light(
            name=name,
            type=kind,
            pos=place,
            dir=towards,
            diffuse=colour,
            specular=[0.0, 0.0, 0.0],
            ambient=[0.0, 0.0, 0.0],
            attenuation=[1.0, 0.0, fall_off],
            castshadow=False,
        )
        if cone:
            light.cutoff, light.exponent = cone, 1.5

    def box(
        self,
        name: str,
        material: Material,
        size: Vector,
        place: Vector,
        *,
        turn: float = 0.0,
        tilt: float = 0.0,
        windows: dict[str, Window] | None = None,
        hidden: tuple[str, ...] | None = None,
    ) -> None:
        """Add a box.

        Args:
            size: Lengths along its x, y, z, metres.
            place: The middle of its **base**, metres (of the box itself if it is tilted).
            turn: About z, degrees.
            tilt: About its y, degrees; positive lowers its +x end.
            windows: Part of the material for some faces; for the others one is cut at random.
            hidden: Faces that nobody can see; None: the bottom, if it lies on the ground.
        """
        chosen = windows or {}
        if hidden is None:
            hidden = ("bottom",) if place[2] == 0.0 and tilt == 0.0 else ()
        faces = {
            face: chosen[face]
            if face in chosen
            else self.cut(material, *surfaces.face_size(face, size))
            for face in FACES
            if face not in hidden
        }
        middle = place if tilt else (place[0], place[1], place[2] + size[2] / 2.0)
        self.look(f"{name}.look", surfaces.box(size, faces), material, middle, turn, tilt)
        half = [length / 2.0 for length in size]
        self.solid(name, mujoco.mjtGeom.mjGEOM_BOX, half, middle, turn, tilt)

    def crate(
        self, name: str, material: Material, edge: float, place: Vector, turn: float | None = None
    ) -> None:
        """Add a cube with random images of a material's nine, turned by degrees or at random."""
        windows = {
            face: tile(int(self.random.integers(9)), 3, 3) for face in FACES if face != "bottom"
        }
        turn = float(self.random.uniform(-9, 9)) if turn is None else turn
        self.box(name, material, (edge, edge, edge), place, turn=turn, windows=windows)

    def cylinder(
        self,
        name: str,
        material: Material,
        radius: float,
        height: float,
        place: Vector,
        top: Window | None = None,
        side: Window | None = None,
        sides: int = 24,
    ) -> None:
        """Add an upright cylinder, drawn with some flat sides; `place` is its base's middle."""
        side = side or self.cut(material, 2.0 * math.pi * radius, height)
        top = top or self.cut(material, 2.0 * radius, 2.0 * radius)
        middle = (place[0], place[1], place[2] + height / 2.0)
        self.look(
            f"{name}.look", surfaces.cylinder(radius, height, side, top, sides), material, middle
        )
        self.solid(name, mujoco.mjtGeom.mjGEOM_CYLINDER, [radius, height / 2.0], middle)

    def crown(self, name: str, material: Material, radii: Vector, place: Vector) -> None:
        """Add a tree's crown: a bumpy ellipsoid about `place`, never outside its solid."""
        bumps = self.random.uniform(0.80, 1.0, (11, 19))
        window = self.cut(material, 4.0 * radii[0], 2.0 * radii[2])
        self.look(f"{name}.look", surfaces.blob(radii, bumps, window), material, place)
        self.solid(name, mujoco.mjtGeom.mjGEOM_ELLIPSOID, radii, place)

    def wall(
        self,
        name: str,
        material: Material,
        size: tuple[float, float],
        place: Vector,
        facing: float,
        thick: float = 0.3,
        window: Window = WHOLE,
    ) -> None:
        """Add a single-sided wall, foot's middle at `place`; its `window` may repeat."""
        width, height = size
        middle = (place[0], place[1], place[2] + height / 2.0)
        self.panel(f"{name}.look", material, window, size, middle, facing)
        angle = math.radians(facing)
        x, y = math.cos(angle) * thick / 2.0, math.sin(angle) * thick / 2.0
        behind = (place[0] - x, place[1] - y, middle[2])
        half = [thick / 2.0, width / 2.0, height / 2.0]
        self.solid(name, mujoco.mjtGeom.mjGEOM_BOX, half, behind, facing)

    def floor(
        self,
        name: str,
        material: Material,
        half: tuple[float, float],
        *,
        middle: tuple[float, float] = (0.0, 0.0),
        window: Window = WHOLE,
        step: float = STEP,
    ) -> None:
        """Add level ground, north up, of half lengths `half`, lit at each `step` metres."""
        self._level(f"{name}.look", material, half, (*middle, 0.0), window, 1.0, step)
        self.solid(name, mujoco.mjtGeom.mjGEOM_PLANE, [*half, 0.1], (*middle, 0.0))

    def ceiling(
        self,
        name: str,
        material: Material,
        half: tuple[float, float],
        height: float,
        *,
        middle: tuple[float, float] = (0.0, 0.0),
        window: Window = WHOLE,
    ) -> None:
        """Add a ceiling, south up in the material; `half` are its half lengths along x and y."""
        self._level(f"{name}.look", material, half, (*middle, height), window, -1.0, STEP)
        place = (*middle, height + 0.1)
        self.solid(name, mujoco.mjtGeom.mjGEOM_BOX, [*half, 0.1], place)

    def _level(
        self,
        name: str,
        material: Material,
        half: tuple[float, float],
        place: Vector,
        window: Window,
        up: float,
        step: float,
    ) -> None:
        surface = surfaces.quad(
            np.array([up * half[0], half[1], 0.0]),
            np.array([0.0, -2.0 * half[1], 0.0]),
            np.array([-2.0 * up * half[0], 0.0, 0.0]),
            window,
            step,
        )
        self.look(name, surface, material, place)

    def panel(
        self,
        name: str,
        material: Material,
        window: Window,
        size: tuple[float, float],
        place: Vector,
        facing: float,
    ) -> None:
        """Hang up an image, without collisions, facing degrees from north to the west."""
        width, height = size
        surface = surfaces.quad(
            np.array([0.0, -width / 2.0, height / 2.0]),
            np.array([0.0, width, 0.0]),
            np.array([0.0, 0.0, -height]),
            window,
        )
        self.look(name, surface, material, place, facing)

    def arch(
        self,
        name: str,
        material: Material,
        *,
        opening: tuple[float, float],  # clear width, and height of the legs, metres
        leg: float,  # width of a leg and of the ring, metres
        depth: float,  # thickness along x, metres
        place: Vector,  # the middle of the opening, on the ground
        turn: float = 0.0,  # about z, degrees
    ) -> None:
        """Add a round arch, open along its x axis: ``<name>/left``, ``/right`` and ``/ring``."""
        inner, rise = opening[0] / 2.0, opening[1]
        side = (-math.sin(math.radians(turn)), math.cos(math.radians(turn)))
        for which, sign in (("left", 1.0), ("right", -1.0)):
            offset = sign * (inner + leg / 2.0)
            foot = (place[0] + side[0] * offset, place[1] + side[1] * offset, place[2])
            self.box(f"{name}/{which}", material, (depth, leg, rise), foot, turn=turn)
        spring = (place[0], place[1], place[2] + rise)
        scale = (1.0 / material.width, 1.0 / material.height)
        ring = surfaces.arch(inner, inner + leg, depth, 16, scale)
        self.look(f"{name}/ring.look", ring, material, spring, turn)
        pieces = 12
        for piece in range(pieces):
            angle = math.pi * (piece + 0.5) / pieces
            radius = inner + leg / 2.0
            at = radius * math.cos(angle)
            self.solid(
                f"{name}/ring" if piece == pieces // 2 else f"{name}/ring_{piece}",
                mujoco.mjtGeom.mjGEOM_BOX,
                [depth / 2.0, radius * math.tan(math.pi / pieces / 2.0), leg / 2.0],
                (
                    spring[0] + side[0] * at,
                    spring[1] + side[1] * at,
                    spring[2] + radius * math.sin(angle),
                ),
                turn,
                roll=angle - math.pi / 2.0,
            )


CLEARANCE = 0.8
"""Least distance (metres) of the straight lines between a tour's points from every solid."""


def _tours() -> dict[str, tuple[Vector3, ...]]:
    tours = tomllib.loads(Path(__file__).with_name("tours.toml").read_text(encoding="utf-8"))
    return {name: tuple((x, y, z) for x, y, z in points) for name, points in tours.items()}


TOURS = _tours()
TOURS["night"] = TOURS["yard"]
"""Tour of each world: waypoints (NED, metres) of a closed path, about 50 to 60 m long."""
