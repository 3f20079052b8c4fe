"""Materials and their patterns: noise, masonry, specks, drips, cracks.

Images here are float32 in 0..1, shape (h, w) or (h, w, 3) RGB; sizes are pixels. Each material is
drawn in any size, at `density` pixels per metre, and never twice alike.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

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


class Canvas(NamedTuple):
    """A piece of a surface to be drawn."""

    shape: tuple[int, int]  # height and width, pixels
    random: np.random.Generator
    density: float = 1.0  # pixels per metre

    @property
    def area(self) -> float:
        """Square metres."""
        return self.shape[0] * self.shape[1] / self.density**2

    def flat(self, colour: Colour) -> Image:
        """Return an image of one colour."""
        return np.full((*self.shape, 3), colour, np.float32)

    def fractal(
        self,
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
        height, width = self.shape
        total = np.zeros(self.shape, np.float32)
        size, weight = coarse, 1.0
        while size >= fine:
            rows = max(2, round(height / (size * stretch[0])) + 1)
            columns = max(2, round(width / (size * stretch[1])) + 1)
            blobs = self.random.standard_normal((rows, columns), dtype=np.float32)
            total += weight * cv2.resize(blobs, (width, height), interpolation=cv2.INTER_CUBIC)
            size, weight = size / 2.0, weight * gain
        total -= total.mean()
        return np.asarray(total / max(float(total.std()), 1e-6), dtype=np.float32)

    def cells(
        self,
        *,
        high: float,  # height of a row
        wide: float,  # mean width of a cell
        stagger: float = 0.0,  # shift of every other row, in cells; 1.0 shifts every row at random
        uneven: float = 0.0,  # variation of the widths, in mean widths (less than 0.5)
    ) -> Cells:
        """Lay out rows of cells."""
        height, width = self.shape
        row_of = (np.arange(height) / high).astype(np.int32)
        index = np.empty(self.shape, np.int32)
        across = np.empty(self.shape, np.float32)
        columns = np.arange(width, dtype=np.float32)
        per_row = int(width / wide) + 4
        for row in range(int(row_of[-1]) + 1):
            shift = self.random.uniform(0, 1) if stagger == 1.0 else stagger * (row % 2)
            steps = 1.0 + uneven * self.random.uniform(-1.0, 1.0, per_row)
            joints = (np.cumsum(steps) - 1.0 - shift) * wide
            cell = np.searchsorted(joints, columns, side="right").astype(np.int32)
            below, above = joints[np.maximum(cell - 1, 0)], joints[np.minimum(cell, per_row - 1)]
            lines = row_of == row
            index[lines] = cell + row * per_row
            across[lines] = np.minimum(np.abs(columns - below), np.abs(above - columns))
        place = np.arange(height, dtype=np.float32) % np.float32(high)
        down = np.minimum(place, np.float32(high) - place)[:, None]
        return Cells(index, np.minimum(across, down), int(index.max()) + 1)

    def specks(self, *, count: int, radius: tuple[float, float]) -> Image:
        """Return soft blots of random size, place and sign, between -1 and 1."""
        height, width = self.shape
        out = np.zeros(self.shape, np.float32)
        places = self.random.integers(0, (width, height), (count, 2)).tolist()
        sizes = np.exp(self.random.uniform(np.log(radius[0]), np.log(radius[1]), count))
        axes = np.maximum(1, np.rint(sizes[:, None] * (1.0, 0.6))).astype(int).tolist()
        tilts = self.random.uniform(0, 180, count).tolist()
        values = (
            self.random.uniform(0.35, 1.0, count) * self.random.choice([-1.0, 1.0], count)
        ).tolist()
        for place, axis, tilt, value in zip(places, axes, tilts, values, strict=True):
            cv2.ellipse(out, place, axis, tilt, 0, 360, value, -1)
        return np.asarray(cv2.GaussianBlur(out, (0, 0), 0.7), dtype=np.float32)

    def cracks(self, count: int) -> Image:
        """Return the strength (0..1) of thin wandering lines."""
        out = np.zeros(self.shape, np.uint8)  # OpenCV draws soft edges in bytes only
        height, width = self.shape
        for _ in range(count):
            start = self.random.uniform((0, 0), (width, height))
            heading = self.random.uniform(0, 2 * np.pi) + np.cumsum(self.random.normal(0, 0.35, 40))
            steps = np.stack([np.cos(heading), np.sin(heading)], 1) * self.random.uniform(3, 8)
            line = (start + np.cumsum(steps, 0)).astype(np.int32)
            cv2.polylines(out, [line], False, float(self.random.uniform(130, 255)), 1, cv2.LINE_AA)
        return share(out)


def per_cell(
    layout: Cells, random: np.random.Generator, palette: tuple[Colour, ...], spread: float
) -> Image:
    """Colour each cell from the palette, its brightness varied by `spread`."""
    colours = np.asarray(palette, np.float32)[random.integers(0, len(palette), layout.count)]
    tone = 1.0 + spread * random.standard_normal((layout.count, 1), dtype=np.float32)
    return np.asarray((colours * tone)[layout.index], dtype=np.float32)


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
    on: Canvas,
    palette: tuple[Colour, ...] = RED_BRICK,
    block: tuple[float, float] = (0.12, 0.28),
    mortar: Colour = (0.70, 0.67, 0.61),
) -> Image:
    """Return masonry in running bond; `block` is a brick's height and length in metres."""
    high, wide = block[0] * on.density, block[1] * on.density
    layout = on.cells(high=high, wide=wide, stagger=0.5, uneven=0.12)
    joint = 0.010 * on.density + 0.5 * on.fractal(coarse=12, fine=4)
    stone = per_cell(layout, on.random, palette, 0.13)
    stone = shade(stone, 0.07 * on.fractal(coarse=16))
    grime = on.fractal(coarse=2.0 * on.density, fine=16)
    wall = mix(stone, mortar, 1.0 - smooth(0.0, 1.5, layout.edge - joint))
    soot = smooth(0.3, 2.2, grime) * 0.45
    chalk = smooth(0.9, 2.4, -grime) * 0.35
    return mix(mix(wall, (0.20, 0.17, 0.16), soot), (0.86, 0.83, 0.78), chalk)


def paint(on: Canvas, colour: Colour, grain: float = 0.005) -> Image:
    """Return smooth paint, with a grain of half a percent: next to no texture."""
    return shade(on.flat(colour), grain * on.random.standard_normal(on.shape, dtype=np.float32))


def concrete(on: Canvas, base: Colour = (0.60, 0.59, 0.56)) -> Image:
    """Return cast concrete: clouds, pores, patches of repair, drips, a few cracks."""
    ground = on.flat(base)
    ground = shade(ground, 0.08 * on.fractal(coarse=1.5 * on.density, gain=0.85))
    drips = on.fractal(coarse=0.2 * on.density, fine=3, stretch=(7.0, 1.0))
    ground = mix(ground, (0.33, 0.30, 0.27), smooth(0.8, 2.6, drips) * 0.5)
    ground = shade(
        ground, 0.30 * on.specks(count=int(70 * on.area), radius=(1.0, 0.045 * on.density))
    )
    lines = on.cracks(max(2, int(on.area / 2.0)))
    return mix(ground, (0.16, 0.15, 0.14), lines * 0.7)


def planks(on: Canvas, palette: tuple[Colour, ...] = OAK, width: float = 0.16) -> Image:
    """Return boards across the image, with grain, knots and nails."""
    layout = on.cells(high=width * on.density, wide=1.9 * on.density, stagger=1.0, uneven=0.3)
    wood = per_cell(layout, on.random, palette, 0.13)
    grain = on.fractal(coarse=0.06 * on.density, fine=2, stretch=(1.0, 14.0), gain=0.9)
    wood = shade(wood, 0.13 * grain)
    knots = on.specks(count=int(9 * on.area), radius=(1.2, 0.03 * on.density))
    wood = mix(wood, (0.18, 0.11, 0.07), np.abs(knots) * 0.75)
    wear = on.fractal(coarse=on.density, fine=12)
    wood = mix(wood, (0.66, 0.61, 0.54), smooth(0.8, 2.4, wear) * 0.45)
    return mix(wood, (0.10, 0.07, 0.05), 1.0 - smooth(0.3, 1.7, layout.edge))


def upright(on: Canvas, palette: tuple[Colour, ...] = OAK, width: float = 0.16) -> Image:
    """Return upright boards."""
    image = planks(on._replace(shape=on.shape[::-1]), palette, width)
    return np.ascontiguousarray(image.transpose(1, 0, 2))


def bark(on: Canvas, width: float) -> Image:
    """Return the bark of a trunk, in upright ridges of a width in metres."""
    return upright(on, width=width, palette=(
        (0.40, 0.31, 0.23), (0.33, 0.26, 0.20), (0.46, 0.38, 0.29),
    ))  # fmt: skip


def tiles(
    on: Canvas,
    palette: tuple[Colour, ...],
    size: tuple[float, float] = (0.4, 0.4),
    joint: Colour = (0.30, 0.29, 0.28),
    stagger: float = 0.0,
    spread: float = 0.09,
) -> Image:
    """Return slabs or tiles of `size` (height, width, metres) with chips, wear and dirty joints."""
    layout = on.cells(
        high=size[0] * on.density, wide=size[1] * on.density, stagger=stagger,
        uneven=0.0 if stagger == 0.0 else 0.15,
    )  # fmt: skip
    floor = per_cell(layout, on.random, palette, spread)
    floor = shade(floor, 0.05 * on.fractal(coarse=0.5 * on.density, gain=0.9))
    blots = on.specks(count=int(45 * on.area), radius=(1.0, 0.04 * on.density))
    floor = shade(floor, 0.30 * blots)
    wear = on.fractal(coarse=2.5 * on.density, fine=8)
    floor = mix(floor, (0.33, 0.30, 0.27), smooth(0.4, 2.4, wear) * 0.4)
    ragged = 0.6 * on.fractal(coarse=10, fine=3)
    return mix(floor, joint, 1.0 - smooth(0.4, 1.9, layout.edge - 0.008 * on.density + ragged))


def plaster(on: Canvas, colour: Colour, under: Image) -> Image:
    """Return old paint over `under` (same shape), flaked off in places."""
    coat = on.flat(colour)
    coat = shade(coat, 0.06 * on.fractal(coarse=1.2 * on.density, gain=0.85))
    coat = shade(coat, 0.26 * on.specks(count=int(38 * on.area), radius=(1.0, 0.05 * on.density)))
    coat = mix(coat, (0.25, 0.22, 0.20), 0.6 * on.cracks(int(on.area / 1.5) + 1))
    flakes = on.fractal(coarse=1.4 * on.density, fine=4, gain=0.62)
    bare = smooth(0.95, 1.05, flakes)
    rim = smooth(0.78, 0.95, flakes) * (1.0 - bare)
    return mix(mix(coat, (0.90, 0.88, 0.83), rim * 0.6), under, bare)


def metal(on: Canvas, colour: Colour, pitch: float = 0.2) -> Image:
    """Return painted corrugated sheet (ribs every `pitch` metres, upright), scratched and rusty."""
    across = np.arange(on.shape[1], dtype=np.float32) / np.float32(pitch * on.density)
    wave = np.abs((across % 1.0) - 0.5) * 2.0
    ribs = smooth(0.25, 0.45, wave) - smooth(0.65, 0.85, np.roll(wave, 3)) * 0.45
    sheet = on.flat(colour)
    sheet = shade(sheet, np.broadcast_to(0.30 * ribs - 0.15, on.shape).astype(np.float32))
    dents = on.specks(count=int(30 * on.area), radius=(1.0, 0.04 * on.density))
    sheet = shade(sheet, 0.28 * dents + 0.05 * on.fractal(coarse=on.density))
    rust = on.fractal(coarse=0.7 * on.density, fine=2, stretch=(2.5, 1.0), gain=0.72)
    sheet = mix(sheet, (0.40, 0.21, 0.12), smooth(1.15, 1.9, rust) * 0.9)
    return mix(sheet, (0.85, 0.83, 0.80), 0.5 * on.cracks(int(on.area)))


def grass(on: Canvas) -> Image:
    """Return a worn lawn: tufts, dry patches, bare soil."""
    tufts = on.fractal(coarse=0.35 * on.density, fine=2, gain=0.95)
    lawn = on.flat((0.30, 0.42, 0.18))
    lawn = shade(lawn, 0.24 * tufts)
    dry = on.fractal(coarse=3.0 * on.density, fine=6)
    lawn = mix(lawn, (0.58, 0.53, 0.30), smooth(0.1, 1.6, dry) * 0.6)
    soil = smooth(0.9, 1.5, -dry + 0.25 * tufts)
    return mix(lawn, (0.40, 0.31, 0.22), soil * 0.8)


def leaves(on: Canvas) -> Image:
    """Return dense foliage: light leaves over dark gaps."""
    green = on.flat((0.20, 0.31, 0.13))
    green = shade(green, 0.30 * on.fractal(coarse=0.5 * on.density, fine=3, gain=0.9))
    near = on.specks(count=int(150 * on.area), radius=(2.0, 0.07 * on.density))
    green = mix(green, (0.48, 0.58, 0.24), np.maximum(near, 0.0) * 0.75)
    return mix(green, (0.05, 0.09, 0.04), np.maximum(-near, 0.0) * 0.8)


def asphalt(on: Canvas) -> Image:
    """Return old asphalt: grit, patches, sealed cracks, oil."""
    road = on.flat((0.47, 0.46, 0.45))
    road = shade(road, 0.10 * on.fractal(coarse=2.0 * on.density, gain=0.95))
    grit = on.specks(count=int(26 * on.area), radius=(1.0, 0.05 * on.density))
    fine = on.fractal(coarse=0.12 * on.density, fine=2, gain=1.0)
    road = shade(road, 0.42 * grit + 0.07 * fine)
    patch = on.cells(high=1.7 * on.density, wide=2.6 * on.density, stagger=1.0, uneven=0.4)
    tone = (on.random.uniform(0, 1, patch.count) < 0.16).astype(np.float32)[patch.index]
    road = shade(road, -0.22 * tone * smooth(0.0, 2.0, patch.edge))
    oil = on.fractal(coarse=1.2 * on.density, fine=6)
    road = mix(road, (0.13, 0.13, 0.14), smooth(1.2, 2.4, oil) * 0.6)
    return mix(road, (0.12, 0.12, 0.12), on.cracks(int(on.area / 4.5)) * 0.8)


def sky(on: Canvas, night: bool = False) -> Image:
    """Return a sky's faces: haze, blue, flat clouds; by night a few stars before them."""
    clouds = on._replace(shape=(1024, 1024)).fractal(coarse=200, fine=6, gain=0.62)
    faces = np.concatenate([_face(on, axes, clouds) for axes in _AXES], 0)
    if night:
        stars = on.random.uniform(size=faces.shape[:2]) > 0.9993
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


def _face(on: Canvas, axes: tuple[tuple[int, int, int], ...], clouds: Image) -> Image:
    middle, right, down = (np.array(axis, np.float32) for axis in axes)
    size = on.shape[0]
    place = (np.arange(size, dtype=np.float32) + 0.5) / size * 2.0 - 1.0
    ray = middle + place[None, :, None] * right + place[:, None, None] * down
    ray /= np.linalg.norm(ray, axis=2, keepdims=True)
    height = ray[..., 1]
    up = smooth(-0.02, 0.65, height)
    sky = mix(on.flat((0.80, 0.84, 0.86)), (0.33, 0.52, 0.76), up)
    # Clouds lie in a plane above; the 0.12 keeps those at the horizon from shrinking to nothing.
    flat = np.maximum(height, 0.0) + 0.12
    u, v = 512.0 + 150.0 * ray[..., 0] / flat, 512.0 + 150.0 * ray[..., 2] / flat
    body = cv2.remap(clouds, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    cover = smooth(0.15, 1.1, body) * smooth(-0.02, 0.1, height)
    light = np.clip(0.93 - 0.10 * smooth(0.8, 2.4, body), 0.0, 1.0)[..., None]
    return mix(sky, np.asarray(light * (1.0, 1.0, 1.0), dtype=np.float32), cover * 0.92)
