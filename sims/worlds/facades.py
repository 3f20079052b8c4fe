"""House fronts: storeys of windows, doors, cornices, pipes. One call, one house."""

from __future__ import annotations

import cv2
import numpy as np

from sims.worlds import materials
from sims.worlds.decals import INKS, WORDS, letters, paste, window_pane
from sims.worlds.patterns import Colour, Image, fractal, mix, shade, smooth

STOREY = 3.1
"""Height of a storey, metres."""
PAINTS: tuple[Colour, ...] = (
    (0.80, 0.70, 0.52), (0.70, 0.46, 0.36), (0.66, 0.72, 0.68), (0.84, 0.80, 0.70),
    (0.60, 0.64, 0.72), (0.78, 0.60, 0.44),
)  # fmt: skip
BRICKS = (materials.RED_BRICK, materials.YELLOW_BRICK, materials.GREY_STONE)


def height_of(storeys: int) -> float:
    """Return the height of a house front, metres."""
    return storeys * STOREY + 1.0


def house(
    width: float, storeys: int, random: np.random.Generator, density: float, number: int
) -> Image:
    """Return a house front `width` metres wide at `density` pixels per metre."""
    height = height_of(storeys)
    shape = (int(height * density), int(width * density))
    bare = materials.brick(shape, random, density, BRICKS[number % 3], (0.17, 0.42))
    front = bare
    if number % 2:
        paint = PAINTS[int(random.integers(len(PAINTS)))]
        front = materials.plaster(shape, random, density, paint, bare)
        front = shade(front, 0.4 * (bare.mean(2) - float(bare.mean())))
    spacing = float(random.uniform(1.9, 2.4))
    columns = max(2, int((width - 0.8) / spacing))
    margin = (width - columns * spacing) / 2.0
    size = (int(1.6 * density), int(1.05 * density))
    door = int(random.integers(columns))
    for storey in range(storeys):
        top = int((height - (storey + 1) * STOREY + 0.75) * density)
        for column in range(columns):
            left = int((margin + (column + 0.5) * spacing - 0.52) * density)
            if storey == 0 and column == door:
                _door(front, left, int((height - 2.3) * density), density, random)
                continue
            pane = window_pane(size, random, lit=bool(random.uniform() < 0.18))
            if random.uniform() < 0.35:
                blind = int(size[0] * random.uniform(0.2, 0.6))
                pane[2:blind, 2:-2] = np.asarray(PAINTS[int(random.integers(6))], np.float32) * 0.9
            paste(front, pane, left, top, border=max(2, int(0.07 * density)))
            sill = top + size[0] + 3
            front[sill : sill + 4, left - 4 : left + size[1] + 4] = (0.78, 0.76, 0.71)
            front[sill + 4 : sill + 7, left - 3 : left + size[1] + 3] *= 0.55
        if storey:
            line = int((height - storey * STOREY) * density)
            front[line - 3 : line + 3] = front[line - 3 : line + 3] * 0.4 + 0.42
            front[line + 3 : line + 6] *= 0.6
    if number % 3 == 1 and columns > 2:
        _sign(front, density, random, number)
    front[: int(0.22 * density)] = (0.40, 0.38, 0.36)
    front[int(0.22 * density) : int(0.34 * density)] *= 0.5
    for x in (4, shape[1] - 8):
        cv2.line(front, (x, 8), (x, shape[0]), (0.30, 0.31, 0.32), 3)
    rise = np.arange(shape[0], 0, -1, dtype=np.float32)[:, None] / density
    damp = fractal(shape, random, coarse=2.0 * density, fine=4, stretch=(3.0, 1.0))
    front = mix(front, (0.26, 0.24, 0.22), smooth(0.9, 2.2, damp) * 0.45)
    foot = np.broadcast_to(-0.4 * np.exp(-rise / 0.5), shape)
    return shade(front, foot.astype(np.float32))


def _door(front: Image, left: int, top: int, density: float, random: np.random.Generator) -> None:
    shape = (front.shape[0] - top, int(1.1 * density))
    leaf = np.full((*shape, 3), PAINTS[int(random.integers(6))], np.float32) * 0.55
    leaf = shade(leaf, 0.12 * fractal(shape, random, coarse=20))
    for row in range(3):
        low, high = int(shape[0] * (0.08 + 0.3 * row)), int(shape[0] * (0.30 + 0.3 * row))
        for start, end in ((0.12, 0.46), (0.54, 0.88)):
            corner = (int(shape[1] * start), low)
            far = (int(shape[1] * end), high)
            cv2.rectangle(leaf, corner, far, (0.12, 0.11, 0.10), 1)
    paste(front, leaf, left, top, border=max(2, int(0.08 * density)))


def _sign(front: Image, density: float, random: np.random.Generator, number: int) -> None:
    """Paint a shop's name between the ground floor and the first."""
    paper, ink, _ = INKS[number % len(INKS)]
    bottom = front.shape[0] - int((STOREY - 0.55) * density)
    top = bottom - int(0.62 * density)
    left, right = int(0.12 * front.shape[1]), int(0.88 * front.shape[1])
    front[top:bottom, left:right] = paper
    cv2.rectangle(front, (left, top), (right, bottom), (0.15, 0.14, 0.13), 2)
    word = WORDS[int(random.integers(len(WORDS)))]
    letters(front, word, (left + 12, top + 4, right - 12, bottom - 4), ink, None)
