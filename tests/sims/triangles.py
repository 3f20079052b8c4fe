"""Triangles without a model, met by a given build of the compiled library."""

from __future__ import annotations

import ctypes
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


class Met(NamedTuple):
    """What rays meet: distances (n,), -1 for nothing; numbers (n,), or -1; normals (n, 3)."""

    distances: Floats
    geoms: npt.NDArray[np.int32]
    normals: Floats
    triangles: npt.NDArray[np.int32]


def meet(
    library: Any,
    points: npt.NDArray[np.float32],
    corners: npt.NDArray[np.int32],
    origin: Floats,
    directions: Floats,
    positions: Floats | None = None,
    turns: Floats | None = None,
    moves: int = 0,
) -> Met:
    """Cast rays at a mesh that stands at each of some poses, the last `moves` of which move."""
    positions = np.zeros((1, 3)) if positions is None else np.ascontiguousarray(positions)
    count = len(positions)
    turns = np.tile(np.eye(3), (count, 1, 1)) if turns is None else np.ascontiguousarray(turns)
    n, directions = len(directions), np.ascontiguousarray(directions, np.float64)
    met = Met(
        np.full(n, -1.0), np.full(n, -1, np.int32), np.zeros((n, 3)), np.full(n, -1, np.int32)
    )
    trees = ctypes.c_void_p(library.rays_new())
    library.rays_mesh(trees, len(points), _at(points), len(corners), _at(corners))
    numbers, meshes = np.arange(count, dtype=np.int32), np.zeros(count, np.int32)
    moving, wanted = numbers >= count - moves, np.ones(count, np.bool_)
    begin, poses = np.ascontiguousarray(origin, np.float64), (_at(positions), _at(turns))
    library.rays_build(trees, count, _at(numbers), _at(meshes), _at(moving), *poses)
    library.rays_cast(
        trees, *poses, _at(wanted), _at(begin), n, _at(directions), *(_at(part) for part in met)
    )
    library.rays_free(trees)
    return met


def _at(array: npt.NDArray[Any]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)
