"""Solids of a mesh: the voxels that its triangles touch, merged into boxes; and its floor.

All lengths are metres, z is up. Cells are counted by integers, and computed by operations on single
elements: every machine gives the same boxes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import permutations
from typing import Any, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt
from scipy import ndimage

from sims.scans.mesh_file import MeshError

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Corners = npt.NDArray[np.int32]

GROUP = 3  # of geoms: met by vehicles and path checks, seen by no camera and no lidar
LIMIT = 4_000_000
"""Most cells that a mesh may fill, as estimated from its area: 200 × 200 m at 0.1 m."""

GAP = 0.3  # metres, between solids, into which no vehicle flies

_COLOUR = (0.5, 0.5, 0.5, 1.0)
_LAYER, _COLUMN = 0.1, 0.5  # height and least width of the cells in which the floor is looked for
_LEAST = 0.05  # of the area of the box about a mesh, of its floor: else it is a table
_FLAT, _LOWER = 3, 20  # a floor: a third of the ground at least, a twentieth at most below it
_DENSE = 20_000_000  # cells of a grid that are looked at at once
_BATCH = 500_000  # rows or columns of cells that are tested at once


class Voxels(NamedTuple):
    """Cells of a grid that are touched by triangles.

    Cells are centred on multiples of their size, so that walls at round numbers, of which single
    precision puts some vertices on the one side and some on the other, fill one layer.
    """

    cells: Integers  # numbers along x, y and z, ascending, shape (n, 3)
    size: float  # metres, of an edge
    level: float = 0.0  # height of the middle of cells whose number along z is 0

    def boxes(self) -> Floats:
        """Return low and high corners of disjoint boxes that fill the cells, shape (k, 6)."""
        ranges = merged(self.cells)
        up = np.array((0.0, 0.0, self.level))
        return np.hstack([(part - 0.5) * self.size + up for part in (ranges[:, :3], ranges[:, 3:])])

    def filled(self, gap: float = GAP) -> Voxels:
        """Return the cells and all between them where no cube fits that is wider than `gap`.

        A third of the boxes fill a warehouse's shelves then, and a quarter a rough scan.
        """
        width = math.floor(gap / self.size + 1e-9) + 1
        if width == 1 or not len(self.cells):
            return self
        low = self.cells.min(axis=0) - width
        sides = self.cells.max(axis=0) - low + 1 + width
        # In slices with margins, as far as a cell depends on others.
        count = min(int(sides[0]), max(1, _DENSE // int(sides[1] * sides[2])))
        margin, parts = 2 * width, []
        x, y, z = (self.cells - low).T
        for first in range(0, int(sides[0]), count):
            row = x - first + margin
            near = (row >= 0) & (row < count + 2 * margin)
            solid = np.zeros((count + 2 * margin, *sides[1:]), np.uint8)
            solid[row[near], y[near], z[near]] = 1
            closed = ndimage.grey_closing(solid, width)[margin:-margin]
            parts.append(np.argwhere(closed) + low + (first, 0, 0))
        return self._replace(cells=np.concatenate(parts))

    def above_floor(self) -> Voxels:
        """Return the cells above the layer of the floor, which is layer 0: a plane stands there."""
        return self._replace(cells=self.cells[self.cells[:, 2] > 0])


def voxel_boxes(
    points: Floats, corners: Corners, voxel: float, floor: float | None = None, gap: float = GAP
) -> Floats:
    """Return disjoint boxes that contain all triangles: low and high corners, shape (k, 6).

    They are the merged voxels that a triangle touches, so that surfaces stand up to one voxel too
    far out: a door of 0.9 m is at least 0.7 m wide at voxels of 0.1 m.

    Args:
        points: Shape (n, 3).
        corners: Numbers of the points of each triangle, shape (m, 3).
        voxel: Edge of a voxel.
        floor: Height of a plane that is added to the world. Voxels are then centred on it, and what
            is less than half a voxel above it or anywhere below has no box: else a vehicle
            would stand above the floor that is seen.
        gap: Width up to which gaps are filled, see `Voxels.filled`; at 0, boxes are exactly the
            voxels.

    Raises:
        MeshError: The triangles touch too many voxels; the message says which size would do.
    """
    voxels = voxelise(points, corners, voxel, 0.0 if floor is None else floor).filled(gap)
    return (voxels if floor is None else voxels.above_floor()).boxes()


def voxelise(points: Floats, corners: Corners, voxel: float, level: float = 0.0) -> Voxels:
    """Return the cells that triangles touch, and none besides.

    A cell is touched if the triangle's projections along all three axes overlap its squares, and
    its plane cuts it (M. Schwarz, H.-P. Seidel, *Fast parallel surface and solid voxelization on
    GPUs*, 2010), which is the test by 13 separating axes (T. Akenine-Möller, 2001) in parts. A face
    that lies between two layers is of the upper one. Triangles without area touch nothing.

    Args:
        level: Height of the middle of layer 0.

    Raises:
        MeshError: Points are not finite, or the triangles touch too many cells.
    """
    if not voxel > 0.0:
        raise MeshError(f"voxel: expected a size above 0 m, found {voxel:g} m")
    places = (points - (0.0, 0.0, level)) / voxel + 0.5  # cell i is from i to i + 1
    cells = _touched(places, corners, voxel)
    return Voxels(cells, voxel, level)


def add_solids(world: Any, boxes: Floats, floor: float | None = None) -> None:
    """Add boxes to a `mujoco.MjSpec`, as geoms ``solid0``, ``solid1``, …, and a plane ``floor``.

    They are of the world's own body: a body of theirs costs the physics twice as much.
    """
    middles, halves = (boxes[:, :3] + boxes[:, 3:]) / 2.0, (boxes[:, 3:] - boxes[:, :3]) / 2.0
    for number, (middle, half) in enumerate(zip(middles, halves, strict=True)):
        world.worldbody.add_geom(
            name=f"solid{number}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=middle,
            size=half,
            group=GROUP,
            rgba=_COLOUR,
        )
    if floor is not None:
        world.worldbody.add_geom(
            name="floor",
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            pos=(0.0, 0.0, floor),
            size=(0.0, 0.0, 1.0),
            group=GROUP,
            rgba=_COLOUR,
        )


class Floor(NamedTuple):
    """Height of the ground, or the reason why no plane can stand for it."""

    height: float | None
    reason: str = ""


def find_floor(points: Floats, corners: Corners) -> Floor:
    """Return the lowest level that is ground: what a plane may stand for, and hide nothing below.

    The ground is the lowest surface that faces up, in each column of a grid: under a table top, and
    under the floor above, it is the floor. A third of it or more is at its floor's level, within a
    layer or two of 0.1 m, and no more than a twentieth below that. So noise of some centimetres,
    steps and stray triangles do not matter; terrain has no such level.
    """
    triangles = points[corners]
    normals = _normals(triangles)
    # Less steep than 60°, of which noise makes no walls.
    upward = 2.0 * normals[:, 2] > _lengths(normals)
    if not upward.any():
        return Floor(None, "no surface faces up")
    triangles, areas = triangles[upward], normals[upward, 2]
    extent = np.ptp(triangles[:, :, :2], axis=(0, 1)).max()
    column = max(_COLUMN, float(extent) / 500.0)
    numbers = np.arange(triangles.size // 3, dtype=np.int32).reshape(-1, 3)
    scaled = triangles.reshape(-1, 3) / (column, column, _LAYER) + 0.5
    cells = _touched(scaled, numbers, _LAYER)
    first = np.append(True, (cells[1:, :2] != cells[:-1, :2]).any(axis=1))
    layers = cells[first, 2]
    base = int(layers.min())
    counts = np.bincount(layers - base)
    pairs = counts + np.append(counts[1:], 0)
    levels = np.flatnonzero(pairs * _FLAT >= len(layers))
    if not len(levels):
        share = pairs.max() / len(layers)
        return Floor(None, f"the ground is nowhere level: {share:.0%} of it within 0.2 m of height")
    level = int(levels[0])
    while level + 1 < len(pairs) and pairs[level + 1] > pairs[level]:
        level += 1
    lower = int(counts[:level].sum())
    if lower * _LOWER > len(layers):
        return Floor(None, f"{lower / len(layers):.0%} of the ground is below its lowest level")
    heights = (triangles[:, 0, 2] + triangles[:, 1, 2] + triangles[:, 2, 2]) / 3.0
    within = abs(heights - (base + level + 0.5) * _LAYER) <= 1.001 * _LAYER
    sides = np.ptp(points[corners].reshape(-1, 3)[:, :2], axis=0)
    if 0.5 * float(areas[within].sum()) < _LEAST * float(sides[0] * sides[1]):
        return Floor(None, f"what is level is less than {_LEAST:.0%} of the mesh's area")
    order = np.argsort(heights[within], kind="stable")
    shares = np.cumsum(areas[within][order])
    if not len(shares):
        return Floor(None, "the ground is of triangles that are tilted")
    middle = int(np.searchsorted(shares, shares[-1] / 2.0))
    return Floor(float(heights[within][order[middle]]))


def _lengths(vectors: Floats) -> Floats:
    x, y, z = vectors.T
    return np.asarray(np.sqrt(x * x + y * y + z * z))


def _touched(places: Floats, corners: Corners, voxel: float) -> Integers:
    """Return the cells of unit size that triangles touch, ascending."""
    if not len(corners):
        return np.zeros((0, 3), np.int64)
    triangles = places[corners]  # (m, corner, axis)
    if not np.isfinite(triangles).all():
        raise MeshError("points: expected finite coordinates, found others")
    normals = _normals(triangles)
    area = float(abs(normals).max(axis=1).sum()) / 2.0
    if area > LIMIT:
        raise MeshError(
            f"voxel: expected a size at which the mesh fills at most {LIMIT:,} voxels, found "
            f"{voxel:g} m, at which it fills {area:,.0f}: try {_rounded_up(voxel, area):g} m"
        )
    low, high = np.floor(triangles.min(axis=1)), np.floor(triangles.max(axis=1))
    base = low.min(axis=0)
    sides = [int(side) for side in high.max(axis=0) - base + 1.0]
    if math.prod(sides) > 2**62:
        raise MeshError(f"points: expected a mesh of up to 10⁶ voxels a side, found {sides}")
    steepest = np.where((normals != 0.0).any(axis=1), abs(normals).argmax(axis=1), -1)
    single = (low == high).all(axis=1) & (steepest >= 0)
    steepest[single] = -1
    parts = [_keys(low[single] - base, sides)]
    for axis in range(3):
        chosen = steepest == axis
        order = [(axis + 1) % 3, (axis + 2) % 3, axis]  # of the axes u, v and w
        back = [order.index(k) for k in range(3)]
        corner, last = low[chosen], (high - low)[chosen]
        local = triangles[chosen] - corner[:, None]
        for number, cells in _cells(local[:, :, order], normals[chosen][:, order], last[:, order]):
            parts.append(_keys(cells[:, back] + corner[number] - base, sides))
    keys = np.unique(np.concatenate(parts))
    rest, z = np.divmod(keys, sides[2])
    x, y = np.divmod(rest, sides[1])
    return np.asarray(np.stack([x, y, z], axis=1) + base.astype(np.int64))


def _rounded_up(voxel: float, area: float) -> float:
    """Return the size at which cells are few enough, in two digits."""
    size = voxel * math.sqrt(area / LIMIT)
    digit = 10.0 ** (math.floor(math.log10(size)) - 1)
    return math.ceil(size / digit) * digit


def _keys(cells: Floats, sides: list[int]) -> Integers:
    """Return one number for each cell of a grid, without repetition."""
    x, y, z = cells.astype(np.int64).T
    return np.unique((x * sides[1] + y) * sides[2] + z)


def _normals(triangles: Floats) -> Floats:
    """Return cross products of edges, shape (m, 3): twice the triangles' areas long."""
    (ax, ay, az), (bx, by, bz) = ((triangles[:, k] - triangles[:, 0]).T for k in (1, 2))
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=1)


def _cells(triangles: Floats, normals: Floats, last: Floats) -> Iterator[tuple[Integers, Floats]]:
    """Yield numbers of triangles, and cells that they touch, shape (n, 3), in batches.

    Args:
        triangles: In axes u, v and w, shape (m, corner, axis), from cell (0, 0, 0) on.
        normals: Of which the component along w is the largest.
        last: Greatest cell of each triangle, shape (m, 3).
    """
    uv, vw, wu = (
        _edges(triangles, normals, a, b, c) for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1))
    )
    for row, u in _expanded(last[:, 0]):
        first, final = _row(triangles[row], u, last[row, 1])
        for index, v in _expanded(final - first):
            number, a, b = row[index], u[index], v + first[index]
            inside = _overlaps(uv, number, a, b)
            number, a, b = number[inside], a[inside], b[inside]
            first_w, final_w = _depths(triangles[number], normals[number], a, b, last[number, 2])
            for column, w in _expanded(final_w - first_w):
                of, cells = number[column], np.stack([a[column], b[column], w + first_w[column]], 1)
                inside = _overlaps(vw, of, cells[:, 1], cells[:, 2])
                inside &= _overlaps(wu, of, cells[:, 2], cells[:, 0])
                yield of[inside], cells[inside]


def _expanded(last: Floats) -> Iterator[tuple[Integers, Floats]]:
    """Yield the number of a sequence for each of its members, and members from 0 to its last."""
    counts = last.astype(np.int64) + 1
    ends = np.cumsum(counts)
    begin = 0
    while begin < len(counts):
        before = ends[begin] - counts[begin]
        end = max(begin + 1, int(np.searchsorted(ends, before + _BATCH, "right")))
        some = counts[begin:end]
        number = np.repeat(np.arange(begin, end), some)
        starts = np.repeat(ends[begin:end] - some - before, some)
        yield number, (np.arange(len(number)) - starts).astype(np.float64)
        begin = end


def _row(triangles: Floats, u: Floats, last: Floats) -> tuple[Floats, Floats]:
    """Return first and final cell along v of triangles between u and u + 1."""
    first, final = np.full(len(u), np.inf), np.full(len(u), -np.inf)
    for k in range(3):
        (a, v), (b, other) = triangles[:, k, :2].T, triangles[:, k - 1, :2].T
        run = np.where(a == b, 1.0, b - a)
        for side in (u, u + 1.0):
            share = np.clip((side - a) / run, 0.0, 1.0)
            at = np.where(
                (np.maximum(a, b) < u) | (np.minimum(a, b) > u + 1.0),
                np.nan,
                v + share * (other - v),
            )
            first, final = np.fmin(first, at), np.fmax(final, at)
    return _clipped(first - 1e-9, last), _clipped(final + 1e-9, last)


def _depths(
    triangles: Floats, normals: Floats, u: Floats, v: Floats, last: Floats
) -> tuple[Floats, Floats]:
    """Return first and final cell along w that a triangle's plane cuts over a square."""
    slopes = normals[:, :2] / normals[:, 2:]
    corner = triangles[:, 0]
    middle = (
        corner[:, 2]
        - slopes[:, 0] * (u + 0.5 - corner[:, 0])
        - slopes[:, 1] * (v + 0.5 - corner[:, 1])
    )
    half = (abs(slopes[:, 0]) + abs(slopes[:, 1])) / 2.0
    return _clipped(middle - half, last), _clipped(middle + half, last)


def _clipped(places: Floats, last: Floats) -> Floats:
    return np.asarray(np.clip(np.floor(places), 0.0, last))


def _edges(triangles: Floats, normals: Floats, a: int, b: int, c: int) -> Floats:
    """Return, of edges seen along axis c, factors of a and b and what is added, shape (m, 3, 3).

    The sum is negative if a unit square from (a, b) on is beyond the edge.
    """
    sign = np.where(normals[:, c] < 0.0, -1.0, 1.0)[:, None]
    along = np.roll(triangles, -1, axis=1) - triangles
    x, y = -along[:, :, b] * sign, along[:, :, a] * sign
    offset = (
        np.maximum(x, 0.0) + np.maximum(y, 0.0) - (x * triangles[:, :, a] + y * triangles[:, :, b])
    )
    return np.stack([x, y, offset], axis=2)


def _overlaps(edges: Floats, number: Integers, a: Floats, b: Floats) -> npt.NDArray[np.bool_]:
    """Return whether unit squares from (a, b) on are on the inner side of all three edges."""
    x, y, offset = np.moveaxis(edges[number], 2, 0)
    beyond = x * a[:, None] + y * b[:, None] + offset < 0.0
    return np.asarray(~beyond.any(axis=1))


def merged(cells: Integers) -> Integers:
    """Return disjoint boxes that fill cells: first and past last along x, y and z, shape (k, 6).

    Cells are joined to rows, rows to rectangles, those to boxes; of the six orders of axes, the one
    with the fewest boxes.
    """
    least = None
    for first, second, third in permutations(range(3)):
        boxes = np.hstack([cells, cells + 1])
        for axis in (first, second, third):
            boxes = _joined(boxes, axis)
        if least is None or len(boxes) < len(least):
            least = boxes
    assert least is not None
    return np.asarray(least)


def _joined(boxes: Integers, axis: int) -> Integers:
    """Return boxes of which those that touch along an axis, and are equal across it, are one."""
    if not len(boxes):
        return boxes
    across = [k for k in range(6) if k % 3 != axis]
    boxes = boxes[np.lexsort([boxes[:, k] for k in (axis, *across)])]
    same = (boxes[1:, across] == boxes[:-1, across]).all(axis=1)
    same &= boxes[1:, axis] == boxes[:-1, axis + 3]
    ends = np.flatnonzero(np.append(~same, True))
    starts = np.append(0, ends[:-1] + 1)
    joined: Integers = boxes[starts]
    joined[:, axis + 3] = boxes[ends, axis + 3]
    return joined
