"""RGB-D odometry on corners: followed from key frames by optical flow, placed by their depth.

A few corners, followed from the picture before, tell about where the camera is; then each picture
is aligned with the last key frame, so that error grows with key frames and not with pictures.
Landmarks live on from key frame to key frame, their places the mean of all depths read. See
`pose`, `depth` and `keyframes` for the parts.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Annotated, Any

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from events import CameraInfo
from nodes.visual_odometry.depth import back_project, inverse_depth_at
from nodes.visual_odometry.keyframes import Keyframe, find_again, fuse, make_keyframe, to_world
from nodes.visual_odometry.pose import Observations, Solution, solve_pose
from nodes.visual_odometry.tracker import (
    Depth,
    Floats,
    Grey,
    Tracked,
    grey_and_depth,
    inverse,
    refuse_distortion,
)

SECOND = 1_000_000_000
_FLOW_ENDS = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)
_ROUND_TRIP = 0.5
"""Pixels by which a corner followed there and back may miss itself."""
_AGREES = 6.0
"""Standard deviations up to which a landmark agrees with a pose."""
_FEW = 120
"""Corners that suffice to tell about where the camera is."""
_REMEMBERED = 6
"""Key frames in which a lost camera looks for itself."""


class FeatureSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the method on features.

    Attributes:
        corners: Landmarks of a key frame.
        window: Pixels along the side of the neighbourhood that optical flow compares; odd.
        levels: Times that flow halves the picture for large motions between two pictures.
        pixel_noise: Standard deviation of a followed corner, pixels.
        depth_noise: Standard deviation of inverse depth, 1/m: k of a sensor with sigma = k z².
        keep: Share of a key frame's landmarks below which the next is made.
        turn: Degrees of rotation at which it is made, too.
        shift: Median pixels of motion at which it is made, too.
        least: Agreeing landmarks below which the camera is lost.
        patience: Seconds that a lost camera looks for a place it knows; then it begins anew from
            its last pose.
    """

    corners: Annotated[int, msgspec.Meta(ge=40, le=2000)] = 400
    window: Annotated[int, msgspec.Meta(ge=5, le=51)] = 15
    levels: Annotated[int, msgspec.Meta(ge=0, le=6)] = 4
    pixel_noise: Annotated[float, msgspec.Meta(gt=0)] = 0.25
    depth_noise: Annotated[float, msgspec.Meta(gt=0)] = 0.002
    keep: Annotated[float, msgspec.Meta(gt=0, lt=1)] = 0.6
    turn: Annotated[float, msgspec.Meta(gt=0)] = 12.0
    shift: Annotated[float, msgspec.Meta(gt=0)] = 45.0
    least: Annotated[int, msgspec.Meta(ge=6)] = 15
    patience: Annotated[float, msgspec.Meta(ge=0)] = 1.0


class Matches(msgspec.Struct, frozen=True, eq=False):
    """Landmarks of the key frame that were followed into a picture.

    Attributes:
        rows: Which they are, shape (n,).
        seen: How the picture shows them.
    """

    rows: npt.NDArray[np.int64]
    seen: Observations


class FeatureOdometry:
    """Follows an RGB-D camera. Equal pictures give equal poses, to the bit.

    Args:
        info: Intrinsics of the pictures, which must be free of distortion.
        settings: Of the method.
    """

    def __init__(self, info: CameraInfo, settings: FeatureSettings | None = None) -> None:
        refuse_distortion(info)
        self._info = info
        self._settings = settings or FeatureSettings()
        self._camera = (info.fx, info.fy, info.cx, info.cy)
        self._pose = np.eye(4)  # world (the first camera) to camera
        self._before: tuple[Grey, Floats, Floats] | None = None
        self._keyframe: Keyframe | None = None
        self._known: deque[Keyframe] = deque(maxlen=_REMEMBERED)
        self._lost_since: int | None = None

    def track(self, stamp: int, image: npt.NDArray[np.uint8], depth: Depth) -> Tracked:
        """Follow the camera by one picture; see `Tracker.track`."""
        grey, depth = grey_and_depth(self._info, image, depth)
        if self._keyframe is None:
            return self._begin(grey, depth, "")
        expected = self._expect(grey)
        matches = self._follow(grey, depth, self._keyframe, expected)
        solution = self._solve(matches, expected)
        if solution is None:
            return self._lose(stamp, grey, depth, matches)
        reason = ""
        if self._lost_since is not None:
            reason = "against a key frame"
            self._lost_since = None
        self._pose = solution.pose
        agree = solution.errors < _AGREES
        self._before = grey, matches.seen.landmarks[agree], matches.seen.pixels[agree]
        self._renew(grey, depth, matches, agree)
        return Tracked(
            pose=inverse(self._pose),
            reason=reason,
            points=matches.seen.pixels.astype(np.float32),
            inliers=agree,
            matches=int(agree.sum()),
        )

    def _begin(self, grey: Grey, depth: Depth, reason: str) -> Tracked:
        """Make the first key frame, at the pose that holds now."""
        frame = make_keyframe(grey, depth, self._pose, self._camera, self._settings.corners)
        pixels = frame.pixels.astype(np.float32)
        pose = inverse(self._pose)
        if len(frame) < self._settings.least:
            few = f"{len(frame)} corners with depth, of {self._settings.least} needed"
            return Tracked(pose, True, few, pixels, np.zeros(len(frame), np.bool_))
        self._keyframe = frame
        self._known.append(frame)
        self._before = grey, frame.landmarks, frame.pixels
        self._lost_since = None
        return Tracked(pose, False, reason, pixels, np.ones(len(frame), np.bool_), len(frame))

    def _expect(self, grey: Grey) -> Floats:
        """Return about where the camera is, by following a few corners from the picture before.

        Coarse to fine, and without a guess: where texture repeats, a guess that is off by half a
        brick would find the next brick.
        """
        if self._before is None:
            return self._pose
        image, landmarks, pixels = self._before
        no_guess: Any = None
        few = slice(None, None, max(len(pixels) // _FEW, 1))
        landmarks, pixels = landmarks[few], pixels[few]
        there, arrived, _ = cv2.calcOpticalFlowPyrLK(
            image,
            grey,
            pixels.astype(np.float32).reshape(-1, 1, 2),
            no_guess,
            winSize=(self._settings.window, self._settings.window),
            maxLevel=self._settings.levels,
            criteria=_FLOW_ENDS,
        )
        good = arrived.ravel() == 1
        if good.sum() < self._settings.least:
            return self._pose
        seen = Observations(
            landmarks[good],
            there.reshape(-1, 2)[good].astype(np.float64),
            np.zeros(int(good.sum())),
            np.zeros(int(good.sum()), np.bool_),
        )
        return self._refine(seen, self._pose).pose

    def _follow(self, grey: Grey, depth: Depth, frame: Keyframe, expected: Floats) -> Matches:
        """Find the key frame's landmarks, beginning where an expected pose puts them."""
        fx, fy, cx, cy = self._camera
        height, width = grey.shape
        points = frame.landmarks @ expected[:3, :3].T + expected[:3, 3]
        z = np.maximum(points[:, 2], 0.05)
        guess = np.stack([fx * points[:, 0] / z + cx, fy * points[:, 1] / z + cy], axis=1)
        rim = self._settings.window // 2
        visible = (points[:, 2] > 0.1) & _inside(guess, width, height, rim)
        rows = np.flatnonzero(visible)
        if not len(rows):
            return Matches(rows, _nothing())
        start = frame.pixels[rows].astype(np.float32).reshape(-1, 1, 2)
        options: Any = {
            "winSize": (self._settings.window, self._settings.window),
            "criteria": _FLOW_ENDS,
            "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
        }
        there, arrived, _ = cv2.calcOpticalFlowPyrLK(
            frame.image,
            grey,
            start,
            guess[rows].astype(np.float32).reshape(-1, 1, 2),
            maxLevel=1,
            **options,
        )
        back, returned, _ = cv2.calcOpticalFlowPyrLK(
            grey, frame.image, there, start.copy(), maxLevel=1, **options
        )
        miss = np.abs(back - start).reshape(-1, 2).max(axis=1)
        pixels = there.reshape(-1, 2).astype(np.float64)
        good = (arrived.ravel() == 1) & (returned.ravel() == 1) & (miss < _ROUND_TRIP)
        good &= _inside(pixels, width, height, 3)
        rows, pixels = rows[good], pixels[good]
        far, measured = inverse_depth_at(depth, pixels)
        return Matches(rows, Observations(frame.landmarks[rows], pixels, far, measured))

    def _solve(self, matches: Matches, expected: Floats) -> Solution | None:
        """Return the pose, if enough landmarks agree with it."""
        least = self._settings.least
        if len(matches.rows) < least:
            return None
        solution = self._refine(matches.seen, expected)
        if (solution.errors < _AGREES).mean() < 0.6:  # the start was wrong, or much is
            cv2.setRNGSeed(1)
            found, turn, shift, _ = cv2.solvePnPRansac(
                matches.seen.landmarks,
                matches.seen.pixels,
                self._info.matrix(),
                None,
                flags=cv2.SOLVEPNP_EPNP,
                reprojectionError=2.0,
            )
            if not found:
                return None
            start = np.eye(4)
            start[:3, :3], start[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
            solution = self._refine(matches.seen, start)
        agree = solution.errors < _AGREES
        if agree.sum() < max(least, 0.25 * len(agree)):
            return None
        final = self._refine(matches.seen.take(agree), solution.pose)
        errors = solution.errors.copy()
        errors[agree] = final.errors
        return Solution(final.pose, errors)

    def _refine(self, seen: Observations, start: Floats) -> Solution:
        noise = self._settings.pixel_noise, self._settings.depth_noise
        return solve_pose(seen, start, self._camera, *noise)

    def _renew(
        self, grey: Grey, depth: Depth, matches: Matches, agree: npt.NDArray[np.bool_]
    ) -> None:
        """Make a new key frame where the last one is nearly out of sight."""
        settings, frame = self._settings, self._keyframe
        assert frame is not None
        turn = self._pose[:3, :3] @ frame.pose[:3, :3].T
        angle = math.degrees(math.acos(min(max((np.trace(turn) - 1.0) / 2.0, -1.0), 1.0)))
        seen, rows = matches.seen.take(agree), matches.rows[agree]
        shift = float(np.median(np.linalg.norm(seen.pixels - frame.pixels[rows], axis=1)))
        enough = len(rows) >= settings.keep * len(frame)
        if enough and angle < settings.turn and shift < settings.shift:
            return
        far = np.maximum(seen.inverse, 1e-3)
        again = to_world(back_project(seen.pixels, far, self._camera), self._pose)
        landmarks, readings = fuse(
            seen.landmarks, frame.readings[rows], again, 1.0 / far, seen.measured
        )
        kept = Keyframe(grey, self._pose, landmarks, seen.pixels, readings)
        self._keyframe = make_keyframe(
            grey, depth, self._pose, self._camera, settings.corners, kept
        )
        self._known.append(self._keyframe)

    def _lose(self, stamp: int, grey: Grey, depth: Depth, matches: Matches) -> Tracked:
        """Look for a place that is known; after a while, begin anew."""
        if self._lost_since is None:
            self._lost_since = stamp
        self._before = None
        for frame in reversed(self._known):
            found = find_again(grey, frame, self._info.matrix())
            if found is not None:
                # The next picture is followed from there; this one is not trusted yet.
                self._pose, self._keyframe = found[0], frame
                break
        else:
            if stamp - self._lost_since >= self._settings.patience * SECOND:
                return self._begin(grey, depth, "by a new map, begun at the last pose")
        return Tracked(
            pose=inverse(self._pose),
            lost=True,
            reason=f"{len(matches.rows)} corners followed, of {self._settings.least} needed",
            points=matches.seen.pixels.astype(np.float32),
            inliers=np.zeros(len(matches.rows), np.bool_),
        )


def _inside(pixels: Floats, width: int, height: int, rim: int) -> npt.NDArray[np.bool_]:
    x, y = pixels.T
    return np.asarray((x >= rim) & (x < width - rim) & (y >= rim) & (y < height - rim))


def _nothing() -> Observations:
    return Observations(np.empty((0, 3)), np.empty((0, 2)), np.empty(0), np.empty(0, np.bool_))
