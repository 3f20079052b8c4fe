"""Boxes, cylinders, walls, arches, crowns: so that a layout reads like a floor plan.

The world here is MuJoCo's: x north, y **west**, z up (NWU), metres. A thing that can be hit is two
geoms: `<name>` is the solid (a primitive, group 3, not drawn), `<name>.look` the textured surface
(a mesh, group 0, meets nothing). They coincide.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import mujoco
import numpy as np

from sims.worlds.decals import tile
from sims.worlds.model import Material, Model, Vector
from sims.worlds.shapes import FACES, STEP, Window, arch, blob, box, cylinder, face_size, quad

WHOLE: Window = (0.0, 0.0, 1.0, 1.0)


def sides(
    half: tuple[float, float], middle: tuple[float, float] = (0.0, 0.0)
) -> Iterator[tuple[str, tuple[float, float], float, float]]:
    """Yield name, place of the foot, direction that it faces and width of a room's four walls."""
    (x, y), (u, v) = half, middle
    yield "wall_north", (u + x, v), 180.0, 2.0 * y
    yield "wall_south", (u - x, v), 0.0, 2.0 * y
    yield "wall_east", (u, v - y), 90.0, 2.0 * x
    yield "wall_west", (u, v + y), -90.0, 2.0 * x


class Builder(Model):
    """A model, with methods for the solids that worlds are built of."""

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
            name: Name of the box.
            material: Material of all its faces.
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
            face: chosen[face] if face in chosen else self.cut(material, *face_size(face, size))
            for face in FACES
            if face not in hidden
        }
        middle = place if tilt else (place[0], place[1], place[2] + size[2] / 2.0)
        self.look(f"{name}.look", box(size, faces), material, middle, turn, tilt)
        half = [length / 2.0 for length in size]
        self.solid(name, mujoco.mjtGeom.mjGEOM_BOX, half, middle, turn, tilt)

    def crate(
        self, name: str, material: Material, edge: float, place: Vector, turn: float | None = None
    ) -> None:
        """Add a cube, each side of which shows one of the nine images of a material at random.

        Without a `turn` (degrees) it stands a little askew, at random.
        """
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
        self.look(f"{name}.look", cylinder(radius, height, side, top, sides), material, middle)
        self.solid(name, mujoco.mjtGeom.mjGEOM_CYLINDER, [radius, height / 2.0], middle)

    def crown(self, name: str, material: Material, radii: Vector, place: Vector) -> None:
        """Add a tree's crown: a bumpy ellipsoid about `place`, never outside its solid."""
        bumps = self.random.uniform(0.80, 1.0, (11, 19))
        window = self.cut(material, 4.0 * radii[0], 2.0 * radii[2])
        self.look(f"{name}.look", blob(radii, bumps, window), material, place)
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
        """Add a wall that has one side; `place` is the middle of its foot.

        It shows all of the material, or that `window` of it, which may repeat it.
        """
        width, height = size
        middle = (place[0], place[1], place[2] + height / 2.0)
        self.panel(f"{name}.look", material, window, size, middle, facing)
        angle = math.radians(facing)
        behind = (
            place[0] - math.cos(angle) * thick / 2.0,
            place[1] - math.sin(angle) * thick / 2.0,
            middle[2],
        )
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
        """Add level ground, north up in the material; `half` are its half lengths along x and y.

        It is cut every `step` metres, at the corners of which it is lit.
        """
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
        surface = quad(
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
        """Hang up an image (drawn, without collisions).

        Args:
            name: Name of the image.
            material: Material of which it shows a part.
            window: That part.
            size: Width and height, metres.
            place: Its middle.
            facing: Direction in which it faces: degrees from north to the west.
        """
        width, height = size
        surface = quad(
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
        opening: tuple[float, float],
        leg: float,
        depth: float,
        place: Vector,
        turn: float = 0.0,
    ) -> None:
        """Add a round arch: two legs and a half ring; one flies through it along its x.

        Args:
            name: Its name; the legs are ``<name>/left``, ``/right``, the ring ``<name>/ring``.
            material: Material of the whole arch.
            opening: Clear width, and height of the legs, metres.
            leg: Width of a leg and of the ring, metres.
            depth: Thickness along x, metres.
            place: The middle of the opening, on the ground.
            turn: About z, degrees.
        """
        inner, rise = opening[0] / 2.0, opening[1]
        side = (-math.sin(math.radians(turn)), math.cos(math.radians(turn)))
        for which, sign in (("left", 1.0), ("right", -1.0)):
            offset = sign * (inner + leg / 2.0)
            foot = (place[0] + side[0] * offset, place[1] + side[1] * offset, place[2])
            self.box(f"{name}/{which}", material, (depth, leg, rise), foot, turn=turn)
        spring = (place[0], place[1], place[2] + rise)
        scale = (1.0 / material.width, 1.0 / material.height)
        ring = arch(inner, inner + leg, depth, 16, scale)
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
