"""`mocap`: a motion capture room, 8 x 8.4 m and 4 m high, made into a place for test flights.

Cloth and carpet show weak texture nearly everywhere; strong corners stand on a few boards, boxes
and strips; walls and windows are white. The middle is free: within 2.6 m of it, nothing but a mat
lies on the floor.

Coordinates in this file are MuJoCo's: x north, y **west**, z up, metres, from the middle of the
floor. What lies flat (strips, play mats, paper, cables) is painted on the floor, as are shadows.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from sims.worlds import decals, materials
from sims.worlds.builder import WHOLE, Builder, Material, sides
from sims.worlds.materials import Canvas, Colour, Image, mix, shade, share, smooth, to_bytes

NORTH, WEST, HEIGHT = 4.0, 4.2, 4.0
FLOOR_DENSITY = 192.0
WALL_DENSITY = 96.0
CLOTH_DENSITY = 160.0

FREE = 2.6
"""Radius about the middle (metres) in which nothing is higher than 0.3 m."""


class Mat(NamedTuple):
    """A gymnastic mat that leans: it touches a wall, or another mat, at (x, y)."""

    x: float
    y: float
    facing: float  # degrees from north to the west, away from what it leans on
    width: float
    height: float
    lean: float  # degrees
    thick: float = 0.16


MATS = (
    Mat(4.0, 3.45, 180.0, 1.25, 2.1, 4.0), Mat(4.0, 0.15, 180.0, 1.25, 2.1, 5.0),
    Mat(4.0, -1.1, 180.0, 1.2, 2.1, 3.0), Mat(4.0, 1.9, 180.0, 2.3, 1.15, 12.0),
    Mat(3.0, 4.2, -90.0, 1.3, 2.1, 4.0), Mat(1.65, 4.2, -90.0, 1.3, 2.1, 6.0),
    Mat(0.3, 4.2, -90.0, 1.3, 2.1, 3.0), Mat(-4.0, -1.2, 0.0, 2.2, 1.0, 15.0),
    Mat(-3.72, -1.3, 0.0, 2.2, 1.0, 17.0), Mat(1.0, -4.2, 90.0, 2.2, 1.0, 9.0),
)  # fmt: skip
STACK = (3.05, -3.05, 1.2, 2.1, 1.0)  # x, y, length along x and y, height
LYING = (-2.55, -1.35, 0.9, 2.2, 0.16)
BOARDS = (  # x, y, facing, edge, lean, number
    (2.43, -2.95, 180.0, 1.0, 12.0, 0), (3.45, 0.75, 180.0, 0.72, 14.0, 1),
    (-2.75, 4.2, -90.0, 0.8, 16.0, 2), (2.6, 3.62, -90.0, 0.6, 15.0, 2),
)  # fmt: skip
BOXES = (  # x, y, base, length along x and y, height, turn, print
    (0.75, -3.4, 0.0, 1.3, 0.42, 0.40, 8.0, 0), (-0.35, -3.55, 0.0, 0.55, 0.42, 0.5, -14.0, 1),
    (-3.2, -3.5, 0.0, 0.6, 0.5, 0.45, 10.0, 2), (-3.2, -3.5, 0.45, 0.5, 0.45, 0.4, -6.0, 2),
    (-2.5, -3.65, 0.0, 0.5, 0.5, 0.55, -4.0, 1), (1.75, -3.2, 0.0, 0.5, 0.3, 0.36, 32.0, 3),
    (-3.6, 2.1, 0.0, 0.5, 0.6, 0.4, 5.0, 0),
)  # fmt: skip
WINDOWS = (  # x, y, facing
    (3.99, 2.0, 180.0), (3.99, -1.9, 180.0), (2.1, -4.19, 90.0), (-0.6, -4.19, 90.0),
)  # fmt: skip
STRIPS = (  # x, y, direction (degrees from north to the west), length
    (2.1, 2.2, 68.0, 1.5), (1.3, 0.3, 24.0, 2.6), (1.9, -0.6, -48.0, 1.7), (-0.3, 1.7, -12.0, 2.4),
    (-0.6, -0.4, 63.0, 2.7), (-1.3, 0.5, -28.0, 2.0), (-1.9, 1.9, 82.0, 1.6),
    (0.1, -2.0, 36.0, 1.8), (2.2, -1.9, 80.0, 1.2), (-2.6, 0.5, 10.0, 1.3),
)  # fmt: skip
PLAY = ((1.55, 1.0, 12.0, 1.9, 1.3), (-0.75, -1.2, -20.0, 1.7, 1.2), (-1.0, 1.3, 35.0, 1.3, 1.0))
"""Play mats: x, y, direction, length, width."""


def mocap(seed: int = 0, bare: bool = False) -> Any:
    """Return the room as a `mujoco.MjSpec`; the seed changes cloth, prints, marks and scraps."""
    b = Builder("mocap", seed, bare)
    b.spec.visual.headlight.ambient = [0.66, 0.66, 0.66]

    def paint(name: str, colour: Colour) -> Material:
        return b.material(name, materials.paint, (64, 64), 32.0, colour=colour, grain=0.02)

    dark, steel = paint("dark", (0.10, 0.10, 0.11)), paint("steel", (0.78, 0.79, 0.80))
    _mats(b)
    _prints(b, dark)
    _fixtures(b, dark, steel)
    _openings(b)
    _shell(b)
    b.light("windows", (0.0, 0.0, 3.0), (0.34, 0.34, 0.34), towards=(-0.7, 0.45, -0.55), sun=True)
    b.light("lamps", (0.0, 0.0, 3.0), (0.18, 0.18, 0.18), towards=(0.4, -0.2, -0.6), sun=True)
    b.spec.stat.center = [0.0, 0.0, 1.5]
    b.spec.stat.extent = 6.0
    return b.spec


def _lean(b: Builder, name: str, material: Material, mat: Mat, face: Any) -> None:
    """Add a slab that leans; `face` is the part of the material that looks into the room."""
    angle, facing = math.radians(mat.lean), math.radians(mat.facing)
    c, s = math.cos(angle), math.sin(angle)
    away = (mat.thick * c + mat.height * s) / 2.0 + 0.005
    up = (mat.thick * s + mat.height * c) / 2.0
    place = (mat.x + away * math.cos(facing), mat.y + away * math.sin(facing), up)
    size = (mat.thick, mat.width, mat.height)
    b.box(name, material, size, place, turn=mat.facing + 180.0, tilt=mat.lean,
          windows={"front": face}, hidden=("bottom",))  # fmt: skip


def _mats(b: Builder) -> None:
    shape = (int(2.0 * CLOTH_DENSITY), int(1.25 * CLOTH_DENSITY))
    tall = b.material("tall", _cloths, shape, CLOTH_DENSITY)
    wide = b.material("wide", _cloths, (shape[1] * 4 // 5, shape[0]), CLOTH_DENSITY)
    for number, mat in enumerate(MATS):
        material = tall if mat.height > mat.width else wide
        _lean(b, f"mat_{number}", material, mat, decals.tile(number % 6, 3, 2))
    x, y, *size, high = STACK
    layers = b.material("stack", _layers, (int(1.0 * CLOTH_DENSITY), shape[0]), CLOTH_DENSITY)
    whole = dict.fromkeys(("front", "left", "back", "right", "top"), WHOLE)
    lid = b.random.uniform(0.06, 0.08)
    b.box("stack", layers, (size[0], size[1], high - 0.14), (x, y, 0.0), windows=whole,
          hidden=("bottom", "top"))  # fmt: skip
    b.box("stack_top", wide, (size[0] + 0.05, size[1] + 0.05, 0.14),
          (x - lid, y + lid, high - 0.14), windows={"top": decals.tile(1, 3, 2)},
          hidden=())  # fmt: skip
    x, y, *size, high = LYING
    b.box("lying", wide, (size[0], size[1], high), (x, y, 0.0), turn=4.0,
          windows={"top": decals.tile(4, 3, 2)})  # fmt: skip


def _prints(b: Builder, dark: Material) -> None:
    """Add boards with patterns, boxes with prints, and a curtain with printed wood."""
    boards = b.material("boards", _boards, (372, 372), 372.0)
    for number, (x, y, facing, edge, lean, kind) in enumerate(BOARDS):
        mat = Mat(x, y, facing, edge, edge, lean, 0.02)
        _lean(b, f"board_{number}", boards, mat, decals.tile(kind, 2, 2))
    boxes = b.material("boxes", _boxes, (160, 256), 256.0)
    for number, (x, y, base, long, wide, high, turn, kind) in enumerate(BOXES):
        windows = dict.fromkeys(("front", "left", "back", "right", "top"), decals.tile(kind, 2, 2))
        b.box(f"box_{number}", boxes, (long, wide, high), (x, y, base), turn=turn,
              windows=windows, hidden=("bottom",))  # fmt: skip
    b.box("case", dark, (0.26, 0.48, 0.3), (0.6, -3.4, 0.4), turn=12.0)
    b.box("case_handle", dark, (0.05, 0.24, 0.06), (0.6, -3.4, 0.7), turn=12.0)
    wood = b.material("drape", _drape, (int(2.4 * 128), int(2.6 * 128)), 128.0)
    b.panel("drape", wood, WHOLE, (2.6, 2.4), (-3.93, 1.05, 1.75), 0.0)
    for number, (y, z) in enumerate(((2.0, 2.65), (0.3, 2.75), (-2.1, 2.3))):
        b.panel(f"marker_{number}", boards, decals.tile(3, 2, 2), (0.22, 0.22), (-3.92, y, z), 0.0)
    b.panel("poster", boards, decals.tile(1, 2, 2), (0.6, 0.6), (-1.6, 4.18, 1.7), -90.0)


def _fixtures(b: Builder, dark: Material, steel: Material) -> None:
    """Add a desk, a ladder, a tripod, a rack and the cameras of the motion capture system."""
    b.box("desk/top", steel, (1.5, 0.7, 0.04), (-1.5, -3.82, 0.72), hidden=())
    for number, x in enumerate((-2.15, -0.85)):
        b.box(f"desk/leg_{number}", steel, (0.05, 0.6, 0.72), (x, -3.82, 0.0))
    for number, x in enumerate((-1.85, -1.2)):
        b.box(f"screen_{number}", dark, (0.56, 0.04, 0.36), (x, -3.9, 0.86), hidden=())
    b.box("computer", dark, (0.22, 0.5, 0.5), (-1.9, -3.8, 0.0))
    shelf = b.material("rack", _rack, (168, 160), 160.0)
    whole = dict.fromkeys(("front", "left", "back", "right"), WHOLE)
    b.box("rack", shelf, (1.0, 0.5, 1.05), (-1.9, 3.85, 0.0), windows=whole)
    b.box("partition", steel, (1.1, 0.05, 1.9), (-0.95, 3.95, 0.0), turn=-6.0)
    for number, x in enumerate((0.35, 0.75)):
        b.box(f"ladder/rail_{number}", steel, (0.03, 0.07, 2.6), (x, -3.85, 0.0))
    for number, z in enumerate(np.arange(0.3, 2.5, 0.28).tolist()):
        b.box(f"ladder/rung_{number}", steel, (0.4, 0.07, 0.04), (0.55, -3.85, z), hidden=())
    for number, turn in enumerate((10.0, 130.0, 250.0)):
        x, y = 0.17 * math.cos(math.radians(turn)), 0.17 * math.sin(math.radians(turn))
        b.box(f"tripod/leg_{number}", dark, (0.03, 0.03, 1.25), (-3.35 - x, -2.55 - y, 0.61),
              turn=turn, tilt=16.0)  # fmt: skip
    b.box("tripod/head", dark, (0.1, 0.1, 0.5), (-3.35, -2.55, 1.2), hidden=())
    b.box("tripod/bar", dark, (0.05, 0.4, 0.06), (-3.35, -2.55, 1.6), hidden=())
    for number, (x, y) in enumerate(
        ((1, 1), (1, -1), (-1, -1), (-1, 1), (1, 0), (0, 1), (-1, 0), (0, -1))
    ):
        place = (3.8 * x, 4.0 * y, 3.35)
        turn = math.degrees(math.atan2(y, x)) + 180.0
        b.box(f"camera_{number}", dark, (0.16, 0.12, 0.12), place, turn=turn, tilt=28.0)


def _openings(b: Builder) -> None:
    pane = b.material("window", _window, (int(1.9 * 96), int(1.9 * 96)), 96.0, glow=0.75)
    for number, (x, y, facing) in enumerate(WINDOWS):
        b.panel(f"window_{number}", pane, WHOLE, (1.9, 1.9), (x, y, 2.2), facing)


def _shell(b: Builder) -> None:
    """Add walls, floor and ceiling; last, for objects before them to be drawn first."""
    for name, place, facing, width in sides((NORTH, WEST)):
        shape = (int(HEIGHT * WALL_DENSITY), int(width * WALL_DENSITY))
        door = 7.3 if name == "wall_south" else None
        wall = b.material(name, _wall, shape, WALL_DENSITY, glow=0.12, door=door)
        b.wall(name, wall, (width, HEIGHT), (*place, 0.0), facing)
    shape = (int(2.0 * NORTH * FLOOR_DENSITY), int(2.0 * WEST * FLOOR_DENSITY))
    b.floor("floor", b.material("floor", _floor, shape, FLOOR_DENSITY), (NORTH, WEST))
    ceiling = b.material("ceiling", _ceiling, (256, 269), 32.0, glow=0.2)
    b.ceiling("ceiling", ceiling, (NORTH, WEST), HEIGHT)


def _weave(on: Canvas) -> Image:
    """Return threads that cross, as a share of the brightness with standard deviation 1."""
    down = on.fractal(coarse=8, fine=2, stretch=(2.5, 1.0), gain=1.0)
    across = on.fractal(coarse=8, fine=2, stretch=(1.0, 2.5), gain=1.0)
    return np.asarray((down + across) / np.float32(math.sqrt(2.0)), dtype=np.float32)


def _folds(on: Canvas) -> Image:
    """Return slanting folds of cloth under tension, mean 0."""
    noise = on.fractal(coarse=0.22 * on.density, fine=5, stretch=(1.0, 8.0), gain=0.75)
    slope = float(on.random.uniform(-0.9, 0.9))
    folds = np.empty_like(noise)
    for column in range(on.shape[1]):
        folds[:, column] = np.roll(noise[:, column], int(slope * column))
    return folds


def _cloth(on: Canvas) -> Image:
    """Return one side of a mat: woven cloth, folds, a seam along its edge."""
    height, width = on.shape
    tone = float(on.random.uniform(0.90, 1.08))
    cloth = on.flat((0.50 * tone, 0.50 * tone, 0.51 * tone))
    cloth = shade(cloth, 0.05 * _weave(on) + 0.07 * _folds(on))
    cloth = shade(cloth, 0.06 * on.fractal(coarse=on.density, fine=0.2 * on.density))
    seam = np.zeros(on.shape, np.uint8)
    cv2.rectangle(seam, (7, 7), (width - 8, height - 8), 255, 2, cv2.LINE_AA)
    if width > height:
        cv2.line(seam, (width // 2, 7), (width // 2, height - 8), 255, 2, cv2.LINE_AA)
    rows, columns = np.arange(height)[:, None], np.arange(width)[None, :]
    edge = np.minimum(np.minimum(rows, height - 1 - rows), np.minimum(columns, width - 1 - columns))
    rim = smooth(0.0, 9.0, edge.astype(np.float32))
    return shade(cloth, -0.28 * share(seam) - 0.22 * (1.0 - rim))


def _cloths(on: Canvas) -> Image:
    return decals.sheets([_cloth(on) for _ in range(6)], 3)


def _layers(on: Canvas) -> Image:
    """Return the side of a stack: round edges of seven mats, with gaps and creases."""
    layer = (np.arange(on.shape[0], dtype=np.float32) / on.shape[0] * 7.0) % 1.0
    wobble = 0.06 * on.fractal(coarse=40, fine=10, stretch=(1.0, 2.0))
    place = layer[:, None] + wobble
    bulge = 1.0 - (2.0 * np.clip(place, 0.0, 1.0) - 1.0) ** 2
    cloth = shade(on.flat((0.48, 0.48, 0.49)), 0.05 * _weave(on))
    creases = on.fractal(coarse=24, fine=4, stretch=(1.5, 1.0), gain=0.9)
    return shade(cloth, 0.6 * bulge - 0.5 + 0.06 * creases)


def _tags(edge: int, random: np.random.Generator) -> Image:
    """Return a grid of 6 x 6 square tags with random bits, and small squares between them."""
    board = np.ones((62, 62), np.float32)
    for row in range(7):
        for column in range(7):
            board[row * 10 : row * 10 + 2, column * 10 : column * 10 + 2] = 0.0
            if row < 6 and column < 6:
                tag = np.zeros((8, 8), np.float32)
                tag[1:7, 1:7] = random.integers(0, 2, (6, 6))
                board[row * 10 + 2 : row * 10 + 10, column * 10 + 2 : column * 10 + 10] = tag
    size = edge // 62
    return np.kron(board, np.ones((size, size), np.float32))


def _squares(edge: int, count: int, margin: int) -> Image:
    """Return a chequerboard of `count` squares a side within a white margin (pixels)."""
    place = np.arange(edge - 2 * margin) * count // (edge - 2 * margin)
    board = np.ones((edge, edge), np.float32)
    odd = (place[:, None] + place[None, :]) % 2
    board[margin : edge - margin, margin : edge - margin] = odd
    return board


def _boards(on: Canvas) -> Image:
    """Return four boards in rows of two: tags, two chequerboards, a large mark."""
    edge = on.shape[0]
    mark = np.ones((8, 8), np.float32)
    mark[1:7, 1:7] = on.random.integers(0, 2, (6, 6))
    large = np.kron(mark, np.ones((edge // 8 + 1,) * 2, np.float32))[:edge, :edge]
    patterns = (_tags(edge, on.random), _squares(edge, 8, 22), _squares(edge, 10, 16), large)
    sheets = [mix(on.flat((0.94, 0.94, 0.93)), (0.07, 0.07, 0.08), 1.0 - p) for p in patterns]
    return decals.sheets(
        [shade(sheet, 0.02 * on.fractal(coarse=64, fine=8)) for sheet in sheets], 2
    )


def _boxes(on: Canvas) -> Image:
    """Return four boxes' sides in rows of two: striped, brown, white, black."""
    height, width = on.shape
    faces = []
    for kind, colour in enumerate(
        ((0.84, 0.84, 0.82), (0.55, 0.43, 0.30), (0.88, 0.88, 0.87), (0.20, 0.21, 0.23))
    ):
        face = to_bytes(shade(on.flat(colour), 0.03 * on.fractal(coarse=32)))
        ink = ((170, 90, 60), (60, 44, 32), (40, 46, 60), (200, 200, 200))[kind]
        if kind == 0:
            for x in range(-height, width, 38):
                cv2.line(face, (x, height), (x + height, 0), ink, 9, cv2.LINE_AA)
            cv2.rectangle(face, (40, 50), (width - 40, height - 50), (226, 226, 222), -1)
        if kind < 3:
            cv2.rectangle(face, (0, height // 2 - 8), (width, height // 2 + 8), (172, 158, 130), -1)
        for line in range(4):
            left, top = int(on.random.integers(8, 60)), 24 + line * height // 4
            end = left + int(on.random.integers(40, 130))
            cv2.line(face, (left, top), (end, top), ink, 3, cv2.LINE_AA)
        sheet = share(face)
        word = decals.WORDS[int(on.random.integers(len(decals.WORDS)))]
        tone = (ink[0] / 255.0, ink[1] / 255.0, ink[2] / 255.0)
        decals.letters(sheet, word, (60, height // 2 + 12, width - 12, height - 12), tone, None)
        faces.append(sheet)
    return decals.sheets(faces, 2)


def _rack(on: Canvas) -> Image:
    """Return a black rack of devices: rows of holes, lamps and plugs."""
    rack = to_bytes(materials.paint(on, (0.09, 0.09, 0.10), grain=0.02))
    height, width = on.shape
    for top in range(8, height - 12, 20):
        cv2.rectangle(rack, (6, top), (width - 7, top + 14), (40, 41, 44), 1)
        for x in range(14, width - 14, 12):
            if on.random.uniform() < 0.6:
                tone = int(on.random.integers(90, 230))
                cv2.circle(rack, (x, top + 7), int(on.random.integers(1, 4)), (tone,) * 3, -1)
    return share(rack)


def _drape(on: Canvas) -> Image:
    """Return a curtain printed with rough upright boards, worn pale in streaks."""
    boards = materials.upright(on, width=0.17, palette=(
        (0.42, 0.40, 0.37), (0.34, 0.32, 0.30), (0.50, 0.47, 0.43), (0.29, 0.28, 0.26),
    ))  # fmt: skip
    streaks = on.fractal(coarse=0.08 * on.density, fine=2, stretch=(4.0, 1.0), gain=1.0)
    boards = mix(boards, (0.86, 0.84, 0.80), smooth(0.7, 1.9, streaks) * 0.85)
    boards = mix(boards, (0.12, 0.11, 0.10), smooth(1.0, 2.4, -streaks) * 0.7)
    turn = 2.0 * math.pi / (0.42 * on.density)  # of the hanging cloth's waves, a column
    hang = np.array([0.08 * math.sin(turn * k) for k in range(on.shape[1])], np.float32)
    return shade(boards, np.broadcast_to(hang, on.shape))


def _window(on: Canvas) -> Image:
    """Return an overexposed window between two pale curtains."""
    height, width = on.shape
    image = on.flat((1.0, 1.0, 1.0))
    for x in (0.25, 0.5, 0.75):
        at = int(x * width)
        image[:, at - 2 : at + 2] = 0.80
    image[height // 3 - 2 : height // 3 + 2] = 0.80
    image[-8:] = 0.72
    folds = on.fractal(coarse=0.16 * on.density, fine=3, stretch=(30.0, 1.0), gain=0.9)
    cloth = shade(on.flat((0.58, 0.58, 0.57)), 0.13 * folds)
    columns = np.abs(np.arange(width, dtype=np.float32) / width - 0.5)
    hem = smooth(0.27, 0.29, columns[None, :] + 0.01 * on.fractal(coarse=60, fine=20))
    return mix(image, cloth, hem)


def _wall(on: Canvas, door: float | None) -> Image:
    """Return a white wall, rubbed here and there, with a skirting, a duct, perhaps a door."""
    height, width = on.shape
    wall = on.flat((0.93, 0.93, 0.92))
    wall = shade(wall, 0.015 * on.fractal(coarse=on.density, fine=3, gain=0.9))
    low = smooth(0.0, 1.0, np.arange(height, dtype=np.float32)[:, None] / height - 0.35)
    scuffs = on.specks(count=int(14 * on.area), radius=(1.0, 5.0))
    wall = shade(wall, -0.22 * np.maximum(scuffs, 0.0) * low)
    wall[-10:] = (0.52, 0.52, 0.51)
    wall[-11] *= 0.7
    at = int(0.62 * width)
    wall[:, at : at + 7] *= 0.90
    wall[:, at + 7 : at + 9] *= 0.70
    beam = int(0.55 * on.density)
    wall[beam : beam + 3] *= 0.72
    if door is not None:
        left, right = int((door - 0.5) * on.density), int((door + 0.5) * on.density)
        top = height - int(2.1 * on.density)
        wall[top - 7 :, left - 7 : right + 7] = (0.45, 0.46, 0.47)
        wall[top:, left:right] = materials.paint(
            on._replace(shape=(height - top, right - left)), (0.70, 0.71, 0.71), grain=0.01
        )
        handle = height - int(1.05 * on.density)
        wall[handle : handle + 4, left + 8 : left + 22] = (0.15, 0.15, 0.16)
    return wall


def _ceiling(on: Canvas) -> Image:
    ceiling = materials.paint(on, (0.80, 0.80, 0.79))
    for line in range(0, on.shape[0], 38):
        ceiling[line] *= 0.85
    for line in range(0, on.shape[1], 38):
        ceiling[:, line] *= 0.85
    for row in (60, 180):
        for column in (50, 180):
            ceiling[row : row + 8, column : column + 44] = (1.0, 1.0, 1.0)
    return ceiling


Bytes = npt.NDArray[np.uint8]


class Sheet:
    """A piece of the floor to print on; points are metres ahead and to the left of its middle."""

    SHIFT = 4  # bits of a pixel's fraction in OpenCV's coordinates

    def __init__(self, floor: Bytes, x: float, y: float, turn: float) -> None:
        self._floor = floor
        self._middle = np.array((x, y))
        c, s = math.cos(math.radians(turn)), math.sin(math.radians(turn))
        self._axes = np.array(((c, s), (-s, c)))

    def _pixels(self, points: Any) -> npt.NDArray[np.int32]:
        north, west = (np.asarray(points, float).reshape(-1, 2) @ self._axes + self._middle).T
        places = np.stack([WEST - west, NORTH - north], 1) * FLOOR_DENSITY
        return np.asarray(np.rint(places * (1 << self.SHIFT)), dtype=np.int32)

    def area(self, points: Any, colour: Sequence[int]) -> None:
        """Fill a polygon."""
        cv2.fillPoly(self._floor, [self._pixels(points)], colour, cv2.LINE_AA, self.SHIFT)

    def box(self, ahead: float, left: float, size: tuple[float, float], colour: Any) -> None:
        """Fill a rectangle about a point."""
        a, b = size[0] / 2.0, size[1] / 2.0
        corners = np.array(((a, b), (a, -b), (-a, -b), (-a, b)))
        self.area(corners + np.array((ahead, left)), colour)

    def line(self, points: Any, width: float, colour: Sequence[int], closed: bool = False) -> None:
        """Draw a line, `width` in metres."""
        thick = max(1, round(width * FLOOR_DENSITY))
        cv2.polylines(
            self._floor, [self._pixels(points)], closed, colour, thick, cv2.LINE_AA, self.SHIFT
        )

    def disc(self, ahead: float, left: float, radius: float, colour: Sequence[int]) -> None:
        """Fill a circle about a point."""
        middle = tuple(self._pixels((ahead, left))[0].tolist())
        reach = round(radius * FLOOR_DENSITY * (1 << self.SHIFT))
        cv2.circle(self._floor, middle, reach, colour, -1, cv2.LINE_AA, self.SHIFT)


def _floor(on: Canvas) -> Image:
    """Return carpet, and what lies on it."""
    carpet = on.flat((0.47, 0.47, 0.46))
    pile = on.fractal(coarse=24, fine=2, gain=0.95)
    worn = on.fractal(coarse=1.5 * on.density, fine=0.2 * on.density)
    carpet = shade(carpet, 0.055 * pile + 0.03 * worn)
    carpet = shade(carpet, -0.10 * np.maximum(on.specks(count=700, radius=(1.5, 9.0)), 0.0))
    floor = to_bytes(carpet)
    for x, y, turn, long, wide in PLAY:
        _play_mat(Sheet(floor, x, y, turn), on.random, long, wide)
    for x, y, turn, long in STRIPS:
        _strip(Sheet(floor, x, y, turn), on.random, long)
    _scraps(floor, on.random)
    return decals.contact_shadow(share(floor), _footprints(on.shape), 14.0, 0.6)


def _strip(sheet: Sheet, random: np.random.Generator, long: float) -> None:
    """Draw a black strip with white confetti, taped down at its ends."""
    wide = 0.17
    sheet.box(0.0, 0.0, (long, wide), (24, 24, 25))
    for _ in range(int(long * 34)):
        ahead, left = random.uniform(-0.5, 0.5, 2) * (long - 0.06, wide - 0.05)
        shape = random.uniform(0.012, 0.034, (4, 1)) * ((1, 1), (1, -1), (-1, -1), (-1, 1))
        sheet.area(shape * random.uniform(0.4, 1.0, 2) + (ahead, left), (232, 232, 230))
    for ahead in (-0.5 * long, 0.5 * long):
        sheet.box(ahead, 0.0, (0.06, 0.3), (84, 84, 84))


def _play_mat(sheet: Sheet, random: np.random.Generator, long: float, wide: float) -> None:
    """Draw a child's play mat: meadows, streets, a pond, houses, trees and cars."""
    sheet.box(0.0, 0.0, (long, wide), (206, 206, 198))
    half = np.array((long, wide)) / 2.0
    for _ in range(7):
        middle = random.uniform(-0.8, 0.8, 2) * half
        angle = np.linspace(0.0, 2.0 * math.pi, 17)[:-1]
        radius = random.uniform(0.08, 0.2) * random.uniform(0.8, 1.2, 16)
        blob = middle + np.stack([np.cos(angle), np.sin(angle)], 1) * radius[:, None]
        colour = ((128, 178, 110), (150, 190, 140), (110, 160, 200))[int(random.integers(3))]
        sheet.area(np.clip(blob, -half + 0.02, half - 0.02), colour)
    ring = np.linspace(0.0, 2.0 * math.pi, 33)[:-1]
    streets = [(np.stack([0.72 * np.cos(ring), 0.68 * np.sin(ring)], 1) * half, True)]
    for place in (-0.32, 0.30):
        ahead = np.linspace(-0.95, 0.95, 13)
        bend = place + 0.16 * np.sin(ahead * random.uniform(2.0, 5.0) + random.uniform(0.0, 6.0))
        streets.append((np.stack([ahead, bend], 1) * half, False))
        streets.append((np.stack([bend, ahead], 1) * half, False))
    for width, colour in ((0.105, (236, 236, 232)), (0.085, (120, 122, 126))):
        for points, closed in streets:
            sheet.line(points, width, colour, closed)
    for points, _ in streets:
        for start, end in itertools.pairwise(points):
            sheet.line((start, start + 0.5 * (end - start)), 0.006, (240, 240, 236))
    for _ in range(int(long * wide * 34)):
        ahead, left = random.uniform(-0.9, 0.9, 2) * half
        kind = int(random.integers(4))
        colour = ((196, 70, 60), (60, 92, 160), (226, 190, 80), (70, 60, 56))[
            int(random.integers(4))
        ]
        if kind == 0:
            sheet.disc(ahead, left, 0.028, (60, 110, 62))
            sheet.disc(ahead + 0.008, left + 0.008, 0.012, (140, 184, 120))
        elif kind == 1:
            sheet.box(ahead, left, (0.05, 0.026), colour)
            sheet.box(ahead, left, (0.016, 0.022), (236, 240, 244))
        else:
            size = random.uniform(0.05, 0.10, 2)
            sheet.box(ahead, left, (float(size[0]), float(size[1])), (238, 232, 220))
            sheet.area(np.array(((0.5, 0.55), (0.5, -0.55), (0.0, -0.3), (0.0, 0.3))) * size
                       + (ahead, left), colour)  # fmt: skip
            sheet.box(ahead - 0.2 * size[0], left, (0.02, 0.016), (50, 52, 60))
    edge = np.array(((1, 1), (1, -1), (-1, -1), (-1, 1))) * half
    sheet.line(edge, 0.02, (66, 70, 84), closed=True)


def _scraps(floor: Bytes, random: np.random.Generator) -> None:
    """Scatter paper: small scraps, dark squares, a few sheets; and lay cables along the walls."""
    for x, y, heading in ((3.0, -1.6, 200.0), (-0.8, -3.0, 80.0), (-3.0, 0.2, 30.0)):
        turns = np.radians(heading) + np.cumsum(random.normal(0.0, 0.22, 60))
        steps = np.stack([np.cos(turns), np.sin(turns)], 1) * 0.06
        Sheet(floor, x, y, 0.0).line(np.cumsum(steps, 0), 0.012, (30, 30, 32))
    for number in range(240):
        near = number % 3 == 0
        x, y = (
            random.normal((-1.8, -2.2), 0.7) if near else random.uniform((-3.7, -3.9), (3.7, 3.9))
        )
        sheet = Sheet(floor, float(x), float(y), float(random.uniform(0.0, 180.0)))
        size = tuple(random.uniform(0.025, 0.06, 2).tolist())
        dark = number % 7 == 0
        sheet.box(0.0, 0.0, size, (30, 30, 32) if dark else (238, 238, 236))
    for _ in range(7):
        x, y = random.uniform((-2.9, -3.0), (2.9, 3.0)).tolist()
        sheet = Sheet(floor, x, y, float(random.uniform(0.0, 180.0)))
        sheet.box(0.0, 0.0, (0.21, 0.297), (236, 236, 234))
        for place in random.uniform(-0.08, 0.08, (3, 2)):
            sheet.box(float(place[0]), float(place[1]), (0.05, 0.05), (40, 42, 46))


def _footprints(shape: tuple[int, int]) -> Image:
    mask = np.zeros(shape, np.uint8)
    for mat in MATS:
        deep = mat.thick + mat.height * math.sin(math.radians(mat.lean))
        sheet = Sheet(mask, mat.x, mat.y, mat.facing)
        sheet.box(0.5 * deep, 0.0, (deep, mat.width), (255,))
    for x, y, long, wide, _ in (STACK, LYING):
        Sheet(mask, x, y, 0.0).box(0.0, 0.0, (long, wide), (255,))
    for x, y, base, long, wide, _, turn, _ in BOXES:
        if base == 0.0:
            Sheet(mask, x, y, turn).box(0.0, 0.0, (long, wide), (255,))
    return share(mask)
