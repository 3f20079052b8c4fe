"""SVO in a worker's process, and its node: images in, estimates out; GPL, and able to crash."""

from __future__ import annotations

import ctypes
import os
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import numpy.typing as npt

from events import CameraInfo
from events.geometry import pose_matrix
from nodes.estimators import EstimatorConfig, MonocularFrame, TrackingResult
from nodes.estimators.odometry import OdometryNode
from runtime import Bundle
from runtime.errors import MissingDependencyError

Count = Annotated[int, msgspec.Meta(ge=1)]
Positive = Annotated[float, msgspec.Meta(gt=0)]


class SvoSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """SVO's own settings (``config.cpp``), besides the calibration; its names are in brackets.

    Attributes:
        features: Landmarks matched in an image, at most (``max_fts``).
        grid_size: Side of the cells of which each gives one landmark, pixels (``grid_size``).
        levels: Levels of the image pyramid (``n_pyr_levels``).
        corner_score: Least score of a landmark's corner (``triang_min_corner_score``).
        init_disparity: Median motion of the corners since the first image at which the map is made,
            pixels (``init_min_disparity``).
        keyframe_distance: Distance from key frames in view for another, as a share of the scene's
            mean depth (``kfselect_mindist``).
        keyframes: Nearest key frames kept; 0 for all (``max_n_kfs``).
        reprojection_threshold: Largest error of an agreeing landmark, pixels (``reproj_thresh``,
            ``poseoptim_thresh``).
        min_features: Matched landmarks below which the camera is lost (``quality_min_fts``).
        max_feature_drop: Drop of landmarks from the last image above which it is lost
            (``quality_max_drop_fts``).
        reset_timeout: Seconds of mere relocalization of a lost camera; then a new map, of a guessed
            unit of length, is made.
    """

    features: Count = 120
    grid_size: Annotated[int, msgspec.Meta(ge=5, le=200)] = 25
    levels: Annotated[int, msgspec.Meta(ge=1, le=6)] = 3
    corner_score: Positive = 20.0
    init_disparity: Positive = 50.0
    keyframe_distance: Positive = 0.12
    keyframes: Annotated[int, msgspec.Meta(ge=0)] = 0
    reprojection_threshold: Positive = 2.0
    min_features: Count = 50
    max_feature_drop: Count = 40
    reset_timeout: Annotated[float, msgspec.Meta(ge=0)] = 1.0

    def native(self) -> dict[str, float]:
        """Return the settings by SVO's own names."""
        return {
            "max_fts": self.features,
            "grid_size": self.grid_size,
            "n_pyr_levels": self.levels,
            "triang_min_corner_score": self.corner_score,
            "init_min_disparity": self.init_disparity,
            "kfselect_mindist": self.keyframe_distance,
            "max_n_kfs": self.keyframes,
            "reproj_thresh": self.reprojection_threshold,
            "poseoptim_thresh": self.reprojection_threshold,
            "quality_min_fts": self.min_features,
            "quality_max_drop_fts": self.max_feature_drop,
        }


Floats = npt.NDArray[np.float64]

INSTALL = "make svo, or: pip install --no-deps 'svo-cpp>=1.5'"  # without ``opencv-python``


class SvoProcess:
    """SVO, whose thread for depths works between two images.

    Its map starts with identity at the first key frame, and a mean depth of 1; a map after a loss
    starts at the last known pose, in the same unit.

    Raises:
        MissingDependencyError: `svo_cpp` cannot be imported.
    """

    def __init__(self, info: CameraInfo, settings: SvoSettings) -> None:
        try:
            import svo_cpp
        except ImportError as error:
            raise MissingDependencyError(f"SVO needs svo_cpp ({error}): {INSTALL}") from error
        self._stages = svo_cpp.Stage
        svo_cpp.set_svo_config(settings.native())
        self._shape = (info.height, info.width)
        self._settings = settings
        # SVO points to the camera, which has to live as long.
        self._camera = svo_cpp.PinholeCamera(
            info.width, info.height, info.fx, info.fy, info.cx, info.cy
        )
        before = _threads()
        self._svo: Any = svo_cpp.SVO(self._camera)
        self._depth_threads = _threads() - before
        self._svo.start()
        self._world = np.eye(4)  # SVO's present world in that of its first map
        self._last = np.eye(4)
        self._known_at = -1
        self._reason = ""
        self._maps = 0  # put where the camera was last known to be

    def track(self, stamp: int, image: npt.NDArray[np.uint8]) -> TrackingResult | None:
        """Return the pose of the next image; see `Tracker.track`.

        Raises:
            RuntimeError: A pose was not understood: another release of `svo_cpp` is needed.
        """
        if image.shape[:2] != self._shape:
            raise ValueError(f"image: expected {self._shape} pixels, found {image.shape[:2]}")
        if self._svo.stage() == self._stages.PAUSED:  # it stops when it cannot make a map
            self._svo.start()
        self._svo.addImage(_grey(image), stamp * 1e-9)
        _wait_for(self._depth_threads)
        if self._svo.stage() == self._stages.DEFAULT_FRAME:
            pose = self._world @ np.linalg.inv(_matrix(self._svo.lastFrame().T_f_w))
            if np.isfinite(pose).all():
                self._last, self._known_at = pose, stamp
                reason, self._reason = self._reason, ""
                return TrackingResult(pose=pose, reason=reason, map=self._maps)
        if self._known_at < 0:
            return None
        relocalizing = self._svo.stage() == self._stages.RELOCALIZING
        if relocalizing and stamp - self._known_at > self._settings.reset_timeout * 1e9:
            self._svo.reset()
            self._svo.start()
            self._world = self._last
            self._maps += 1
            self._reason = "a new map, put where the camera was last known to be"
        reason = "too few landmarks; looking for the nearest key frame"
        return TrackingResult(
            pose=self._last,
            lost=True,
            reason=reason if relocalizing else "a new map has not been made yet",
        )


def _grey(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    if image.ndim == 3:
        image = np.rint(image @ np.array([0.299, 0.587, 0.114])).astype(np.uint8)
    return np.ascontiguousarray(image)


def _matrix(transform: Any) -> Floats:
    """Return a ``Sophus::SE3d`` as a matrix, shape (4, 4); NaN if not finite.

    The module's own method returns a type unknown to Python, so the rotation is read from memory:
    in a pybind11 object the value's pointer follows the object's head, and the value is a
    quaternion (x, y, z, w) and a translation. Raises `RuntimeError` if it contradicts the module's
    methods.
    """
    translation = np.ravel(transform.translation())
    centre = np.ravel(transform.inverse().translation())
    if not np.isfinite([translation, centre]).all():
        return np.full((4, 4), np.nan)
    address = ctypes.c_void_p.from_address(id(transform) + object.__basicsize__).value
    assert address is not None
    *quaternion, tx, ty, tz = (ctypes.c_double * 7).from_address(address)
    x, y, z, w = quaternion
    matrix = pose_matrix((tx, ty, tz), (w, x, y, z))
    actual = [np.linalg.norm(quaternion), tx, ty, tz, *(matrix[:3, :3] @ centre + matrix[:3, 3])]
    if not np.allclose(
        actual, [1.0, *translation, 0.0, 0.0, 0.0], atol=1e-6 * (1 + abs(centre).max())
    ):
        raise RuntimeError(
            "expected svo_cpp's poses as in release 1.5 (a quaternion and a translation), found "
            f"a quaternion of length {actual[0]:g} and {tx:g}, {ty:g}, {tz:g}: {INSTALL}"
        )
    return matrix


def _threads() -> set[str]:
    return set(os.listdir("/proc/self/task"))  # noqa: PTH208  # names are all that is wanted


def _wait_for(threads: Iterable[str]) -> None:
    """Return when threads of this process sleep, with all their frames done, on any machine."""
    files = [Path(f"/proc/self/task/{thread}/stat") for thread in threads]
    asleep = 0
    while asleep < 2:
        states = [file.read_text().rpartition(")")[2].split()[0] for file in files]
        asleep = asleep + 1 if all(state == "S" for state in states) else 0
        if not asleep:
            time.sleep(0.0002)


class SvoConfig(EstimatorConfig):
    """Settings of SVO.

    Attributes:
        svo: SVO's own settings.
    """

    svo: SvoSettings = SvoSettings()


class Svo(OdometryNode[SvoConfig]):
    """Estimator of a single camera's pose by SVO, in a process and a unit of length of its own.

    C. Forster, M. Pizzoli and D. Scaramuzza, "SVO: Fast Semi-Direct Monocular Visual Odometry",
    ICRA 2014.
    """

    needs = frozenset({"grey"})
    lenses = frozenset()
    method = "SVO"
    library = "svo_cpp", INSTALL
    scale_free = True

    frames = Bundle(MonocularFrame, keep="latest")

    def tracker(self) -> tuple[Any, ...]:
        """Return what makes the tracker, and its arguments."""
        return SvoProcess, self.the_camera().info, self.config.svo
