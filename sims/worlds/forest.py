"""`forest`: a wood with thin stems and branches, 40 x 40 m, whose leaves and shadows move.

Coordinates in this file are MuJoCo's: x north, y **west**, z up, metres, from the middle. Where
things stand is drawn once for all seeds, so that the tour's path stays free.
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import mujoco
import numpy as np
import numpy.typing as npt

from runtime.portable import sines
from sims.worlds import materials
from sims.worlds.builder import TOURS, Builder, Material, Vector
from sims.worlds.dynamics import Dynamics, Motion, Scene
from sims.worlds.materials import Canvas, Image, mix, shade, share, smooth
from sims.worlds.surfaces import Surface, cylinder

HALF = 20.0
DENSITY = 60.0
STEMS, BRANCHES = 46, 2
SUN = (0.40, -0.35, -0.85)
Points = npt.NDArray[np.float64]
GROUPS = 7
SWING = np.repeat([[0.16, 0.16, 0.05], [0.07, 0.07, 0.03], [0.35, 0.35, 0.0]], GROUPS, axis=0)
"""How far crowns, sprays of leaves and shadows move, in so many groups each, metres."""


class Sway(Motion, frozen=True):
    """Leaves and shadows in the wind: some mocap bodies move to and fro, each at its own pace."""

    swing: Points  # greatest distance from the place along x, y, z, metres, shape (n, 3)

    def apply(self, model: Any, data: Any, seconds: float) -> None:
        """Move the bodies from ``sway_0`` on."""
        count = len(self.swing)
        first = int(model.body("sway_0").mocapid[0])
        phases = 2.4 * np.arange(count)
        slow, quick = sines(1.9 * seconds + phases), sines(5.3 * seconds + 2.7 * phases)
        offset = np.stack([0.7 * slow + 0.3 * quick, 0.6 * quick - 0.3 * slow, quick], axis=1)
        data.mocap_pos[first : first + count] = self.swing * offset


def forest(seed: int = 0, bare: bool = False) -> Scene:
    """Return the wood and its dynamics; bark, ground and leaves depend on the seed."""
    b = Builder("forest", seed, bare)
    b.spec.visual.headlight.ambient = [0.50, 0.55, 0.48]
    bark = b.material("bark", materials.bark, (768, 192), 96.0, width=0.05)
    green = b.material("leaves", materials.leaves, (512, 512), 96.0)
    sways = [b.moving(f"sway_{number}") for number in range(len(SWING))]
    _leaves(b, green, _stems(b, bark), sways)
    back = b.material("thicket", _thicket, (576, 480), 24.0)
    size = (2.0 * HALF * math.tan(math.pi / 24) + 0.05, 24.0)
    for number in range(24):
        angle = math.radians(15.0 * number)
        place = (-HALF * math.cos(angle), -HALF * math.sin(angle), 0.0)
        b.wall(f"thicket_{number}", back, size, place, 15.0 * number, window=b.cut(back, *size))
    ground = b.material("ground", _ground, (int(2 * HALF * DENSITY),) * 2, DENSITY)
    b.floor("ground", ground, (HALF, HALF), step=2.5)
    _shadows(b, sways[2 * GROUPS :])
    b.sky()
    b.light("sun", (0.0, 0.0, 20.0), (0.66, 0.62, 0.46), towards=SUN, sun=True)
    b.light("sky_light", (0.0, 0.0, 20.0), (0.12, 0.15, 0.17), towards=(-0.5, 0.5, -0.3), sun=True)
    b.spec.stat.center = [0.0, 0.0, 2.0]
    b.spec.stat.extent = 20.0
    return Scene(b.spec, Dynamics((Sway(SWING),)))


def _free(point: Points, path: Points) -> float:
    return float(np.linalg.norm(path - point, axis=-1).min())


def _stems(b: Builder, bark: Material) -> list[Vector]:
    """Add stems with branches, none near the tour; return where leaves hang."""
    fixed = np.random.default_rng(11)
    tour = np.array(TOURS["forest"]) * (1.0, -1.0, -1.0)
    share = np.linspace(0.0, 1.0, 40)[:, None, None]
    path = (tour + share * (np.roll(tour, -1, axis=0) - tour)).reshape(-1, 3)
    stems: list[Points] = []
    ends: list[Vector] = []
    while len(stems) < STEMS:
        place = fixed.uniform(-16.5, 16.5, 2)
        crowded = any(math.dist(place, other) < 1.9 for other in stems)
        if crowded or _free(place, path[:, :2]) < 1.12 or np.hypot(*place) > 17.5:
            continue
        number, thin = len(stems), len(stems) % 3 == 2
        stems.append(place)
        x, y = place.tolist()
        radius = 0.035 if thin else float(fixed.uniform(0.09, 0.2))
        height = 3.2 if thin else float(fixed.uniform(6.5, 8.0))
        b.cylinder(f"stem_{number}", bark, radius, height, (x, y, 0.0), sides=5 if thin else 9)
        ends.append((x, y, height))
        made = 0
        while made < BRANCHES and not thin:
            turn, tilt = float(fixed.uniform(0, 360)), float(fixed.uniform(50, 78))
            length, low = float(fixed.uniform(1.2, 2.4)), float(fixed.uniform(1.2, 4.0))
            t, r = math.radians(tilt), math.radians(turn)
            way = (math.sin(t) * math.cos(r), math.sin(t) * math.sin(r), math.cos(t))
            line = np.array([x, y, low]) + np.outer(np.linspace(0.0, length, 12), way)
            if min(_free(point, path) for point in line) < 0.95:
                continue
            at: Vector = tuple(((line[0] + line[-1]) / 2.0).tolist())
            name = f"stem_{number}/branch_{made}"
            side = b.cut(bark, 0.15, length)
            b.look(f"{name}.look", cylinder(0.022, length, side, None, 4), bark, at, turn, tilt)
            b.solid(name, mujoco.mjtGeom.mjGEOM_CYLINDER, [0.022, length / 2], at, turn, tilt)
            ends.append(tuple(line[-1].tolist()))
            made += 1
    return ends


def _leaves(b: Builder, green: Material, ends: list[Vector], sways: list[Any]) -> None:
    b.mesh("crown", _cluster(b, 64, 2.1, 0.44))
    b.mesh("spray", _cluster(b, 20, 0.6, 0.17))
    for number, place in enumerate(ends):
        high = place[2] > 5.0
        body = sways[number % GROUPS + (0 if high else GROUPS)]
        b.hang(f"leaves_{number}", "crown" if high else "spray", green, body, place, 37.0 * number)


def _cluster(b: Builder, count: int, reach: float, size: float, *, flat: bool = False) -> Surface:
    """Return leaves, each a diamond with two sides, scattered about the origin, or flat there."""
    way = b.random.standard_normal((count, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    middle = way * reach * np.cbrt(b.random.uniform(size=(count, 1))) * (1.0, 1.0, 0.6)
    along = b.random.standard_normal((count, 3)) * (1.0, 1.0, 0.5)
    along *= size / np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(along, b.random.standard_normal((count, 3)))
    across *= 0.45 * size / np.linalg.norm(across, axis=1, keepdims=True)
    corners = np.stack([middle - along, middle - across, middle + along, middle + across], 1)
    corners[..., 2] *= not flat
    normal = np.cross(along, across)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    centre = b.random.uniform(0.05, 0.95, (count, 1, 2))
    texture = centre + np.array([[-0.04, 0], [0, -0.03], [0.04, 0], [0, 0.03]])
    halves = np.array([[0, 1, 2], [0, 2, 3]])
    front = (4 * np.arange(count)[:, None, None] + halves).reshape(-1, 3)
    sides = 4 * count
    return Surface(
        np.tile(corners.reshape(-1, 3), (2, 1)),
        np.concatenate([np.repeat(normal, 4, 0), -np.repeat(normal, 4, 0)]),
        np.tile(texture.reshape(-1, 2), (2, 1)),
        np.concatenate([front, front[:, ::-1] + sides]).astype(np.int32),
    )


def _shadows(b: Builder, sways: list[Any]) -> None:
    """Lay the crowns' moving shadows on the ground; last, to be drawn over the ground."""
    b.spec.add_material(name="shadow", rgba=[0.02, 0.03, 0.02, 0.30], specular=0.0)
    b.mesh("shadow", _cluster(b, 40, 1.6, 0.36, flat=True))
    places = np.random.default_rng(12).uniform(-11.0, 11.0, (18, 2)).tolist()
    for number, (x, y) in enumerate(places):
        body = sways[number % len(sways)]
        b.hang(f"shadow_{number}", "shadow", Material("shadow", 1.0, 1.0), body, (x, y, 0.015))


def _ground(on: Canvas) -> Image:
    ground = materials.grass(on)
    where = on.fractal(coarse=4.0 * DENSITY)
    ground = mix(ground, (0.33, 0.25, 0.17), smooth(-0.4, 0.5, where) * 0.85)
    fallen = on.specks(count=30000, radius=(1.5, 4.0))
    ground = mix(ground, (0.58, 0.40, 0.18), np.maximum(fallen, 0.0) * 0.8)
    ground = shade(ground, -0.5 * np.maximum(-fallen, 0.0))
    sun = smooth(0.2, 0.7, on.fractal(coarse=1.6 * DENSITY, gain=0.5))
    return shade(ground, 0.55 * sun - 0.25)


def _thicket(on: Canvas) -> Image:
    """Return 20 x 24 m of dense wood in the distance: stems, leaves, light in gaps."""
    shape, random = on.shape, on.random
    height = np.broadcast_to(np.linspace(1.0, 0.0, shape[0], dtype=np.float32)[:, None], shape)
    wood = materials.leaves(on._replace(density=40.0))
    stems = np.zeros(shape, np.uint8)
    for x in random.integers(0, shape[1], 44).tolist():
        lean = int(random.integers(-14, 15))
        cv2.line(stems, (x, 0), (x + lean, shape[0]), 255, int(random.integers(2, 9)), cv2.LINE_AA)
    wood = mix(wood, (0.28, 0.24, 0.19), share(stems) * smooth(1.0, 0.2, height))
    gaps = on.fractal(coarse=48, fine=3, gain=0.9)
    wood = mix(wood, (0.78, 0.85, 0.80), smooth(1.5, 2.0, gaps + 1.6 * height - 0.6))
    return shade(wood, 0.9 * height - 0.45)
