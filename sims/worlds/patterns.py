"""Patterns that materials are made of: noise, masonry, specks, drips, cracks.

Images here are float32 in 0..1, shape (h, w) or (h, w, 3) RGB; sizes are pixels. Materials made
of these are in `sims.worlds.materials`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[Any]
"""float32; numpy's stubs lose that in sums with plain floats, so it isn't in the type."""
Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Cells:
    """A surface laid out in rows of cells: bricks, planks, tiles.

    Attributes:
        index: int32 number of the cell that each pixel belongs to, shape (h, w).
        edge: Distance to the cell's edge, pixels, shape (h, w).
        count: Number of cells.
    """

    index: npt.NDArray[np.int32]
    edge: Image
    count: int


def fractal(
    shape: tuple[int, int],
    random: np.random.Generator,
    *,
    coarse: float = 128.0,
    fine: float = 2.0,
    stretch: tuple[float, float] = (1.0, 1.0),
    gain: float = 0.7,
) -> Image:
    """Return noise with mean 0 and standard deviation 1 that has detail at every scale.

    Args:
        shape: Height and width.
        random: Source of random numbers.
        coarse: Size of the largest blobs, pixels.
        fine: Size of the smallest; below 2 it would alias.
        stretch: Blobs are this much longer down and across: wood grain, drips.
        gain: Strength of each octave in terms of the one before.
    """
    height, width = shape
    total = np.zeros(shape, np.float32)
    size, weight = coarse, 1.0
    while size >= fine:
        rows = max(2, round(height / (size * stretch[0])) + 1)
        columns = max(2, round(width / (size * stretch[1])) + 1)
        blobs = random.standard_normal((rows, columns), dtype=np.float32)
        total += weight * cv2.resize(blobs, (width, height), interpolation=cv2.INTER_CUBIC)
        size, weight = size / 2.0, weight * gain
    total -= total.mean()
    return np.asarray(total / max(float(total.std()), 1e-6), dtype=np.float32)


def cells(
    shape: tuple[int, int],
    random: np.random.Generator,
    *,
    high: float,
    wide: float,
    stagger: float = 0.0,
    uneven: float = 0.0,
) -> Cells:
    """Lay out rows of cells.

    Args:
        shape: Height and width.
        random: Source of random numbers for shifts and widths.
        high: Height of a row.
        wide: Mean width of a cell.
        stagger: Shift of every other row, in cells; 1.0 shifts every row at random.
        uneven: Variation of the widths, in mean widths (less than 0.5).
    """
    height, width = shape
    row_of = (np.arange(height) / high).astype(np.int32)
    index = np.empty(shape, np.int32)
    across = np.empty(shape, np.float32)
    columns = np.arange(width, dtype=np.float32)
    per_row = int(width / wide) + 4
    for row in range(int(row_of[-1]) + 1):
        shift = random.uniform(0, 1) if stagger == 1.0 else stagger * (row % 2)
        steps = 1.0 + uneven * random.uniform(-1.0, 1.0, per_row)
        joints = (np.cumsum(steps) - 1.0 - shift) * wide
        found = np.searchsorted(joints, columns, side="right").astype(np.int32)
        below, above = joints[np.maximum(found - 1, 0)], joints[np.minimum(found, per_row - 1)]
        lines = row_of == row
        index[lines] = found + row * per_row
        across[lines] = np.minimum(np.abs(columns - below), np.abs(above - columns))
    place = np.arange(height, dtype=np.float32) % np.float32(high)
    down = np.minimum(place, np.float32(high) - place)[:, None]
    return Cells(index, np.minimum(across, down), int(index.max()) + 1)


def per_cell(
    layout: Cells, random: np.random.Generator, palette: tuple[Colour, ...], spread: float
) -> Image:
    """Colour each cell with one of the palette's colours, its brightness varied by `spread`."""
    colours = np.asarray(palette, np.float32)[random.integers(0, len(palette), layout.count)]
    tone = 1.0 + spread * random.standard_normal((layout.count, 1), dtype=np.float32)
    return np.asarray((colours * tone)[layout.index], dtype=np.float32)


def specks(
    shape: tuple[int, int],
    random: np.random.Generator,
    *,
    count: int,
    radius: tuple[float, float],
) -> Image:
    """Return soft blots of random size, place and sign, between -1 and 1."""
    height, width = shape
    out = np.zeros(shape, np.float32)
    places = random.integers(0, (width, height), (count, 2)).tolist()
    sizes = np.exp(random.uniform(np.log(radius[0]), np.log(radius[1]), count))
    axes = np.maximum(1, np.rint(sizes[:, None] * (1.0, 0.6))).astype(int).tolist()
    tilts = random.uniform(0, 180, count).tolist()
    values = (random.uniform(0.35, 1.0, count) * random.choice([-1.0, 1.0], count)).tolist()
    for place, axis, tilt, value in zip(places, axes, tilts, values, strict=True):
        cv2.ellipse(out, place, axis, tilt, 0, 360, value, -1)
    return np.asarray(cv2.GaussianBlur(out, (0, 0), 0.7), dtype=np.float32)


def cracks(shape: tuple[int, int], random: np.random.Generator, *, count: int) -> Image:
    """Return the strength (0..1) of thin wandering lines."""
    out = np.zeros(shape, np.uint8)  # OpenCV draws soft edges in bytes only
    height, width = shape
    for _ in range(count):
        start = random.uniform((0, 0), (width, height))
        heading = random.uniform(0, 2 * np.pi) + np.cumsum(random.normal(0, 0.35, 40))
        steps = np.stack([np.cos(heading), np.sin(heading)], 1) * random.uniform(3, 8)
        line = (start + np.cumsum(steps, 0)).astype(np.int32)
        cv2.polylines(out, [line], False, float(random.uniform(130, 255)), 1, cv2.LINE_AA)
    return share(out)


def share(stencil: npt.NDArray[np.uint8]) -> Image:
    """Return a mask that was drawn in bytes as shares 0..1."""
    return np.asarray(stencil, dtype=np.float32) / np.float32(255.0)


def smooth(low: float, high: float, value: Image) -> Image:
    """Return a soft step (Hermite) from 0 where `value` <= low to 1 where it is >= high."""
    out = np.empty(value.shape, np.float32)
    for rows in _strips(out):
        t = np.clip((value[rows] - low) / (high - low), 0.0, 1.0)
        out[rows] = t * t * (3.0 - 2.0 * t)
    return out


def mix(below: Image, above: Image | Colour, amount: Image | float) -> Image:
    """Lay an image or a colour over another; `amount` is 0..1, shape (h, w) or one number."""
    if not isinstance(above, np.ndarray):
        # One row of it: numpy is slow where the innermost loop is three long.
        above = np.tile(np.asarray(above, np.float32), (1, below.shape[1], 1))
    out = np.empty(below.shape, np.float32)
    for rows in _strips(out):
        under, over = below[rows], above if len(above) == 1 else above[rows]
        part = over - under
        part *= _three(amount[rows]) if isinstance(amount, np.ndarray) else np.float32(amount)
        np.add(part, under, out=out[rows], casting="same_kind")
    return out


def shade(image: Image, amount: Image) -> Image:
    """Make an image brighter (amount > 0) or darker, shape (h, w), as a share of itself."""
    out = np.empty(image.shape, np.float32)
    for rows in _strips(out):
        out[rows] = image[rows] * _three(1.0 + amount[rows])
    return out


def _strips(image: Image) -> Iterator[slice]:
    """Yield runs of rows of about 64 kB, which stay in a processor's cache while worked on."""
    count = max(1, 65536 // max(image[:1].nbytes, 1))
    for top in range(0, len(image), count):
        yield slice(top, top + count)


def _three(amount: Image) -> Image:
    """Repeat an image of one channel as three."""
    flat = np.ascontiguousarray(amount, dtype=np.float32)
    return np.asarray(cv2.merge((flat, flat, flat)), dtype=np.float32)


def to_bytes(image: Image) -> npt.NDArray[np.uint8]:
    """Return uint8 RGB, shape (h, w, 3)."""
    return np.asarray(np.clip(image * 255.0 + 0.5, 0, 255), dtype=np.uint8)
