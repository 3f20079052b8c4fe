"""`field`: open ground, 1.75 km square: a mown lawn among meadows, fields, trees, huts and stones.

Coordinates in this file are MuJoCo's: x north, y **west**, z up, metres, from the middle. Where
things stand is drawn once for all seeds: densely near the start, sparsely far away, and not at all
within `FREE` of it. Shadows are painted on the lawn.
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import mujoco
import numpy as np
import numpy.typing as npt

from runtime.portable import sines
from sims.worlds import decals, materials
from sims.worlds.builder import WHOLE, Builder, sides
from sims.worlds.materials import Canvas, Image, mix, shade, share, smooth
from sims.worlds.surfaces import Surface, Window, join, quad

CELL, CELLS = 50.0, 35  # the ground's pieces, metres, and how many along a side
HALF = CELL * CELLS / 2.0
LAWN, DENSITY = CELL / 2.0, 40.0  # half its length, metres; pixels per metre
TILE, COARSE = 40.0, 24.0  # length of a piece of land that is repeated; its pixels per metre
FREE = 12.0  # radius about the start that is clear of things
SUN = (0.50, 0.42, -0.76)
WOOD = 13.0  # height of the trees round the field
Points = npt.NDArray[np.float64]

TREES = (  # x, y, height of the trunk, radius of the crown; the first stand on the lawn
    (15.5, 3.5, 2.8, 1.9), (13.0, -9.5, 2.4, 1.6), (19.0, -4.0, 3.2, 2.2), (20.5, 12.0, 3.0, 2.0),
    (-4.5, 15.0, 2.6, 1.8), (-16.0, 6.0, 3.0, 2.1), (-13.5, -11.0, 2.5, 1.7),
    (3.5, -17.5, 2.9, 2.0), (-20.5, -4.0, 3.1, 2.0), (9.0, 19.5, 2.7, 1.8),
    (-17.5, 19.0, 3.0, 2.1), (20.0, -20.0, 3.0, 2.2),
)  # fmt: skip
HUTS = (  # x, y, turn, length, width, height
    (15.5, 10.0, 24.0, 4.2, 3.2, 2.4), (-10.0, 17.5, -66.0, 5.0, 3.4, 2.5),
    (-19.0, -14.0, 40.0, 4.0, 3.0, 2.3), (8.0, -18.0, 82.0, 4.6, 3.2, 2.4),
)  # fmt: skip
STONES = (  # x, y, radii
    (13.2, 0.5, 0.9, 0.7, 0.6), (11.5, 6.5, 0.7, 0.9, 0.5), (6.5, -12.5, 0.8, 0.6, 0.5),
    (-12.8, -3.0, 1.0, 0.8, 0.7), (-9.5, -10.5, 0.6, 0.7, 0.45), (-12.6, 3.5, 0.7, 0.6, 0.5),
    (2.0, 13.5, 0.9, 0.7, 0.6), (8.5, 11.5, 0.6, 0.5, 0.4), (-2.5, -13.5, 0.8, 1.0, 0.6),
)  # fmt: skip
BALES = ((-6.5, -14.5), (-5.0, -15.2), (13.5, -5.0), (5.5, 16.0), (-14.8, 9.5), (17.2, -10.5))
WALLS = (  # x, y, turn, length: dry stone
    (20.0, 4.0, 86.0, 8.0), (-1.0, 20.0, 3.0, 10.0), (-21.5, 3.0, 92.0, 9.0),
    (-6.0, -20.5, -4.0, 8.0),
)  # fmt: skip
FENCES = (  # x, y, turn, length: boards
    (16.0, -15.0, -42.0, 7.0), (13.0, 16.5, 40.0, 6.0), (-15.0, 13.5, 130.0, 6.0),
    (-10.5, -16.5, 38.0, 6.0),
)  # fmt: skip
FAR = {"tree": 20, "hut": 6, "stone": 12, "bale": 10, "wall": 6, "fence": 6}


def field(seed: int = 0, bare: bool = False) -> Any:
    """Return the field as a `mujoco.MjSpec`; every seed has its own soil, grass and leaves."""
    b = Builder("field", seed, bare)
    b.spec.visual.headlight.ambient = [0.54, 0.58, 0.62]
    _land(b)
    _things(b)
    _wood(b)
    b.sky()
    b.light("sun", (0.0, 0.0, 40.0), (0.70, 0.65, 0.52), towards=SUN, sun=True)
    b.light("sky_light", (0.0, 0.0, 40.0), (0.16, 0.18, 0.22), towards=(-0.6, -0.5, -0.4), sun=True)
    b.spec.stat.center = [0.0, 0.0, 2.0]
    b.spec.stat.extent = 20.0
    return b.spec


def _land(b: Builder) -> None:
    """Lay the lawn in the middle, and pieces of land about it, several cells each."""
    lawn = b.material("lawn", _lawn, (int(2 * LAWN * DENSITY),) * 2, DENSITY)
    kinds = {"meadow": _meadow, "stubble": _stubble, "plough": _plough, "clover": _clover}
    shape = (int(TILE * COARSE),) * 2
    land = [b.material(name, draw, shape, COARSE) for name, draw in kinds.items()]
    middle = CELLS // 2
    cells: list[list[Surface]] = [[] for _ in land]
    for left, right, low, high, kind, turn, shift in _pieces():
        for i in range(left, right):
            for j in range(low, high):
                if (i, j) != (middle, middle):
                    cells[kind].append(_cell(i - middle, j - middle, turn, shift))
    b.look("ground.look", _cell(0, 0, 0.0, (0.0, 0.0), whole=True), lawn, (0.0, 0.0, 0.0))
    for material, surfaces in zip(land, cells, strict=True):
        b.look(material.name, join(surfaces), material, (0.0, 0.0, 0.0))
    b.solid("ground", mujoco.mjtGeom.mjGEOM_PLANE, [HALF, HALF, 0.1], (0.0, 0.0, 0.0))


def _pieces() -> list[tuple[int, int, int, int, int, float, tuple[float, float]]]:
    """Return the pieces of land: cells from and to along x and y, kind, turn and shift of its look.

    The piece with the lawn in it is a meadow.
    """
    fixed = np.random.default_rng(21)
    middle = CELLS // 2
    near = (middle - 2, middle + 3)
    whole = [(0, CELLS, near[1], CELLS), (0, CELLS, 0, near[0]), (near[1], CELLS, *near),
             (0, near[0], *near)]  # fmt: skip
    pieces = [(*near, *near, 0, 0.0, (0.0, 0.0))]
    while whole:
        left, right, low, high = whole.pop()
        wide, deep = right - left, high - low
        if max(wide, deep) <= 3:
            turn = float(fixed.uniform(0.0, 2.0 * math.pi))
            shift = (float(fixed.uniform()), float(fixed.uniform()))
            pieces.append((left, right, low, high, int(fixed.integers(4)), turn, shift))
        elif wide >= deep:
            cut = left + int(fixed.integers(1, wide))
            whole += [(left, cut, low, high), (cut, right, low, high)]
        else:
            cut = low + int(fixed.integers(1, deep))
            whole += [(left, right, low, cut), (left, right, cut, high)]
    return pieces


def _cell(
    i: int, j: int, turn: float, shift: tuple[float, float], *, whole: bool = False
) -> Surface:
    """Return a cell of the ground, so many cells north and west of the lawn's."""
    corner = np.array([(i + 0.5) * CELL, (j + 0.5) * CELL, 0.0])
    right, down = np.array([0.0, -CELL, 0.0]), np.array([-CELL, 0.0, 0.0])
    cell = quad(corner, right, down, WHOLE, CELL)
    if whole:
        return cell
    c, s = (round(part / TILE, 9) for part in (math.cos(turn), math.sin(turn)))
    texture = cell.points[:, :2] @ np.array([[-s, -c], [-c, s]]) + shift
    return cell._replace(texture=texture)


def _far() -> list[tuple[str, float, float, float, float]]:
    """Return things beyond the lawn: kind, x, y, turn and a share that decides about their size.

    There are as many between 60 and 120 m as between 30 and 60.
    """
    fixed = np.random.default_rng(22)
    things: list[tuple[str, float, float, float, float]] = []
    for kind, count in FAR.items():
        for _ in range(count):
            while True:
                away = 30.0 * (0.88 * HALF / 30.0) ** fixed.uniform()
                angle = fixed.uniform(0.0, 2.0 * math.pi)
                x, y = round(away * math.cos(angle), 2), round(away * math.sin(angle), 2)
                if all(math.dist((x, y), other[1:3]) > 9.0 for other in things):
                    break
            turn, share = round(fixed.uniform(0.0, 360.0), 1), round(fixed.uniform(), 3)
            things.append((kind, x, y, turn, share))
    return things


def _things(b: Builder) -> None:
    """Add what stands about; what is far away has the shapes of what is near, in other sizes."""
    far: dict[str, list[tuple[float, float, float, float]]] = {kind: [] for kind in FAR}
    for kind, *where in _far():
        far[kind].append((where[0], where[1], where[2], where[3]))
    _trees(b, (*TREES, *((x, y, 2.3 + s, 1.5 + s) for x, y, _, s in far["tree"])))
    _huts(b, (*HUTS, *((x, y, t, 4.0 + 3 * s, 3.0 + s, 2.4) for x, y, t, s in far["hut"])))
    rock = b.material("rock", _rock, (384, 576), 96.0)
    stones = (*STONES, *((x, y, 0.7 + s, 0.6 + s, 0.5 + 0.8 * s) for x, y, _, s in far["stone"]))
    for number, (x, y, *radii) in enumerate(stones):
        b.crown(f"stone_{number}", rock, (radii[0], radii[1], radii[2]), (x, y, 0.5 * radii[2]))
    straw = b.material("straw", _straw, (128, 480), 96.0)
    for number, (x, y) in enumerate((*BALES, *((x, y) for x, y, *_ in far["bale"]))):
        b.cylinder(f"bale_{number}", straw, 0.75, 1.25, (x, y, 0.0), sides=16)
    masonry = b.material("masonry", materials.brick, (128, 768), 96.0, block=(0.17, 0.38),
                         palette=materials.GREY_STONE, mortar=(0.26, 0.25, 0.22))  # fmt: skip
    boards = b.material("boards", _boards, (112, 768), 96.0)
    rows = ((WALLS, far["wall"], "stone_wall", masonry, 0.45, 1.1),
            (FENCES, far["fence"], "fence", boards, 0.08, 1.15))  # fmt: skip
    for near, others, name, material, thick, high in rows:
        lines = (*near, *((x, y, t, 8.0 + 12.0 * s) for x, y, t, s in others))
        for number, (x, y, turn, length) in enumerate(lines):
            along: Window = (0.0, 0.0, length / material.width, 1.0)
            b.box(f"{name}_{number}", material, (thick, length, high), (x, y, 0.0), turn=turn,
                  windows={"front": along, "back": along})  # fmt: skip


def _trees(b: Builder, trees: tuple[tuple[float, float, float, float], ...]) -> None:
    bark = b.material("bark", materials.bark, (384, 192), 96.0, width=0.07)
    green = b.material("leaves", materials.leaves, (512, 768), 72.0)
    for number, (x, y, height, radius) in enumerate(trees):
        high = 1.15 * radius
        b.cylinder(f"tree_{number}/trunk", bark, 0.19, height, (x, y, 0.0), sides=10)
        b.crown(f"tree_{number}/crown", green, (radius, radius, high), (x, y, height + 0.8 * high))


def _huts(b: Builder, huts: tuple[tuple[float, ...], ...]) -> None:
    """Add huts of planks, each with a door, a window and a flat roof of turf."""
    planks = b.material("planks", _planks, (240, 1536), 96.0)
    turf = b.material("turf", materials.grass, (480, 720), 96.0)
    for number, (x, y, turn, long, wide, high) in enumerate(huts):
        share = wide / (wide + long)
        windows: dict[str, Window] = {
            "front": (0.0, 0.0, share, 1.0), "left": (share, 0.0, 1.0, 1.0),
            "back": (share, 0.0, 0.0, 1.0), "right": (1.0, 0.0, share, 1.0),
        }  # fmt: skip
        name, place = f"hut_{number}", (x, y, 0.0)
        b.box(f"{name}/walls", planks, (long, wide, high), place, turn=turn, windows=windows,
              hidden=("top", "bottom"))  # fmt: skip
        b.box(f"{name}/roof", turf, (long + 0.7, wide + 0.7, 0.28), (x, y, high), turn=turn)


def _wood(b: Builder) -> None:
    """Put a wood round the field."""
    back = b.material("wood", _edge, (int(WOOD * 16.0), 1024), 16.0)
    window: Window = (0.0, 0.0, round(2.0 * HALF / back.width), 1.0)
    for name, (x, y), facing, width in sides((HALF, HALF)):
        right, down = np.array([0.0, width, 0.0]), np.array([0.0, 0.0, -WOOD])
        panel = quad(-right / 2.0 - down / 2.0, right, down, window, CELL)
        b.look(f"{name}.look", panel, back, (x, y, WOOD / 2.0 - 0.2), facing)
        angle = math.radians(facing)
        behind = (x - round(math.cos(angle)), y - round(math.sin(angle)), WOOD / 2.0 - 0.2)
        b.solid(name, mujoco.mjtGeom.mjGEOM_BOX, [1.0, width / 2.0, WOOD / 2.0], behind, facing)


def _lawn(on: Canvas) -> Image:
    """Return the lawn, north up: mown in stripes, with a landing mark, paths and shadows."""
    x, y = _coordinates(on.shape[0])
    wobble = on.fractal(coarse=2.0 * DENSITY, fine=6, gain=0.6)
    ground = materials.grass(on)
    stripes = smooth(0.46, 0.54, np.abs((0.82 * x + 0.57 * y) / 1.6 % 2.0 - 1.0))
    ground = shade(ground, 0.16 * stripes - 0.08)
    winding = y + sines(x[:, 0] / 7.0)[:, None] * 2.2 - 4.0
    path = np.minimum(np.abs(winding), np.abs(x - 0.35 * y - 8.5)).astype(np.float32)
    bare = smooth(0.75, 0.35, path + 0.16 * wobble)
    ground = mix(ground, _gravel(on), bare)
    mark = np.abs(np.hypot(x, y) - 2.1)
    cross = np.minimum(np.abs(x), np.abs(y)) + np.where(np.hypot(x, y) < 1.3, 0.0, 9.0)
    worn = smooth(-1.3, 0.4, on.fractal(coarse=30))
    paint = smooth(0.13, 0.10, np.minimum(mark, cross).astype(np.float32))
    ground = mix(ground, (0.88, 0.88, 0.84), paint * worn * 0.9)
    mask = cv2.GaussianBlur(_shadows(on.shape), (0, 0), 2.0)
    shadow = cv2.merge([1.0 - mask * np.float32(dark) for dark in (0.50, 0.47, 0.40)])
    return np.asarray(ground * shadow, dtype=np.float32)


def _coordinates(size: int) -> tuple[Image, Image]:
    line = LAWN - (np.arange(size, dtype=np.float32) + 0.5) / DENSITY
    return np.broadcast_to(line[:, None], (size, size)), np.broadcast_to(line, (size, size))


def _pixels(points: Points) -> npt.NDArray[np.int32]:
    """Return columns and rows of places on the lawn, shape (n, 2)."""
    return np.rint((LAWN - points[:, ::-1]) * DENSITY).astype(np.int32)


def _shadows(shape: tuple[int, int]) -> Image:
    """Return the shadows' darkness on the lawn (0..1): footprints swept along the sun by height."""
    mask = np.zeros(shape, np.float32)
    shift = np.array([SUN[0], SUN[1]]) / -SUN[2]
    boxes = [(x, y, long, wide, turn, high) for x, y, turn, long, wide, high in HUTS]
    boxes += [(x, y, 0.45, length, turn, 1.1) for x, y, turn, length in WALLS]
    boxes += [(x, y, 0.08, length, turn, 1.15) for x, y, turn, length in FENCES]
    boxes += [(x, y, 1.2, 1.2, 0.0, 1.25) for x, y in BALES]
    boxes += [(x, y, 0.3, 0.3, 0.0, height) for x, y, height, _ in TREES]
    for x, y, long, wide, turn, height in boxes:
        c, s = math.cos(math.radians(turn)), math.sin(math.radians(turn))
        corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * (long / 2, wide / 2)
        corners = corners @ np.array([[c, s], [-s, c]]) + (x, y)
        swept = np.concatenate([corners, corners + shift * height])
        cv2.fillConvexPoly(mask, cv2.convexHull(_pixels(swept)), 1.0)
    rounds = [(x, y, height + 0.92 * radius, radius) for x, y, height, radius in TREES]
    rounds += [(x, y, 0.4 * z, max(a, b)) for x, y, a, b, z in STONES]
    for x, y, height, radius in rounds:
        centre = _pixels(np.array([[x, y]]) + shift * height)[0].tolist()
        cv2.circle(mask, centre, int(0.95 * radius * DENSITY), 1.0, -1)
    return mask


def _gravel(on: Canvas) -> Image:
    ground = on.flat((0.55, 0.49, 0.40))
    ground = shade(ground, 0.12 * on.fractal(coarse=on.density, gain=0.9))
    return shade(ground, 0.45 * on.specks(count=9000, radius=(1.0, 4.0)))


def _seamless(image: Image) -> Image:
    """Return an image that fits its own other side: near its edges, what was in its middle."""
    for axis in (0, 1):
        size = image.shape[axis]
        edge = np.minimum(np.arange(size), size - 1 - np.arange(size)).astype(np.float32)
        amount = smooth(0.0, 0.2 * size, edge)
        amount = amount[:, None] if axis == 0 else amount[None, :]
        whole = np.ascontiguousarray(np.broadcast_to(amount, image.shape[:2]))
        image = mix(np.roll(image, size // 2, axis), image, whole)
    return image


def _meadow(on: Canvas) -> Image:
    land = on.flat((0.27, 0.40, 0.15))
    land = shade(land, 0.26 * on.fractal(coarse=1.2 * on.density, gain=0.95))
    dry = on.fractal(coarse=8.0 * on.density, fine=6)
    land = mix(land, (0.55, 0.52, 0.26), smooth(0.2, 1.8, dry) * 0.6)
    land = mix(land, (0.13, 0.24, 0.09), smooth(0.6, 1.8, -dry) * 0.6)
    return _seamless(_flowers(on, land, 9000, (0.90, 0.88, 0.74)))


def _clover(on: Canvas) -> Image:
    land = on.flat((0.25, 0.38, 0.17))
    land = shade(land, 0.30 * on.fractal(coarse=2.5 * on.density, gain=0.9))
    return _seamless(_flowers(on, land, 24000, (0.74, 0.44, 0.58)))


def _flowers(on: Canvas, land: Image, count: int, colour: materials.Colour) -> Image:
    spots = on.specks(count=count, radius=(1.0, 3.4))
    land = mix(land, colour, np.maximum(spots, 0.0) * 0.8)
    return mix(land, (0.08, 0.13, 0.05), np.maximum(-spots, 0.0) * 0.7)


def _stubble(on: Canvas) -> Image:
    land = on.flat((0.70, 0.60, 0.36))
    rows = _rows(on, 40)
    land = shade(land, 0.20 * rows + 0.16 * on.fractal(coarse=3.0 * on.density, gain=0.9))
    chaff = on.specks(count=16000, radius=(1.0, 4.0))
    return _seamless(shade(land, 0.5 * chaff))


def _plough(on: Canvas) -> Image:
    land = on.flat((0.40, 0.29, 0.20))
    land = shade(land, 0.30 * _rows(on, 34) + 0.18 * on.fractal(coarse=4.0 * on.density, gain=0.9))
    clods = on.specks(count=16000, radius=(1.0, 6.0))
    return _seamless(shade(land, 0.55 * clods))


def _rows(on: Canvas, count: int) -> Image:
    """Return furrows from side to side, an even number so that they meet their other side."""
    bend = 0.06 * on.fractal(coarse=6.0 * on.density, fine=24)
    down = np.arange(on.shape[0], dtype=np.float32)[:, None] * np.float32(count / on.shape[0])
    wave = np.abs((down + bend) % 1.0 - 0.5)
    return 2.0 * smooth(0.05, 0.45, wave) - 1.0


def _rock(on: Canvas) -> Image:
    stone = on.flat((0.50, 0.49, 0.46))
    stone = shade(stone, 0.22 * on.fractal(coarse=1.2 * on.density, gain=0.9))
    stone = shade(stone, 0.4 * on.specks(count=900, radius=(1.0, 7.0)))
    lichen = on.fractal(coarse=0.5 * on.density, fine=3)
    stone = mix(stone, (0.66, 0.66, 0.38), smooth(1.0, 1.8, lichen) * 0.7)
    return mix(stone, (0.13, 0.13, 0.12), on.cracks(14) * 0.8)


def _straw(on: Canvas) -> Image:
    """Return straw, pressed into a bale and bound."""
    straw = on.flat((0.76, 0.64, 0.34))
    fibre = on.fractal(coarse=0.1 * on.density, fine=2, stretch=(1.0, 9.0), gain=0.9)
    straw = shade(straw, 0.28 * fibre + 0.30 * on.specks(count=500, radius=(1.0, 5.0)))
    bands = np.abs((np.arange(on.shape[0], dtype=np.float32) / on.density + 0.1) % 0.4 - 0.2)
    amount = np.broadcast_to(smooth(0.02, 0.01, bands)[:, None], on.shape)
    return mix(straw, (0.24, 0.36, 0.52), np.ascontiguousarray(amount) * 0.7)


def _boards(on: Canvas) -> Image:
    """Return a fence's upright boards, with gaps that are painted and two rails."""
    boards = materials.upright(on, width=0.14)
    down = np.arange(on.shape[0], dtype=np.float32) / on.shape[0]
    rails = np.minimum(np.abs(down - 0.22), np.abs(down - 0.78))
    amount = np.broadcast_to(smooth(0.07, 0.06, rails)[:, None], on.shape)
    return mix(boards, (0.36, 0.25, 0.16), np.ascontiguousarray(amount) * 0.75)


def _planks(on: Canvas) -> Image:
    """Return a hut's short side and, right of it, its long one: boards, a door and a window."""
    wall = materials.planks(on, width=0.2)
    high, wide = on.shape
    door = (int(0.66 * wide), int(0.18 * high), int(0.74 * wide), high)
    cv2.rectangle(wall, door[:2], door[2:], (0.22, 0.30, 0.26), -1)
    cv2.rectangle(wall, door[:2], door[2:], (0.80, 0.76, 0.66), 4)
    for left in (0.14, 0.83):
        corner, end = (
            (int(left * wide), int(0.3 * high)),
            (int((left + 0.07) * wide), int(0.62 * high)),
        )
        cv2.rectangle(wall, corner, end, (0.16, 0.20, 0.24), -1)
        cv2.rectangle(wall, corner, end, (0.84, 0.82, 0.76), 5)
    number = f"{int(on.random.integers(10, 99))}"
    box = (door[0] + 20, door[1] + 10, door[2] - 20, door[1] + 70)
    decals.letters(wall, number, box, (0.88, 0.80, 0.42), None)
    return wall


def _edge(on: Canvas) -> Image:
    """Return a wood from outside: crowns against the light, stems in the dark."""
    leaves = materials.leaves(on._replace(density=30.0))
    height = np.broadcast_to(
        np.linspace(1.0, 0.0, on.shape[0], dtype=np.float32)[:, None], on.shape
    )
    stems = np.zeros(on.shape, np.uint8)
    for column in on.random.integers(0, on.shape[1], 90).tolist():
        cv2.line(stems, (column, on.shape[0] // 2), (column, on.shape[0]), 255,
                 int(on.random.integers(2, 6)), cv2.LINE_AA)  # fmt: skip
    wood = mix(leaves, (0.26, 0.22, 0.17), share(stems) * smooth(0.45, 0.2, height))
    return _seamless(shade(wood, 0.8 * height - 0.4))
