"""Reading depth at corners: where the surface is whole, between the pixels, as inverse depth.

On a plane inverse depth is an affine function of the pixel, and a triangulating sensor's noise is
the same at every distance in it; so that is what is interpolated, checked and weighted.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nodes.visual_odometry.tracker import Depth, Floats

_REACH = 2
_OFFSETS = [(dx, dy) for dy in range(-_REACH, _REACH + 1) for dx in range(-_REACH, _REACH + 1)]
_DESIGN = np.array([(1.0, dx, dy) for dx, dy in _OFFSETS])
_FIT = np.linalg.pinv(_DESIGN)

NEAREST = 0.1
"""Metres; what is closer is dirt on the lens."""
_TORN = 0.012
"""1/m: a neighbourhood that differs so from a plane holds an edge, and its corner no one depth."""
_FARTHEST = 0.02
"""1/m: beyond 50 m depth says nothing of a metre's motion."""


def inverse_depth_at(depth: Depth, pixels: Floats) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """Return inverse depth at points, by a plane through the 5×5 pixels around each.

    Args:
        depth: Metres, shape (h, w).
        pixels: Column and row, shape (n, 2).

    Returns:
        Inverse depth in 1/m, shape (n,), 0 where there is none; and where there is one.
    """
    height, width = depth.shape
    column = np.clip(np.rint(pixels[:, 0]).astype(int), _REACH, width - _REACH - 1)
    row = np.clip(np.rint(pixels[:, 1]).astype(int), _REACH, height - _REACH - 1)
    patch = np.stack([depth[row + dy, column + dx] for dx, dy in _OFFSETS], axis=1)
    inverse = 1.0 / np.maximum(patch, 1e-3).astype(np.float64)  # of inf: 0
    plane = inverse @ _FIT.T
    torn = np.abs(inverse - plane @ _DESIGN.T).max(axis=1) > _TORN
    value = plane[:, 0] + plane[:, 1] * (pixels[:, 0] - column) + plane[:, 2] * (pixels[:, 1] - row)
    whole = np.isfinite(patch).all(axis=1) & (patch.min(axis=1) > NEAREST)
    good = whole & ~torn & (value > _FARTHEST)
    return np.where(good, value, 0.0), good


def back_project(pixels: Floats, inverse: Floats, camera: tuple[float, ...]) -> Floats:
    """Return points in the optical frame, metres, shape (n, 3).

    Args:
        pixels: Column and row, shape (n, 2).
        inverse: Their inverse depth, 1/m, above zero, shape (n,).
        camera: fx, fy, cx, cy.
    """
    fx, fy, cx, cy = camera
    rays = np.stack(
        [(pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy, np.ones(len(pixels))], axis=1
    )
    return np.asarray(rays / inverse[:, None])
