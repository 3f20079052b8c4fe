"""Materials and their patterns: noise, masonry, specks, drips, cracks.

Images here are float32 in 0..1, shape (h, w) or (h, w, 3) RGB; sizes are pixels. Each material is
drawn in any size, at `density` pixels per metre, and never twice alike.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[Any]
"""float32; typed as Any, since numpy's stubs lose float32 in sums with plain floats."""
Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Cells:
    """A surface laid out in rows of cells: bricks, planks, tiles."""

    # int32 number of the cell that each pixel belongs to, shape (h, w).
    index: npt.NDArray[np.int32]
    edge: Image  # distance to the cell's edge, pixels, shape (h, w)
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
    """Return noise of mean 0 and standard deviation 1, with detail at every scale.

    Args:
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
    high: float,  # height of a row
    wide: float,  # mean width of a cell
    stagger: float = 0.0,  # shift of every other row, in cells; 1.0 shifts every row at random
    uneven: float = 0.0,  # variation of the widths, in mean widths (less than 0.5)
) -> Cells:
    """Lay out rows of cells."""
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
    """Colour each cell from the palette, its brightness varied by `spread`."""
    colours = np.asarray(palette, np.float32)[random.integers(0, len(palette), layout.count)]
    tone = 1.0 + spread * random.standard_normal((layout.count, 1), dtype=np.float32)
    return np.asarray((colours * tone)[layout.index], dtype=np.float32)


def specks(
    shape: tuple[int, int], random: np.random.Generator, *, count: int, radius: tuple[float, float]
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
    """Return a byte mask as shares 0..1."""
    return np.asarray(stencil, dtype=np.float32) / np.float32(255.0)


def smooth(low: float, high: float, value: Image) -> Image:
    """Return a soft step (Hermite), 0 for `value` <= low and 1 for `value` >= high."""
    out = np.empty(value.shape, np.float32)
    for rows in _strips(out):
        t = np.clip((value[rows] - low) / (high - low), 0.0, 1.0)
        out[rows] = t * t * (3.0 - 2.0 * t)
    return out


def mix(below: Image, above: Image | Colour, amount: Image | float) -> Image:
    """Lay an image or a colour over another; `amount` is 0..1, shape (h, w) or scalar."""
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
    """Yield runs of rows of about 64 kB, small enough for a processor's cache."""
    count = max(1, 65536 // max(image[:1].nbytes, 1))
    for top in range(0, len(image), count):
        yield slice(top, top + count)


def _three(amount: Image) -> Image:
    flat = np.ascontiguousarray(amount, dtype=np.float32)
    return np.asarray(cv2.merge((flat, flat, flat)), dtype=np.float32)


def to_bytes(image: Image) -> npt.NDArray[np.uint8]:
    """Return uint8 RGB, shape (h, w, 3)."""
    return np.asarray(np.clip(image * 255.0 + 0.5, 0, 255), dtype=np.uint8)


RED_BRICK: tuple[Colour, ...] = (
    (0.62, 0.32, 0.23), (0.55, 0.27, 0.20), (0.68, 0.39, 0.28), (0.46, 0.24, 0.20),
    (0.72, 0.46, 0.33), (0.38, 0.22, 0.20),
)  # fmt: skip
YELLOW_BRICK: tuple[Colour, ...] = (
    (0.76, 0.66, 0.46), (0.68, 0.57, 0.38), (0.82, 0.74, 0.56), (0.58, 0.47, 0.33),
    (0.72, 0.58, 0.44),
)  # fmt: skip
GREY_STONE: tuple[Colour, ...] = (
    (0.58, 0.57, 0.54), (0.50, 0.50, 0.50), (0.66, 0.64, 0.59), (0.44, 0.44, 0.45),
    (0.60, 0.55, 0.48),
)  # fmt: skip
OAK: tuple[Colour, ...] = (
    (0.62, 0.44, 0.27), (0.55, 0.38, 0.23), (0.70, 0.52, 0.34), (0.48, 0.33, 0.21),
)  # fmt: skip


def brick(
    shape: tuple[int, int],
    random: np.random.Generator,
    density: float,
    palette: tuple[Colour, ...] = RED_BRICK,
    block: tuple[float, float] = (0.12, 0.28),
    mortar: Colour = (0.70, 0.67, 0.61),
) -> Image:
    """Return masonry in running bond; `block` is a brick's height and length in metres."""
    high, wide = block[0] * density, block[1] * density
    layout = cells(shape, random, high=high, wide=wide, stagger=0.5, uneven=0.12)
    joint = 0.010 * density + 0.5 * fractal(shape, random, coarse=12, fine=4)
    stone = per_cell(layout, random, palette, 0.13)
    stone = shade(stone, 0.07 * fractal(shape, random, coarse=16))
    grime = fractal(shape, random, coarse=2.0 * density, fine=16)
    wall = mix(stone, mortar, 1.0 - smooth(0.0, 1.5, layout.edge - joint))
    soot = smooth(0.3, 2.2, grime) * 0.45
    chalk = smooth(0.9, 2.4, -grime) * 0.35
    return mix(mix(wall, (0.20, 0.17, 0.16), soot), (0.86, 0.83, 0.78), chalk)


def paint(
    shape: tuple[int, int], random: np.random.Generator, colour: Colour, grain: float = 0.005
) -> Image:
    """Return smooth paint, with a grain of half a percent: next to no texture."""
    coat = np.full((*shape, 3), colour, np.float32)
    return shade(coat, grain * random.standard_normal(shape, dtype=np.float32))


def concrete(
    shape: tuple[int, int],
    random: np.random.Generator,
    density: float,
    base: Colour = (0.60, 0.59, 0.56),
) -> Image:
    """Return cast concrete: clouds, pores, patches of repair, drips, a few cracks."""
    area = shape[0] * shape[1] / density**2
    ground = np.full((*shape, 3), base, np.float32)
    ground = shade(ground, 0.08 * fractal(shape, random, coarse=1.5 * density, gain=0.85))
    drips = fractal(shape, random, coarse=0.2 * density, fine=3, stretch=(7.0, 1.0))
    ground = mix(ground, (0.33, 0.30, 0.27), smooth(0.8, 2.6, drips) * 0.5)
    ground = shade(
        ground, 0.30 * specks(shape, random, count=int(70 * area), radius=(1.0, 0.045 * density))
    )
    lines = cracks(shape, random, count=max(2, int(area / 2.0)))
    return mix(ground, (0.16, 0.15, 0.14), lines * 0.7)


def planks(
    shape: tuple[int, int],
    random: np.random.Generator,
    density: float,
    palette: tuple[Colour, ...] = OAK,
    width: float = 0.16,
) -> Image:
    """Return boards across the image, with grain, knots and nails."""
    layout = cells(shape, random, high=width * density, wide=1.9 * density, stagger=1.0, uneven=0.3)
    wood = per_cell(layout, random, palette, 0.13)
    grain = fractal(shape, random, coarse=0.06 * density, fine=2, stretch=(1.0, 14.0), gain=0.9)
    wood = shade(wood, 0.13 * grain)
    area = shape[0] * shape[1] / density**2
    knots = specks(shape, random, count=int(9 * area), radius=(1.2, 0.03 * density))
    wood = mix(wood, (0.18, 0.11, 0.07), np.abs(knots) * 0.75)
    wear = fractal(shape, random, coarse=density, fine=12)
    wood = mix(wood, (0.66, 0.61, 0.54), smooth(0.8, 2.4, wear) * 0.45)
    return mix(wood, (0.10, 0.07, 0.05), 1.0 - smooth(0.3, 1.7, layout.edge))


def bark(
    shape: tuple[int, int], random: np.random.Generator, density: float, width: float
) -> Image:
    """Return the bark of a trunk, in upright ridges of a width in metres."""
    image = planks(shape[::-1], random, density, width=width, palette=(
        (0.40, 0.31, 0.23), (0.33, 0.26, 0.20), (0.46, 0.38, 0.29),
    ))  # fmt: skip
    return np.ascontiguousarray(image.transpose(1, 0, 2))


def tiles(
    shape: tuple[int, int],
    random: np.random.Generator,
    density: float,
    palette: tuple[Colour, ...],
    size: tuple[float, float] = (0.4, 0.4),
    joint: Colour = (0.30, 0.29, 0.28),
    stagger: float = 0.0,
    spread: float = 0.09,
) -> Image:
    """Return slabs or tiles of `size` (height, width, metres) with chips, wear and dirty joints."""
    layout = cells(
        shape, random, high=size[0] * density, wide=size[1] * density, stagger=stagger,
        uneven=0.0 if stagger == 0.0 else 0.15,
    )  # fmt: skip
    area = shape[0] * shape[1] / density**2
    floor = per_cell(layout, random, palette, spread)
    floor = shade(floor, 0.05 * fractal(shape, random, coarse=0.5 * density, gain=0.9))
    blots = specks(shape, random, count=int(45 * area), radius=(1.0, 0.04 * density))
    floor = shade(floor, 0.30 * blots)
    wear = fractal(shape, random, coarse=2.5 * density, fine=8)
    floor = mix(floor, (0.33, 0.30, 0.27), smooth(0.4, 2.4, wear) * 0.4)
    ragged = 0.6 * fractal(shape, random, coarse=10, fine=3)
    return mix(floor, joint, 1.0 - smooth(0.4, 1.9, layout.edge - 0.008 * density + ragged))


def plaster(
    shape: tuple[int, int],
    random: np.random.Generator,
    density: float,
    colour: Colour,
    under: Image,
) -> Image:
    """Return old paint over `under` (same shape), flaked off in places."""
    coat = np.full((*shape, 3), colour, np.float32)
    coat = shade(coat, 0.06 * fractal(shape, random, coarse=1.2 * density, gain=0.85))
    area = shape[0] * shape[1] / density**2
    coat = shade(
        coat, 0.26 * specks(shape, random, count=int(38 * area), radius=(1.0, 0.05 * density))
    )
    coat = mix(coat, (0.25, 0.22, 0.20), 0.6 * cracks(shape, random, count=int(area / 1.5) + 1))
    flakes = fractal(shape, random, coarse=1.4 * density, fine=4, gain=0.62)
    bare = smooth(0.95, 1.05, flakes)
    rim = smooth(0.78, 0.95, flakes) * (1.0 - bare)
    return mix(mix(coat, (0.90, 0.88, 0.83), rim * 0.6), under, bare)


def metal(
    shape: tuple[int, int],
    random: np.random.Generator,
    density: float,
    colour: Colour,
    pitch: float = 0.2,
) -> Image:
    """Return painted corrugated sheet (ribs every `pitch` metres, upright), scratched and rusty."""
    across = np.arange(shape[1], dtype=np.float32) / np.float32(pitch * density)
    wave = np.abs((across % 1.0) - 0.5) * 2.0
    ribs = smooth(0.25, 0.45, wave) - smooth(0.65, 0.85, np.roll(wave, 3)) * 0.45
    sheet = np.full((*shape, 3), colour, np.float32)
    sheet = shade(sheet, np.broadcast_to(0.30 * ribs - 0.15, shape).astype(np.float32))
    area = shape[0] * shape[1] / density**2
    dents = specks(shape, random, count=int(30 * area), radius=(1.0, 0.04 * density))
    sheet = shade(sheet, 0.28 * dents + 0.05 * fractal(shape, random, coarse=density))
    rust = fractal(shape, random, coarse=0.7 * density, fine=2, stretch=(2.5, 1.0), gain=0.72)
    sheet = mix(sheet, (0.40, 0.21, 0.12), smooth(1.15, 1.9, rust) * 0.9)
    return mix(sheet, (0.85, 0.83, 0.80), 0.5 * cracks(shape, random, count=int(area)))


def grass(shape: tuple[int, int], random: np.random.Generator, density: float) -> Image:
    """Return a worn lawn: tufts, dry patches, bare soil."""
    tufts = fractal(shape, random, coarse=0.35 * density, fine=2, gain=0.95)
    lawn = np.full((*shape, 3), (0.30, 0.42, 0.18), np.float32)
    lawn = shade(lawn, 0.24 * tufts)
    dry = fractal(shape, random, coarse=3.0 * density, fine=6)
    lawn = mix(lawn, (0.58, 0.53, 0.30), smooth(0.1, 1.6, dry) * 0.6)
    soil = smooth(0.9, 1.5, -dry + 0.25 * tufts)
    return mix(lawn, (0.40, 0.31, 0.22), soil * 0.8)


def leaves(shape: tuple[int, int], random: np.random.Generator, density: float) -> Image:
    """Return dense foliage: light leaves over dark gaps."""
    area = shape[0] * shape[1] / density**2
    green = np.full((*shape, 3), (0.20, 0.31, 0.13), np.float32)
    green = shade(green, 0.30 * fractal(shape, random, coarse=0.5 * density, fine=3, gain=0.9))
    near = specks(shape, random, count=int(150 * area), radius=(2.0, 0.07 * density))
    green = mix(green, (0.48, 0.58, 0.24), np.maximum(near, 0.0) * 0.75)
    return mix(green, (0.05, 0.09, 0.04), np.maximum(-near, 0.0) * 0.8)


def asphalt(shape: tuple[int, int], random: np.random.Generator, density: float) -> Image:
    """Return old asphalt: grit, patches, sealed cracks, oil."""
    area = shape[0] * shape[1] / density**2
    road = np.full((*shape, 3), (0.47, 0.46, 0.45), np.float32)
    road = shade(road, 0.10 * fractal(shape, random, coarse=2.0 * density, gain=0.95))
    grit = specks(shape, random, count=int(26 * area), radius=(1.0, 0.05 * density))
    fine = fractal(shape, random, coarse=0.12 * density, fine=2, gain=1.0)
    road = shade(road, 0.42 * grit + 0.07 * fine)
    patch = cells(shape, random, high=1.7 * density, wide=2.6 * density, stagger=1.0, uneven=0.4)
    tone = (random.uniform(0, 1, patch.count) < 0.16).astype(np.float32)[patch.index]
    road = shade(road, -0.22 * tone * smooth(0.0, 2.0, patch.edge))
    oil = fractal(shape, random, coarse=1.2 * density, fine=6)
    road = mix(road, (0.13, 0.13, 0.14), smooth(1.2, 2.4, oil) * 0.6)
    return mix(road, (0.12, 0.12, 0.12), cracks(shape, random, count=int(area / 4.5)) * 0.8)


SIZE = 384


def sky(random: np.random.Generator, night: bool = False) -> Image:
    """Return a sky for `Builder.sky`: haze, blue, flat clouds; by night a few stars before them."""
    clouds = fractal((1024, 1024), random, coarse=200, fine=6, gain=0.62)
    faces = np.concatenate([_face(axes, clouds) for axes in _AXES], 0)
    if night:
        stars = random.uniform(size=faces.shape[:2]) > 0.9993
        faces = mix(faces * (0.05, 0.06, 0.09), (0.75, 0.78, 0.82), stars.astype(np.float32))
    return faces


# Each face in GL's order (+x -x +y -y +z -z, where y is up and z is our west): its middle, its
# right, its down, by OpenGL 4.6's table 8.19.
_AXES = (
    ((1, 0, 0), (0, 0, -1), (0, -1, 0)),
    ((-1, 0, 0), (0, 0, 1), (0, -1, 0)),
    ((0, 1, 0), (1, 0, 0), (0, 0, 1)),
    ((0, -1, 0), (1, 0, 0), (0, 0, -1)),
    ((0, 0, 1), (1, 0, 0), (0, -1, 0)),
    ((0, 0, -1), (-1, 0, 0), (0, -1, 0)),
)


def _face(axes: tuple[tuple[int, int, int], ...], clouds: Image) -> Image:
    middle, right, down = (np.array(axis, np.float32) for axis in axes)
    place = (np.arange(SIZE, dtype=np.float32) + 0.5) / SIZE * 2.0 - 1.0
    ray = middle + place[None, :, None] * right + place[:, None, None] * down
    ray /= np.linalg.norm(ray, axis=2, keepdims=True)
    height = ray[..., 1]
    up = smooth(-0.02, 0.65, height)
    sky = mix(np.full((SIZE, SIZE, 3), (0.80, 0.84, 0.86), np.float32), (0.33, 0.52, 0.76), up)
    # Clouds lie in a plane above; the 0.12 keeps those at the horizon from shrinking to nothing.
    flat = np.maximum(height, 0.0) + 0.12
    u, v = 512.0 + 150.0 * ray[..., 0] / flat, 512.0 + 150.0 * ray[..., 2] / flat
    body = cv2.remap(clouds, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    cover = smooth(0.15, 1.1, body) * smooth(-0.02, 0.1, height)
    light = np.clip(0.93 - 0.10 * smooth(0.8, 2.4, body), 0.0, 1.0)[..., None]
    return mix(sky, np.asarray(light * (1.0, 1.0, 1.0), dtype=np.float32), cover * 0.92)
