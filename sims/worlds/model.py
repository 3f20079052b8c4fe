"""Puts materials, surfaces, solids and lights into a model, under names.

The world here is MuJoCo's: x north, y **west**, z up (NWU), metres. What is put together of these
(boxes, arches, walls) is in `sims.worlds.builder`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from events.frames import from_rpy
from sims.worlds.shapes import Surface, Window
from sims.worlds.textures import Draw, own_generator, texture

LOOK_GROUP, SOLID_GROUP = 0, 3
Vector = tuple[float, float, float]


class Material(NamedTuple):
    """A texture in the model.

    Attributes:
        name: Name of the material.
        width: Width that it covers, metres.
        height: Height that it covers, metres.
        module: Pieces that are cut out of it start at a multiple of this, metres down: a course
            of bricks.
    """

    name: str
    width: float
    height: float
    module: float = 0.0


class Model:
    """Collects a world.

    Args:
        name: Name of the model, which its random numbers depend on.
        seed: Seed of everything random.
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

    def _texture(self, name: str, draw: Draw, kind: Any) -> tuple[int, int]:
        """Add a texture, and return its width and height, pixels."""
        random = own_generator(self._world, self._seed, name, self.random)
        if self._bare:
            image = np.zeros((6, 1, 3), np.uint8)  # as a skybox has it, which is six squares
        else:
            image = texture(self._world, self._seed, name, draw, random)
        height, width = image.shape[:2]
        added = self.spec.add_texture(name=name, type=kind, width=width, height=height, nchannel=3)
        added.data = image.tobytes()
        return width, height

    def material(
        self, name: str, draw: Draw, density: float, module: float = 0.0, glow: float = 0.0
    ) -> Material:
        """Add a material drawn at `density` pixels per metre.

        Args:
            name: Name of the material and of its texture.
            draw: Draws it, if it is not in the cache.
            density: Pixels per metre.
            module: See `Material`.
            glow: Light that it emits, 0..1.
        """
        width, height = self._texture(name, draw, mujoco.mjtTexture.mjTEXTURE_2D)
        material = self.spec.add_material(
            name=name, specular=0.05, shininess=0.1, reflectance=0.0, emission=glow
        )
        textures = list(material.textures)
        textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
        material.textures = textures
        return Material(name, width / density, height / density, module)

    def sky(self, draw: Draw) -> None:
        """Add a sky: the six faces of a cube, one below the other, as OpenGL has them."""
        self._texture("sky", draw, mujoco.mjtTexture.mjTEXTURE_SKYBOX)

    def cut(self, material: Material, width: float, height: float) -> Window:
        """Return a piece of a material from a random place, of a size in metres.

        A piece larger than the material is all of it, drawn larger.
        """
        width, height = min(width, material.width), min(height, material.height)
        left = self.random.uniform(0.0, material.width - width)
        top = self.random.uniform(0.0, material.height - height)
        if material.module > 0.0:
            top = math.floor(top / material.module) * material.module
        return (
            left / material.width,
            top / material.height,
            (left + width) / material.width,
            (top + height) / material.height,
        )

    def look(
        self,
        name: str,
        surface: Surface,
        material: Material,
        place: Vector,
        turn: float = 0.0,
        tilt: float = 0.0,
    ) -> None:
        """Add a surface that is drawn, without collisions."""
        self.mesh(name, surface)
        self.hang(name, name, material, self.spec.worldbody, place, turn, tilt)

    def mesh(self, name: str, surface: Surface) -> None:
        """Add a surface that can be hung up more than once."""
        self.spec.add_mesh(
            name=name,
            uservert=surface.points.ravel(),
            usernormal=surface.normals.ravel(),
            usertexcoord=surface.texture.ravel(),
            userface=surface.faces.ravel(),
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
        )

    def moving(self, name: str) -> Any:
        """Add a body that moves by itself, to hang surfaces on; it has no weight that matters."""
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
        """Put a surface that `mesh` added on a body: drawn, without collisions."""
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
        colour: Vector,
        *,
        towards: Vector = (0.0, 0.0, -1.0),
        sun: bool = False,
        fall_off: float = 0.0,
        cone: float = 0.0,
    ) -> None:
        """Add a light.

        Args:
            name: Name of the light.
            place: Its position, metres.
            colour: Strength in red, green, blue.
            towards: Its direction.
            sun: Parallel rays from very far away.
            fall_off: 1/m² in 1 / (1 + fall_off r²).
            cone: Degrees to each side of its direction that it reaches; 0: to all sides.
        """
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
