"""Free space of a mesh: its volume, a place to start from, and a tour that is clear of solids."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from events import Vector3
from sims.scans.solids import Voxels
from sims.worlds import CLEARANCE

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]
Cell = tuple[int, int]

LENGTH = 30.0  # of a tour, metres
HEIGHTS = (1.5, 1.25, 1.75, 1.0, 2.0)  # of a tour above the ground, metres, by preference
HALF_WIDTH = 0.33  # of a vehicle, to the tips of its propellers, metres
ENOUGH = 1.5  # metres of clearance of which more is not looked for

_ROUGH = 0.2  # metres that scanned ground may be above the plane that stands for it
_MOST = 2_000_000  # cells of the grid; larger meshes have larger cells
_SLACK = 1.1  # cells from a point near a cell's middle to the surface of another, more than between
_SPACING = 0.3  # of the points between which paths are looked for, metres
_PLACES = 16  # that a tour may lead by
_DETOUR = 0.5  # by a waypoint of a tour, least, metres
_SAMPLING = 0.05  # of a tour whose clearance is measured, metres


class Tour(NamedTuple):
    """Closed path: from the last waypoint it goes straight back to the first."""

    waypoints: tuple[Vector3, ...]  # metres, z up; the first is above the start
    length: float  # metres
    clearance: float  # least distance from voxels and floor, metres


class FreeSpace(NamedTuple):
    """Where a vehicle can be: inside the box around a mesh, above what the mesh shows."""

    volume: float  # that a vehicle reaches, m³
    start: Vector3  # on the ground, metres, z up
    tour: Tour


def find_free_space(voxels: Voxels, floor: float | None = None) -> FreeSpace | None:
    """Return the free space of a mesh; `None` if there is no ground on which a vehicle fits.

    A tour of about `LENGTH` metres at one height keeps `CLEARANCE` from all voxels. If not even a
    third of it has that, 0.1 m less is tried, down to 0.3 m: the tour's length and clearance are
    what is measured. An open mesh ends at the box around it.

    Args:
        voxels: Of all triangles, the floor's, too; of level `floor` if there is one.
        floor: Height of the plane that stands for the ground.
    """
    if not len(voxels.cells):
        return None
    grid = _Grid(voxels, floor)
    best: tuple[_Level, Tour] | None = None
    for tenths in range(round(CLEARANCE * 10.0), 2, -1):
        for height in HEIGHTS:
            level = _Level.of(grid, height, tenths / 10.0)
            if level is None:
                continue
            tour = level.tour()
            if best is None or tour.length > best[1].length:
                best = level, tour
            if tour.length > 0.8 * LENGTH:
                break
        if best is not None and best[1].length > LENGTH / 3.0:
            break
    if best is None:
        return None
    level, tour = best
    i, j = level.start
    x, y, _ = grid.middle(i, j, 0)
    volume = grid.reachable((i, j, level.layer))
    return FreeSpace(volume, (x, y, round(level.ground_at_start(), 3)), tour)


class _Grid:
    """Solid cells of the box around a mesh, with some air above it; layer 0 is the floor's.

    Of the mesh's voxels, as many as fit make a cell; layer 0 is one of voxels alone.
    """

    def __init__(self, voxels: Voxels, floor: float | None) -> None:
        self.floor = floor
        self.margin = 0.0 if floor is None else voxels.size / 2.0  # from the floor to layer 1
        self.boxes = (voxels if floor is None else voxels.above_floor()).boxes()
        low = voxels.cells.min(axis=0)
        if floor is not None:
            low[2] = 0
        sides = np.maximum(voxels.cells.max(axis=0) - low + 1, 1)
        self._factor = 1
        while (-(-sides // self._factor) + 1).prod() > _MOST:
            self._factor += 1
        self.step = voxels.size * self._factor
        air = math.ceil((max(HEIGHTS) + ENOUGH) / self.step)
        shape = -(-sides // self._factor) + (0, 0, 1 + air)
        self.origin: Floats = np.add(low, (-0.5, -0.5, 0.5)) * voxels.size
        self.origin[2] += voxels.level
        self.solid: Mask = np.zeros(shape, np.bool_)
        self.shown: Mask = np.zeros(shape[:2], np.bool_)  # columns with a surface below a tour
        x, y, z = (voxels.cells - low).T
        x, y, z = x // self._factor, y // self._factor, -(-z // self._factor)
        self.top = int(z.max()) + 1  # layers above are air
        below = z * self.step < min(HEIGHTS)
        self.shown[x[below], y[below]] = True
        inside = z >= 0
        self.solid[x[inside], y[inside], z[inside]] = True
        if floor is not None:
            self.solid[:, :, 0] = True
        self.shown = _closed(self.shown, math.ceil(0.5 / self.step))
        # Metres from the middle of a cell to that of the nearest solid one.
        self.room: Floats = ndimage.distance_transform_edt(~self.solid, self.step)
        self.fit = HALF_WIDTH + self.step  # least room of a vehicle

    def height(self, layer: int) -> float:
        """Return the height of the lower face of a layer above 0."""
        return float(self.origin[2]) + (layer - 1) * self.step

    def middle(self, i: int, j: int, layer: int) -> Vector3:
        """Return the middle of a cell, rounded to millimetres."""
        x, y, _ = self.origin.tolist()
        z = self.height(layer) + self.step / 2.0
        return (
            round(x + (i + 0.5) * self.step, 3),
            round(y + (j + 0.5) * self.step, 3),
            round(z, 3),
        )

    def reachable(self, cell: tuple[int, int, int]) -> float:
        """Return the volume, m³, of the space that a vehicle fills that flies from a cell."""
        wide = (self.room >= self.fit) & self.shown[:, :, None]
        wide[:, :, self.top :] = False
        labels, _ = ndimage.label(wide)
        if not labels[cell]:
            return 0.0
        away = ndimage.distance_transform_edt(labels != labels[cell], self.step)
        free = ~self.solid & (away < self.fit)
        free[:, :, self.top :] = False
        return float(free.sum()) * self.step**3


class _Level(NamedTuple):
    """Clear cells of one layer that are connected, and a cell among them to start below."""

    grid: _Grid
    layer: int
    clear: Mask
    start: Cell
    ground: Integers  # layer of the lowest cell in which a vehicle could stand, -1 for none

    @classmethod
    def of(cls, grid: _Grid, height: float, clearance: float) -> _Level | None:
        """Return the largest part of a level at a height above the best start's ground."""
        step = grid.step
        up = round((height - grid.margin) / step - 0.5)
        ground = _ground(grid.solid, up + 1 + math.ceil(HALF_WIDTH / step))
        ground[~grid.shown] = -1
        layers = np.maximum(ground + up, 0)
        least_room = clearance + _SLACK * step
        rooms = np.take_along_axis(grid.room, layers[:, :, None], axis=2)[:, :, 0]
        least, most = (f(ground, 3) for f in (ndimage.minimum_filter, ndimage.maximum_filter))
        flat = ground == 1 if grid.floor is not None else (least >= 0) & (most == least)
        # A rough scan's floor, or terrain, may be nowhere flat: then uneven by a cell.
        highest = grid.solid.shape[2] if grid.floor is None else 1.0 + _ROUGH / step
        for level in (flat, (least >= 0) & (most - least <= 1) & (most <= highest)):
            aside = ndimage.distance_transform_edt(np.pad(level, 1), step)[1:-1, 1:-1]
            fits = (aside >= grid.fit) & (rooms >= least_room)
            if fits.any():
                break
        else:
            return None
        middle = np.argwhere(grid.shown).mean(axis=0)
        away = np.sqrt(((np.indices(fits.shape).T - middle) ** 2).sum(axis=-1)).T * step
        score = np.minimum(np.minimum(aside, rooms), ENOUGH) - 1e-3 * away
        score = np.where(fits, np.round(score, 6), -np.inf)
        layer = int(layers.flat[score.argmax()])
        labels, _ = ndimage.label((grid.room[:, :, layer] >= least_room) & grid.shown)
        score[layers != layer] = -np.inf
        sizes = np.bincount(labels.ravel())
        starts = np.unique(labels[np.isfinite(score)])
        largest = starts[sizes[starts].argmax()]
        clear = labels == largest
        score[~clear] = -np.inf
        i, j = np.unravel_index(int(score.argmax()), score.shape)
        return cls(grid, layer, clear, (int(i), int(j)), ground)

    def ground_at_start(self) -> float:
        """Return the height of the highest ground below a vehicle at the start."""
        (i, j), reach = self.start, math.ceil(HALF_WIDTH / self.grid.step)
        i, j = max(i - reach, 0), max(j - reach, 0)
        layer = int(self.ground[i : i + 2 * reach + 1, j : j + 2 * reach + 1].max())
        floor = self.grid.floor
        return self.grid.height(layer) if floor is None or layer > 1 else floor

    def tour(self) -> Tour:
        """Return a tour from above the start, by places far from each other, and back."""
        cells, graph = self._graph()
        places = [int((cells == self.start).all(axis=1).argmax())]
        ways: list[Floats] = []  # metres from each place to all nodes
        before: list[Integers] = []  # the nodes on the way
        while len(places) > len(ways):
            way, previous = dijkstra(graph, False, places[-1], return_predecessors=True)
            ways.append(way)
            before.append(previous)
            nearest = np.where(ways[0] <= LENGTH / 4.0, np.min(ways, axis=0), 0.0)
            if len(places) < _PLACES and nearest.max() > 1.0:
                places.append(int(nearest.argmax()))
        order, length = [0], 0.0
        for number, place in enumerate(places[1:], 1):
            legs = zip(order, [*order[1:], 0], strict=True)
            extra = [ways[a][place] + ways[number][places[b]] - ways[a][places[b]] for a, b in legs]
            if length + min(extra) <= 1.1 * LENGTH:  # what follows shortens it
                length += min(extra)
                order.insert(extra.index(min(extra)) + 1, number)
        path: list[Cell] = []
        for a, b in zip(order, [*order[1:], 0], strict=True):
            leg = [places[b]]
            while leg[-1] != places[a]:
                leg.append(int(before[a][leg[-1]]))
            path += self._straight([(i, j) for i, j in cells[leg[::-1]].tolist()])
        path = self._smooth(path)
        return _measured([self.grid.middle(i, j, self.layer) for i, j in path], self.grid)

    def _graph(self) -> tuple[Integers, Any]:
        """Return clear cells some way apart, shape (n, 2), and lengths of ways between them."""
        spacing = max(1, round(_SPACING / self.grid.step))
        cells = np.argwhere(self.clear)
        away = cells - self.start
        reach = LENGTH / 2.0 / self.grid.step
        cells = cells[(away % spacing == 0).all(axis=1) & (abs(away) <= reach).all(axis=1)]
        numbers = np.full(self.clear.shape, -1)
        numbers[tuple(cells.T)] = np.arange(len(cells))
        rows, columns, lengths = [], [], []
        for way in ((1, 0), (0, 1), (1, 1), (1, -1)):
            steps = cells[:, None] + np.arange(1, spacing + 1)[:, None] * way
            inside = ((steps >= 0) & (steps < self.clear.shape)).all(axis=(1, 2))
            x, y = np.moveaxis(steps[inside], 2, 0)
            ends = np.where(self.clear[x, y].all(axis=1), numbers[x[:, -1], y[:, -1]], -1)
            rows.append(np.flatnonzero(inside)[ends >= 0])
            columns.append(ends[ends >= 0])
            lengths.append(np.full((ends >= 0).sum(), math.hypot(*way) * spacing * self.grid.step))
        entries = np.concatenate(lengths), (np.concatenate(rows), np.concatenate(columns))
        return cells, coo_array(entries, shape=(len(cells), len(cells))).tocsr()

    def _straight(self, path: list[Cell]) -> list[Cell]:
        """Return a path with as few corners as can be seen from each other, without its end."""
        corners, k = [], 0
        while k + 1 < len(path):
            corners.append(path[k])
            k = next(
                n for n in range(len(path) - 1, k, -1) if n == k + 1 or self._sees(path[k], path[n])
            )
        return corners or path

    def _smooth(self, path: list[Cell]) -> list[Cell]:
        """Return a closed path without the corners that hardly lengthen it."""
        corners = path[:1]
        for place, after in pairwise([*path[1:], path[0]]):
            before = corners[-1]
            detour = math.dist(before, place) + math.dist(place, after) - math.dist(before, after)
            if detour * self.grid.step > _DETOUR or not self._sees(before, after):
                corners.append(place)
        return corners

    def _sees(self, a: Cell, b: Cell) -> bool:
        """Return whether all cells on the line between two are clear."""
        count = 4 * max(abs(b[0] - a[0]), abs(b[1] - a[1])) + 1
        x, y = (
            np.rint(np.linspace(*ends, count)).astype(np.intp) for ends in zip(a, b, strict=True)
        )
        return bool(self.clear[x, y].all())


def _ground(solid: Mask, room: int) -> Integers:
    """Return the lowest layer of each column with ground below and free cells from it on, or -1."""
    ground = np.full(solid.shape[:2], -1)
    free = np.full(solid.shape[:2], room)  # above the top
    for layer in range(solid.shape[2] - 1, 0, -1):
        free = np.where(solid[:, :, layer], 0, free + 1)
        ground[solid[:, :, layer - 1] & (free >= room)] = layer
    return ground


def _closed(shown: Mask, radius: int) -> Mask:
    """Return columns with gaps of up to two radii, and what is enclosed, filled."""
    wide = ndimage.distance_transform_edt(np.pad(~shown, radius, constant_values=True)) <= radius
    closed = ndimage.distance_transform_edt(wide) > radius
    return np.asarray(ndimage.binary_fill_holes(closed[radius:-radius, radius:-radius] | shown))


def _measured(path: list[Vector3], grid: _Grid) -> Tour:
    """Return a tour with its length, and its distance from voxels and floor."""
    points = np.array(path)
    ends = np.roll(points, -1, axis=0)
    lengths = np.sqrt(((ends - points) ** 2).sum(axis=1))
    samples = np.vstack([
        start + np.linspace(0.0, 1.0, 2 + int(length / _SAMPLING))[:, None] * (end - start)
        for start, end, length in zip(points, ends, lengths, strict=True)
    ])  # fmt: skip
    boxes = grid.boxes
    least = math.inf if grid.floor is None else float(points[:, 2].min()) - grid.floor
    near = (boxes[:, :3] < samples.max(axis=0) + 3.0) & (boxes[:, 3:] > samples.min(axis=0) - 3.0)
    for box in boxes[near.all(axis=1)]:
        beyond = np.maximum(np.maximum(box[:3] - samples, samples - box[3:]), 0.0)
        least = min(least, math.sqrt((beyond**2).sum(axis=1).min()))
    # Between samples it may be nearer by half of their distance.
    return Tour(tuple(path), float(lengths.sum()), max(least - _SAMPLING / 2.0, 0.0))
