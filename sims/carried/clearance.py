"""Distance from points to the nearest solid of a world, still or moving."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from events import Vector3
from events.frames import flip_yz
from sims.ray_casting import cast_ray
from sims.vehicle.simulation import mover_of, name_of
from sims.worlds import Dynamics

Floats = npt.NDArray[np.float64]

_TYPES = mujoco.mjtGeom
_PAIRS = 10_000  # of points and boxes, whose distances are computed at once


class Clearance:
    """Solids of a compiled world that stand still; or, with its dynamics, those that they move.

    Distances are exact of planes, boxes, spheres, capsules and cylinders. That of an ellipsoid is
    an estimate, that of a mesh is of its convex hull, which is what vehicles touch, and of the
    nearest of the hull's planes, and that of a height field the height above it, made less by the
    steepest slope: not more than the true ones. Sums are taken in a fixed order, so that every
    processor gives the same bits.
    """

    def __init__(self, model: Any, dynamics: Dynamics | None = None) -> None:
        self._model = model
        self._dynamics = dynamics
        self._data: Any = mujoco.MjData(model)
        mujoco.mj_kinematics(model, self._data)
        solid = (model.geom_contype | model.geom_conaffinity) != 0
        moves = model.body_mocapid[model.body_rootid[model.geom_bodyid]] >= 0
        self._geoms = [
            int(geom)
            for geom in np.flatnonzero(solid & (moves == (dynamics is not None)))
            if int(model.geom_type[geom]) in _DISTANCES | _MODELLED
            and (dynamics is not None or not mover_of(model, int(geom)))
        ]
        self._places = self._data.geom_xpos
        self._axes = self._data.geom_xmat.reshape(-1, 3, 3)
        self._modelled = {
            geom: _MODELLED[kind](model, geom)
            for geom in self._geoms
            if (kind := int(model.geom_type[geom])) in _MODELLED
        }
        is_box = (model.geom_type == _TYPES.mjGEOM_BOX).tolist()
        self._boxes = np.array([geom for geom in self._geoms if is_box[geom]], np.intp)
        self._others = [geom for geom in self._geoms if not is_box[geom]]

    def __bool__(self) -> bool:
        return bool(self._geoms)

    def at(self, seconds: float) -> Clearance:
        """Move what moves to where it is at a time."""
        if self._dynamics is not None:
            self._dynamics.solid.apply(self._model, self._data, seconds)
            mujoco.mj_kinematics(self._model, self._data)
        return self

    def distances(self, points: Floats) -> Floats:
        """Return metres to the nearest solid from points (m NED, shape (n, 3)); inside negative."""
        return self.nearest(points)[0]

    def nearest(self, points: Floats) -> tuple[Floats, npt.NDArray[np.intp]]:
        """Return metres to the nearest solid, and its number; ``inf`` and -1 in an empty world."""
        nwu = points * (1.0, -1.0, -1.0)
        least, geoms = np.full(len(points), np.inf), np.full(len(points), -1, np.intp)
        if len(self._boxes):
            self._to_boxes(nwu, np.arange(len(points)), self._boxes, least, geoms)
        for geom in self._others:
            away = nwu - self._places[geom]
            turn = self._axes[geom]
            local = [
                away[:, 0] * turn[0, k] + away[:, 1] * turn[1, k] + away[:, 2] * turn[2, k]
                for k in range(3)
            ]
            size = self._model.geom_size[geom].tolist()
            if geom in self._modelled:
                distance = self._modelled[geom](local)
            else:
                distance = _DISTANCES[int(self._model.geom_type[geom])](local, size)
            nearer = (distance < least) | ((distance == least) & (geom < geoms))
            least[nearer], geoms[nearer] = distance[nearer], geom
        return least, geoms

    def _to_boxes(
        self,
        nwu: Floats,
        rows: npt.NDArray[np.intp],
        boxes: npt.NDArray[np.intp],
        least: Floats,
        geoms: npt.NDArray[np.intp],
    ) -> None:
        """Write, for rows of points, the distance to the nearest of boxes, and its number.

        Points are halved until boxes are few. About the middle of points, boxes are left out that
        are farther than another by more than the points' width: at none of them are they nearest.
        """
        points = nwu[rows]
        if len(rows) > 1 and len(rows) * len(boxes) > _PAIRS:
            low, high = points.min(axis=0), points.max(axis=0)
            middle, (x, y, z) = (low + high) / 2.0, (high - low).tolist()
            distances = self._from_boxes(middle[None], boxes)[0]
            near = distances.min() + math.sqrt(x * x + y * y + z * z) + 1e-6
            boxes = boxes[distances <= near]
            if len(rows) * len(boxes) > _PAIRS:
                order = points[:, (x, y, z).index(max(x, y, z))].argsort(kind="stable")
                for half in np.array_split(rows[order], 2):
                    self._to_boxes(nwu, half, boxes, least, geoms)
                return
        distances = self._from_boxes(points, boxes)
        nearest = distances.argmin(axis=1)
        least[rows] = distances[np.arange(len(rows)), nearest]
        geoms[rows] = boxes[nearest]

    def _from_boxes(self, points: Floats, boxes: npt.NDArray[np.intp]) -> Floats:
        """Return distances of points, shape (n, 3), from boxes, (m,): shape (n, m)."""
        away = [points[:, k, None] - self._places[boxes, k] for k in range(3)]
        turn = self._axes[boxes]
        local = [
            away[0] * turn[:, 0, k] + away[1] * turn[:, 1, k] + away[2] * turn[:, 2, k]
            for k in range(3)
        ]
        return _to_box(local, list(self._model.geom_size[boxes].T))

    def covered(self, point: Vector3) -> bool:
        """Return whether anything is above a point, m NED: whether it is indoors, as a rule."""
        origin, upwards = np.array(flip_yz(point)), np.array((0.0, 0.0, 1.0))
        distance, _ = cast_ray(self._model, self._data, origin, upwards)
        return distance >= 0.0

    def name_of(self, geom: int) -> str:
        """Return the name of a solid for a reader."""
        ground = self._model.geom_type[geom] == _TYPES.mjGEOM_PLANE
        if ground:
            return "the ground"
        return mover_of(self._model, geom) or name_of(self._model, geom) or f"geom {geom}"

    def bounds(self) -> Floats:
        """Return the corners of the box around all solids but planes, m NED, shape (2, 3)."""
        corners = []
        for geom in self._geoms:
            if self._model.geom_type[geom] == _TYPES.mjGEOM_PLANE:
                continue
            middle, half = self._model.geom_aabb[geom, :3], self._model.geom_aabb[geom, 3:]
            axes = self._axes[geom]
            centre = self._places[geom] + (axes * middle).sum(axis=1)
            reach = (abs(axes) * half).sum(axis=1)
            corners += [centre - reach, centre + reach]
        if not corners:
            return np.array([[-20.0, -20.0, -10.0], [20.0, 20.0, 0.0]])
        low, high = np.min(corners, axis=0), np.max(corners, axis=0)
        return np.array([[low[0], -high[1], -high[2]], [high[0], -low[1], -low[2]]])


def _to_plane(local: list[Floats], size: list[float]) -> Floats:
    inside = np.ones(len(local[0]), np.bool_)
    for axis in (0, 1):
        if size[axis] > 0.0:
            inside &= abs(local[axis]) <= size[axis]
    return np.where(inside, local[2], np.inf)


def _to_sphere(local: list[Floats], size: list[float]) -> Floats:
    return np.asarray(np.sqrt(local[0] ** 2 + local[1] ** 2 + local[2] ** 2) - size[0])


def _to_capsule(local: list[Floats], size: list[float]) -> Floats:
    along = np.maximum(abs(local[2]) - size[1], 0.0)
    return np.asarray(np.sqrt(local[0] ** 2 + local[1] ** 2 + along**2) - size[0])


def _to_box(local: list[Floats], size: Sequence[Any]) -> Floats:
    beyond = [abs(part) - half for part, half in zip(local, size, strict=True)]
    return _outside(beyond)


def _to_cylinder(local: list[Floats], size: list[float]) -> Floats:
    across = np.sqrt(local[0] ** 2 + local[1] ** 2) - size[0]
    return _outside([across, abs(local[2]) - size[1]])


def _outside(beyond: list[Floats]) -> Floats:
    """Return the distance from a convex shape, from how far a point is beyond each face."""
    squares = sum(np.maximum(part, 0.0) ** 2 for part in beyond)
    inside = beyond[0]
    for part in beyond[1:]:
        inside = np.maximum(inside, part)
    return np.asarray(np.sqrt(squares) + np.minimum(inside, 0.0))


def _to_ellipsoid(local: list[Floats], size: list[float]) -> Floats:
    """Return the first-order distance: the scaled one by the length of its gradient."""
    scaled = [part / half for part, half in zip(local, size, strict=True)]
    length = np.sqrt(sum(part**2 for part in scaled))
    slope = np.sqrt(sum((part / half) ** 2 for part, half in zip(scaled, size, strict=True)))
    return np.where(slope > 1e-12, length * (length - 1.0) / np.maximum(slope, 1e-12), -min(size))


_DISTANCES = {
    int(_TYPES.mjGEOM_PLANE): _to_plane,
    int(_TYPES.mjGEOM_SPHERE): _to_sphere,
    int(_TYPES.mjGEOM_CAPSULE): _to_capsule,
    int(_TYPES.mjGEOM_BOX): _to_box,
    int(_TYPES.mjGEOM_CYLINDER): _to_cylinder,
    int(_TYPES.mjGEOM_ELLIPSOID): _to_ellipsoid,
}


def _hull(model: Any, geom: int) -> Callable[[list[Floats]], Floats]:
    """Return the distance from a mesh's convex hull, by the planes around it."""
    from scipy.spatial import ConvexHull

    mesh = int(model.geom_dataid[geom])
    begin, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    vertices = model.mesh_vert[begin : begin + count].astype(np.float64)
    planes = ConvexHull(vertices).equations.tolist()  # unit normals and offsets

    def distance(local: list[Floats]) -> Floats:
        farthest = np.full(len(local[0]), -math.inf)
        for a, b, c, d in planes:
            farthest = np.maximum(farthest, local[0] * a + local[1] * b + local[2] * c + d)
        return farthest

    return distance


def _field(model: Any, geom: int) -> Callable[[list[Floats]], Floats]:
    """Return the distance from a height field, which is solid from its surface down."""
    field = int(model.geom_dataid[geom])
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    begin, half = int(model.hfield_adr[field]), model.hfield_size[field].tolist()
    heights = model.hfield_data[begin : begin + rows * columns].astype(np.float64)
    heights = heights.reshape(rows, columns) * half[2]
    cells = (columns - 1) / (2.0 * half[0]), (rows - 1) / (2.0 * half[1])  # per metre
    slopes = [float(abs(np.diff(heights, axis=1 - k)).max()) * cells[k] for k in (0, 1)]
    steepest = math.sqrt(1.0 + slopes[0] ** 2 + slopes[1] ** 2)

    def distance(local: list[Floats]) -> Floats:
        x, y = ((np.clip(local[k], -half[k], half[k]) + half[k]) * cells[k] for k in (0, 1))
        column = np.minimum(x.astype(np.intp), columns - 2)
        row = np.minimum(y.astype(np.intp), rows - 2)
        x, y = x - column, y - row
        near, far = heights[row, column], heights[row + 1, column + 1]
        right, left = heights[row, column + 1], heights[row + 1, column]
        surface = np.where(
            x > y, near + x * (right - near) + y * (far - right),
            near + y * (left - near) + x * (far - left),
        )  # fmt: skip
        above = local[2] - surface
        beside = np.maximum(abs(local[0]) - half[0], abs(local[1]) - half[1])
        lower = np.where(above > 0.0, above / steepest, above)
        return np.asarray(np.where(beside > 0.0, np.maximum(beside, lower), lower))

    return distance


_MODELLED = {int(_TYPES.mjGEOM_MESH): _hull, int(_TYPES.mjGEOM_HFIELD): _field}
"""Shapes whose data stand in the model: makers of their distances."""
