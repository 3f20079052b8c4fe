"""Visual odometry nodes: RGB-D, feature-based or dense, and stereo.

The dense one is OpenCV 5's `cv2.Odometry` on all pixels: colour and depth, coarse to fine (F.
Steinbrücker, J. Sturm and D. Cremers, "Real-time visual odometry from dense RGB-D images", ICCV
Workshops 2011), with the point-to-plane distances of depth beside the differences of colour. The
library gives no certainty: before a plain wall poses are wrong by percents of the path and not
lost.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any, Literal

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from events import CameraInfo
from nodes.estimators import EstimatorConfig, RgbdFrame, StereoFrame, TrackingResult
from nodes.estimators.images import Depth, Floats, grey_and_depth, refuse_distortion
from nodes.estimators.odometry import OdometryNode
from nodes.estimators.visual_odometry.features import FeatureSettings, FeatureTracker
from nodes.estimators.visual_odometry.stereo import StereoMatcher, StereoSettings, baseline
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
        success, motion = self._odometry.compute(frame, other)
        return np.asarray(pose @ motion) if success and np.isfinite(motion).all() else None

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
            pixel, by OpenCV 5's ``cv2.Odometry``, an example that never knows itself lost.
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

    def check(self) -> Iterable[str]:
        """Return the errors of every estimator, and one if OpenCV lacks the dense method."""
        yield from super().check()
        if self.config.method == "dense" and not hasattr(cv2, "Odometry"):
            yield (
                f'method = "dense" needs OpenCV 5, found {cv2.__version__}: '
                "pip install 'opencv-python-headless>=5'"
            )

    def tracker(self) -> tuple[Any, ...]:
        """Return what makes the tracker of the chosen method."""
        return make_tracker, self.config, self.the_camera().info


def make_tracker(config: VisualOdometryConfig, info: CameraInfo) -> DenseTracker | FeatureTracker:
    """Make the tracker chosen by the settings; for a call in the worker's process."""
    cv2.setNumThreads(1)
    if config.method == "dense":
        return DenseTracker(info, config.dense)
    return FeatureTracker(info, config.features)


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
