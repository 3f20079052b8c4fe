"""Surfaces seen around pixels: inverse depth, its slope and noise.

Inverse depth of a plane is linear over the image, so that a neighbourhood without an edge is one.
"""

from __future__ import annotations

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from nodes.estimators.images import Depth, Floats

REACH = 6  # radius of continuous surface required around a corner by optical flow, pixels
NEAREST = 0.05  # least depth, metres; smaller values are ignored, as of dirt on the lens
_FARTHEST = 0.02  # 1/m: beyond 50 m depth says nothing about a motion of metres
_HOLE = -200.0  # placeholder for no depth, 1/m: so low, a smoothed neighbour stays below zero
_TORN = 0.02  # largest deviation of a neighbourhood from a plane, relative to inverse depth
_NOISY = 2.0  # the same, in standard deviations of a reading
_GRID = np.array([(x, y) for y in range(-REACH, REACH + 1, 3) for x in range(-REACH, REACH + 1, 3)])
_SPREAD = float((_GRID[:, 0] ** 2).sum())


class Surfaces(msgspec.Struct, frozen=True, eq=False):
    """The planes around some pixels."""

    inverse: Floats  # inverse depth at each, 1/m, shape (n,)
    slope: Floats  # its change by column and by row, 1/m, shape (n, 2)
    continuous: npt.NDArray[np.bool_]  # mask, shape (n,): elsewhere depth is torn or missing

    def take(self, rows: npt.NDArray[np.bool_]) -> Surfaces:
        """Return some of them."""
        return Surfaces(self.inverse[rows], self.slope[rows], self.continuous[rows])


def inverse_depth(depth: Depth) -> Depth:
    """Return inverse depth in 1/m, the mean of 3×3 pixels; below zero by holes, shape (h, w)."""
    with np.errstate(divide="ignore"):
        inverse = np.reciprocal(depth)
    unknown = ~((depth > NEAREST) & (depth < np.inf))
    if unknown.any():
        inverse[unknown] = _HOLE
    return np.asarray(cv2.blur(inverse, (3, 3)))


def surfaces_at(
    inverse: Depth,  # as of `inverse_depth`, shape (h, w)
    pixels: Floats,  # column and row, shape (n, 2)
    noise: float,  # standard deviation of one pixel's inverse depth, 1/m
) -> Surfaces:
    """Fit a plane to inverse depth around each pixel."""
    height, width = inverse.shape
    centre = np.rint(pixels).astype(int)
    columns = np.clip(centre[:, 0, None] + _GRID[:, 0], 0, width - 1)
    rows = np.clip(centre[:, 1, None] + _GRID[:, 1], 0, height - 1)
    around = inverse[rows, columns].astype(np.float64)
    mean = around.mean(axis=1)
    slope = around @ _GRID / _SPREAD
    bend = np.abs(around - mean[:, None] - slope @ _GRID.T).max(axis=1)
    continuous = (around.min(axis=1) > 0) & (bend < np.maximum(_TORN * mean, _NOISY * noise))
    value = mean + ((pixels - centre) * slope).sum(axis=1)
    continuous &= value > _FARTHEST
    return Surfaces(np.where(continuous, value, 0.0), slope, continuous)
