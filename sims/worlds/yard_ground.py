"""The ground of `yard`, in one image: asphalt, slabs, lawn, paint, and the sun's shadows.

Shadows are painted, not drawn: they cost nothing per frame. The positions of objects are therefore
given here (x north, y west, metres, as in `sims.worlds.yard`).
"""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
import numpy.typing as npt

from sims.worlds import decals, materials
from sims.worlds.patterns import Image, fractal, mix, share, smooth

HALF = 17.6
DENSITY = 60.0

CONTAINERS = (  # x, y, base, turn
    (-2.3, -3.3, 0.0, 8.0), (9.9, 1.2, 0.0, 84.0), (-9.6, 8.2, 0.0, 38.0),
    (10.2, -10.4, 0.0, -28.0), (9.7, 1.0, 2.59, 96.0),
)  # fmt: skip
CRATES = (  # x, y, base, edge, turn
    (1.6, -4.1, 0.0, 0.9, 14.0), (2.3, -3.7, 0.0, 0.7, -20.0), (-4.2, 3.9, 0.0, 0.9, 9.0),
    (-4.3, 4.0, 0.9, 0.7, 30.0), (-8.9, -11.3, 0.0, 1.0, -12.0), (-10.0, -11.0, 0.0, 0.9, 22.0),
    (-9.4, -11.2, 1.0, 0.8, 6.0), (7.6, 9.6, 0.0, 0.9, -8.0), (12.6, -2.6, 0.0, 1.0, 17.0),
    (-12.8, 1.2, 0.0, 1.0, 4.0), (-12.6, 2.2, 0.0, 0.8, -17.0), (3.1, 10.4, 0.9, 0.7, 21.0),
)  # fmt: skip
TREES = (  # x, y, height of the trunk, radius of the crown
    (2.9, 4.6, 3.1, 1.35), (8.6, 12.6, 2.6, 1.9), (-4.0, 12.4, 2.8, 1.8), (-12.4, 12.6, 2.6, 2.0),
    (-12.2, -1.4, 2.7, 1.6), (-12.3, -12.6, 2.8, 2.0), (4.6, -12.9, 2.7, 1.7),
    (13.2, 11.6, 2.8, 1.7), (-16.2, 6.5, 3.0, 1.5), (-16.2, -6.0, 3.0, 1.6), (7.5, 16.2, 3.0, 1.5),
    (-8.0, 16.2, 3.2, 1.6), (13.4, -13.2, 2.6, 1.6),
)  # fmt: skip
POSTS = ((12.5, -5.0), (-1.5, 10.9), (-8.9, 3.4), (0.6, -9.9))
Points = npt.NDArray[np.float64]


def image(random: np.random.Generator, sun: tuple[float, float, float] | None) -> Image:
    """Return the ground, north up and west left, with shadows if light goes along a `sun`."""
    shape = (int(2 * HALF * DENSITY),) * 2
    ground = materials.asphalt(shape, random, DENSITY)
    slabs = materials.tiles(
        shape, random, DENSITY, ((0.62, 0.59, 0.53), (0.55, 0.53, 0.49), (0.68, 0.63, 0.55)),
        size=(0.6, 0.9), stagger=0.5,
    )  # fmt: skip
    wobble = fractal(shape, random, coarse=2.0 * DENSITY, fine=6, gain=0.6)
    x, y = _coordinates(shape[0])
    # A paved round in the middle, a paved strip along the houses and the walls.
    paved = np.maximum(
        smooth(0.0, 0.06, 4.2 - np.hypot(x + 0.5, y)),
        smooth(0.0, 0.06, np.maximum(np.maximum(x, -y) - 14.6, np.maximum(-x, y) - 13.6)),
    )
    ground = mix(ground, slabs, paved)
    kerb = smooth(0.0, 0.04, 0.12 - np.abs(np.hypot(x + 0.5, y) - 4.2))
    ground = mix(ground, (0.70, 0.68, 0.64), kerb * 0.8)
    field = np.full(shape, -2.0, np.float32)
    for tree_x, tree_y, _, radius in TREES:
        near = 1.5 * radius - np.hypot(x - tree_x, y - tree_y)
        field = np.maximum(field, near.astype(np.float32))
    green = smooth(-0.05, 0.25, field + 0.35 * wobble)
    ground = mix(ground, materials.grass(shape, random, DENSITY), green * (1.0 - 0.97 * kerb))
    _paint(ground, random)
    ground = _manholes(ground, random)
    if sun is None:
        return ground
    mask = _shadows(shape, sun)
    mask = cv2.GaussianBlur(mask, (0, 0), 2.5)
    # The sky still lights what the sun doesn't: shadows are blue.
    shadow = cv2.merge([1.0 - mask * np.float32(dark) for dark in (0.48, 0.45, 0.38)])
    return np.asarray(ground * shadow, dtype=np.float32)


def pixels(points: Points) -> npt.NDArray[np.int32]:
    """Return columns and rows of places on the ground, shape (n, 2)."""
    columns, rows = (HALF - points[:, 1]) * DENSITY, (HALF - points[:, 0]) * DENSITY
    return np.stack([columns, rows], 1).astype(np.int32)


def _coordinates(size: int) -> tuple[Image, Image]:
    line = HALF - (np.arange(size, dtype=np.float32) + 0.5) / DENSITY
    return np.broadcast_to(line[:, None], (size, size)), np.broadcast_to(line, (size, size))


def _paint(ground: Image, random: np.random.Generator) -> None:
    """Parking bays in the south, a ball court's lines in the north, numbers."""
    size = ground.shape[0]
    worn = smooth(-1.2, 0.6, fractal((size, size), random, coarse=40))
    lines = np.zeros((size, size), np.uint8)
    for y in np.arange(-10.5, 1.0, 2.7):
        ends = pixels(np.array([[-13.2, y], [-9.4, y]]))
        cv2.line(lines, tuple(ends[0].tolist()), tuple(ends[1].tolist()), 255, 6, cv2.LINE_AA)
    corners = pixels(np.array([[13.0, 4.8], [13.0, -9.0], [5.4, -9.0], [5.4, 4.8]]))
    cv2.polylines(lines, [corners], True, 255, 5, cv2.LINE_AA)
    centre = pixels(np.array([[9.2, -2.1]]))[0]
    cv2.circle(lines, tuple(centre.tolist()), int(1.8 * DENSITY), 255, 5, cv2.LINE_AA)
    ground[:] = mix(ground, (0.84, 0.83, 0.78), share(lines) * worn * 0.85)
    for number, (x, y) in enumerate(((-11.2, -9.1), (-11.2, -6.4), (-11.2, -3.7), (7.0, -6.0),
                                     (6.6, 6.4), (-6.6, 6.0), (-4.6, -6.8))):  # fmt: skip
        column, row = pixels(np.array([[x, y]]))[0].tolist()
        box = (column - 40, row - 55, column + 40, row + 55)
        colour = ((0.84, 0.83, 0.78), (0.86, 0.66, 0.18))[number % 2]
        decals.letters(ground, f"{number + 1}", box, colour, worn * 0.9)


def _manholes(ground: Image, random: np.random.Generator) -> Image:
    for x, y in random.uniform(-12.0, 12.0, (9, 2)):
        at = tuple(pixels(np.array([[x, y]]))[0].tolist())
        cv2.circle(ground, at, int(0.36 * DENSITY), (0.20, 0.20, 0.20), -1)
        cv2.circle(ground, at, int(0.31 * DENSITY), (0.46, 0.44, 0.41), -1)
        for ring in (0.10, 0.20):
            cv2.circle(ground, at, int(ring * DENSITY), (0.24, 0.23, 0.22), 2)
        for angle in np.arange(0.0, np.pi, np.pi / 4):
            arm = np.array([np.cos(angle), np.sin(angle)]) * 0.30 * DENSITY
            ends = [tuple((np.asarray(at) + sign * arm).astype(int).tolist()) for sign in (-1, 1)]
            cv2.line(ground, ends[0], ends[1], (0.24, 0.23, 0.22), 2)
    return ground


def _shadows(shape: tuple[int, int], sun: tuple[float, float, float]) -> Image:
    """Return how dark it is (0..1): each thing's footprint, swept along the sun by its height."""
    mask = np.zeros(shape, np.float32)
    shift = np.array([sun[0], sun[1]]) / -sun[2]
    things = [(x, y, 6.06, 2.44, turn, base, 2.59) for x, y, base, turn in CONTAINERS]
    things += [(x, y, e, e, turn, base, e) for x, y, base, e, turn in CRATES]
    things += [(-1.6, 3.3, 4.0, 0.32, 6.0, 0.0, 1.5), (3.6, -4.9, 2.4, 0.4, 48.0, 0.0, 1.2)]
    things += [(2.6, 10.0, 3.0, 2.6, 0.0, 0.0, 0.9), (-15.15, 0.0, 0.3, 30.0, 0.0, 0.0, 2.3)]
    things += [(x, y, 0.18, 0.18, 0.0, 0.0, 4.5) for x, y in POSTS]
    things += [(x, y, 0.3, 0.3, 0.0, 0.0, height) for x, y, height, _ in TREES]
    for x, y, turn, wide, leg, deep in ((0.15, -6.85, -14.0, 2.6, 0.55, 0.8),
                                        (-1.25, 6.3, -14.4, 2.6, 0.45, 0.6)):  # fmt: skip
        for sign in (-1.0, 1.0):
            off, angle = sign * (wide + leg) / 2.0, np.radians(turn)
            foot = (x - off * np.sin(angle), y + off * np.cos(angle))
            things.append((*foot, deep, leg, turn, 0.0, 1.6))
        _arch_shadow(mask, (x, y), np.radians(turn), (wide / 2.0, leg, deep), shift)
    for x, y, long, wide, turn, base, height in things:
        a = np.radians(turn)
        frame = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
        corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * (long / 2, wide / 2) @ frame.T
        corners += (x, y)
        swept = np.concatenate([corners + shift * base, corners + shift * (base + height)])
        cv2.fillConvexPoly(mask, cv2.convexHull(pixels(swept)), 1.0)
    for x, y, height, radius in TREES:
        for level, size in ((0.8, 1.0), (1.9, 0.62)):
            at = np.array([[x, y]]) + shift * (height + level * 0.85 * radius)
            centre = tuple(pixels(at)[0].tolist())
            cv2.circle(mask, centre, int(0.92 * size * radius * DENSITY), 1.0, -1)
    return mask


def _arch_shadow(
    mask: Image,
    place: tuple[float, float],
    turn: float,
    size: tuple[float, float, float],
    shift: Points,
) -> None:
    inner, leg, deep = size
    across, along = np.array([-np.sin(turn), np.cos(turn)]), np.array([np.cos(turn), np.sin(turn)])
    angles = np.linspace(0.0, np.pi, 17)
    for start, end in pairwise(angles):
        points = [
            np.array(place) + across * r * np.cos(t) + along * d + shift * (1.5 + r * np.sin(t))
            for t in (start, end) for r in (inner, inner + leg) for d in (-deep / 2, deep / 2)
        ]  # fmt: skip
        cv2.fillConvexPoly(mask, cv2.convexHull(pixels(np.array(points))), 1.0)
