"""`yard`: a courtyard in the sun, 30 x 30 m, among houses, with containers, trees and arches.

`night` is the same yard, of the same seed to the brick, by the light of four lamps. Coordinates in
this file are MuJoCo's: x north, y **west**, z up, metres, from the middle. Shadows are painted on
the ground, not drawn: they cost nothing per frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from sims.worlds import decals, materials
from sims.worlds.builder import WHOLE, Builder, Material
from sims.worlds.materials import Canvas, Image, mix, shade, share, smooth

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


def _ground(on: Canvas, sun: tuple[float, float, float] | None) -> Image:
    """Return the ground, north up and west left, with shadows if light goes along a `sun`."""
    shape, random = on.shape, on.random
    ground = materials.asphalt(on)
    slabs = materials.tiles(
        on, ((0.62, 0.59, 0.53), (0.55, 0.53, 0.49), (0.68, 0.63, 0.55)),
        size=(0.6, 0.9), stagger=0.5,
    )  # fmt: skip
    wobble = on.fractal(coarse=2.0 * DENSITY, fine=6, gain=0.6)
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
    ground = mix(ground, materials.grass(on), green * (1.0 - 0.97 * kerb))
    _paint(ground, on)
    ground = _manholes(ground, random)
    if sun is None:
        return ground
    mask = _shadows(shape, sun)
    mask = cv2.GaussianBlur(mask, (0, 0), 2.5)
    # The sky still lights what the sun doesn't: shadows are blue.
    shadow = cv2.merge([1.0 - mask * np.float32(dark) for dark in (0.48, 0.45, 0.38)])
    return np.asarray(ground * shadow, dtype=np.float32)


def _pixels(points: Points) -> npt.NDArray[np.int32]:
    """Return columns and rows of places on the ground, shape (n, 2)."""
    columns, rows = (HALF - points[:, 1]) * DENSITY, (HALF - points[:, 0]) * DENSITY
    return np.stack([columns, rows], 1).astype(np.int32)


def _coordinates(size: int) -> tuple[Image, Image]:
    line = HALF - (np.arange(size, dtype=np.float32) + 0.5) / DENSITY
    return np.broadcast_to(line[:, None], (size, size)), np.broadcast_to(line, (size, size))


def _paint(ground: Image, on: Canvas) -> None:
    """Parking bays in the south, a ball court's lines in the north, numbers."""
    worn = smooth(-1.2, 0.6, on.fractal(coarse=40))
    lines = np.zeros(on.shape, np.uint8)
    for y in np.arange(-10.5, 1.0, 2.7):
        ends = _pixels(np.array([[-13.2, y], [-9.4, y]]))
        cv2.line(lines, tuple(ends[0].tolist()), tuple(ends[1].tolist()), 255, 6, cv2.LINE_AA)
    corners = _pixels(np.array([[13.0, 4.8], [13.0, -9.0], [5.4, -9.0], [5.4, 4.8]]))
    cv2.polylines(lines, [corners], True, 255, 5, cv2.LINE_AA)
    centre = _pixels(np.array([[9.2, -2.1]]))[0]
    cv2.circle(lines, tuple(centre.tolist()), int(1.8 * DENSITY), 255, 5, cv2.LINE_AA)
    ground[:] = mix(ground, (0.84, 0.83, 0.78), share(lines) * worn * 0.85)
    for number, (x, y) in enumerate(((-11.2, -9.1), (-11.2, -6.4), (-11.2, -3.7), (7.0, -6.0),
                                     (6.6, 6.4), (-6.6, 6.0), (-4.6, -6.8))):  # fmt: skip
        column, row = _pixels(np.array([[x, y]]))[0].tolist()
        box = (column - 40, row - 55, column + 40, row + 55)
        colour = ((0.84, 0.83, 0.78), (0.86, 0.66, 0.18))[number % 2]
        decals.letters(ground, f"{number + 1}", box, colour, worn * 0.9)


def _manholes(ground: Image, random: np.random.Generator) -> Image:
    for x, y in random.uniform(-12.0, 12.0, (9, 2)):
        at = tuple(_pixels(np.array([[x, y]]))[0].tolist())
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
    """Return the shadows' darkness (0..1): footprints swept along the sun by height."""
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
        cv2.fillConvexPoly(mask, cv2.convexHull(_pixels(swept)), 1.0)
    for x, y, height, radius in TREES:
        for level, size in ((0.8, 1.0), (1.9, 0.62)):
            at = np.array([[x, y]]) + shift * (height + level * 0.85 * radius)
            centre = tuple(_pixels(at)[0].tolist())
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
        cv2.fillConvexPoly(mask, cv2.convexHull(_pixels(np.array(points))), 1.0)


SUN = (0.50, 0.42, -0.76)
HOUSE_DENSITY = 36.0
SIDES = {  # the houses' line, how they are turned, widths and storeys from the left
    "north": (17.5, 0.0, ((9.5, 4), (11.0, 3), (8.0, 4), (9.5, 3))),
    "east": (17.5, -90.0, ((10.0, 3), (8.5, 4), (10.5, 3), (9.0, 4))),
    "south": (17.5, 180.0, ((8.5, 4), (10.0, 3), (9.0, 4), (10.5, 3))),
    "west": (17.5, 90.0, ((11.0, 3), (9.0, 4), (8.0, 3), (10.0, 4))),
}


def yard(seed: int = 0, bare: bool = False, night: bool = False) -> Any:
    """Return the yard as a `mujoco.MjSpec`; every seed has its own houses, ground and trees."""
    b = Builder("yard", seed, bare, "night" if night else "")
    b.spec.visual.headlight.ambient = [0.07, 0.08, 0.12] if night else [0.56, 0.59, 0.66]
    red = b.material("brick", materials.brick, (384, 768), 80.0, module=0.12)
    ashlar = b.material("ashlar", materials.brick, (512, 768), 96.0, module=0.22,
                        palette=materials.GREY_STONE, block=(0.22, 0.46))  # fmt: skip
    cast = b.material("concrete", materials.concrete, (512, 512), 96.0)
    wood = b.material("wood", materials.planks, (256, 512), 96.0)
    crates = b.material("crates", decals.crate_faces, (192, 192), 192.0)
    steel = b.material("steel", _containers, (208, 688), 80.0)
    _containers_and_crates(b, steel, crates)
    _masonry(b, red, ashlar, cast)
    _furniture(b, wood, cast)
    _trees(b)
    _walls(b, red)
    _houses(b)
    shape = (int(2 * HALF * DENSITY),) * 2
    ground = b.material("ground", _ground, shape, DENSITY, sun=None if night else SUN)
    step = 0.8 if night else 2.2
    b.floor("ground", ground, (HALF, HALF), step=step)
    b.sky(night)
    (_lamps if night else _daylight)(b)
    b.spec.stat.center = [0.0, 0.0, 2.0]
    b.spec.stat.extent = 20.0
    return b.spec


def night(seed: int = 0, bare: bool = False) -> Any:
    """Return the yard by night as a `mujoco.MjSpec`."""
    return yard(seed, bare, night=True)


def _daylight(b: Builder) -> None:
    b.light("sun", (-10.0, -10.0, 20.0), (0.72, 0.66, 0.54), towards=SUN, sun=True)
    b.light("sky_light", (10.0, 10.0, 20.0), (0.16, 0.18, 0.22), towards=(-0.6, -0.5, -0.4),
            sun=True)  # fmt: skip
    b.light("bounce", (0.0, 0.0, 6.0), (0.14, 0.12, 0.09), towards=(-0.2, 0.7, 0.5), sun=True)


def _lamps(b: Builder) -> None:
    """Light the lamps on the posts, a few windows, and a faint moon."""
    shine = b.material("shine", materials.paint, (64, 64), 64.0, glow=1.0, colour=(1.0, 0.93, 0.74))
    lit = b.material("lit", decals.window_pane, (102, 67), 64.0, glow=0.9, lit=True)
    for number, (x, y) in enumerate(POSTS):
        b.cylinder(f"lamp_{number}", shine, 0.24, 0.2, (x, y, 4.52), top=WHOLE, side=WHOLE)
        b.light(f"lamp_{number}", (x, y, 4.0), (1.9, 1.5, 0.95), fall_off=0.05,
                cone=80.0)  # fmt: skip
    for number in range(18):
        facing = 90.0 * (number % 4)
        along, storey = float(b.random.uniform(-14.0, 14.0)), int(b.random.integers(3))
        c, s = np.cos(np.radians(facing)), np.sin(np.radians(facing))
        place = (-17.46 * c - along * s, -17.46 * s + along * c, decals.STOREY * storey + 1.55)
        b.panel(f"lit_{number}", lit, WHOLE, (1.05, 1.6), place, facing)
    b.light("moon", (0.0, 0.0, 20.0), (0.05, 0.06, 0.09), towards=(0.5, -0.4, -0.7), sun=True)


def _containers_and_crates(b: Builder, steel: Material, crates: Material) -> None:
    for number, (x, y, base, turn) in enumerate(CONTAINERS):
        top, bottom = number % 4 / 4.0 + 0.001, (number % 4 + 1) / 4.0 - 0.001
        end = 2.44 / 8.6
        windows = {
            "right": (0.0, top, 6.06 / 8.6, bottom),
            "left": (0.0, top, 6.06 / 8.6, bottom),
            "front": (1.0 - end, top, 1.0, bottom),
            "back": (1.0 - end, top, 1.0, bottom),
        }
        b.box(f"container_{number}", steel, (6.06, 2.44, 2.59), (x, y, base), turn=turn,
              windows=windows)  # fmt: skip
    for number, (x, y, base, edge, turn) in enumerate(CRATES):
        b.crate(f"crate_{number}", crates, edge, (x, y, base), turn)


def _masonry(b: Builder, red: Material, ashlar: Material, cast: Material) -> None:
    b.arch("stone_arch", ashlar, opening=(2.6, 1.5), leg=0.55, depth=0.8,
           place=(0.15, -6.85, 0.0), turn=-14.0)  # fmt: skip
    b.arch("brick_arch", red, opening=(2.6, 1.5), leg=0.45, depth=0.6,
           place=(-1.25, 6.3, 0.0), turn=-14.4)  # fmt: skip
    b.box("low_wall_0", red, (4.0, 0.32, 1.5), (-1.6, 3.3, 0.0), turn=6.0)
    b.box("low_wall_1", ashlar, (2.4, 0.4, 1.2), (3.6, -4.9, 0.0), turn=48.0)
    # A platform with three steps on its south side and a ramp on its north.
    b.box("platform", cast, (3.0, 2.6, 0.9), (2.6, 10.0, 0.0))
    for step in range(3):
        b.box(f"step_{step}", cast, (0.36, 2.6, 0.225 * (step + 1)),
              (0.2 + 0.36 * step, 10.0, 0.0))  # fmt: skip
    length = float(np.hypot(3.6, 0.9))
    slope = float(np.degrees(np.arctan2(0.9, 3.6)))
    lower = 0.1  # half its thickness, so that its upper side meets the platform's edge
    tilt = np.radians(slope)
    middle = (4.1 + 1.8 - lower * np.sin(tilt), 10.0, 0.45 - lower * np.cos(tilt))
    b.box("ramp", cast, (length, 2.6, 2.0 * lower), (float(middle[0]), 10.0, float(middle[2])),
          tilt=slope)  # fmt: skip
    for number, (x, y) in enumerate(((6.0, -11.5), (-4.0, -11.8), (-11.8, -4.5))):
        b.box(f"planter_{number}", cast, (1.5, 1.5, 0.6), (x, y, 0.0), turn=9.0 * number)


def _furniture(b: Builder, wood: Material, cast: Material) -> None:
    for number, (x, y, turn) in enumerate(
        ((13.5, -6.0, 90.0), (13.2, 6.5, 90.0), (-3.0, -13.6, 0))
    ):
        b.box(f"bench_{number}/seat", wood, (1.9, 0.5, 0.1), (x, y, 0.42), turn=turn, hidden=())
        b.box(f"bench_{number}/foot", cast, (1.3, 0.36, 0.42), (x, y, 0.0), turn=turn)
    for number, (x, y) in enumerate(POSTS):
        b.cylinder(f"post_{number}", cast, 0.09, 4.2, (x, y, 0.0))
        b.box(f"post_{number}/lamp", cast, (0.36, 0.36, 0.3), (x, y, 4.2), hidden=())


def _trees(b: Builder) -> None:
    bark = b.material("bark", materials.bark, (384, 192), 96.0, width=0.07)
    green = b.material("leaves", materials.leaves, (512, 768), 72.0)
    for number, (x, y, height, radius) in enumerate(TREES):
        b.cylinder(f"tree_{number}/trunk", bark, 0.17, height, (x, y, 0.0))
        flat = 0.85 * radius
        b.crown(f"tree_{number}/crown", green, (radius, radius, flat), (x, y, height + 0.8 * flat))
        off = b.random.uniform(-0.5, 0.5, 2) * radius
        small = 0.66 * radius
        top = height + 1.6 * flat
        b.crown(f"tree_{number}/top", green, (small, small, 0.8 * small),
                (x + float(off[0]), y + float(off[1]), top))  # fmt: skip


def _walls(b: Builder, red: Material) -> None:
    for number, start in enumerate(np.arange(-15.0, 15.0, 6.0)):
        b.box(f"wall_south_{number}", red, (0.3, 6.0, 2.3), (-15.15, float(start) + 3.0, 0.0))
        b.box(f"wall_west_{number}", red, (6.0, 0.3, 2.3), (float(start) + 3.0, 15.15, 0.0))


def _houses(b: Builder) -> None:
    """Add four rows of houses, each with a common texture for its fronts."""
    for side, (line, turn, row) in SIDES.items():
        heights = [int(decals.height_of(storeys) * HOUSE_DENSITY) for _, storeys in row]
        tall = max(heights)
        material = b.material(f"houses_{side}", _fronts, (tall, 0), HOUSE_DENSITY, row=row,
                              side=side)  # fmt: skip
        angle = np.radians(turn)
        total = sum(width for width, _ in row)
        left = 0.0
        for number, ((width, _), pixels) in enumerate(zip(row, heights, strict=True)):
            high = pixels / HOUSE_DENSITY
            window = (
                left / total + 1e-3, 1.0 - pixels / tall, (left + width) / total - 1e-3, 1.0,
            )  # fmt: skip
            # In the box's own axes the front looks to -x, and the left is +y.
            x, y = line + 2.0, total / 2.0 - left - width / 2.0
            place = (
                float(x * np.cos(angle) - y * np.sin(angle)),
                float(x * np.sin(angle) + y * np.cos(angle)),
                0.0,
            )
            b.box(f"house_{side}_{number}", material, (4.0, width, high), place, turn=turn,
                  windows={"front": window, "left": window, "right": window},
                  hidden=("bottom", "back", "top"))  # fmt: skip
            left += width


def _fronts(on: Canvas, row: Sequence[tuple[float, int]], side: str) -> Image:
    fronts = [
        decals.house(width, storeys, on.random, on.density, number + len(side))
        for number, (width, storeys) in enumerate(row)
    ]
    tall = max(len(front) for front in fronts)
    padded = [np.pad(f, ((tall - len(f), 0), (0, 0), (0, 0)), "edge") for f in fronts]
    return np.concatenate(padded, 1)


def _containers(on: Canvas) -> Image:
    """Return long side and end of four named containers, stacked downwards."""
    rows = []
    paints = ((0.20, 0.36, 0.50), (0.66, 0.30, 0.18), (0.30, 0.44, 0.34), (0.74, 0.58, 0.24))
    for number, paint in enumerate(paints):
        sheet = materials.metal(on, paint, pitch=0.28)
        worn = smooth(-1.5, 0.1, on.fractal(coarse=30))
        word = decals.WORDS[(3 * number + 2) % 12]
        decals.letters(sheet, word, (50, 50, 360, 120), (0.88, 0.86, 0.80), worn)
        code = f"VNRU {on.random.integers(100000, 999999)}"
        decals.letters(sheet, code, (330, 140, 470, 180), (0.88, 0.86, 0.80), worn)
        decals.letters(sheet, f"{number + 1}", (510, 40, 670, 150), (0.88, 0.86, 0.80), worn)
        frame = np.zeros(on.shape, np.float32)
        frame[:9] = frame[-12:] = 1.0
        for x in (0, 476, 486, 680):
            frame[:, x : x + 8] = 1.0
        rows.append(shade(sheet, -0.45 * frame))
    return np.concatenate(rows, 0)
