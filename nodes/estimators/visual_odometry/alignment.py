"""Alignment of an image with a reference image by brightness at edges and by depth.

Where corners are few, any pixel with a gradient is compared (J. Engel, V. Koltun and D. Cremers,
"Direct Sparse Odometry", IEEE T-PAMI 2018, with gain and offset of the brightness), and distances
of surfaces (point-to-plane: Y. Chen and G. Medioni, "Object modeling by registration of multiple
range images", ICRA 1991). Distances are inverse depths: planes are affine in them, and a
triangulating sensor's noise is uniform.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from events.geometry import inverse
from nodes.estimators.images import Depth, Floats, Grey, inside
from nodes.estimators.pose import huber, intrinsics, motion_between, moved, rays
from nodes.estimators.surfaces import surfaces_at

_LEVELS = 4
_CELL = 4  # side of the squares of the half-sized image with at most a single edge pixel each
_EDGE = 2.0  # least gradient of an edge in the half-sized image, grey levels per pixel
_EDGES = 1000
_SPACING = 16  # distance of the surface points, pixels
_OUTLINE = 0.05  # relative difference of inverse depth around an outline
_BRIGHTNESS_NOISE = 3.0  # least standard deviation of a difference of brightness, grey levels
_HUBER = 1.5
_STEPS = 6  # steps with each size of image, at most
_RIM = 4  # pixels at the edge of the image without points
_CORRELATED = 9.0  # number of correlated residuals counted as a single residual
_AGREES = 3.0  # inlier threshold of a point, standard deviations
_OFF = 0.5  # additional tolerance of an edge, pixels
_FEW = 30  # least number of edges for a meaningful agreement
_OTHER, _OTHER_SHARE = 6.0, 0.1  # least difference of another surface: sigmas, share
_HIDDEN = 1.15  # least inverse depth of a surface hiding an edge, relative to the edge's
_ORDINARY = np.diag([1e2, 1e-2])  # prior information on gain and offset, about equal exposures
_SMALL = 2e-4  # convergence threshold of a step in full images: metres, radians


class View(msgspec.Struct, frozen=True, eq=False):
    """An image made ready to be aligned."""

    greys: tuple[Depth, ...]  # grey float32 images, each half as large as the one before
    inverse_depths: Depth  # as of `inverse_depth`, shape (h, w)
    smooth: Depth  # the same, a mean of more pixels

    @classmethod
    def of(cls, grey: Grey, inverse_depths: Depth) -> View:
        """Return the view of an image and its inverse depth."""
        greys = [np.asarray(cv2.GaussianBlur(grey.astype(np.float32), (3, 3), 0.0), np.float32)]
        while len(greys) < _LEVELS and min(greys[-1].shape) >= 64:
            greys.append(np.asarray(cv2.pyrDown(greys[-1]), np.float32))
        return cls(tuple(greys), inverse_depths, np.asarray(cv2.blur(inverse_depths, (5, 5))))


class Reference(msgspec.Struct, frozen=True, eq=False):
    """Points of an image as the reference of alignments."""

    pose: Floats  # world to camera, shape (4, 4)
    edges: Floats  # points at edges of brightness, in the camera, metres, shape (3, n)
    brightness: Floats  # theirs, by size of image, shape (levels, n)
    surfaces: Floats  # points of surfaces, in the camera, metres, shape (3, m)
    planes: Floats  # their planes: vectors p with p · x = 1 for all points x, shape (3, m)

    @classmethod
    def of(cls, view: View, pose: Floats, matrix: Floats, noise: float) -> Reference:
        """Return the points of a view.

        Args:
            pose: World to camera, shape (4, 4).
            matrix: K, shape (3, 3).
            noise: Standard deviation of inverse depth, 1/m.
        """
        pixels, nearest = _edges(view)
        edges = (rays(pixels, matrix) / nearest[:, None]).T
        brightness = np.stack([_sample(grey, pixels, n) for n, grey in enumerate(view.greys)])
        height, width = view.inverse_depths.shape
        columns, rows = np.meshgrid(
            np.arange(_SPACING // 2, width, _SPACING), np.arange(_SPACING // 2, height, _SPACING)
        )
        grid = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64)
        surfaces = surfaces_at(view.inverse_depths, grid, noise)
        ray = rays(grid[surfaces.continuous], matrix)
        depth = surfaces.inverse[surfaces.continuous]
        fx, fy, *_ = intrinsics(matrix)
        across = surfaces.slope[surfaces.continuous] * (fx, fy)
        constant = depth - (across * ray[:, :2]).sum(axis=1)
        planes = np.column_stack([across, constant]).T
        return cls(pose, edges, brightness, (ray / depth[:, None]).T, planes)


class Alignment(NamedTuple):
    """Result of an alignment."""

    pose: Floats  # world to camera, shape (4, 4)
    reference: Floats  # the same of the reference
    # Inverse covariance of a small motion of the camera's frame (translation, rotation) by the
    # image alone, shape (6, 6).
    information: Floats
    share: float  # share of the reference's points in the image that agree
    sharp: float  # share of visible edges with agreeing brightness; 1 if too few
    pixels: Floats  # of the reference's points in the image, shape (n, 2)
    agree: npt.NDArray[np.bool_]  # mask of those that agree, shape (n,)

    def deviation(self) -> float:
        """Return the largest standard deviation of the position in any direction, metres."""
        if np.linalg.eigvalsh(self.information)[0] < 1e-9:
            return math.inf
        return math.sqrt(np.linalg.eigvalsh(np.linalg.inv(self.information)[:3, :3])[-1])


class _Residuals(NamedTuple):
    """Residuals of n points, their weights, and derivatives by pose, gain and offset, (8, n)."""

    values: Floats
    weights: Floats
    by: Floats
    pixels: Floats
    agree: npt.NDArray[np.bool_]
    visible: int


def align(
    reference: Reference,
    view: View,
    start: Floats,  # expected pose, world to camera, shape (4, 4)
    matrix: Floats,  # K, shape (3, 3)
    noise: float,  # standard deviation of inverse depth at a point, 1/m
    prior: tuple[float, float],  # standard deviations of the expected pose: metres, radians
) -> Alignment:
    """Return the alignment of an image with a reference."""
    expected = start @ inverse(reference.pose)
    pose, brightness = expected.copy(), np.array([1.0, 0.0])
    sure = np.diag(np.repeat(1.0 / np.square(prior), 3))
    for level in reversed(range(len(view.greys))):
        for _ in range(_STEPS):
            edges = _brightness(reference, view, level, pose, brightness, matrix)
            surfaces = _distances(reference, view, pose, matrix, noise)
            normal, gradient = np.zeros((8, 8)), np.zeros(8)
            for values, weights, by, *_ in (edges, surfaces):
                weighted = by * (weights / _CORRELATED)
                normal += weighted @ by.T
                gradient += weighted @ values
            normal[6:, 6:] += _ORDINARY
            gradient[6:] += _ORDINARY @ (brightness - (1.0, 0.0))
            information = normal[:6, :6].copy()
            normal[:6, :6] += sure
            gradient[:6] += sure @ motion_between(expected, pose)
            step: Floats = np.asarray(np.linalg.solve(normal, -gradient), np.float64)
            pose, brightness = moved(pose, step[:6]), brightness + step[6:]
            if np.abs(step[:6]).max() < _SMALL * 2**level:
                break
    information -= normal[:6, 6:] @ np.linalg.solve(normal[6:, 6:], normal[6:, :6])
    pose[:3, :3] = cv2.Rodrigues(cv2.Rodrigues(pose[:3, :3])[0])[0]  # a rotation, to the last bit
    agree = np.concatenate([edges.agree, surfaces.agree])
    return Alignment(
        pose=pose @ reference.pose,
        reference=reference.pose,
        information=information,
        share=agree.sum() / max(reference.edges.shape[1] + reference.surfaces.shape[1], 1),
        sharp=edges.agree.sum() / edges.visible if edges.visible >= _FEW else 1.0,
        pixels=np.concatenate([edges.pixels, surfaces.pixels]),
        agree=agree,
    )


def _edges(view: View) -> tuple[Floats, Floats]:
    """Return pixels with a gradient, shape (n, 2), and their inverse depth, shape (n,)."""
    grey = view.greys[1] if len(view.greys) > 1 else view.greys[0]
    scale = view.greys[0].shape[1] / grey.shape[1]
    strength = cv2.magnitude(
        cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=0.125),
        cv2.Sobel(grey, cv2.CV_32F, 0, 1, scale=0.125),
    )
    strength[:_RIM], strength[-_RIM:], strength[:, :_RIM], strength[:, -_RIM:] = 0, 0, 0, 0
    height, width = (side // _CELL for side in strength.shape)
    whole = strength[: height * _CELL, : width * _CELL].reshape(height, _CELL, width, _CELL)
    cells = whole.swapaxes(1, 2).reshape(-1, _CELL * _CELL)
    best = cells.argmax(axis=1)
    chosen = np.flatnonzero(cells[np.arange(len(cells)), best] > _EDGE)
    row, column = (
        chosen // width * _CELL + best[chosen] // _CELL,
        chosen % width * _CELL + best[chosen] % _CELL,
    )
    pixels = np.stack([column, row], axis=1) * scale
    # An outline belongs to what is nearer; its own depth may be of either side, or missing.
    around = np.ones((9, 9), np.uint8)
    at = tuple(pixels.astype(int).T[::-1])
    nearest = cv2.dilate(view.inverse_depths, around)[at].astype(np.float64)
    farthest = cv2.erode(view.inverse_depths, around)[at]
    own_depth = view.inverse_depths[at]
    depth = np.where(farthest < (1.0 - 2 * _OUTLINE) * nearest, nearest, own_depth)
    valid = np.flatnonzero(depth > 0.02)
    valid = valid[:: max(-(-len(valid) // _EDGES), 1)]
    return pixels[valid], depth[valid]


def _sample(
    image: Depth, pixels: Floats, level: int, interpolation: int = cv2.INTER_LINEAR
) -> Floats:
    """Return an image's values at pixels of the largest size, shape (n,)."""
    if not len(pixels):
        return np.empty(0)
    # OpenCV keeps every second pixel, so a pixel's coordinates are halved.
    x, y = (pixels.T / 2**level).astype(np.float32)
    samples = cv2.remap(image, x[None], y[None], interpolation, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(samples, np.float64).ravel()


def _project(points: Floats, pose: Floats, matrix: Floats) -> tuple[Floats, Floats]:
    """Return points as x/z, y/z, 1/z in a camera, shape (3, n), and their pixels, shape (n, 2)."""
    fx, fy, cx, cy = intrinsics(matrix)
    in_camera = pose[:3, :3] @ points + pose[:3, 3:]
    z = np.maximum(in_camera[2], 0.05)
    image = np.stack([in_camera[0] / z, in_camera[1] / z, 1.0 / z])
    image[:2, in_camera[2] < 0.05] = np.inf
    return image, np.stack([fx * image[0] + cx, fy * image[1] + cy], axis=1)


def _motions(image: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the derivatives of x/z, y/z and 1/z by translation and rotation, (6, n) each."""
    x, y, w = image
    o = np.zeros_like(x)
    return (
        np.stack([w, o, -x * w, -x * y, 1.0 + x * x, -y]),
        np.stack([o, w, -y * w, -1.0 - y * y, x * y, x]),
        np.stack([o, o, -w * w, -y * w, x * w, o]),
    )


def _brightness(
    reference: Reference, view: View, level: int, pose: Floats, brightness: Floats, matrix: Floats
) -> _Residuals:
    image, pixels = _project(reference.edges, pose, matrix)
    good = np.flatnonzero(inside(pixels, view.inverse_depths.shape, 2 * 2**level))
    image, pixels = image[:, good], pixels[good]
    visible = _sample(view.inverse_depths, pixels, 0, cv2.INTER_NEAREST) < _HIDDEN * image[2]
    step = 0.5 * 2**level
    around = np.array([(0, 0), (step, 0), (-step, 0), (0, step), (0, -step)])
    beside = _sample(view.greys[level], (pixels + around[:, None]).reshape(-1, 2), level)
    value, right, left, below, above = beside.reshape(5, -1)
    across, down = (right - left) / (2 * step), (below - above) / (2 * step)
    fx, fy, *_ = intrinsics(matrix)
    dx, dy, _ = _motions(image)
    expected = reference.brightness[level][good]
    residual = value - brightness[0] * expected - brightness[1]
    by = np.concatenate([across * fx * dx + down * fy * dy, [-expected, -np.ones(len(expected))]])
    spread = 1.4826 * float(np.median(np.abs(residual))) if len(good) else 0.0
    deviation = max(spread, _BRIGHTNESS_NOISE)
    weights = huber(np.abs(residual / deviation), _HUBER) * visible / deviation**2
    limit = _AGREES * _BRIGHTNESS_NOISE + _OFF * np.hypot(across, down)
    agree = visible & (np.abs(residual) < limit)
    return _Residuals(residual, weights, by, pixels, agree, int(visible.sum()))


def _distances(
    reference: Reference, view: View, pose: Floats, matrix: Floats, noise: float
) -> _Residuals:
    """Return the residuals of inverse depth to the reference's planes."""
    image, pixels = _project(reference.surfaces, pose, matrix)
    good = np.flatnonzero(inside(pixels, view.inverse_depths.shape, _RIM))
    image, pixels = image[:, good], pixels[good]
    measured = _sample(view.smooth, pixels, 0)
    planes = pose[:3, :3] @ reference.planes[:, good]
    planes = planes / (1.0 + pose[:3, 3] @ planes)
    residual = measured - image[2]
    dx, dy, dw = _motions(image)
    by = np.concatenate([planes[0] * dx + planes[1] * dy - dw, np.zeros((2, len(good)))])
    errors = np.abs(residual) / noise
    close = (measured > 0) & (errors < np.maximum(_OTHER, _OTHER_SHARE * image[2] / noise))
    weights = huber(errors, _HUBER) * close / noise**2
    return _Residuals(residual, weights, by, pixels, close & (errors < _AGREES), len(good))


_FADES = 0.5  # decay time (to 1/e) of the expected velocity without a measurement, seconds


class Motion:
    """A velocity in the camera's own frame: constant, and fading where nothing is measured."""

    def __init__(self) -> None:
        self._velocity = np.zeros(6)  # metres and radians per second
        self._last: tuple[int, Floats] | None = None
        self._steady: tuple[int, Floats, Floats] | None = None

    def expected(self, stamp: int) -> Floats:
        """Return the pose at a time (ns), world to camera, shape (4, 4)."""
        if self._last is None:
            return np.eye(4)
        before, pose = self._last
        return moved(pose, self._velocity * (stamp - before) * 1e-9)

    def measured(self, stamp: int, pose: Floats) -> None:
        """Record a measured pose, world to camera, shape (4, 4)."""
        if self._last is not None and stamp > self._last[0]:
            before, last = self._last
            self._velocity = motion_between(last, pose) / ((stamp - before) * 1e-9)
        self._last = stamp, pose
        self._steady = stamp, pose, self._velocity

    def steady(self, stamp: int) -> Floats:
        """Return the pose at a time if the last measured velocity has not changed since."""
        if self._steady is None:
            return self.expected(stamp)
        before, pose, velocity = self._steady
        return moved(pose, velocity * (stamp - before) * 1e-9)

    def carried(self, stamp: int) -> Floats:
        """Return the pose expected without a measurement, and let the motion fade."""
        pose, before = self.expected(stamp), stamp if self._last is None else self._last[0]
        self._velocity = self._velocity * math.exp((before - stamp) * 1e-9 / _FADES)
        self._last = stamp, pose
        return pose

    def placed(self, stamp: int, pose: Floats) -> None:
        """Record a relocalized pose; the velocity stays as before."""
        self._last = stamp, pose
