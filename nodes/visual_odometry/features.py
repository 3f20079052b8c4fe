"""RGB-D odometry on corners: patches of key frames found again, placed by their depth.

A few corners, followed from the picture before, tell about where the camera is. Then landmarks of
all key frames remembered are looked for as they should look from there, each in its first sight:
error grows with new landmarks and not with pictures, and not at all where the camera returns in
time. A landmark's depth is the mean of all readings. See `landmarks`, `patches`, `surfaces` and
`pose` for the parts.
"""

from __future__ import annotations

import math
from typing import Annotated, Any

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from events import CameraInfo
from events.poses import inverse
from nodes.visual_odometry.corners import find_corners, squares
from nodes.visual_odometry.landmarks import Landmarks
from nodes.visual_odometry.patches import Rows, find_patches, half_width
from nodes.visual_odometry.pose import Observations, Solution, solve_pose
from nodes.visual_odometry.recognition import Place, describe, recognise, remember
from nodes.visual_odometry.surfaces import inverse_depth, surfaces_at
from nodes.visual_odometry.tracker import (
    Depth,
    Floats,
    Grey,
    Tracked,
    grey_and_depth,
    refuse_distortion,
)

SECOND = 1_000_000_000
_FLOW_ENDS = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)
_FLOW_WINDOW = 15
_AGREES = 4.0
"""Standard deviations up to which a landmark agrees with a pose."""
_FEW = 120
"""Corners that suffice to tell about where the camera is."""
_SEARCHED = 20
"""Key frames in which a lost camera looks for itself,"""
_AT_ONCE = 2
"""so many in each picture, because each takes as long as following does."""
_SURE = 0.6
"""Share of the landmarks looked for that must agree with a pose that came from nowhere."""
_NEAR = 64.0
"""Pixels beyond the picture's edge up to which landmarks may soon be in view,"""
_SOON = 8
"""for so many pictures."""
_READING = 0.5
"""Noise of a reading of depth, which is a mean of many pixels but not of a true plane, in that of
one pixel."""


class FeatureSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the method on features.

    Attributes:
        spacing: Side of the squares of the picture of which each holds one landmark, pixels. Time
            grows with their number.
        window: Side of the patches that are compared, pixels; odd.
        levels: Times that flow halves the picture for large motions between two pictures.
        pixel_noise: Standard deviation of a patch's place, pixels.
        depth_noise: Standard deviation of inverse depth, 1/m: k of a sensor with sigma = k z².
        keyframes: Key frames remembered. One takes the memory of a grey picture.
        keep: Share of the last key frame's landmarks below which the next is made.
        turn: Degrees of rotation at which it is made, too.
        shift: Pixels of motion at a middling distance at which it is made, too.
        least: Agreeing landmarks below which the camera is lost.
        patience: Seconds that a lost camera looks for a place it knows; then it begins anew from
            its last pose.
    """

    spacing: Annotated[int, msgspec.Meta(ge=12, le=128)] = 28
    window: Annotated[int, msgspec.Meta(ge=7, le=31)] = 11
    levels: Annotated[int, msgspec.Meta(ge=0, le=6)] = 4
    pixel_noise: Annotated[float, msgspec.Meta(gt=0)] = 0.3
    depth_noise: Annotated[float, msgspec.Meta(gt=0)] = 0.002
    keyframes: Annotated[int, msgspec.Meta(ge=2, le=10_000)] = 200
    keep: Annotated[float, msgspec.Meta(gt=0, lt=1)] = 0.6
    turn: Annotated[float, msgspec.Meta(gt=0)] = 12.0
    shift: Annotated[float, msgspec.Meta(gt=0)] = 40.0
    least: Annotated[int, msgspec.Meta(ge=6)] = 15
    patience: Annotated[float, msgspec.Meta(ge=0)] = 1.0


class Keyframe(msgspec.Struct, frozen=True, eq=False):
    """A picture that brought landmarks.

    Attributes:
        image: Grey.
        pose: World to camera, shape (4, 4).
        place: By which to know it again.
    """

    image: Grey
    pose: Floats
    place: Place


class Sight(msgspec.Struct, frozen=True, eq=False):
    """What a picture shows of the map.

    Attributes:
        pose: World to camera, shape (4, 4).
        rows: Landmarks found, shape (n,).
        pixels: Where, shape (n, 2).
        agree: Which of them agree with the pose, shape (n,).
        missed: Landmarks looked for and not found.
    """

    pose: Floats
    rows: Rows
    pixels: Floats
    agree: npt.NDArray[np.bool_]
    missed: Rows

    @property
    def share(self) -> float:
        """How many of the landmarks looked for agree with the pose, of 1."""
        return float(self.agree.sum()) / (len(self.rows) + len(self.missed))


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
        self._lost_since: int | None = None
        self._count = 0  # pictures so far
        self._searched = 0  # key frames, since it was lost
        self._near_until = 0
        self._near: Rows | None = None  # landmarks that are or may soon be in view
        self._forget()

    def track(self, stamp: int, image: npt.NDArray[np.uint8], depth: Depth) -> Tracked:
        """Follow the camera by one picture; see `Tracker.track`."""
        grey, depth = grey_and_depth(self._info, image, depth)
        inverse_of = inverse_depth(depth)
        self._count += 1
        if not len(self._map):
            first = "" if self._lost_since is None else "by a first map"
            return self._begin(stamp, grey, inverse_of, first)
        sight = self._look(grey, inverse_of)
        if sight is None:
            return self._lose(stamp, grey, inverse_of)
        reason = "" if self._lost_since is None else "against a key frame"
        self._lost_since = None
        self._pose = sight.pose
        agree, rows = sight.agree, sight.rows
        self._map.judge(self._count, rows[agree], np.concatenate([sight.missed, rows[~agree]]))
        noise = self._settings.depth_noise
        read = surfaces_at(inverse_of, sight.pixels[agree], noise)
        self._map.fuse(self._pose, rows[agree], read, _READING * noise)
        self._before = grey, rows[agree], sight.pixels[agree]
        if self._is_far(rows[agree]):
            self._add_keyframe(grey, inverse_of, rows[agree], sight.pixels[agree])
        return Tracked(
            pose=inverse(self._pose),
            reason=reason,
            points=sight.pixels.astype(np.float32),
            inliers=agree,
            matches=int(agree.sum()),
        )

    def _look(self, grey: Grey, inverse_of: Depth) -> Sight | None:
        """Find the map in a picture, near the picture before or, if lost, near a key frame."""
        expected = self._expect(grey)
        sight = None if expected is None else self._find(grey, inverse_of, expected)
        if sight is not None or self._lost_since is None:
            return sight
        pixels, descriptors = describe(grey)
        for frame in self._next_searched():
            found = recognise(pixels, descriptors, frame.place, self._info.matrix())
            if found is not None:
                self._near = None
                sight = self._find(grey, inverse_of, found)
                # Again from there: what was beyond the margin of the search is found now, or not.
                sight = sight and self._find(grey, inverse_of, sight.pose)
                if sight is not None and sight.share > _SURE:
                    return sight
        self._near = None
        return None

    def _next_searched(self) -> list[Keyframe]:
        """Return the next few key frames to look in: from picture to picture, back in time."""
        frames = list(self._keyframes.values())[: -_SEARCHED - 1 : -1]
        start, self._searched = self._searched % len(frames), self._searched + _AT_ONCE
        return frames[start : start + _AT_ONCE]

    def _expect(self, grey: Grey) -> Floats | None:
        """Return about where the camera is, by following a few corners from the picture before.

        Coarse to fine, and without a guess: where texture repeats, a guess that is off by half a
        brick would find the next brick.
        """
        image, rows, pixels = self._before
        few = slice(None, None, max(len(rows) // _FEW, 1))
        rows, pixels = rows[few], pixels[few]
        no_guess: Any = None
        there, arrived, _ = cv2.calcOpticalFlowPyrLK(
            image,
            grey,
            pixels.astype(np.float32).reshape(-1, 1, 2),
            no_guess,
            winSize=(_FLOW_WINDOW, _FLOW_WINDOW),
            maxLevel=self._settings.levels,
            criteria=_FLOW_ENDS,
        )
        good = arrived.ravel() == 1
        if good.sum() < self._settings.least:
            return None
        places, there = self._map.places[rows[good]], there.reshape(-1, 2)[good].astype(np.float64)
        solution = self._solve(places, there, self._pose)
        if (solution.errors < 2 * _AGREES).mean() > 0.6:
            return solution.pose
        cv2.setRNGSeed(1)
        found, turn, shift, _ = cv2.solvePnPRansac(
            places,
            there,
            self._info.matrix(),
            None,
            flags=cv2.SOLVEPNP_EPNP,
            reprojectionError=2.0,
        )
        if not found:
            return None
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
        return pose

    def _find(self, grey: Grey, inverse_of: Depth, expected: Floats) -> Sight | None:
        """Find the map in a picture that was taken near an expected pose."""
        settings, landmarks = self._settings, self._map
        size = self._info.width, self._info.height
        near = self._near
        if near is None or self._count >= self._near_until:
            near = landmarks.in_view(expected, size, _NEAR, np.arange(len(landmarks)))
            self._near, self._near_until = near, self._count + _SOON
        rows = landmarks.awake(self._count, near)
        rows = landmarks.in_view(expected, size, -half_width(settings.window) - 1.0, rows)
        rows = landmarks.unhidden(expected, inverse_of, rows, settings.depth_noise)
        rows, patches = landmarks.patches(expected, rows)
        # The oldest of each square: they are the nearest to where all began.
        _, oldest = np.unique(squares(patches.expected, settings.spacing), return_index=True)
        rows, patches = rows[oldest], patches.take(oldest)
        if len(rows) < settings.least:
            return None
        pixels, found = find_patches(patches, self._pictures(), grey, settings.window)
        missed, rows, pixels = rows[~found], rows[found], pixels[found]
        if len(rows) < settings.least:
            return None
        read = surfaces_at(inverse_of, pixels, settings.depth_noise)
        places = landmarks.places[rows]
        first = self._solve(places, pixels, expected, read.inverse, read.whole)
        agree = first.errors < _AGREES
        if agree.sum() < max(settings.least, 0.4 * len(agree)):
            return None
        last = self._solve(
            places[agree], pixels[agree], first.pose, read.inverse[agree], read.whole[agree]
        )
        return Sight(last.pose, rows, pixels, agree, missed)

    def _solve(
        self,
        places: Floats,
        pixels: Floats,
        start: Floats,
        read: Floats | None = None,
        whole: npt.NDArray[np.bool_] | None = None,
    ) -> Solution:
        if read is None or whole is None:
            read, whole = np.zeros(len(places)), np.zeros(len(places), np.bool_)
        settings = self._settings
        return solve_pose(
            Observations(places, pixels, read, whole),
            start,
            self._camera,
            settings.pixel_noise,
            _READING * settings.depth_noise,
        )

    def _is_far(self, rows: Rows) -> bool:
        """Return whether the last key frame is nearly out of sight."""
        settings, last = self._settings, next(reversed(self._keyframes.values()))
        if len(rows) < settings.keep * self._at_keyframe:
            return True
        between = self._pose @ inverse(last.pose)
        angle = math.acos(min(max((np.trace(between[:3, :3]) - 1.0) / 2.0, -1.0), 1.0))
        _, z = self._map.project(self._pose, rows)
        shift = self._info.fx * float(np.linalg.norm(between[:3, 3]) / np.median(z))
        return math.degrees(angle) > settings.turn or shift > settings.shift

    def _add_keyframe(self, grey: Grey, inverse_of: Depth, rows: Rows, pixels: Floats) -> None:
        """Remember this picture, and new landmarks between those seen."""
        settings = self._settings
        corners = find_corners(grey, settings.spacing, pixels)
        seen = surfaces_at(inverse_of, corners, settings.depth_noise)
        number = next(reversed(self._keyframes), -1) + 1
        new = self._map.add(number, self._pose, corners[seen.whole], seen.take(seen.whole))
        rows, pixels = np.concatenate([rows, new]), np.concatenate([pixels, corners[seen.whole]])
        noise = settings.depth_noise
        place = remember(grey, inverse_of, self._pose, self._camera, noise)
        self._keyframes[number] = Keyframe(grey, self._pose, place)
        self._at_keyframe = len(rows)
        self._near = None
        if len(self._keyframes) > settings.keyframes:
            del self._keyframes[next(iter(self._keyframes))]
            gone = self._map.forget_before(next(iter(self._keyframes)))
            pixels, rows = pixels[rows >= gone], rows[rows >= gone] - gone
        self._before = grey, rows, pixels

    def _pictures(self) -> dict[int, Grey]:
        return {number: frame.image for number, frame in self._keyframes.items()}

    def _forget(self) -> None:
        self._map = Landmarks(self._camera)
        self._keyframes: dict[int, Keyframe] = {}
        self._at_keyframe = 0
        self._near = None
        self._near_until = 0

    def _begin(self, stamp: int, grey: Grey, inverse_of: Depth, reason: str) -> Tracked:
        """Make the first key frame of a new map, at the pose that holds now, if it shows enough."""
        corners = find_corners(grey, self._settings.spacing, np.empty((0, 2)))
        count = int(surfaces_at(inverse_of, corners, self._settings.depth_noise).whole.sum())
        if count < self._settings.least:
            few = f"{count} corners with depth, of {self._settings.least} needed for a map"
            return self._say_lost(stamp, few)
        self._forget()
        self._lost_since = None
        self._add_keyframe(grey, inverse_of, np.empty(0, np.int64), np.empty((0, 2)))
        _, _, pixels = self._before
        return Tracked(
            pose=inverse(self._pose),
            reason=reason,
            points=pixels.astype(np.float32),
            inliers=np.ones(count, np.bool_),
            matches=count,
        )

    def _lose(self, stamp: int, grey: Grey, inverse_of: Depth) -> Tracked:
        """Say that it is lost; after a while, begin anew."""
        said = self._say_lost(stamp, "too little is seen of what is known")
        assert self._lost_since is not None
        if stamp - self._lost_since < self._settings.patience * SECOND:
            return said
        return self._begin(stamp, grey, inverse_of, "by a new map, begun at the last pose")

    def _say_lost(self, stamp: int, reason: str) -> Tracked:
        if self._lost_since is None:
            self._lost_since, self._searched = stamp, 0
        return Tracked(pose=inverse(self._pose), lost=True, reason=reason)
