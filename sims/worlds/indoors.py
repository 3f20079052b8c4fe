"""Worlds indoors: `corridor`, whose doors are all alike, and `office`, plain and white.

`corridor` is a closed corridor round a block, 57 m long. Its image repeats every 2.6 m to the
pixel, so opposite places cannot be told from each other. `office` is an open-plan office, 16 x 12
m, with a glazed meeting room: colour shows things behind the glass, depth the pane.

Coordinates are MuJoCo's: x north, y **west**, z up, metres, from the middle of the corridor's east
side or of the office's floor.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from sims.worlds import materials
from sims.worlds.builder import WHOLE, Builder, Material, sides
from sims.worlds.materials import Canvas, Colour, Image, shade, smooth

MODULE = 2.6  # metres from door to door, and the width of the corridor

CEILING = 2.7
MODULES_NORTH, MODULES_WEST = 9, 4  # modules along the outer walls

DENSITY = 128.0


def corridor(seed: int = 0, bare: bool = False) -> Any:
    """Return the corridor as a `mujoco.MjSpec`; the seed changes grain and speckles only."""
    b = Builder("corridor", seed, bare)
    b.spec.visual.headlight.ambient = [0.74, 0.74, 0.72]
    wall = b.material("wall", _wall, (_pixels(CEILING), _pixels(MODULE)), DENSITY)
    trim, red = (
        b.material(name, materials.paint, (64, 64), 64.0, colour=colour)
        for name, colour in (("trim", (0.60, 0.63, 0.62)), ("red", (0.72, 0.13, 0.10)))
    )
    half_x, half_y = MODULES_NORTH * MODULE / 2.0, MODULES_WEST * MODULE / 2.0
    middle = half_y - MODULE / 2.0
    _pilasters(b, trim, half_x, half_y, middle)
    for corner, (x, y) in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1))):
        foot = (x * (half_x - 0.3), middle + y * (half_y - 0.3), 0.0)
        b.cylinder(f"bin_{corner}", red, 0.17, 0.7, foot, top=WHOLE, side=WHOLE)
    inner = (2.0 * half_x - 2.0 * MODULE, 2.0 * half_y - 2.0 * MODULE, CEILING)
    long, short = (0.0, 0.0, MODULES_NORTH - 2.0, 1.0), (0.0, 0.0, MODULES_WEST - 2.0, 1.0)
    b.box("block", wall, inner, (0.0, middle, 0.0), hidden=("top", "bottom"),
          windows={"front": short, "back": short, "left": long, "right": long})  # fmt: skip
    square = (_pixels(MODULE),) * 2
    half, window = (half_x, half_y), (0.0, 0.0, float(MODULES_WEST), float(MODULES_NORTH))
    for name, place, facing, width in sides(half, (0.0, middle)):
        b.wall(name, wall, (width, CEILING), (*place, 0.0), facing,
               window=(0.0, 0.0, float(round(width / MODULE)), 1.0))  # fmt: skip
    b.floor("floor", b.material("floor", _floor, square, DENSITY), half, middle=(0.0, middle),
            window=window)  # fmt: skip
    b.ceiling("ceiling", b.material("ceiling", _ceiling, square, DENSITY, glow=0.25), half, CEILING,
              middle=(0.0, middle), window=window)  # fmt: skip
    for name, way in (("fill", 1.0), ("glow", -1.0)):  # as bright on each side of the block
        b.light(name, (0.0, 0.0, 2.0), (0.17, 0.17, 0.17), towards=(0.5 * way, 0.3 * way, -0.4),
                sun=True)  # fmt: skip
    b.spec.stat.center = [0.0, middle, 1.3]
    b.spec.stat.extent = 12.0
    return b.spec


def _pilasters(b: Builder, trim: Material, half_x: float, half_y: float, middle: float) -> None:
    """Put a pilaster between each two doors, on the outer walls and on the block."""
    places = []
    for off, lean in ((0.0, -0.05), (MODULE, 0.05)):
        x, y = half_x - off, half_y - off
        for side in (-1.0, 1.0):
            along, across = (np.arange(MODULE - end, end - 0.1, MODULE).tolist() for end in (x, y))
            places += [(at, side * (y + lean), 0.0) for at in along]
            places += [(side * (x + lean), at, 90.0) for at in across]
    for number, (x, y, turn) in enumerate(places):
        b.box(f"pilaster_{number}", trim, (0.24, 0.1, CEILING), (x, middle + y, 0.0), turn=turn,
              hidden=("top", "bottom"))  # fmt: skip


def _pixels(metres: float) -> int:
    return round(metres * DENSITY)


def _wall(on: Canvas) -> Image:
    """Return a wall module: a door with its frame, a notice, a handrail, a skirting."""
    shape = on.shape
    height = CEILING - np.arange(shape[0], dtype=np.float32)[:, None] / DENSITY
    wall = materials.paint(on, (0.86, 0.85, 0.79))
    lower = materials.paint(on, (0.52, 0.64, 0.61))
    rail = smooth(0.0, 0.01, 0.05 - np.abs(height - 0.95))
    wall = np.where(height[..., None] < 0.92, lower, wall)
    wall = shade(wall, np.broadcast_to(-0.45 * rail, shape))

    def fill(left: float, right: float, low: float, high: float, colour: Colour) -> None:
        rows, columns = (
            slice(_pixels(CEILING - high), _pixels(CEILING - low)),
            slice(_pixels(left), _pixels(right)),
        )
        part = wall[rows, columns]
        part[:] = materials.paint(on._replace(shape=part.shape[:2]), colour)

    fill(0.0, MODULE, 0.0, 0.10, (0.26, 0.28, 0.29))
    fill(0.78, 1.82, 0.0, 2.14, (0.36, 0.38, 0.40))
    fill(0.85, 1.75, 0.02, 2.07, (0.63, 0.47, 0.31))
    fill(1.42, 1.60, 1.15, 1.85, (0.20, 0.25, 0.28))
    fill(1.44, 1.58, 1.17, 1.83, (0.55, 0.66, 0.70))
    fill(0.90, 1.04, 1.00, 1.05, (0.80, 0.80, 0.80))
    fill(0.85, 1.75, 0.02, 0.24, (0.66, 0.67, 0.68))
    fill(1.98, 2.26, 1.42, 1.82, (0.93, 0.93, 0.90))
    for line in range(6):
        fill(2.01, 2.20 - 0.03 * (line % 3), 1.73 - 0.05 * line, 1.745 - 0.05 * line,
             (0.30, 0.32, 0.36))  # fmt: skip
    fill(0.30, 0.50, 1.45, 1.65, (0.10, 0.50, 0.30))
    fill(0.36, 0.44, 1.49, 1.61, (0.92, 0.95, 0.92))
    light = np.exp(-((np.arange(shape[1], dtype=np.float32) / DENSITY - MODULE / 2.0) ** 2) / 1.2)
    fall = 0.16 * light[None, :] * smooth(0.4, 2.5, height) - 0.08
    return shade(wall, fall.astype(np.float32))


def _square(on: Canvas, colour: Colour) -> tuple[Image, Image]:
    """Return a module of plain surface, and each pixel's nearness to the lamp, 0..1."""
    place = (np.arange(on.shape[0], dtype=np.float32) + 0.5) / DENSITY - MODULE / 2.0
    near = np.exp(-(place[:, None] ** 2 + place[None, :] ** 2) / 0.9)
    return materials.paint(on, colour), near.astype(np.float32)


def _floor(on: Canvas) -> Image:
    floor, near = _square(on, (0.55, 0.56, 0.53))
    spots = on.specks(count=900, radius=(1.0, 2.0))
    floor = shade(floor, 0.12 * spots + 0.30 * near - 0.10)
    floor[:2] *= 0.8
    floor[:, :2] *= 0.8
    return floor


def _ceiling(on: Canvas) -> Image:
    ceiling, near = _square(on, (0.74, 0.74, 0.72))
    ceiling = shade(ceiling, 0.15 * near - 0.05)
    size = _pixels(MODULE)
    for line in np.linspace(0.0, size, 5)[:-1].astype(int).tolist():
        ceiling[line : line + 2] *= 0.72
        ceiling[:, line : line + 2] *= 0.72
    quarter = size // 4
    cv2.rectangle(ceiling, (quarter, size // 2 - 22), (3 * quarter, size // 2 + 22),
                  (0.45, 0.45, 0.45), -1)  # fmt: skip
    cv2.rectangle(ceiling, (quarter + 4, size // 2 - 18), (3 * quarter - 4, size // 2 + 18),
                  (1.0, 1.0, 0.96), -1)  # fmt: skip
    return ceiling


NORTH, WEST, HEIGHT = 8.0, 6.0, 2.9
DESKS = (  # x, y, turn
    (3.6, 2.2, 0.0), (3.6, 4.0, 0.0), (-4.2, 2.3, 90.0), (-2.2, 2.3, 90.0),
    (-5.8, -2.1, 0.0), (0.9, -2.2, 90.0),
)  # fmt: skip
COLUMNS = ((2.1, -1.9), (-2.4, -2.1), (1.4, 2.4))
MEETING = (6.3, -4.5)  # the middle of the glazed room, 3.4 x 3 m in the north-east corner


def office(seed: int = 0, bare: bool = False) -> Any:
    """Return the office as a `mujoco.MjSpec`; the seed changes the grain of paint and carpet."""
    b = Builder("office", seed, bare)
    b.spec.visual.headlight.ambient = [0.80, 0.80, 0.80]

    def paint(name: str, colour: Colour, glow: float = 0.0) -> Material:
        return b.material(name, materials.paint, (128, 128), 32.0, glow=glow, colour=colour)

    white, dark = paint("white", (0.90, 0.90, 0.88)), paint("dark", (0.13, 0.14, 0.16))
    grey, blue = paint("grey", (0.60, 0.62, 0.64)), paint("blue", (0.20, 0.29, 0.42))
    wood = paint("wood", (0.78, 0.66, 0.50))
    for number, (x, y, turn) in enumerate(DESKS):
        _desk(b, f"desk_{number}", (x, y, turn), (wood, grey, dark, blue))
    for number, (x, y) in enumerate(COLUMNS):
        b.box(f"column_{number}", white, (0.4, 0.4, HEIGHT), (x, y, 0.0), hidden=("top", "bottom"))
    for number, x in enumerate((-6.9, -5.8, -4.7, -3.6)):
        b.box(f"cabinet_{number}", white, (1.08, 0.45, 1.25), (x, 5.75, 0.0))
    b.box("sofa/seat", blue, (0.8, 2.0, 0.42), (7.5, 0.6, 0.0))
    b.box("sofa/back", blue, (0.25, 2.0, 0.4), (7.8, 0.6, 0.42), hidden=())
    b.box("board", white, (0.05, 2.2, 1.2), (-7.95, 1.6, 0.9), hidden=("bottom",))
    _shell(b, white, paint("window", (0.93, 0.96, 1.0), glow=0.8), grey)
    _glazing(b, grey)
    b.light("lamps", (0.0, 0.0, 2.0), (0.22, 0.22, 0.21), towards=(0.3, 0.45, -0.7), sun=True)
    b.light("windows", (0.0, 0.0, 2.0), (0.20, 0.21, 0.23), towards=(-0.8, 0.2, -0.25), sun=True)
    b.spec.stat.center = [0.0, 0.0, 1.4]
    b.spec.stat.extent = 10.0
    return b.spec


def _desk(b: Builder, name: str, at: tuple[float, float, float], of: tuple[Material, ...]) -> None:
    """Add a desk with its legs, two screens, and a chair in front (-x)."""
    top, steel, dark, cloth = of
    x, y, turn = at
    c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))

    def part(what: str, of: Material, size: Any, ahead: float, left: float, up: float) -> None:
        place = (float(x + c * ahead - s * left), float(y + s * ahead + c * left), up)
        hidden = ("bottom",) if up < 0.5 else ()
        b.box(f"{name}/{what}", of, size, place, turn=turn, hidden=hidden)

    part("top", top, (0.8, 1.6, 0.04), 0.0, 0.0, 0.72)
    part("left_leg", steel, (0.7, 0.05, 0.72), 0.0, 0.72, 0.0)
    part("right_leg", steel, (0.7, 0.05, 0.72), 0.0, -0.72, 0.0)
    part("screen_0", dark, (0.04, 0.62, 0.38), 0.15, 0.36, 0.88)
    part("screen_1", dark, (0.04, 0.62, 0.38), 0.15, -0.36, 0.88)
    part("seat", cloth, (0.48, 0.48, 0.1), -0.75, 0.1, 0.44)
    part("back", cloth, (0.07, 0.46, 0.55), -0.98, 0.1, 0.54)
    part("foot", dark, (0.1, 0.1, 0.44), -0.75, 0.1, 0.0)


def _shell(b: Builder, white: Material, window: Material, frame: Material) -> None:
    for name, place, facing, width in sides((NORTH, WEST)):
        b.wall(name, white, (width, HEIGHT), (*place, 0.0), facing)
    for number, x in enumerate(np.arange(-7.0, 8.0, 2.0).tolist()):
        b.box(f"mullion_{number}", frame, (0.06, 0.06, 1.7), (x - 0.88, -5.97, 0.9), hidden=())
        b.panel(f"pane_{number}", window, (0.0, 0.0, 0.4, 0.4), (1.7, 1.6), (x, -5.98, 1.75), 90.0)
    grain = 0.03  # the carpet's pile
    pile = b.material(
        "carpet", materials.paint, (128, 128), 64.0, colour=(0.42, 0.44, 0.47), grain=grain
    )
    b.floor("floor", pile, (NORTH, WEST), window=(0.0, 0.0, 8.0, 6.0))
    tiles = b.material("tiles", _tiles, (205, 192), 64.0, glow=0.3)
    b.ceiling("ceiling", tiles, (NORTH, WEST), HEIGHT, window=(0.0, 0.0, 4.0, 5.0))


def _glazing(b: Builder, frame: Material) -> None:
    """Add the meeting room's panes; last of all, to be drawn over the background."""
    x, y = MEETING
    b.spec.add_material(name="glass", rgba=[0.72, 0.86, 0.88, 0.28], specular=0.0)
    glass = Material("glass", 1.0, 1.0)
    b.box("glass_0", glass, (0.04, 3.0, 2.5), (x - 1.7, y, 0.0), hidden=("bottom", "top"))
    b.box("glass_1", glass, (3.4, 0.04, 2.5), (x, y + 1.5, 0.0), hidden=("bottom", "top"))
    for number, (dx, dy) in enumerate(((-1.7, 1.5), (1.65, 1.5), (-1.7, -1.45), (0.0, 1.5))):
        b.box(f"post_{number}", frame, (0.08, 0.08, HEIGHT), (x + dx, y + dy, 0.0))
    b.box("table", frame, (1.6, 0.9, 0.74), (x, y, 0.0))


def _tiles(on: Canvas) -> Image:
    tiles = materials.paint(on, (0.76, 0.76, 0.76))
    for k in range(5):
        tiles[k * 41] *= 0.88
        tiles[:, min(k * 48, 191)] *= 0.88
    tiles[84:122, 50:95] = (1.0, 1.0, 0.98)
    return tiles
