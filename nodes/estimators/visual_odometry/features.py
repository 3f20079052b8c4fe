"""RGB-D odometry on corners: patches of key frames are found again, and placed by their depth.

A few corners, followed from the previous image, give an approximate pose. Landmarks of all stored
key frames are then searched, each by its patch in its first key frame: error grows with new
landmarks and not with images. A landmark's depth is the mean of all readings. Where few landmarks
are found, edges and surfaces are aligned with an earlier image, too.
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
from events.geometry import inverse
from nodes.estimators import TrackingResult
from nodes.estimators.images import Depth, Floats, Grey, grey_and_depth, refuse_distortion
from nodes.estimators.optical_flow import FLOW_CRITERIA
from nodes.estimators.pose import solve_pose, transform
from nodes.estimators.relocalization import detect_and_describe, relocalize
from nodes.estimators.surfaces import Surfaces, inverse_depth, surfaces_at
from nodes.estimators.visual_odometry.alignment import Alignment, Motion, View
from nodes.estimators.visual_odometry.landmarks import (
    ORB_POINTS,
    Described,
    Keyframe,
    Landmarks,
    MapMatch,
    References,
    Rows,
    find_corners,
    find_patches,
    half_width,
    squares,
)
from nodes.estimators.visual_odometry.misalignment import disparity_information
from nodes.estimators.visual_odometry.stereo import StereoMatcher

_FLOW_WINDOW = 15
_LARGE = 320  # least side (pixels) of images halved before following corners
_AGREES = 4.0  # inlier threshold of a landmark, standard deviations
_FEW = 120  # number of corners sufficient for an approximate pose, at most
_ENOUGH = 60 / 512**2  # agreeing landmarks per pixel for a pose without alignment of edges
BELIEVED = 0.03  # weight of an alignment beside landmarks: its pixels' errors correlate
_FEWEST = 4  # least number of agreeing landmarks beside an alignment
_SEARCHED = 20  # number of newest key frames searched to relocalize a lost camera
_SEARCHED_PER_IMAGE = 2  # key frames tried with each image: each takes as long as tracking
_SURE = 0.6  # least share of agreeing landmarks, among those searched, in a relocalized pose
_PARALLAX = 0.02  # motion between corrections of disparities, relative to the median depth
_NEAR = 64.0  # margin around the image for landmarks soon in view, pixels
_SOON = 8  # images between updates of the list of such landmarks
_READING = 0.5  # noise of a depth reading, a mean of many pixels, relative to a single pixel's


class FeatureSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the method on features.

    Attributes:
        spacing: Side of image squares with a landmark each, pixels; time grows with their number.
        window: Side of compared patches, pixels; odd.
        levels: Times that flow halves the image for large motions between two images.
        pixel_noise: Standard deviation of a patch's position, pixels.
        depth_noise: Standard deviation of inverse depth, 1/m: k of a sensor with sigma = k z².
        keyframes: Stored key frames, each of the size of a grey image.
        keyframe_overlap: Share of the last key frame's landmarks in view below which another is
            made,
        keyframe_rotation: or rotation since the last one, degrees,
        keyframe_shift: or motion since the last one, pixels at the median depth.
        min_inliers: Agreeing landmarks below which the camera is lost.
        reset_timeout: Seconds of mere relocalization of a lost camera; then a new map starts at its
            last pose.
    """

    spacing: Annotated[int, msgspec.Meta(ge=12, le=128)] = 28
    window: Annotated[int, msgspec.Meta(ge=7, le=31)] = 11
    levels: Annotated[int, msgspec.Meta(ge=0, le=6)] = 4
    pixel_noise: Annotated[float, msgspec.Meta(gt=0)] = 0.3
    depth_noise: Annotated[float, msgspec.Meta(gt=0)] = 0.002
    keyframes: Annotated[int, msgspec.Meta(ge=2, le=10_000)] = 200
    keyframe_overlap: Annotated[float, msgspec.Meta(gt=0, lt=1)] = 0.6
    keyframe_rotation: Annotated[float, msgspec.Meta(gt=0)] = 12.0
    keyframe_shift: Annotated[float, msgspec.Meta(gt=0)] = 40.0
    min_inliers: Annotated[int, msgspec.Meta(ge=6)] = 15
    reset_timeout: Annotated[float, msgspec.Meta(ge=0)] = 1.0


class FeatureTracker:
    """Tracker of a camera without distortion, with depth or by stereo; reproducible to the bit.

    Args:
        matcher: Measures depth by the image of the right camera, which then comes in its place.
    """

    _aligns: bool = True
    """Whether edges and surfaces are aligned where landmarks are few."""

    def __init__(
        self,
        info: CameraInfo,
        settings: FeatureSettings | None = None,
        matcher: StereoMatcher | None = None,
    ) -> None:
        refuse_distortion(info)
        self._info = info
        self._settings = settings or FeatureSettings()
        self._matcher, self._surfaces_at = matcher, surfaces_at
        if matcher is not None:
            noise = matcher.depth_noise
            self._settings = msgspec.structs.replace(self._settings, depth_noise=noise)
            self._surfaces_at = matcher.surfaces_at
        self._matrix = info.matrix()
        large = self._settings.levels and min(info.width, info.height) >= _LARGE
        self._reduction = 2 if large else 1
        self._enough = max(_ENOUGH * info.width * info.height, self._settings.min_inliers)
        self._pose = np.eye(4)  # world (the first camera) to camera
        self._lost_since: int | None = None
        self._count = 0  # images so far
        self._maps = 0  # begun at a guessed pose
        self._searched = 0  # key frames, since tracking was lost
        self._near_until = 0
        self._corrected_at: Floats | None = None  # place of the last correction, metres
        self._near: Rows | None = None  # landmarks that are or may soon be in view
        self._motion = Motion()
        self._references = References(self._matrix, self._settings.depth_noise)
        self._clear_map()

    def track(
        self, stamp: int, image: npt.NDArray[np.uint8], other: npt.NDArray[np.uint8] | Depth
    ) -> TrackingResult:
        """Return the pose of the next image; see `Tracker.track`."""
        if self._matcher is not None:
            other = self._matcher.depth(image, np.asarray(other, np.uint8))
        grey, depth = grey_and_depth(self._info, image, np.asarray(other, np.float32))
        inverse_depths = inverse_depth(depth)
        self._count += 1
        if not self._keyframes:
            first = "" if self._lost_since is None else "by a first map"
            return self._start_map(stamp, grey, inverse_depths, first)
        lost, alignment = self._lost_since is not None, None
        match = self._match(grey, inverse_depths)
        if self._aligns and (match is None or match.agree.sum() < self._enough):
            view = View.of(grey, inverse_depths)
            starts, guessed = self._starts(stamp, match)
            alignment = self._references.align(view, starts, guessed)
            if alignment is not None:
                match = self._aligned(grey, inverse_depths, alignment, match)
        if match is None:
            return self._lose(stamp, grey, inverse_depths)
        (self._motion.placed if lost else self._motion.measured)(stamp, match.pose)
        self._lost_since = None
        self._pose = match.pose
        agree, rows = match.agree, match.rows
        self._map.update_found(
            self._count, rows[agree], np.concatenate([match.missed, rows[~agree]])
        )
        noise = self._settings.depth_noise
        read = self._surfaces_at(inverse_depths, match.pixels[agree], noise)
        self._map.fuse(self._pose, rows[agree], read, _READING * noise)
        if self._matcher is not None:
            self._correct_disparities(self._matcher, match, read)
        self._before = self._reduced(grey), rows[agree], match.pixels[agree]
        self._remember_image(grey, inverse_depths, alignment is not None)
        points, inliers = match.pixels, agree
        if alignment is None:
            far = self._is_far(rows[agree])
        else:
            far = alignment.share < self._settings.keyframe_overlap
            far |= self._is_far_from(alignment.reference, np.inf)
            points = np.concatenate([points, alignment.pixels])
            inliers = np.concatenate([inliers, alignment.agree])
            if far:
                self._references.renew(view, self._pose)
        if far:
            self._add_keyframe(grey, inverse_depths, rows[agree], match.pixels[agree])
        return TrackingResult(
            pose=inverse(self._pose),
            reason="against a key frame" if lost else "",
            points=points.astype(np.float32),
            inliers=inliers,
            map=self._maps,
        )

    def _starts(self, stamp: int, match: MapMatch | None) -> tuple[list[Floats], bool]:
        """Return poses to begin an alignment with, and whether these are guesses only."""
        lost = self._lost_since is not None
        starts = [match.pose] if match and lost else [self._motion.expected(stamp)]
        if match is None and lost:
            starts += [self._motion.steady(stamp), self._pose]
        return starts, lost

    def _aligned(
        self,
        grey: Grey,
        inverse_depths: Depth,
        alignment: Alignment,
        match: MapMatch | None,  # noqa: ARG002
    ) -> MapMatch | None:
        believed = BELIEVED * alignment.information
        map_match = self._find(grey, inverse_depths, alignment.pose, believed)
        return map_match or MapMatch.without_landmarks(alignment.pose)

    def _correct_disparities(self, matcher: StereoMatcher, match: MapMatch, read: Surfaces) -> None:
        """Correct the matcher's disparities, and the depth of all landmarks, by those in view.

        Once for each bit of motion: images from one place show noise alone.
        """
        field, table, place = matcher.disparities, self._map.table, inverse(self._pose)[:3, 3]
        rows = match.rows[match.agree]
        if len(rows) < self._settings.min_inliers:
            return
        if self._corrected_at is None:
            self._corrected_at = place
        _, depths = self._map.project(self._pose, rows)
        if np.linalg.norm(place - self._corrected_at) < _PARALLAX * float(np.median(depths)):
            return
        self._corrected_at = place
        change = field.update(
            *disparity_information(
                field, matcher.unit, self._map, match, read, matcher.depth_noise, self._matrix
            )
        )
        self._map.change_depths(field.terms(table["pixel"]) @ change / matcher.unit)

    def _remember_image(self, grey: Grey, inverse_depths: Depth, aligned: bool) -> None:
        """Store an image of known pose as a reference; `aligned` keeps the present reference."""
        self._references.remember(grey, inverse_depths, self._pose, aligned)

    def _match(self, grey: Grey, inverse_depths: Depth) -> MapMatch | None:
        """Find the map in an image, from the previous pose or, if lost, by relocalization."""
        expected = self._expect(grey)
        match = None if expected is None else self._find(grey, inverse_depths, expected)
        if match is not None or self._lost_since is None:
            return match
        pixels, descriptors = detect_and_describe(grey, ORB_POINTS)
        for frame in self._next_searched():
            pose = relocalize(pixels, descriptors, frame.points, self._matrix, cv2.SOLVEPNP_AP3P)
            if pose is not None:
                self._near = None
                match = self._find(grey, inverse_depths, pose)
                # Again from there, for the landmarks that were beyond the margin of the search.
                match = match and self._find(grey, inverse_depths, match.pose)
                if match is not None and match.share > _SURE:
                    return match
        self._near = None
        return None

    def _next_searched(self) -> list[Described]:
        """Return the key frames to try with this image: each time further back in time."""
        frames = list(reversed(self._newest))
        start, self._searched = self._searched % len(frames), self._searched + _SEARCHED_PER_IMAGE
        return frames[start : start + _SEARCHED_PER_IMAGE]

    def _expect(self, grey: Grey) -> Floats | None:
        """Return the approximate pose by flow of a few corners, without a misleading guess."""
        image, rows, pixels = self._before
        if len(rows) < self._settings.min_inliers:
            return None
        few = slice(None, None, max(-(-len(rows) // _FEW), 1))
        rows, pixels = rows[few], pixels[few]
        no_guess: Any = None
        followed, arrived, _ = cv2.calcOpticalFlowPyrLK(
            image,
            self._reduced(grey),
            (pixels / self._reduction).astype(np.float32).reshape(-1, 1, 2),
            no_guess,
            winSize=(_FLOW_WINDOW, _FLOW_WINDOW),
            maxLevel=self._settings.levels - (self._reduction > 1),
            criteria=FLOW_CRITERIA,
        )
        good = arrived.ravel() == 1
        if good.sum() < self._settings.min_inliers:
            return None
        places = self._map.table["place"][rows[good]]
        followed = self._reduction * followed.reshape(-1, 2)[good].astype(np.float64)
        pose, errors = self._solve(places, followed, self._pose)
        if (errors < 2 * _AGREES).mean() > 0.6:
            return pose
        cv2.setRNGSeed(1)
        solved, rotation, translation, _ = cv2.solvePnPRansac(
            places, followed, self._matrix, None, flags=cv2.SOLVEPNP_EPNP, reprojectionError=2.0
        )
        if not solved:
            return None
        return transform(cv2.Rodrigues(rotation)[0], translation)

    def _reduced(self, grey: Grey) -> Grey:
        """Return the image for following corners: half-sized, if large."""
        return np.asarray(cv2.pyrDown(grey), np.uint8) if self._reduction > 1 else grey

    def _find(
        self, grey: Grey, inverse_depths: Depth, expected: Floats, information: Floats | None = None
    ) -> MapMatch | None:
        """Find the map near an expected pose; given its information, few landmarks suffice."""
        settings, landmarks = self._settings, self._map
        least = settings.min_inliers if information is None else _FEWEST
        size = self._info.width, self._info.height
        near = self._near
        if near is None or self._count >= self._near_until:
            near = landmarks.in_view(expected, size, _NEAR, np.arange(len(landmarks)))
            self._near, self._near_until = near, self._count + _SOON
        rows = landmarks.active(self._count, near)
        rows = landmarks.in_view(expected, size, -half_width(settings.window) - 1.0, rows)
        rows = landmarks.unhidden(expected, inverse_depths, rows, settings.depth_noise)
        rows, patches = landmarks.patches(expected, rows)
        # The oldest of each square, as they have the least error.
        _, oldest = np.unique(squares(patches.expected, settings.spacing), return_index=True)
        rows, patches = rows[oldest], patches.take(oldest)
        if len(rows) < least:
            return None
        pixels, matched = find_patches(patches, self._images(), grey, settings.window)
        missed, rows, pixels = rows[~matched], rows[matched], pixels[matched]
        if len(rows) < least:
            return None
        read = self._surfaces_at(inverse_depths, pixels, settings.depth_noise)
        places = landmarks.table["place"][rows]
        start, errors = self._solve(places, pixels, expected, read, information)
        agree = errors < _AGREES
        if agree.sum() < max(least, 0.4 * len(agree)):
            return None
        start = start if information is None else expected
        agreeing = places[agree], pixels[agree], start, read.take(agree)
        pose, _ = self._solve(*agreeing, information)
        return MapMatch(pose, rows, pixels, agree, missed)

    def _solve(
        self,
        places: Floats,
        pixels: Floats,
        start: Floats,
        read: Surfaces | None = None,
        information: Floats | None = None,
    ) -> tuple[Floats, Floats]:
        pixel_noise, noise = self._settings.pixel_noise, _READING * self._settings.depth_noise
        return solve_pose(
            places, pixels, start, self._matrix, pixel_noise, read, noise, information
        )

    def _is_far(self, rows: Rows) -> bool:
        """Return whether the last key frame is nearly out of sight."""
        if len(rows) < self._settings.keyframe_overlap * self._at_keyframe:
            return True
        _, z = self._map.project(self._pose, rows)
        last = next(reversed(self._keyframes.values()))
        return self._is_far_from(last.pose, float(np.median(z)))

    def _is_far_from(self, other: Floats, depth: float) -> bool:
        settings, between = self._settings, self._pose @ inverse(other)
        angle = math.acos(min(max((np.trace(between[:3, :3]) - 1.0) / 2.0, -1.0), 1.0))
        shift = self._info.fx * float(np.linalg.norm(between[:3, 3]) / depth)
        return math.degrees(angle) > settings.keyframe_rotation or shift > settings.keyframe_shift

    def _add_keyframe(self, grey: Grey, inverse_depths: Depth, rows: Rows, pixels: Floats) -> None:
        """Store this image, and new landmarks between those found."""
        settings = self._settings
        corners = find_corners(grey, settings.spacing, pixels)
        surfaces = self._surfaces_at(inverse_depths, corners, settings.depth_noise)
        number = next(reversed(self._keyframes), -1) + 1
        new = self._map.add(
            number, self._pose, corners[surfaces.continuous], surfaces.take(surfaces.continuous)
        )
        rows, pixels = (
            np.concatenate([rows, new]),
            np.concatenate([pixels, corners[surfaces.continuous]]),
        )
        self._keyframes[number] = frame = Keyframe(grey, self._pose)
        self._newest.append(Described(frame, inverse_depths, self._matrix, settings.depth_noise))
        self._at_keyframe = len(rows)
        self._near = None
        if len(self._keyframes) > settings.keyframes:
            del self._keyframes[next(iter(self._keyframes))]
            removed = self._map.forget_before(next(iter(self._keyframes)))
            pixels, rows = pixels[rows >= removed], rows[rows >= removed] - removed
        self._before = self._reduced(grey), rows, pixels

    def _images(self) -> dict[int, Grey]:
        return {number: frame.image for number, frame in self._keyframes.items()}

    def _clear_map(self) -> None:
        self._corrected_at = None
        self._map = Landmarks(self._matrix)
        self._keyframes: dict[int, Keyframe] = {}
        self._newest: deque[Described] = deque(maxlen=min(_SEARCHED, self._settings.keyframes))
        self._at_keyframe = 0
        self._near = None
        self._near_until = 0

    def _start_map(
        self, stamp: int, grey: Grey, inverse_depths: Depth, reason: str
    ) -> TrackingResult:
        """Start a new map with a key frame at the present pose, given enough corners."""
        corners = find_corners(grey, self._settings.spacing, np.empty((0, 2)))
        surfaces = self._surfaces_at(inverse_depths, corners, self._settings.depth_noise)
        count = int(surfaces.continuous.sum())
        if count < self._settings.min_inliers:
            view = View.of(grey, inverse_depths)
            if not (self._aligns and self._references.suffices(view)):
                least = self._settings.min_inliers
                few = f"{count} corners with depth, of {least} needed for a map, and too few edges"
                return self._lost(stamp, few)
        self._maps += bool(self._keyframes) and not self._is_carried
        self._clear_map()
        self._lost_since = None
        self._motion.placed(stamp, self._pose)
        self._references.remember(grey, inverse_depths, self._pose, False)
        self._add_keyframe(grey, inverse_depths, np.empty(0, np.int64), np.empty((0, 2)))
        _, _, pixels = self._before
        return TrackingResult(
            pose=inverse(self._pose),
            reason=reason,
            points=pixels.astype(np.float32),
            inliers=np.ones(len(pixels), np.bool_),
            map=self._maps,
        )

    @property
    def _is_carried(self) -> bool:
        """Return whether the pose is known without the map: a new map stays in the frame."""
        return False

    def _lose(self, stamp: int, grey: Grey, inverse_depths: Depth) -> TrackingResult:
        """Return a lost result; after a while, start a new map at the carried or guessed pose."""
        result = self._lost(stamp, "too few landmarks of the map were found")
        assert self._lost_since is not None
        carried = self._pose
        if self._aligns:
            view = View.of(grey, inverse_depths)
            carried = self._references.carry(view, self._motion.carried(stamp))
            self._motion.placed(stamp, carried)
        if stamp - self._lost_since < self._settings.reset_timeout * 1e9:
            return result
        self._pose = carried
        return self._start_map(stamp, grey, inverse_depths, "by a new map, at the estimated pose")

    def _lost(self, stamp: int, reason: str) -> TrackingResult:
        if self._lost_since is None:
            self._lost_since, self._searched = stamp, 0
        return TrackingResult(pose=inverse(self._pose), lost=True, reason=reason)
