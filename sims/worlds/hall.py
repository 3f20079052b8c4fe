"""`hall`: an old brick factory hall, 16 x 12 m and 5 m high, made into a flying arena.

Coordinates in this file are MuJoCo's: x north, y **west**, z up, metres, from the middle of the
floor. Shadows are painted on the floor, not drawn: they cost nothing per frame.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from sims.worlds import decals, materials
from sims.worlds.builder import Builder, Material, sides
from sims.worlds.materials import Canvas, Image, mix, shade, share, smooth

NORTH, WEST, HEIGHT = 8.0, 6.0, 5.0
DENSITY = 96.0  # pixels per metre of floor and walls

CEILING_DENSITY = 64.0

PILLARS = ((2.3, 2.1), (-2.6, -2.2), (2.2, -2.2), (-4.6, 1.9))
CRATES = (  # x, y, base, edge, turn
    (6.9, 5.0, 0.0, 0.9, 8.0), (7.2, 3.9, 0.0, 0.8, -12.0), (6.95, 4.9, 0.9, 0.8, 31.0),
    (-7.2, -5.1, 0.0, 1.0, 4.0), (-6.2, -5.4, 0.0, 0.8, -20.0), (-7.1, -5.1, 1.0, 0.7, 25.0),
    (7.0, -5.1, 0.0, 0.9, -6.0), (0.2, -2.3, 0.0, 0.8, 17.0), (0.3, -2.25, 0.8, 0.6, -24.0),
    (4.3, 1.9, 0.0, 0.7, 38.0), (-1.9, -2.0, 0.0, 0.6, 12.0), (-7.2, 5.2, 0.0, 1.0, -9.0),
)  # fmt: skip
BARRELS = (
    (-6.3, 5.3, "blue"), (-5.7, 5.5, "red"), (6.0, -5.4, "blue"), (5.4, -5.5, "red"),
    (3.6, -2.2, "red"), (-7.4, -1.0, "blue"), (7.4, 1.0, "red"),
)  # fmt: skip


def _wall(on: Canvas) -> Image:
    """Return brick, painted from 1.1 m up where paint still holds, windows under the ceiling."""
    shape, random, width = on.shape, on.random, on.shape[1] / DENSITY
    bare = materials.brick(on)
    colours = ((0.74, 0.73, 0.66), (0.62, 0.68, 0.66), (0.78, 0.70, 0.56), (0.68, 0.70, 0.74))
    colour = colours[int(random.integers(len(colours)))]
    painted = materials.plaster(on, colour, bare)
    # Bricks show through paint.
    relief = bare.mean(2) - float(bare.mean())
    painted = shade(painted, 0.35 * relief)
    level = np.arange(shape[0], dtype=np.float32)[:, None] / DENSITY
    ragged = 0.03 * on.fractal(coarse=40)
    wall = mix(bare, painted, smooth(-0.03, 0.03, (HEIGHT - 1.15) - level + ragged))
    band = smooth(-0.02, 0.02, 0.07 - np.abs(level - (HEIGHT - 1.2)) + 0.3 * ragged)
    wall = mix(wall, (0.22, 0.34, 0.38), band * smooth(-1.4, 0.0, on.fractal()) * 0.9)
    step = 2.0
    for left in np.arange(0.45, width - 1.4, step):
        if random.uniform() < 0.72:
            size = (int(0.95 * DENSITY), int(1.25 * DENSITY))
            pane = decals.window_pane(on._replace(shape=size), lit=random.uniform() < 0.25)
            decals.paste(wall, pane, int(left * DENSITY), int(0.5 * DENSITY), border=7)
        else:
            number = f"{random.integers(1, 99):02d}"
            box = (int(left * DENSITY), 50, int((left + 1.25) * DENSITY), 140)
            decals.letters(wall, number, box, (0.20, 0.24, 0.28),
                           smooth(-1.2, 0.2, on.fractal(coarse=24)))  # fmt: skip
    # Dirt gathers in the corners and at the foot.
    across = np.arange(shape[1], dtype=np.float32)[None, :] / DENSITY
    corner = np.exp(-np.minimum(across, width - across) / 0.5)
    foot = np.exp(-(HEIGHT - level) / 0.35)
    return shade(
        wall, (-0.35 * corner - 0.45 * foot - 0.2 * np.exp(-level / 0.4)).astype(np.float32)
    )


def _floor(on: Canvas) -> Image:
    """Return slabs and cast concrete, with course lines and the objects' shadows."""
    shape = on.shape
    slabs = materials.tiles(
        on, ((0.58, 0.56, 0.52), (0.50, 0.49, 0.47), (0.64, 0.60, 0.53)),
        size=(0.8, 0.8),
    )  # fmt: skip
    cast = materials.concrete(on, (0.55, 0.54, 0.52))
    where = on.fractal(coarse=4.0 * DENSITY, fine=8, gain=0.55)
    floor = mix(slabs, cast, smooth(0.25, 0.32, where))
    worn = smooth(-1.5, 0.3, on.fractal(coarse=50))
    line = np.zeros(shape, np.uint8)
    inset = int(1.0 * DENSITY)
    cv2.rectangle(line, (inset, inset), (shape[1] - inset, shape[0] - inset), 255, 9)
    floor = mix(floor, (0.86, 0.70, 0.22), share(line) * worn * 0.85)
    ring = np.zeros(shape, np.uint8)
    middle = (shape[1] // 2, shape[0] // 2)
    cv2.circle(ring, middle, int(0.75 * DENSITY), 255, 8, cv2.LINE_AA)
    floor = mix(floor, (0.88, 0.88, 0.84), share(ring) * worn * 0.9)
    decals.letters(floor, "H", (middle[0] - 40, middle[1] - 40, middle[0] + 40, middle[1] + 40),
                   (0.88, 0.88, 0.84), worn * 0.9)  # fmt: skip
    for number, (x, y) in enumerate(((5.2, 0.6), (4.9, 4.1), (-4.2, 4.3), (-5.3, -0.6),
                                     (-4.0, -4.2), (3.6, -4.3))):  # fmt: skip
        column, row = _pixel(x, y)
        decals.letters(floor, f"{number + 1}", (column - 45, row - 60, column + 45, row + 60),
                       (0.80, 0.80, 0.76), worn * 0.85)  # fmt: skip
    for x, y in PILLARS:
        column, row = _pixel(x, y)
        decals.stripes(floor, (column - 45, row - 45, column + 45, row + 45), worn)
    return decals.contact_shadow(floor, _footprints(shape), 22.0, 0.75)


def _pixels(density: float) -> tuple[int, int]:
    return int(2 * NORTH * density), int(2 * WEST * density)


def _pixel(x: float, y: float) -> tuple[int, int]:
    return int((WEST - y) * DENSITY), int((NORTH - x) * DENSITY)


def _footprints(shape: tuple[int, int]) -> Image:
    mask = np.zeros(shape, np.float32)
    squares = [(x, y, e, e) for x, y, base, e, _ in CRATES if base == 0.0]
    squares += [(x, y, 0.5, 0.5) for x, y in PILLARS]
    squares += [(x, y, 0.55, 0.55) for x, y, _ in BARRELS]
    squares += [(-1.6, 2.15, 3.6, 0.2), (-1.8, 5.7, 3.7, 0.5), (-6.9, -2.9, 1.4, 1.4)]
    squares += [(3.0, 4.15 + s * 1.42, 0.6, 0.45) for s in (-1, 1)]
    squares += [(-0.6, y, 0.3, 0.3) for y in (-2.95, -5.55)]
    for x, y, along, across in squares:
        column, row = _pixel(x, y)
        high, wide = int(along * DENSITY / 2), int(across * DENSITY / 2)
        mask[max(row - high, 0) : row + high, max(column - wide, 0) : column + wide] = 1.0
    mask[:6] = mask[-6:] = 1.0
    mask[:, :6] = mask[:, -6:] = 1.0
    return mask


def _ceiling(on: Canvas) -> Image:
    """Return painted boards between the beams, with skylights and water stains."""
    density = on.density
    boards = materials.planks(
        on, width=0.30,
        palette=((0.60, 0.58, 0.53), (0.52, 0.50, 0.46), (0.68, 0.64, 0.57), (0.45, 0.43, 0.41)),
    )  # fmt: skip
    boards = shade(boards, 0.30 * on.specks(count=5000, radius=(1.2, 5.0)))
    stain = on.fractal(coarse=2.5 * density, fine=6)
    boards = mix(boards, (0.34, 0.27, 0.20), smooth(0.8, 1.9, stain) * 0.6)
    for x in (-3.6, 0.0, 3.6):
        for y in (-4.3, 0.6, 4.5):
            size = (int(1.7 * density), int(1.2 * density))
            pane = decals.window_pane(on._replace(shape=size), lit=False)
            row, column = int((NORTH + x - 0.85) * density), int((WEST - y - 0.6) * density)
            decals.paste(boards, pane, column, row, border=5)
    return boards


def _columns(on: Canvas) -> Image:
    """Return sixteen pillar faces side by side: concrete, a number, stripes at the foot."""
    foot, width = on.shape
    faces = []
    for number in range(16):
        face = materials.concrete(on, (0.63, 0.62, 0.58))
        layout = on.cells(high=1.25 * DENSITY, wide=10.0 * DENSITY)
        face = mix(face, (0.25, 0.24, 0.22), 1.0 - smooth(0.5, 2.0, layout.edge))
        worn = smooth(-1.6, 0.2, on.fractal(coarse=20))
        decals.stripes(face, (0, foot - 105, width, foot - 8), worn)
        decals.letters(
            face,
            f"{'NESW'[number % 4]}{number // 4 + 1}",
            (4, foot - 210, width - 4, foot - 150),
            (0.16, 0.22, 0.30),
            worn,
        )
        faces.append(face)
    return np.concatenate(faces, 1)


def _steel(on: Canvas) -> Image:
    """Return blue barrels' sides above, red ones' in the middle, bare sheet below."""
    parts = []
    for rows, colour in ((154, (0.20, 0.36, 0.52)), (154, (0.62, 0.24, 0.18)),
                         (76, (0.58, 0.59, 0.60))):  # fmt: skip
        part = on._replace(shape=(rows, on.shape[1]))
        sheet = materials.metal(part, colour, pitch=0.32)
        rims = part.cells(high=rows / 3.0, wide=5000.0)
        sheet = shade(sheet, 0.35 * smooth(1.0, 3.0, rims.edge) - 0.35)
        parts.append(sheet)
    return np.concatenate(parts, 0)


def hall(seed: int = 0, bare: bool = False) -> Any:
    """Return the hall as a `mujoco.MjSpec`; every seed has its own bricks, posters and crates."""
    b = Builder("hall", seed, bare)
    b.spec.visual.headlight.ambient = [0.62, 0.62, 0.64]
    crates = b.material("crates", decals.crate_faces, (256, 256), 256.0)
    posters = b.material("posters", decals.posters, (288, 216), 128.0, glow=0.15)
    red = b.material("brick", materials.brick, (512, 1024), DENSITY, module=0.12)
    wood = b.material("wood", materials.planks, (512, 768), 128.0)
    timber = b.material("timber", materials.upright, (384, 384), 128.0, width=0.14)
    column = b.material("column", _columns, (int(HEIGHT * DENSITY), int(0.45 * DENSITY)), DENSITY)
    steel = b.material("steel", _steel, (384, 512), 128.0)
    _things(b, crates, steel)
    _structure(b, red, wood, timber, column)
    _partition(b, wood, posters)
    _shelf(b, wood, crates)
    _shell(b, posters)
    _roof(b, wood, steel)
    _lights(b)
    b.spec.stat.center = [0.0, 0.0, 2.0]
    b.spec.stat.extent = 10.0
    return b.spec


def _things(b: Builder, crates: Material, steel: Material) -> None:
    for number, (x, y, base, edge, turn) in enumerate(CRATES):
        b.crate(f"crate_{number}", crates, edge, (x, y, base), turn)
    for number, (x, y, colour) in enumerate(BARRELS):
        row = 0 if colour == "blue" else 1
        side = (0.0, row * 0.4, 1.0, row * 0.4 + 0.4)
        b.cylinder(
            f"barrel_{number}", steel, 0.29, 0.88, (x, y, 0.0), (0.02, 0.82, 0.3, 0.98), side
        )


def _structure(
    b: Builder, red: Material, wood: Material, timber: Material, column: Material
) -> None:
    for number, (x, y) in enumerate(PILLARS):
        left = number * 0.25
        windows = {
            face: (left + i * 0.0625, 0.0, left + (i + 1) * 0.0625, 1.0)
            for i, face in enumerate(("front", "left", "back", "right"))
        }
        b.box(f"pillar_{number}", column, (0.45, 0.45, HEIGHT), (x, y, 0.0), windows=windows,
              hidden=("top", "bottom"))  # fmt: skip
    b.arch("brick_arch", red, opening=(2.4, 1.5), leg=0.45, depth=0.6, place=(3.0, 4.15, 0.0))
    # A timber portal.
    for side, y in (("left", -2.95), ("right", -5.55)):
        b.box(f"portal/{side}", timber, (0.3, 0.3, 2.7), (-0.6, y, 0.0))
    b.box("portal/beam", wood, (0.34, 3.2, 0.34), (-0.6, -4.25, 2.7), hidden=())
    b.box("plinth", red, (1.4, 1.4, 0.36), (-6.9, -2.9, 0.0), turn=0.0)


def _partition(b: Builder, wood: Material, posters: Material) -> None:
    b.box("partition", wood, (3.6, 0.14, 2.5), (-1.6, 2.15, 0.0))
    for number, x in enumerate((-2.8, -1.6, -0.4)):
        b.panel(f"partition_poster_{number}", posters, decals.tile(number, 4, 3), (0.75, 1.0),
                (x, 2.225, 1.45), 90.0)  # fmt: skip
        b.panel(f"partition_poster_{number + 3}", posters, decals.tile(number + 3, 4, 3),
                (0.75, 1.0), (x, 2.075, 1.45), -90.0)  # fmt: skip


def _shelf(b: Builder, wood: Material, crates: Material) -> None:
    for number, x in enumerate((-3.6, -1.8, 0.0)):
        b.box(f"rack/upright_{number}", wood, (0.08, 0.5, 2.3), (x, 5.7, 0.0))
    for level, height in enumerate((0.35, 1.05, 1.75)):
        b.box(f"rack/board_{level}", wood, (3.7, 0.5, 0.06), (-1.8, 5.7, height), hidden=())
        for slot, x in enumerate((-3.1, -2.4, -1.3, -0.5)):
            if b.random.uniform() < 0.75:
                edge = float(b.random.uniform(0.3, 0.46))
                place = (x, 5.7, height + 0.06)
                b.crate(f"rack/box_{level}_{slot}", crates, edge, place)


def _shell(b: Builder, posters: Material) -> None:
    """Add floor and walls; last, for objects before them to be drawn first."""
    count = 0
    for name, place, facing, width in sides((NORTH, WEST)):
        inward = np.array([np.cos(np.radians(facing)), np.sin(np.radians(facing))])
        along = np.array([-inward[1], inward[0]])
        for offset in np.arange(-width / 2 + 1.7, width / 2 - 1.0, 2.9):
            at = np.array(place) + inward * 0.02 + along * (offset + b.random.uniform(-0.3, 0.3))
            height = float(b.random.uniform(0.95, 1.25))
            where = (float(at[0]), float(at[1]), float(b.random.uniform(1.5, 2.0)))
            b.panel(f"{name}_poster_{count}", posters, decals.tile(count % 12, 4, 3),
                    (0.75 * height, height), where, facing)  # fmt: skip
            count += 1
        brick = b.material(name, _wall, (int(HEIGHT * DENSITY), int(width * DENSITY)), DENSITY)
        b.wall(name, brick, (width, HEIGHT), (*place, 0.0), facing)
    floor = b.material("floor", _floor, _pixels(DENSITY), DENSITY)
    b.floor("floor", floor, (NORTH, WEST))


def _roof(b: Builder, wood: Material, steel: Material) -> None:
    for number, x in enumerate((-5.4, -1.8, 1.8, 5.4)):
        b.box(f"beam_{number}", wood, (0.24, 2 * WEST, 0.4), (x, 0.0, HEIGHT - 0.4),
              hidden=("top", "left", "right"))  # fmt: skip
    for number, y in enumerate((-3.0, 3.0)):
        for piece, x in enumerate((-6.0, -2.0, 2.0, 6.0)):
            bare = (0.0, 0.82, 1.0, 0.99)  # the steel's lowest band has no paint
            b.box(f"duct_{number}_{piece}", steel, (4.0, 0.4, 0.34), (x, y, HEIGHT - 0.85),
                  windows=dict.fromkeys(("left", "right", "top", "bottom"), bare),
                  hidden=("front", "back"))  # fmt: skip
    ceiling = b.material("ceiling", _ceiling, _pixels(CEILING_DENSITY), CEILING_DENSITY)
    b.ceiling("ceiling", ceiling, (NORTH, WEST), HEIGHT)


def _lights(b: Builder) -> None:
    b.light("daylight", (0.0, 0.0, 5.0), (0.42, 0.43, 0.46), towards=(0.35, -0.6, -0.7), sun=True)
