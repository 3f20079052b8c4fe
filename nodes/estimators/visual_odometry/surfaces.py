"""Inverse depth at corners, interpolated between pixels where the surface is continuous.

On a plane inverse depth is an affine function of the pixel, and a triangulating sensor's noise is
the same at every distance in it; so inverse depth is smoothed, fitted, checked and weighted.
"""

from __future__ import annotations

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from nodes.estimators.odometry.images import Depth, Floats

REACH = 6
"""Pixels around a corner over which its surface must be continuous: optical flow compares them."""
NEAREST = 0.05
"""Metres; depth below it is ignored, as that of dirt on the lens."""
_FARTHEST = 0.02
"""1/m: beyond 50 m depth says nothing about a motion of metres."""
_HOLE = -200.0
"""1/m: stands for no depth; so low that smoothing leaves a neighbour of a hole below zero."""
_TORN = 0.02
"""Share of its inverse depth by which a neighbourhood may differ from a plane."""
_NOISY = 2.0
"""The same, in standard deviations of a reading."""

_GRID = np.array([(x, y) for y in range(-REACH, REACH + 1, 3) for x in range(-REACH, REACH + 1, 3)])
_SPREAD = float((_GRID[:, 0] ** 2).sum())


class Surfaces(msgspec.Struct, frozen=True, eq=False):
    """The planes around some pixels.

    Attributes:
        inverse: Inverse depth at each, 1/m, shape (n,).
        slope: Its change by a column and by a row, 1/m, shape (n, 2).
        continuous: Where there is one, shape (n,): elsewhere depth is torn or missing.
    """

    inverse: Floats
    slope: Floats
    continuous: npt.NDArray[np.bool_]

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


def surfaces_at(inverse: Depth, pixels: Floats, noise: float) -> Surfaces:
    """Fit a plane to inverse depth around each pixel.

    Args:
        inverse: As `inverse_depth` gives it, shape (h, w).
        pixels: Column and row, shape (n, 2).
        noise: Standard deviation of one pixel's inverse depth, 1/m.
    """
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
