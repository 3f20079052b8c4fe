"""`hall`: an old brick factory hall, 16 x 12 m and 5 m high, made into a flying arena.

Coordinates in this file are MuJoCo's: x north, y **west**, z up, metres, from the middle of the
floor. What things are made of is in `materials` and `decals`, the images of floor, walls and
ceiling in `hall_surfaces`; how they get into the model, in `builder`.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from sims.worlds import decals, hall_surfaces, materials
from sims.worlds.builder import Builder, sides
from sims.worlds.hall_surfaces import (
    BARRELS,
    CEILING_DENSITY,
    CRATES,
    DENSITY,
    HEIGHT,
    NORTH,
    PILLARS,
    WEST,
)
from sims.worlds.model import Material
from sims.worlds.patterns import Image


def hall(seed: int = 0, bare: bool = False) -> Any:
    """Return the hall as a `mujoco.MjSpec`; every seed has its own bricks, posters and crates."""
    b = Builder("hall", seed, bare)
    b.spec.visual.headlight.ambient = [0.62, 0.62, 0.64]
    crates = b.material("crates", hall_surfaces.crates, 256.0)
    posters = b.material("posters", hall_surfaces.posters, 128.0, glow=0.15)
    red = b.material("brick", lambda r: materials.brick((512, 1024), r, DENSITY), DENSITY, 0.12)
    wood = b.material("wood", lambda r: materials.planks((512, 768), r, 128.0), 128.0)
    timber = b.material("timber", _upright, 128.0)
    column = b.material("column", hall_surfaces.columns, 96.0)
    steel = b.material("steel", hall_surfaces.steel, 128.0)
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


def _upright(random: np.random.Generator) -> Image:
    boards = materials.planks((384, 384), random, 128.0, width=0.14)
    return np.ascontiguousarray(boards.transpose(1, 0, 2))


def _things(b: Builder, crates: Material, steel: Material) -> None:
    for number, (x, y, base, edge, turn) in enumerate(CRATES):
        b.crate(f"crate_{number}", crates, edge, (x, y, base), turn)
    for number, (x, y, colour) in enumerate(BARRELS):
        row = 0 if colour == "blue" else 1
        b.cylinder(
            f"barrel_{number}",
            steel,
            0.29,
            0.88,
            (x, y, 0.0),
            side=(0.0, row * 0.4, 1.0, row * 0.4 + 0.4),
            top=(0.02, 0.82, 0.3, 0.98),
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
    """Put a rack along the west wall: boards on uprights, with boxes on them."""
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
    """Add floor and walls; last, so that what stands before them is drawn first."""
    count = 0
    for name, place, facing, width in sides((NORTH, WEST)):
        inward = np.array([np.cos(np.radians(facing)), np.sin(np.radians(facing))])
        along = np.array([-inward[1], inward[0]])
        for offset in np.arange(-width / 2 + 1.7, width / 2 - 1.0, 2.9):
            at = np.array(place) + inward * 0.02 + along * (offset + b.random.uniform(-0.3, 0.3))
            height = float(b.random.uniform(0.95, 1.25))
            b.panel(
                f"{name}_poster_{count}",
                posters,
                decals.tile(count % 12, 4, 3),
                (0.75 * height, height),
                (float(at[0]), float(at[1]), float(b.random.uniform(1.5, 2.0))),
                facing,
            )
            count += 1
        brick = b.material(name, functools.partial(hall_surfaces.wall, width=width), DENSITY)
        b.wall(name, brick, (width, HEIGHT), (*place, 0.0), facing)
    floor = b.material("floor", hall_surfaces.floor, DENSITY)
    b.floor("floor", floor, (NORTH, WEST))


def _roof(b: Builder, wood: Material, steel: Material) -> None:
    for number, x in enumerate((-5.4, -1.8, 1.8, 5.4)):
        b.box(f"beam_{number}", wood, (0.24, 2 * WEST, 0.4), (x, 0.0, HEIGHT - 0.4),
              hidden=("top", "left", "right"))  # fmt: skip
    for number, y in enumerate((-3.0, 3.0)):
        for piece, x in enumerate((-6.0, -2.0, 2.0, 6.0)):
            bare = (0.0, 0.82, 1.0, 0.99)  # the steel's lowest band has no paint
            b.box(
                f"duct_{number}_{piece}",
                steel,
                (4.0, 0.4, 0.34),
                (x, y, HEIGHT - 0.85),
                windows=dict.fromkeys(("left", "right", "top", "bottom"), bare),
                hidden=("front", "back"),
            )
    ceiling = b.material("ceiling", hall_surfaces.ceiling, CEILING_DENSITY)
    b.ceiling("ceiling", ceiling, (NORTH, WEST), HEIGHT)


def _lights(b: Builder) -> None:
    b.light("lamp_north", (4.8, -1.5, 4.2), (0.95, 0.80, 0.58), fall_off=0.06)
    b.light("lamp_south", (-5.0, 2.0, 4.2), (0.60, 0.74, 0.95), fall_off=0.06)
    b.light("lamp_east", (-1.0, -4.0, 3.6), (0.85, 0.72, 0.55), fall_off=0.10)
    b.light("daylight", (0.0, 0.0, 5.0), (0.42, 0.43, 0.46), towards=(0.35, -0.6, -0.7), sun=True)
