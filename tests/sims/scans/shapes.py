"""Meshes of known geometry, metres, z up: points, shape (n, 3), and corners, shape (m, 3)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Mesh = tuple[Floats, npt.NDArray[np.int32]]
Place = tuple[float, float, float]

_FACES = {
    "west": (0, 4, 6, 2), "east": (1, 3, 7, 5), "south": (0, 1, 5, 4), "north": (2, 6, 7, 3),
    "bottom": (0, 2, 3, 1), "top": (4, 5, 7, 6),
}  # fmt: skip


def block(low: Place, high: Place, without: str = "", inward: bool = False) -> Mesh:
    """Return the faces of a box, two triangles each, but those that are named."""
    points = np.array([[(low, high)[n >> k & 1][k] for k in range(3)] for n in range(8)])
    quads = np.array([quad for name, quad in _FACES.items() if name not in without.split()])
    corners = np.vstack([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return points, (corners[:, ::-1] if inward else corners).astype(np.int32)


def room(width: float, depth: float, height: float, *inside: Mesh) -> Mesh:
    """Return a closed room, seen from inside, and what stands in it."""
    return together(block((0.0, 0.0, 0.0), (width, depth, height), inward=True), *inside)


def together(*meshes: Mesh) -> Mesh:
    """Return one mesh of several."""
    starts = np.cumsum([0, *(len(points) for points, _ in meshes)])
    corners = [corners + start for (_, corners), start in zip(meshes, starts, strict=False)]
    return np.vstack([points for points, _ in meshes]), np.vstack(corners).astype(np.int32)


def ground(side: float, count: int, height: Callable[[Any, Any], Any]) -> Mesh:
    """Return terrain of count × count squares, whose height is a function of x and y."""
    x, y = np.meshgrid(*[np.linspace(0.0, side, count + 1)] * 2, indexing="ij")
    points = np.stack([x, y, height(x, y) + 0.0 * x], axis=-1).reshape(-1, 3)
    numbers = np.arange(len(points)).reshape(count + 1, count + 1)
    a, b, c, d = (part.ravel() for part in (
        numbers[:-1, :-1], numbers[1:, :-1], numbers[1:, 1:], numbers[:-1, 1:],
    ))  # fmt: skip
    return points, np.vstack([np.c_[a, b, c], np.c_[a, c, d]]).astype(np.int32)
