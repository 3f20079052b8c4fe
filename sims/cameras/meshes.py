"""Triangles of a model's geoms, cut as MuJoCo's renderer cuts them (``visual/quality``)."""

from __future__ import annotations

import itertools
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from sims.cameras.surfaces import vertex_colours

Floats = npt.NDArray[np.float64]
Corners = npt.NDArray[np.int64]

FARTHEST = 2000.0  # half length of a plane without end, metres

MOST_CELLS = 40  # along a side of a plane; MuJoCo's 200 look the same, and cost more

_Kind = mujoco.mjtGeom
_LARGEST = float(np.finfo(np.float32).max)


def narrow(values: npt.ArrayLike) -> npt.NDArray[np.float32]:
    """Return numbers as finite float32: the largest for what is beyond, and 0 for NaN."""
    finite = np.nan_to_num(np.asarray(values, np.float64), nan=0.0)
    return np.ascontiguousarray(np.clip(finite, -_LARGEST, _LARGEST), np.float32)


class Mesh:
    """Triangles with normals and places in a texture.

    Where a mesh of the model has no places of its own, they are MuJoCo's: each shape's surface from
    0 to 1, a mesh or height field as it is seen from above.
    """

    def __init__(
        self,
        points: npt.ArrayLike,
        normals: npt.ArrayLike,
        corners: npt.ArrayLike,
        places: npt.ArrayLike,
        colours: npt.NDArray[np.float32] | None = None,
    ) -> None:
        self.points = narrow(points)  # metres, shape (n, 3)
        self.normals = narrow(normals)  # shape (n, 3)
        self.corners = np.ascontiguousarray(corners, np.int32)  # of triangles, shape (m, 3)
        self.places = narrow(places)  # u and v, shape (n, 2)
        # Factors on the colour: red, green, blue, opacity, shape (n, 4); None: 1.
        self.colours = None if colours is None else narrow(colours)

    def turned(self) -> Mesh:
        """Return the same triangles, to be seen from their other side, with the same normals."""
        return Mesh(self.points, self.normals, self.corners[:, ::-1], self.places, self.colours)


def shape_of(model: Any, geom: int) -> tuple[Any, ...]:
    """Return what a geom's mesh depends on."""
    kind, data = int(model.geom_type[geom]), int(model.geom_dataid[geom])
    if kind in (_Kind.mjGEOM_MESH, _Kind.mjGEOM_HFIELD):
        return kind, data
    return kind, *model.geom_size[geom].tolist()


@np.errstate(divide="ignore", invalid="ignore", over="ignore")  # `narrow` bounds what is too large
def mesh_of(model: Any, kind: int, *of: Any) -> Mesh:
    """Return the mesh of a `shape_of`; `ValueError` for a kind that is not drawn."""
    quality = model.vis.quality
    slices, stacks, quads = quality.numslices, quality.numstacks, quality.numquads
    size = np.array(of, np.float64)
    match kind:
        case _Kind.mjGEOM_MESH:
            return _own_mesh(model, *of)
        case _Kind.mjGEOM_HFIELD:
            return _height_field(model, *of)
        case _Kind.mjGEOM_PLANE:
            return _plane(size)
        case _Kind.mjGEOM_BOX:
            return _box(size, quads)
        case _Kind.mjGEOM_SPHERE:
            return _ellipsoid(np.repeat(size[:1], 3), slices, stacks)
        case _Kind.mjGEOM_ELLIPSOID:
            return _ellipsoid(size, slices, stacks)
        case _Kind.mjGEOM_CYLINDER:
            return _cylinder(size[0], size[1], slices, stacks)
        case _Kind.mjGEOM_CAPSULE:
            return _capsule(size[0], size[1], slices, stacks)
    raise ValueError(
        f'renderer = "raster": cannot draw geoms of type {_Kind(kind).name}; "mujoco" can'
    )


def _joined(*parts: Mesh) -> Mesh:
    starts = np.cumsum([0, *(len(part.points) for part in parts)])
    return Mesh(
        np.concatenate([part.points for part in parts]),
        np.concatenate([part.normals for part in parts]),
        np.concatenate([p.corners + start for p, start in zip(parts, starts, strict=False)]),
        np.concatenate([part.places for part in parts]),
    )


def _grid(columns: int, rows: int) -> Corners:
    """Return the triangles of a grid of so many cells, of vertices row by row, shape (m, 3)."""
    across, down = np.meshgrid(np.arange(columns), np.arange(rows))
    first = (down * (columns + 1) + across).ravel()
    above = first + columns + 1
    lower = np.stack([first, first + 1, above + 1], axis=-1)
    upper = np.stack([first, above + 1, above], axis=-1)
    return np.concatenate([lower, upper])


def _square(cells: int) -> tuple[Floats, Corners]:
    """Return the vertices (n, 2) from -1 to 1 and the triangles of a square."""
    at = np.linspace(-1.0, 1.0, cells + 1)
    return np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2), _grid(cells, cells)


def _box(half: Floats, cells: int) -> Mesh:
    """Return a box of half lengths `half`, its faces cut into cells."""
    flat, corners = _square(cells)
    sides = []
    for axis, (across, up) in enumerate([(1, 2), (0, 2), (0, 1)]):
        for sign in (1.0, -1.0):
            points = np.zeros((len(flat), 3))
            points[:, across], points[:, up], points[:, axis] = flat[:, 0], flat[:, 1], sign
            normal = np.zeros(3)
            normal[axis] = sign
            outward = sign > 0.0 if axis != 1 else sign < 0.0
            places = _unit(flat[:, 0], -flat[:, 1])
            sides.append(
                Mesh(
                    points * half,
                    np.tile(normal, (len(flat), 1)),
                    corners if outward else corners[:, ::-1],
                    places,
                )
            )
    return _joined(*sides)


def _ellipsoid(radii: Floats, slices: int, stacks: int) -> Mesh:
    directions, corners, around, up = _directions(slices, stacks, -0.5, 0.5)
    normals = directions / radii
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Mesh(directions * radii, normals, corners, np.stack([around, 0.5 - up], -1))


def _cylinder(radius: float, half: float, slices: int, stacks: int, ends: bool = True) -> Mesh:
    """Return a cylinder about z, with or without flat ends."""
    lines = np.linspace(0.0, 1.0, slices + 1), np.linspace(-1.0, 1.0, stacks + 1)
    around, up = (grid.ravel() for grid in np.meshgrid(*lines))
    angle = 2.0 * np.pi * around
    normals = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(up)], axis=-1)
    points = normals * radius
    points[:, 2] = up * half
    side = Mesh(points, normals, _grid(slices, stacks), np.stack([around, 0.5 - 0.5 * up], -1))
    if not ends:
        return side
    angles = np.linspace(0.0, 2.0 * np.pi, slices, endpoint=False)
    edge = np.append(np.stack([np.cos(angles), np.sin(angles)], -1), [[0.0, 0.0]], axis=0)
    rim = np.arange(slices)
    disks = []
    for sign in (1.0, -1.0):
        points = np.column_stack([edge * radius, np.full(slices + 1, sign * half)])
        order = (rim, (rim + 1) % slices) if sign > 0 else ((rim + 1) % slices, rim)
        corners = np.stack([np.full(slices, slices), *order], axis=-1)
        normals = np.tile([0.0, 0.0, sign], (slices + 1, 1))
        disks.append(Mesh(points, normals, corners, _unit(edge[:, 0], edge[:, 1])))
    return _joined(side, *disks)


def _capsule(radius: float, half: float, slices: int, stacks: int) -> Mesh:
    """Return a cylinder about z of half length `half` between two half balls."""
    caps = []
    for sign in (1.0, -1.0):
        low, high = (0.0, 0.5) if sign > 0 else (-0.5, 0.0)
        directions, corners, around, up = _directions(slices, max(stacks // 2, 1), low, high)
        points = directions * radius
        points[:, 2] += sign * half
        places = np.stack([around, 1.0 - 2.0 * up if sign > 0 else -2.0 * up], -1)
        caps.append(Mesh(points, directions, corners, places))
    return _joined(_cylinder(radius, half, slices, stacks, ends=False), *caps)


def _directions(
    slices: int, stacks: int, low: float, high: float
) -> tuple[Floats, Corners, Floats, Floats]:
    """Return unit vectors at equal steps of longitude and latitude, and the triangles between.

    With them the longitudes, as shares of a turn, and the latitudes, as shares of half a turn, from
    `low` to `high`.
    """
    lines = np.linspace(0.0, 1.0, slices + 1), np.linspace(low, high, stacks + 1)
    around, up = (grid.ravel() for grid in np.meshgrid(*lines))
    angle, rise = 2.0 * np.pi * around, np.pi * up
    directions = np.stack(
        [np.cos(rise) * np.cos(angle), np.cos(rise) * np.sin(angle), np.sin(rise)], -1
    )
    return directions, _grid(slices, stacks), around, up


def _plane(size: Floats) -> Mesh:
    """Return a level rectangle in cells of the third size; without end where a half length is 0."""
    half, cell = size[:2], size[2]
    far = np.append(0.0, np.geomspace(1.0, FARTHEST, 24))
    endless = np.append(-far[:0:-1], far)
    across, along = (
        np.linspace(-length, length, _cells(2.0 * length / cell) + 1) if length else endless
        for length in half
    )
    flat = np.stack(np.meshgrid(across, along), axis=-1).reshape(-1, 2)
    points = np.column_stack([flat, np.zeros(len(flat))])
    corners = _grid(len(across) - 1, len(along) - 1)
    u, v = (flat / half).T if half.all() else (points[:, :2] - (1.0, -1.0)).T
    return Mesh(points, np.tile([0.0, 0.0, 1.0], (len(points), 1)), corners, _unit(u, -v))


def _cells(count: float) -> int:
    """Return a whole number of cells along a side of a plane."""
    return int(np.clip(np.rint(np.nan_to_num(count)), 1, MOST_CELLS))


def _unit(u: Floats, v: Floats) -> Floats:
    """Return places from 0 to 1 of coordinates from -1 to 1."""
    return 0.5 + 0.5 * np.stack([u, v], axis=-1)


def _height_field(model: Any, number: int) -> Mesh:
    """Return a height field with its skirt down to its base."""
    rows, columns = int(model.hfield_nrow[number]), int(model.hfield_ncol[number])
    start = int(model.hfield_adr[number])
    x, y, top, base = model.hfield_size[number]
    heights = model.hfield_data[start : start + rows * columns].reshape(rows, columns) * top
    across, along = np.meshgrid(np.linspace(-x, x, columns), np.linspace(-y, y, rows))
    points = np.stack([across, along, heights], axis=-1).reshape(-1, 3)
    corners = _grid(columns - 1, rows - 1)
    face = points[corners]
    normal = np.cross(face[:, 1] - face[:, 0], face[:, 2] - face[:, 0])
    normals = np.zeros_like(points)
    for corner in range(3):
        np.add.at(normals, corners[:, corner], normal)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    ring = np.arange(rows * columns).reshape(rows, columns)
    border = np.concatenate([ring[0], ring[1:, -1], ring[-1, -2::-1], ring[-2::-1, 0]])
    skirts = []
    for one, other in itertools.pairwise(border):
        edge = points[[one, other, other, one]].copy()
        edge[2:, 2] = -base
        out = np.cross(edge[3] - edge[0], edge[1] - edge[0])
        out /= max(float(np.linalg.norm(out)), 1e-12)
        skirts.append(Mesh(edge, np.tile(out, (4, 1)), [[0, 3, 2], [0, 2, 1]], _above(edge)))
    below = np.array([[-x, -y, -base], [x, -y, -base], [x, y, -base], [-x, y, -base]])
    down = Mesh(below, np.tile([0.0, 0.0, -1.0], (4, 1)), [[0, 2, 1], [0, 3, 2]], _above(below))
    return _joined(Mesh(points, normals, corners, _above(points)), *skirts, down)


def _above(points: Floats) -> Floats:
    """Return places of points as they are seen from above, for a texture of 2 m about 0, 0."""
    return points[:, :2] * (0.5, -0.5)


SMOOTH = 0.8  # least cosine of a triangle's normal with a vertex's for it to be smooth there


def _own_mesh(model: Any, number: int) -> Mesh:
    """Return a mesh of the model: its vertices, one for each normal and place in a texture."""
    faces = slice(int(model.mesh_faceadr[number]), None)
    count = int(model.mesh_facenum[number])
    textured = int(model.mesh_texcoordadr[number]) >= 0
    corners = model.mesh_face[faces][:count]
    vertices = model.mesh_vert[int(model.mesh_vertadr[number]) :]
    points = vertices[corners].reshape(-1, 3)
    index = model.mesh_facenormal[faces][:count]
    kinds = [corners.ravel(), index.ravel()]
    normals = model.mesh_normal[int(model.mesh_normaladr[number]) :][index].reshape(-1, 3)
    one, other, third = points.reshape(-1, 3, 3).transpose(1, 0, 2).astype(np.float64)
    flat = np.cross(other - one, third - one)
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-30)
    flat = np.repeat(flat, 3, axis=0)
    sharp = np.flatnonzero((flat * normals).sum(axis=1) < SMOOTH)
    normals = normals.astype(np.float32)
    normals[sharp] = flat[sharp]
    places = _above(points).astype(np.float32)
    if textured:
        at = model.mesh_texcoord[int(model.mesh_texcoordadr[number]) :]
        index = model.mesh_facetexcoord[faces][:count]
        kinds.append(index.ravel())
        places = at[index].reshape(-1, 2)
    chosen, vertex = _merged(kinds, sharp)
    colours = vertex_colours(model, number)
    return Mesh(
        points[chosen],
        normals[chosen],
        vertex.reshape(-1, 3),
        places[chosen],
        None if colours is None else colours[kinds[0][chosen]],
    )


def _merged(kinds: list[Corners], apart: Corners) -> tuple[Corners, Corners]:
    """Return the first corner of each kind, and the number of each corner's kind.

    Args:
        kinds: Whole numbers of all corners, shape (m,) each; corners with the same ones are one.
        apart: Corners that are kinds of their own.
    """
    key = kinds[0].astype(np.int64)
    for other in kinds[1:]:
        if not np.array_equal(other, kinds[0]):
            key = np.unique(key * (int(other.max(initial=0)) + 1) + other, return_inverse=True)[1]
    key[apart] = int(key.max(initial=0)) + 1 + np.arange(len(apart))
    first = np.full(int(key.max(initial=-1)) + 1, -1)
    first[key[::-1]] = np.arange(len(key))[::-1]
    chosen = np.flatnonzero(first >= 0)
    number = np.zeros(len(first), np.int64)
    number[chosen] = np.arange(len(chosen))
    return first[chosen], number[key]
