"""`office`: an open-plan office, 16 x 12 m, white and plain, with a glazed meeting room.

Coordinates are MuJoCo's: x north, y **west**, z up, metres, from the middle of the floor. Colour
shows things behind the glass, depth the pane.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sims.worlds import materials
from sims.worlds.builder import Builder, Material, sides
from sims.worlds.materials import Canvas, Colour, Image

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
