"""Stereo matching: depth of a rectified pair's left camera, and of its corners.

Block matching (K. Konolige, "Small vision systems", ISRR 1997; OpenCV's `cv2.StereoBM`) on halved
images finds continuous surfaces, and starts the optical flow of a corner to the right image (to
hundredths of a pixel) and back. Alone it draws slanted surfaces towards whole pixels, with four
times the error. Where it finds nothing, flow starts from afar, and is checked by the corner's
neighbours. What the calibration leaves of rows and disparities is estimated and taken off, and so
is a difference of the eyes' brightness, which flow would take for motion.
"""

from __future__ import annotations

import math
from typing import Annotated, Any

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from events import CameraAnnouncement, CameraInfo
from nodes.estimators.images import Depth, Floats, Grey, grey_image
from nodes.estimators.optical_flow import follow_both_ways
from nodes.estimators.surfaces import Surfaces, surfaces_at
from nodes.estimators.visual_odometry.landmarks import SAME, around, correlation
from nodes.estimators.visual_odometry.misalignment import SmoothField

_LARGE = 320  # least side (pixels) of images halved before block matching
_BLOCK = 11
_WINDOW = 15
_REFINED = 1.5  # largest correction of block matching by flow, pixels
_OFF_ROW = 0.6  # largest distance of a corner from its row, pixels, when that is known
_UNSURE = 3.0  # standard deviations of a row's offset added to it
_SPARSE = 2  # pixels from one pixel whose brightness is compared to the next, both ways
_BLACK, _WHITE, _FEW = 8, 240, 200  # grey levels, least pixels of such a comparison
_COARSE = 2.0  # noise of block matching, relative to flow
_STEP, _DISTINCT = 3.0, 1.5  # pixels beside a disparity, least ratio of differences there
_LEVELS = 3  # halvings of the images for flow, where block matching found nothing
_ASIDE = 4  # distance of such a corner from the neighbours defining its plane, pixels
_BESIDE = np.array([(_ASIDE, 0), (-_ASIDE, 0), (0, _ASIDE), (0, -_ASIDE)])
_TORN, _BENT = 0.02, 0.15  # largest deviation from the neighbours' mean: share, pixels


class StereoSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of stereo matching.

    Attributes:
        min_depth: Metres, below which there is no depth; the less, the wider the unmatched strip at
            the left edge.
        max_depth: Metres, above which there is no depth.
        noise: Standard deviation of a corner's disparity, pixels.
        baseline_noise: Standard deviation of the calibrated baseline, metres: a share of each
            covariance that the images cannot lessen.
    """

    min_depth: Annotated[float, msgspec.Meta(gt=0)] = 0.6
    max_depth: Annotated[float, msgspec.Meta(gt=0)] = 50.0
    noise: Annotated[float, msgspec.Meta(gt=0)] = 0.08
    baseline_noise: Annotated[float, msgspec.Meta(ge=0)] = 2e-4

    def __post_init__(self) -> None:
        if self.min_depth >= self.max_depth:
            raise ValueError(
                f"expected min_depth below max_depth, found {self.min_depth} and {self.max_depth}"
            )


class StereoMatcher:
    """Meter of depth in the left camera of a rectified pair without distortion.

    Attributes:
        rows: Offset of rows, right less left, by which the calibration errs; estimated here.
        disparities: What disparities lack because of it; left to who sees the pair move.
        unit: Disparity (pixels) times depth (metres).
    """

    def __init__(
        self,
        info: CameraInfo,
        baseline: float,  # metres from the left camera to the right one
        settings: StereoSettings | None = None,
    ) -> None:
        self._info = info
        settings = settings or StereoSettings()
        self.unit = info.fx * baseline
        self.rows, self.disparities = SmoothField(info), SmoothField(info)
        # Standard deviation of a corner's inverse depth, 1/m.
        self.depth_noise = settings.noise / self.unit
        self._least = self.unit / settings.max_depth
        self._reduction = 2 if min(info.width, info.height) >= _LARGE else 1
        nearest = self.unit / settings.min_depth / self._reduction
        self._blocks = cv2.StereoBM.create(16 * math.ceil(nearest / 16), _BLOCK)
        self._blocks.setPreFilterType(cv2.STEREO_BM_PREFILTER_XSOBEL)
        self._blocks.setUniquenessRatio(10)
        self._blocks.setDisp12MaxDiff(1)
        self._pair: tuple[Grey, Grey] | None = None

    def depth(self, left: npt.NDArray[np.uint8], right: npt.NDArray[np.uint8]) -> Depth:
        """Return coarse depth (metres, shape (h, w); ``inf`` where unknown), and keep the images.

        Images are grey, shape (h, w), or red, green, blue, shape (h, w, 3).

        Raises:
            ValueError: The size is not that of the camera.
        """
        pair = full_size = grey_image(self._info, left), grey_image(self._info, right)
        if self._reduction > 1:
            pair = (
                np.asarray(cv2.pyrDown(pair[0]), np.uint8),
                np.asarray(cv2.pyrDown(pair[1]), np.uint8),
            )
        matched: Any = self._blocks.compute(*pair)  # sixteenths of a pixel
        self._pair = full_size[0], scaled(full_size[1], brightness_ratio(*pair, matched))
        disparity: Any = matched.astype(np.float32) * (self._reduction / 16.0)
        if self._reduction > 1:
            size = self._info.width, self._info.height
            disparity = cv2.resize(disparity, size, interpolation=cv2.INTER_NEAREST)
        valid = disparity > 0.0
        disparity += self.disparities.everywhere()
        depth = np.full(disparity.shape, np.inf, np.float32)
        np.divide(self.unit, disparity, out=depth, where=valid & (disparity > self._least))
        return depth

    def surfaces_at(
        self,
        inverse: Depth,  # of its coarse depth, as of `inverse_depth`, shape (h, w)
        pixels: Floats,  # column and row, shape (n, 2)
        noise: float,  # standard deviation of inverse depth, 1/m
    ) -> Surfaces:
        """Return the planes around pixels of the pair last given to `depth`."""
        coarse = surfaces_at(inverse, pixels, _COARSE * noise)
        if self._pair is None or not len(pixels):
            return coarse
        rows, without = np.flatnonzero(coarse.continuous), np.flatnonzero(~coarse.continuous)
        guess, slope = coarse.inverse * self.unit, coarse.slope.copy()
        refined = np.zeros(len(pixels))
        if len(rows):
            disparity, good = self._disparity(pixels[rows], guess[rows], 0)
            good &= np.abs(disparity - guess[rows]) < _REFINED
            good &= self._is_distinct(pixels[rows], disparity)
            refined[rows[good]] = disparity[good]
        if len(without):
            # Blocks match on little texture, but not at outlines. Flow finds any corner, and the
            # flow of its neighbourhood shows whether that is a plane.
            centre = pixels[without]
            disparity, good = self._disparity(centre, np.zeros(len(centre)), _LEVELS)
            beside, all_good = self._disparity(
                (centre[:, None] + _BESIDE).reshape(-1, 2), disparity.repeat(len(_BESIDE)), 0
            )
            right, left, below, above = beside.reshape(-1, len(_BESIDE)).T
            bend = np.abs(np.stack([right + left, below + above]) / 2 - disparity).max(axis=0)
            good &= all_good.reshape(-1, len(_BESIDE)).all(axis=1)
            good &= bend < np.maximum(_TORN * disparity, _BENT)
            good &= self._is_distinct(centre, disparity)
            refined[without[good]] = disparity[good]
            change = np.stack([right - left, below - above], axis=1) / (2 * _ASIDE)
            slope[without] = change / self.unit
        return Surfaces(refined / self.unit, slope, refined > 0)

    def _disparity(
        self, pixels: Floats, guess: Floats, levels: int
    ) -> tuple[Floats, npt.NDArray[np.bool_]]:
        """Return disparities by flow from a guess, and a mask of the good, both (n,)."""
        assert self._pair is not None
        start = self._to_right(pixels, guess)
        matches, good = follow_both_ways(*self._pair, pixels, start, _WINDOW, levels)
        disparity = pixels[:, 0] - matches[:, 0] + self.disparities.at(pixels)
        offsets = matches[:, 1] - pixels[:, 1]
        tolerance = _OFF_ROW + _UNSURE * self.rows.deviation(pixels)
        good &= (np.abs(offsets - self.rows.at(pixels)) < tolerance) & (disparity > self._least)
        if not levels:
            self.rows.measure(pixels[good], offsets[good])
            good &= np.abs(offsets - self.rows.at(pixels)) < _OFF_ROW
        return disparity, good

    def _to_right(self, pixels: Floats, disparity: Floats) -> Floats:
        """Return where pixels of the left image are in the right one, shape (n, 2)."""
        across, down = self.disparities.at(pixels) - disparity, self.rows.at(pixels)
        return pixels + np.stack([across, down], axis=1)

    def _is_distinct(self, pixels: Floats, disparity: Floats) -> npt.NDArray[np.bool_]:
        """Return a mask of distinct disparities; noise and level edges fit any."""
        assert self._pair is not None
        left, matches = around(self._pair[0], pixels, _WINDOW), self._to_right(pixels, disparity)
        at, before, after = (
            correlation(left, around(self._pair[1], matches + np.array([step, 0.0]), _WINDOW))
            for step in (0.0, -_STEP, _STEP)
        )
        return (at > SAME) & (1.0 - np.maximum(before, after) > _DISTINCT * (1.0 - at))


def brightness_ratio(left: Grey, right: Grey, disparity: npt.NDArray[np.int16]) -> float:
    """Return how much brighter the left image is than the right one, where blocks match.

    Args:
        disparity: Sixteenths of a pixel, shape (h, w) as the images; not positive where unknown.
    """
    rows, columns = np.nonzero(disparity[::_SPARSE, ::_SPARSE] > 0)
    rows, columns = rows * _SPARSE, columns * _SPARSE
    left_levels = left[rows, columns]
    right_levels = right[rows, np.maximum(columns - ((disparity[rows, columns] + 8) >> 4), 0)]
    usable = (np.minimum(left_levels, right_levels) > _BLACK) & (
        np.maximum(left_levels, right_levels) < _WHITE
    )
    if np.count_nonzero(usable) < _FEW:
        return 1.0
    return int(left_levels[usable].sum(dtype=np.int64)) / int(
        right_levels[usable].sum(dtype=np.int64)
    )


def scaled(image: Grey, factor: float) -> Grey:
    """Return an image whose grey levels are multiplied; within 0.2 % of one it is the same."""
    levels = np.minimum(np.rint(np.arange(256) * factor), 255).astype(np.uint8)
    return np.asarray(cv2.LUT(image, levels), np.uint8)


def baseline(left: CameraAnnouncement, right: CameraAnnouncement) -> float:
    """Return the distance from the left to the right camera, both aligned, metres."""
    return math.dist(left.position, right.position)
