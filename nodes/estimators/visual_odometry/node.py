"""Visual odometry nodes: RGB-D, feature-based or dense, and stereo.

The dense one is OpenCV's `cv2.Odometry` on all pixels: colour and depth, coarse to fine (F.
Steinbrücker, J. Sturm and D. Cremers, "Real-time visual odometry from dense RGB-D images", ICCV
Workshops 2011), with the point-to-plane distances of depth beside the differences of colour. The
library gives no certainty: before a plain wall poses are wrong by percents of the path and not
lost.

Stereo: block matching (K. Konolige, "Small vision systems", ISRR 1997; OpenCV's `cv2.StereoBM`) on
halved images finds continuous surfaces, and starts the optical flow of a corner to the right image
(to hundredths of a pixel) and back. Alone it draws slanted surfaces towards whole pixels, with four
times the error. Where it finds nothing, flow starts from afar, and is checked by the corner's
neighbours.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from events import CameraAnnouncement, CameraInfo
from nodes.estimators import EstimatorConfig, RgbdFrame, StereoFrame, TrackingResult
from nodes.estimators.odometry import (
    Depth,
    Floats,
    Grey,
    OdometryNode,
    Surfaces,
    follow_both_ways,
    grey_and_depth,
    grey_image,
    refuse_distortion,
    surfaces_at,
)
from nodes.estimators.visual_odometry.features import FeatureSettings, FeatureTracker
from nodes.estimators.visual_odometry.landmarks import SAME, around, correlation
from runtime import Bundle


class DenseSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the dense method.

    Attributes:
        width: Pixels to which wider images are reduced, about 250 or more.
        max_depth: Metres beyond which depth is not used; over 10 m the library misreads the unit.
        keyframe_interval: Images from one key frame to the next.
        pixel_share: Largest share of compared pixels; time grows with it.
        max_depth_change: Metres by which a point's depth may change between key frame and image.
        reset_timeout: Seconds without a pose after which a new map starts at the last pose.
    """

    width: Annotated[int, msgspec.Meta(ge=32)] = 256
    max_depth: Annotated[float, msgspec.Meta(gt=0, lt=10)] = 9.9
    keyframe_interval: Annotated[int, msgspec.Meta(ge=1)] = 2
    pixel_share: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.3
    max_depth_change: Annotated[float, msgspec.Meta(gt=0)] = 0.3
    reset_timeout: Annotated[float, msgspec.Meta(ge=0)] = 1.0


class DenseTracker:
    """Tracker of an RGB-D camera without distortion, by key frames; reproducible."""

    def __init__(self, info: CameraInfo, settings: DenseSettings | None = None) -> None:
        refuse_distortion(info)
        self._info = info
        self._settings = settings = settings or DenseSettings()
        self._step = max(info.width // settings.width, 1)
        self._odometry = cv2.Odometry(
            cv2.OdometryType_RGB_DEPTH, self._library_settings(), cv2.OdometryAlgoType_COMMON
        )
        self._pose = np.eye(4)  # camera to the first camera
        self._keyframe: Any = None
        self._keyframe_pose = np.eye(4)
        self._before: Any = None
        self._age = 0
        self._lost_since: int | None = None
        self._maps = 0  # begun at a guessed pose

    def track(self, stamp: int, image: npt.NDArray[np.uint8], depth: Depth) -> TrackingResult:
        """Return the pose of the next image; see `Tracker.track`."""
        grey, depth = grey_and_depth(self._info, image, depth)
        step = self._step
        depth = depth[step // 2 :: step, step // 2 :: step]
        usable = np.isfinite(depth) & (depth > 0) & (depth < self._settings.max_depth)
        if usable.mean() < 0.05:
            return self._lose(stamp, "less than a twentieth of the image has depth")
        height, width = depth.shape
        small = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)
        frame = cv2.OdometryFrame(np.where(usable, depth, np.nan).astype(np.float32), small)
        self._odometry.prepareFrame(frame)
        if self._keyframe is None:
            self._make_keyframe(frame)
            return TrackingResult(self._pose)
        pose = self._align(frame, self._keyframe, self._keyframe_pose)
        if pose is None and self._before is not None:
            pose = self._align(frame, self._before, self._pose)
            self._age = self._settings.keyframe_interval  # the key frame cannot be used any more
        if pose is None:
            lost = self._lose(stamp, "the images could not be aligned")
            if stamp - (self._lost_since or stamp) < self._settings.reset_timeout * 1e9:
                return lost
            self._make_keyframe(frame)
            self._lost_since = None
            self._maps += 1
            reason = "by a new map, started at the last pose"
            return TrackingResult(self._pose, reason=reason, map=self._maps)
        reason = "against a key frame" if self._lost_since is not None else ""
        self._lost_since = None
        self._pose = pose
        self._before = frame
        self._age += 1
        if self._age >= self._settings.keyframe_interval:
            self._make_keyframe(frame)
        return TrackingResult(pose, reason=reason, map=self._maps)

    def _make_keyframe(self, frame: Any) -> None:
        self._keyframe, self._keyframe_pose, self._age = frame, self._pose, 0

    def _align(self, frame: Any, other: Any, pose: Floats) -> Floats | None:
        found, motion = self._odometry.compute(frame, other)
        return np.asarray(pose @ motion) if found and np.isfinite(motion).all() else None

    def _lose(self, stamp: int, reason: str) -> TrackingResult:
        if self._lost_since is None:
            self._lost_since = stamp
        self._before = None
        return TrackingResult(self._pose, lost=True, reason=reason)

    def _library_settings(self) -> Any:
        info, step = self._info, self._step
        settings = cv2.OdometrySettings()
        matrix = info.matrix()
        # Pixel centres are whole numbers: of every block of `step` pixels, the centre is kept.
        matrix[:2, 2] = (matrix[:2, 2] - (step - 1) / 2) / step
        matrix[0, 0], matrix[1, 1] = info.fx / step, info.fy / step
        settings.setCameraMatrix(matrix.astype(np.float32))
        settings.setMaxDepth(self._settings.max_depth)
        settings.setMaxDepthDiff(self._settings.max_depth_change)
        settings.setMaxPointsPart(self._settings.pixel_share)
        settings.setMaxTranslation(1.0)
        settings.setMaxRotation(30.0)
        return settings


class VisualOdometryConfig(EstimatorConfig):
    """Settings of visual odometry.

    Attributes:
        method: ``features``: corners, followed by optical flow, and their depth; ``dense``: every
            pixel, by OpenCV's ``cv2.Odometry``, an example that never knows itself lost.
        features: Settings of the method ``features``.
        dense: Settings of the method ``dense``.
    """

    method: Literal["features", "dense"] = "features"
    features: FeatureSettings = FeatureSettings()
    dense: DenseSettings = DenseSettings()


class VisualOdometry(OdometryNode[VisualOdometryConfig]):
    """Estimates the pose of a camera with depth from its images alone."""

    needs = frozenset({"grey", "depth"})
    lenses = frozenset()

    frames = Bundle(RgbdFrame, keep="latest")

    def __init__(self) -> None:
        example = ", an example" if self.config.method == "dense" else ""
        self.method = f"RGB-D odometry ({self.config.method}{example})"

    def tracker(self) -> tuple[Any, ...]:
        """Return what makes the tracker of the chosen method."""
        return make_tracker, self.config, self.the_camera().info


def make_tracker(config: VisualOdometryConfig, info: CameraInfo) -> DenseTracker | FeatureTracker:
    """Make the tracker chosen by the settings; for a call in the worker's process."""
    cv2.setNumThreads(1)
    if config.method == "dense":
        return DenseTracker(info, config.dense)
    return FeatureTracker(info, config.features)


_LARGE = 320  # least side (pixels) of images halved before block matching
_BLOCK = 11
_WINDOW = 15
_REFINED = 1.5  # largest correction of block matching by flow, pixels
_OFF_ROW = 0.6  # largest distance of a corner from its row, pixels
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
    """

    min_depth: Annotated[float, msgspec.Meta(gt=0)] = 0.6
    max_depth: Annotated[float, msgspec.Meta(gt=0)] = 50.0
    noise: Annotated[float, msgspec.Meta(gt=0)] = 0.08

    def __post_init__(self) -> None:
        if self.min_depth >= self.max_depth:
            raise ValueError(
                f"expected min_depth below max_depth, found {self.min_depth} and {self.max_depth}"
            )


class StereoMatcher:
    """Meter of depth in the left camera of a rectified pair without distortion."""

    def __init__(
        self,
        info: CameraInfo,
        baseline: float,  # metres from the left camera to the right one
        settings: StereoSettings | None = None,
    ) -> None:
        self._info = info
        settings = settings or StereoSettings()
        self._unit = info.fx * baseline  # disparity (pixels) times depth
        # Standard deviation of a corner's inverse depth, 1/m.
        self.depth_noise = settings.noise / self._unit
        self._least = self._unit / settings.max_depth
        self._reduction = 2 if min(info.width, info.height) >= _LARGE else 1
        nearest = self._unit / settings.min_depth / self._reduction
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
        self._pair = pair = grey_image(self._info, left), grey_image(self._info, right)
        if self._reduction > 1:
            pair = (
                np.asarray(cv2.pyrDown(pair[0]), np.uint8),
                np.asarray(cv2.pyrDown(pair[1]), np.uint8),
            )
        found: Any = self._blocks.compute(*pair)  # sixteenths of a pixel
        disparity = found.astype(np.float32) * (self._reduction / 16.0)
        if self._reduction > 1:
            size = self._info.width, self._info.height
            disparity = cv2.resize(disparity, size, interpolation=cv2.INTER_NEAREST)
        depth = np.full(disparity.shape, np.inf, np.float32)
        np.divide(self._unit, disparity, out=depth, where=disparity > self._least)
        return depth

    def surfaces_at(
        self,
        inverse: Depth,  # of its coarse depth, as of `inverse_depth`, shape (h, w)
        pixels: Floats,  # column and row, shape (n, 2)
        noise: float,  # standard deviation of inverse depth, 1/m
    ) -> Surfaces:
        """Return the planes around pixels of the pair last given to `depth`."""
        found = surfaces_at(inverse, pixels, _COARSE * noise)
        if self._pair is None or not len(pixels):
            return found
        rows, without = np.flatnonzero(found.continuous), np.flatnonzero(~found.continuous)
        there, slope = found.inverse * self._unit, found.slope.copy()
        fine = np.zeros(len(pixels))
        if len(rows):
            disparity, good = self._disparity(pixels[rows], there[rows], 0)
            good &= np.abs(disparity - there[rows]) < _REFINED
            good &= self._is_distinct(pixels[rows], disparity)
            fine[rows[good]] = disparity[good]
        if len(without):
            # Blocks match on little texture, and at no outline; flow finds any corner, and says by
            # its neighbourhood whether that is a plane.
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
            fine[without[good]] = disparity[good]
            change = np.stack([right - left, below - above], axis=1) / (2 * _ASIDE)
            slope[without] = change / self._unit
        return Surfaces(fine / self._unit, slope, fine > 0)

    def _disparity(
        self, pixels: Floats, guess: Floats, levels: int
    ) -> tuple[Floats, npt.NDArray[np.bool_]]:
        """Return disparities by flow from a guess, and a mask of the good, both (n,)."""
        assert self._pair is not None
        there = pixels - guess[:, None] * (1.0, 0.0)
        found, good = follow_both_ways(*self._pair, pixels, there, _WINDOW, levels)
        disparity = pixels[:, 0] - found[:, 0]
        good &= np.abs(found[:, 1] - pixels[:, 1]) < _OFF_ROW
        return disparity, good & (disparity > self._least)

    def _is_distinct(self, pixels: Floats, disparity: Floats) -> npt.NDArray[np.bool_]:
        """Return a mask of distinct disparities; noise and level edges fit any."""
        assert self._pair is not None
        left, there = around(self._pair[0], pixels, _WINDOW), pixels - disparity[:, None] * (1, 0)
        at, before, after = (
            correlation(left, around(self._pair[1], there + np.array([step, 0.0]), _WINDOW))
            for step in (0.0, -_STEP, _STEP)
        )
        return (at > SAME) & (1.0 - np.maximum(before, after) > _DISTINCT * (1.0 - at))


class StereoOdometryConfig(EstimatorConfig):
    """Settings of stereo odometry.

    Attributes:
        stereo: Settings of the matching of both images.
        features: Settings of the tracker; its ``depth_noise`` is that of the matching.
    """

    stereo: StereoSettings = StereoSettings()
    features: FeatureSettings = FeatureSettings()


class StereoOdometry(OdometryNode[StereoOdometryConfig]):
    """Estimates the pose of the left camera of a rectified stereo rig from its images alone."""

    needs = frozenset({"grey"})
    eyes = 2
    lenses = frozenset()
    method = "stereo odometry (features)"

    frames = Bundle(StereoFrame, keep="latest")

    def tracker(self) -> tuple[Any, ...]:
        """Return what makes the tracker, and its arguments."""
        settings = self.config.stereo, self.config.features
        return StereoTracker, self.the_camera().info, baseline(*self.cameras), *settings


class StereoTracker(FeatureTracker):
    """Tracker of a rectified pair's left camera, a baseline (m) apart."""

    def __init__(
        self, info: CameraInfo, baseline: float, stereo: StereoSettings, features: FeatureSettings
    ) -> None:
        cv2.setNumThreads(1)
        super().__init__(info, features, StereoMatcher(info, baseline, stereo))


def baseline(left: CameraAnnouncement, right: CameraAnnouncement) -> float:
    """Return the distance from the left to the right camera, both aligned, metres."""
    return math.dist(left.position, right.position)
