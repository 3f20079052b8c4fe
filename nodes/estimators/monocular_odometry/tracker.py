"""Monocular odometry on corners, and its node: poses from landmarks, landmarks from poses.

In the manner of sparse, semi-direct methods (C. Forster, M. Pizzoli and D. Scaramuzza, "SVO", ICRA
2014): patches are aligned with the last key frame directly, poses come from their landmarks, new
landmarks from two views far enough apart; the last key frames and landmarks are adjusted together.
The unit of length is the first map's.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from events import CameraInfo
from events.geometry import inverse
from nodes.estimators import EstimatorConfig, MonocularFrame, TrackingResult
from nodes.estimators.images import Floats, Grey, grey_image, inside, refuse_distortion
from nodes.estimators.monocular_odometry.geometry import Indices, Keyframe, MonocularSettings
from nodes.estimators.monocular_odometry.local_map import Initialization, LocalMap
from nodes.estimators.odometry import OdometryNode
from nodes.estimators.optical_flow import follow_both_ways
from nodes.estimators.pose import intrinsics, solve_pose
from nodes.estimators.relocalization import describe, detect_and_describe, relocalize
from runtime import Bundle

_AGREES = 6.0  # inlier threshold of a landmark, standard deviations
_FEW = 120  # number of corners sufficient for an approximate pose
_STORED = 6  # number of newest key frames searched to relocalize a lost camera
_ORB_POINTS = 1000  # number of points describing a lost camera's image


class MonocularTracker:
    """Tracker of a camera without distortion (else a `ValueError`); reproducible to the bit."""

    def __init__(self, info: CameraInfo, settings: MonocularSettings | None = None) -> None:
        refuse_distortion(info)
        self._info = info
        self._settings = settings or MonocularSettings()
        self._matrix = info.matrix()
        self._map: LocalMap | None = None
        self._initialization: Initialization | None = None
        self._pose = np.eye(4)  # the last known one, world to camera
        self._guess = self._pose  # from which the next pose is computed
        self._before: tuple[Grey, Floats, Floats] | None = None  # image, landmarks, their pixels
        self._stored: deque[Keyframe] = deque(maxlen=_STORED)
        self._lost_since: int | None = None
        self._maps = 0  # begun at a guessed pose, with a guessed unit

    def track(self, stamp: int, image: npt.NDArray[np.uint8]) -> TrackingResult | None:
        """Return the pose of the next image; see `Tracker.track`."""
        grey = grey_image(self._info, image)
        if self._map is None:
            return self._initialize(grey)
        expected = self._expect(grey)
        rows, pixels = self._follow(grey, self._map, expected)
        tracks = self._map.tracks
        known = tracks.known[rows]
        solution = self._solve(tracks.points[rows][known], pixels[known], expected)
        if solution is None:
            return self._lost(stamp, grey, pixels)
        reason = "" if self._lost_since is None else "against a key frame"
        self._lost_since = self._initialization = None
        self._pose, errors = solution
        self._guess = self._pose
        agree = np.ones(len(rows), np.bool_)
        agree[known] = errors < _AGREES
        landmarks = known & agree
        self._before = grey, tracks.points[rows][landmarks], pixels[landmarks]
        result = TrackingResult(
            pose=inverse(self._pose),
            reason=reason,
            points=pixels[known].astype(np.float32),
            inliers=agree[known],
            map=self._maps,
        )
        shift = np.linalg.norm(pixels - tracks.pixels[rows], axis=1)
        far = float(np.median(shift[agree])) > self._settings.keyframe_shift
        overlap = self._settings.keyframe_overlap
        fewer = (
            agree.sum() < overlap * len(tracks) or landmarks.sum() < overlap * tracks.known.sum()
        )
        if far or fewer:
            self._map.add_keyframe(grey, self._pose, rows[agree], pixels[agree])
            self._continue_from(self._map)
        return result

    # The first map, and later ones.

    def _initialize(self, grey: Grey) -> TrackingResult | None:
        """Add an image to the initialization; return its pose if there is a map now.

        The first map is the world; others are put where the last one ended, with its median depth.
        """
        if self._initialization is None:
            self._initialization = Initialization(self._matrix, self._settings)
        initial = self._initialization.add(grey)
        if initial is None:
            return None
        unit, reason = 1.0, ""
        if self._map is not None:
            unit, reason = self._map.depth, "by a new map: its unit of length is a guess"
            self._maps += 1
        start = inverse(self._pose)
        self._map = LocalMap.first(initial, grey, start, unit, self._matrix, self._settings)
        self._lost_since = self._initialization = None
        self._stored.clear()
        self._continue_from(self._map)
        count = len(initial.points)
        return TrackingResult(
            pose=inverse(self._pose),
            reason=reason,
            points=initial.pixels[1].astype(np.float32),
            inliers=np.ones(count, np.bool_),
            map=self._maps,
        )

    def _continue_from(self, world: LocalMap) -> None:
        keyframe = world.keyframe()
        self._pose = self._guess = keyframe.pose
        self._before = keyframe.image, keyframe.landmarks, keyframe.pixels
        self._stored.append(keyframe)

    # Every image.

    def _expect(self, grey: Grey) -> Floats:
        """Return the approximate pose, by following a few corners from the previous image."""
        if self._before is None:
            return self._guess
        image, points, pixels = self._before
        few = slice(None, None, max(len(pixels) // _FEW, 1))
        settings = self._settings
        followed, good = follow_both_ways(
            image, grey, pixels[few], pixels[few], settings.window, settings.levels
        )
        if 2 * good.sum() < settings.min_inliers:
            return self._guess
        return self._refine(points[few][good], followed[good], self._guess)[0]

    def _follow(self, grey: Grey, world: LocalMap, expected: Floats) -> tuple[Indices, Floats]:
        """Follow the newest key frame's corners; return found rows and their pixels."""
        points = world.approximate_points()
        window = self._settings.window
        fx, fy, cx, cy = intrinsics(self._matrix)
        in_camera = points @ expected[:3, :3].T + expected[:3, 3]
        z = np.maximum(in_camera[:, 2], 1e-6)
        guess = np.stack([fx * in_camera[:, 0] / z + cx, fy * in_camera[:, 1] / z + cy], axis=1)
        visible = (in_camera[:, 2] > 1e-3 * world.depth) & inside(guess, grey.shape, window // 2)
        rows = np.flatnonzero(visible)
        if not len(rows):
            return rows, np.empty((0, 2))
        start = world.tracks.pixels[rows]
        pixels, good = follow_both_ways(world.image, grey, start, guess[rows], window, 1)
        return rows[good], pixels[good]

    def _solve(
        self, points: Floats, pixels: Floats, expected: Floats
    ) -> tuple[Floats, Floats] | None:
        """Return the pose and errors of `solve_pose`; `None` if too few landmarks agree."""
        least = self._settings.min_inliers
        if len(points) < least:
            return None
        pose, errors = self._refine(points, pixels, expected)
        agree = errors < _AGREES
        if agree.sum() < max(least, 0.4 * len(agree)):
            return None
        pose, errors[agree] = self._refine(points[agree], pixels[agree], pose)
        return pose, errors

    def _refine(self, points: Floats, pixels: Floats, start: Floats) -> tuple[Floats, Floats]:
        return solve_pose(points, pixels, start, self._matrix, self._settings.pixel_noise)

    # Lost.

    def _lost(self, stamp: int, grey: Grey, pixels: Floats) -> TrackingResult:
        """Relocalize by the stored key frames; after a while, try a new map as well."""
        if self._lost_since is None:
            self._lost_since = stamp
        self._before = None
        corners, descriptors = detect_and_describe(grey, _ORB_POINTS)
        for keyframe in reversed(self._stored):
            described = describe(keyframe.image, keyframe.pixels, keyframe.landmarks)
            pose = relocalize(corners, descriptors, described, self._matrix)
            if pose is not None:  # the next image is tracked from this pose
                self._map = LocalMap.around(keyframe, self._matrix, self._settings)
                self._guess = pose
                break
        else:
            waited = stamp - self._lost_since >= self._settings.reset_timeout * 1e9
            if waited and (result := self._initialize(grey)) is not None:
                return result
        return TrackingResult(
            pose=inverse(self._pose),
            lost=True,
            reason=f"too few of the {len(pixels)} corners that were found agree on a pose",
            points=pixels.astype(np.float32),
            inliers=np.zeros(len(pixels), np.bool_),
        )


class MonocularOdometryConfig(EstimatorConfig):
    """Settings of monocular odometry.

    Attributes:
        tracker: Settings of the tracker.
    """

    tracker: MonocularSettings = MonocularSettings()


class MonocularOdometry(OdometryNode[MonocularOdometryConfig]):
    """Estimates the pose of a single camera, in a unit of length of its own."""

    needs = frozenset({"grey"})
    lenses = frozenset()
    method = "monocular odometry"
    scale_free = True

    frames = Bundle(MonocularFrame, keep="latest")

    def tracker(self) -> tuple[Any, ...]:
        """Return what makes the tracker, and its arguments."""
        return make_tracker, self.the_camera().info, self.config.tracker


def make_tracker(info: CameraInfo, settings: MonocularSettings) -> MonocularTracker:
    """Make the tracker; for a call in the worker's process."""
    cv2.setNumThreads(1)
    return MonocularTracker(info, settings)
