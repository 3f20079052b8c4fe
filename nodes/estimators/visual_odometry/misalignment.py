"""Misalignment of a rectified stereo pair, estimated from its images.

A calibration errs by some tenths of a pixel and hundredths of a degree. What that does to a pair of
rectified images is smooth: an offset of rows, seen at once, and an offset of disparities, seen in
motion. A disparity that is off by the same everywhere, as by the principal points, leaves all rows
right, and makes near and far things contradict each other as the camera moves. Both are polynomials
of degree 2 over the image here, so that no model of the lens is needed. The unit of length stays
that of the announced baseline.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from events import CameraInfo
from nodes.estimators.images import Floats
from nodes.estimators.pose import huber, intrinsics, rays
from nodes.estimators.rig import crosses
from nodes.estimators.surfaces import Surfaces
from nodes.estimators.visual_odometry.landmarks import Landmarks, MapMatch

_TERMS = 6
_DEVIATIONS = np.array([1.0, 0.7, 0.7, 0.4, 0.4, 0.4])  # of the coefficients beforehand, pixels
_HUBER = 2.0
_FEW = 10  # least number of a key frame's landmarks in an image for an update of the disparities
_ALIKE = 0.1  # weight of a landmark: errors of matching are alike in all images
_ROW_NOISE = 0.2  # standard deviation of a row, pixels
_PIXEL_NOISE = 0.5  # standard deviation of a landmark's pixel, errors of its place included
_READING, _BENT = 0.8, 0.003  # noise of a depth reading: of its stated one, of inverse depth
_VAGUE = 1e-3  # information on a key frame's pose beforehand, so that any can be eliminated


class SmoothField:
    """An offset over the image, a polynomial of degree 2 in x/z and y/z, with its certainty."""

    def __init__(self, info: CameraInfo) -> None:
        self._info = info
        self.coefficients = np.zeros(_TERMS)  # pixels
        self.information = np.diag(_DEVIATIONS**-2)  # inverse covariance, shape (6, 6)
        x = (np.arange(info.width) - info.cx) / info.fx
        y = (np.arange(info.height) - info.cy) / info.fy
        self._axes = x.astype(np.float32), y.astype(np.float32)[:, None]
        self._drawn = self.coefficients, np.zeros((info.height, info.width), np.float32)

    def terms(self, pixels: Floats) -> Floats:
        """Return the powers at pixels (n, 2), shape (n, 6)."""
        x = (pixels[:, 0] - self._info.cx) / self._info.fx
        y = (pixels[:, 1] - self._info.cy) / self._info.fy
        return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)

    def at(self, pixels: Floats) -> Floats:
        """Return the offset at pixels (n, 2), shape (n,)."""
        return np.asarray(self.terms(pixels) @ self.coefficients)

    def deviation(self, pixels: Floats) -> Floats:
        """Return the offset's standard deviation at pixels (n, 2), shape (n,)."""
        terms = self.terms(pixels)
        solved = np.linalg.solve(self.information, terms.T)
        return np.asarray(np.sqrt((terms * solved.T).sum(axis=1)))

    def everywhere(self) -> npt.NDArray[np.float32]:
        """Return the offset at all pixels, shape (h, w)."""
        if self._drawn[0] is not self.coefficients:  # which are replaced, and never changed
            x, y = self._axes
            c = self.coefficients.astype(np.float32)
            offsets = (c[0] + x * (c[1] + c[3] * x)) + y * (c[2] + c[4] * x + c[5] * y)
            self._drawn = self.coefficients, offsets
        return self._drawn[1]

    def update(self, information: Floats, gradient: Floats) -> Floats:
        """Update by a measurement; return the change of the coefficients.

        Args:
            information: Jᵀ J of its residuals by the coefficients, weighted, shape (6, 6).
            gradient: Jᵀ r at the present coefficients, shape (6,).
        """
        self.information = self.information + information
        change = -np.linalg.solve(self.information, gradient)
        self.coefficients = self.coefficients + change
        return np.asarray(change)

    def measure(self, pixels: Floats, offsets: Floats) -> None:
        """Update by offsets (n,) measured at pixels (n, 2), some of them wrong."""
        terms, residuals = self.terms(pixels), self.at(pixels) - offsets
        spread = np.hypot(_ROW_NOISE, self.deviation(pixels))
        weights = _ALIKE / _ROW_NOISE**2 * huber(np.abs(residuals) / spread, _HUBER)
        weighted = terms.T * weights
        self.update(weighted @ terms, weighted @ residuals)


def disparity_information(
    field: SmoothField,  # offset of the disparities
    unit: float,  # disparity (pixels) times depth
    landmarks: Landmarks,
    match: MapMatch,
    read: Surfaces,  # of those that agree
    noise: float,  # standard deviation of inverse depth, 1/m
    matrix: Floats,  # K, shape (3, 3)
) -> tuple[Floats, Floats]:
    """Return the disparities' offsets as landmarks show them, for `SmoothField.update`.

    Depth at a landmark's first sight and depth now are off, each by the field at its pixel. The
    motion since each key frame is unknown, so it is eliminated (Schur complement): how poses were
    bent by the same error does not matter.
    """
    rows, pixels = match.rows[match.agree], match.pixels[match.agree]
    table, pose = landmarks.table[rows], match.pose
    x, y, z = points = pose[:3, :3] @ table["place"].T + pose[:3, 3:]
    image = np.stack([x / z, y / z, 1.0 / z], axis=1)
    measured = rays(pixels, matrix)
    measured[:, 2] = read.inverse
    slant = _PIXEL_NOISE * np.linalg.norm(read.slope, axis=1)
    deviation = np.sqrt((_READING * noise) ** 2 + slant**2 + (_BENT * read.inverse) ** 2)
    fx, fy, *_ = intrinsics(matrix)
    scale = np.column_stack(
        [np.full((len(rows), 2), (fx, fy)) / _PIXEL_NOISE, read.continuous / deviation]
    )
    residuals = (image - measured) * scale
    by_point = np.zeros((len(rows), 3, 3))
    by_point[:, 0, 0] = by_point[:, 1, 1] = image[:, 2]
    by_point[:, :, 2] = -image * image[:, 2:]
    moved = -(table["directions"][:, :, 2] @ pose[:3, :3].T) / table["inverse"][:, None] ** 2
    by_field = (by_point @ moved[:, :, None]) * field.terms(table["pixel"])[:, None]
    by_field[:, 2] -= field.terms(pixels)
    by_field *= scale[:, :, None] / unit
    by_pose = np.concatenate([by_point, -by_point @ crosses(points.T)], axis=2) * scale[:, :, None]
    size = np.abs(residuals)
    size[:, :2] = np.hypot(residuals[:, 0], residuals[:, 1])[:, None]
    root = np.sqrt(_ALIKE * huber(size, _HUBER))[:, :, None]
    equations = np.concatenate([by_pose, by_field, residuals[:, :, None]], axis=2) * root
    information, gradient = np.zeros((_TERMS, _TERMS)), np.zeros(_TERMS)
    for number in np.unique(table["keyframe"]).tolist():
        part = equations[table["keyframe"] == number].reshape(-1, 6 + _TERMS + 1)
        if len(part) < 3 * _FEW:
            continue
        normal = part.T @ part
        eliminated = np.linalg.solve(normal[:6, :6] + _VAGUE * np.eye(6), normal[:6, 6:])
        reduced = normal[6:, 6:] - normal[6:, :6] @ eliminated
        information += reduced[:_TERMS, :_TERMS]
        gradient += reduced[:_TERMS, _TERMS]
    return information, gradient
