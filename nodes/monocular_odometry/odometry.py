"""Monocular odometry on corners: poses from landmarks, landmarks from poses, both adjusted.

In the manner of sparse, semi-direct methods (C. Forster, M. Pizzoli and D. Scaramuzza, "SVO", ICRA
2014): patches are aligned with the last key frame directly, poses come from the landmarks behind
them, and new landmarks from two views far enough apart; the last key frames and all that they see
are then adjusted together. The unit of length is the first map's.

Not here: the first map (`nodes.monocular_odometry.beginning`) and how it grows
(`nodes.monocular_odometry.local_map`).
"""

from __future__ import annotations

from collections import deque

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from events import CameraInfo
from events.poses import inverse
from nodes.monocular_odometry.beginning import Beginning
from nodes.monocular_odometry.bundle import Indices
from nodes.monocular_odometry.flow import follow_both_ways, inside
from nodes.monocular_odometry.keyframes import Keyframe, find_again
from nodes.monocular_odometry.local_map import LocalMap
from nodes.monocular_odometry.settings import MonocularSettings
from nodes.visual_odometry.pose import Observations, Solution, solve_pose
from nodes.visual_odometry.tracker import Floats, Grey

SECOND = 1_000_000_000
_AGREES = 6.0
"""Standard deviations up to which a landmark agrees with a pose."""
_FEW = 120
"""Corners that suffice to tell about where the camera is."""
_REMEMBERED = 6
"""Key frames in which a lost camera looks for itself."""


class Tracked(msgspec.Struct, frozen=True, eq=False):
    """What monocular odometry says of one picture.

    Attributes:
        pose: The optical camera now, in the optical camera at the map's first picture, in units of
            the map, shape (4, 4).
        initialised: Whether there is a map; without one the pose means nothing.
        lost: Whether the pose is not known; `pose` is then the last that was, or a guess.
        reason: Why it is lost, or how it was regained.
        points: float32 pixels (column, row), shape (n, 2): what was followed.
        inliers: bool, shape (n,): what agrees with the pose.
        matches: How many do.
    """

    pose: Floats
    initialised: bool = True
    lost: bool = False
    reason: str = ""
    points: npt.NDArray[np.float32] = np.empty((0, 2), np.float32)
    inliers: npt.NDArray[np.bool_] = np.empty(0, np.bool_)
    matches: int = 0


class MonocularOdometry:
    """Follows a single camera. Equal pictures give equal poses, to the bit.

    Args:
        info: Intrinsics of the pictures, which must be free of distortion.
        settings: Of the method.

    Raises:
        ValueError: The pictures are distorted.
    """

    def __init__(self, info: CameraInfo, settings: MonocularSettings | None = None) -> None:
        if any(info.distortion):
            raise ValueError(
                f"camera: expected pictures without distortion, found {info.distortion}"
            )
        self._info = info
        self._settings = settings or MonocularSettings()
        self._matrix = info.matrix()
        self._camera = (info.fx, info.fy, info.cx, info.cy)
        self._map: LocalMap | None = None
        self._beginning: Beginning | None = Beginning(self._matrix, self._settings)
        self._pose = np.eye(4)  # the last that was known, world to camera
        self._guess = self._pose  # where to look from
        self._before: tuple[Grey, Floats, Floats] | None = None  # picture, landmarks, their pixels
        self._known: deque[Keyframe] = deque(maxlen=_REMEMBERED)
        self._lost_since: int | None = None

    def track(self, stamp: int, image: npt.NDArray[np.uint8]) -> Tracked:
        """Follow the camera by one picture.

        Args:
            stamp: Of the exposure (ns).
            image: Shape (h, w, 3) red, green, blue, or (h, w) grey.

        Raises:
            ValueError: The size is not that of the camera.
        """
        grey = self._grey(image)
        if self._map is None:
            return self._begin(grey) or Tracked(np.eye(4), initialised=False, reason="initialising")
        expected = self._expect(grey)
        rows, pixels = self._follow(grey, self._map, expected)
        tracks = self._map.tracks
        known = tracks.known[rows]
        solution = self._solve(tracks.points[rows][known], pixels[known], expected)
        if solution is None:
            return self._lost(stamp, grey, pixels)
        reason = "" if self._lost_since is None else "against a key frame"
        self._lost_since = self._beginning = None
        self._pose = self._guess = solution.pose
        agree = np.ones(len(rows), np.bool_)
        agree[known] = solution.errors < _AGREES
        seen = known & agree
        self._before = grey, tracks.points[rows][seen], pixels[seen]
        said = Tracked(
            pose=inverse(self._pose),
            reason=reason,
            points=pixels[known].astype(np.float32),
            inliers=agree[known],
            matches=int(seen.sum()),
        )
        shift = np.linalg.norm(pixels - tracks.pixels[rows], axis=1)
        far = float(np.median(shift[agree])) > self._settings.shift
        keep = self._settings.keep
        fewer = agree.sum() < keep * len(tracks) or seen.sum() < keep * tracks.known.sum()
        if far or fewer:
            self._map.add_keyframe(grey, self._pose, rows[agree], pixels[agree])
            self._arrive(self._map)
        return said

    def _grey(self, image: npt.NDArray[np.uint8]) -> Grey:
        size = (self._info.height, self._info.width)
        if image.shape[:2] != size or image.shape[2:] not in {(), (3,)}:
            raise ValueError(
                f"image: expected {size[1]}×{size[0]} pixels, as the camera announced, "
                f"found shape {image.shape}"
            )
        if image.ndim == 2:
            return image
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)

    # The first map, and the next.

    def _begin(self, grey: Grey) -> Tracked | None:
        """Take a picture for a new map; return what is known if now there is one.

        The first map is the world. Any other is put where the last one ended and given its median
        depth, for want of anything better.
        """
        if self._beginning is None:
            self._beginning = Beginning(self._matrix, self._settings)
        found = self._beginning.see(grey)
        if found is None:
            return None
        unit, reason = 1.0, ""
        if self._map is not None:
            unit, reason = self._map.depth, "by a new map: its unit of length is a guess"
        start = inverse(self._pose)
        self._map = LocalMap.first(found, grey, start, unit, self._matrix, self._settings)
        self._lost_since = self._beginning = None
        self._known.clear()
        self._arrive(self._map)
        count = len(found.points)
        return Tracked(
            pose=inverse(self._pose),
            reason=reason,
            points=found.pixels[1].astype(np.float32),
            inliers=np.ones(count, np.bool_),
            matches=count,
        )

    def _arrive(self, world: LocalMap) -> None:
        """Go on from the map's newest key frame, and remember it."""
        keyframe = world.keyframe()
        self._pose = self._guess = keyframe.pose
        self._before = keyframe.image, keyframe.landmarks, keyframe.pixels
        self._known.append(keyframe)

    # Every picture.

    def _expect(self, grey: Grey) -> Floats:
        """Return about where the camera is, by following a few corners from the picture before."""
        if self._before is None:
            return self._guess
        image, points, pixels = self._before
        few = slice(None, None, max(len(pixels) // _FEW, 1))
        settings = self._settings
        there, good = follow_both_ways(
            image, grey, pixels[few], pixels[few], settings.window, settings.levels
        )
        if 2 * good.sum() < settings.least:
            return self._guess
        return self._refine(points[few][good], there[good], self._guess).pose

    def _follow(self, grey: Grey, world: LocalMap, expected: Floats) -> tuple[Indices, Floats]:
        """Find the newest key frame's corners; return which were found, and their pixels."""
        points = world.supposed()
        window = self._settings.window
        fx, fy, cx, cy = self._camera
        seen = points @ expected[:3, :3].T + expected[:3, 3]
        z = np.maximum(seen[:, 2], 1e-6)
        guess = np.stack([fx * seen[:, 0] / z + cx, fy * seen[:, 1] / z + cy], axis=1)
        visible = (seen[:, 2] > 1e-3 * world.depth) & inside(guess, grey.shape, window // 2)
        rows = np.flatnonzero(visible)
        if not len(rows):
            return rows, np.empty((0, 2))
        start = world.tracks.pixels[rows]
        pixels, good = follow_both_ways(world.image, grey, start, guess[rows], window, 1)
        return rows[good], pixels[good]

    def _solve(self, points: Floats, pixels: Floats, expected: Floats) -> Solution | None:
        """Return the pose, if enough landmarks agree with it."""
        least = self._settings.least
        if len(points) < least:
            return None
        solution = self._refine(points, pixels, expected)
        agree = solution.errors < _AGREES
        if agree.sum() < max(least, 0.4 * len(agree)):
            return None
        final = self._refine(points[agree], pixels[agree], solution.pose)
        errors = solution.errors.copy()
        errors[agree] = final.errors
        return Solution(final.pose, errors)

    def _refine(self, points: Floats, pixels: Floats, start: Floats) -> Solution:
        none = np.zeros(len(points))
        seen = Observations(points, pixels, none, none.astype(np.bool_))
        return solve_pose(seen, start, self._camera, self._settings.pixel_noise, 1.0)

    # Lost.

    def _lost(self, stamp: int, grey: Grey, pixels: Floats) -> Tracked:
        """Look for a place that is known; after a while, begin a new map as well."""
        if self._lost_since is None:
            self._lost_since = stamp
        self._before = None
        for keyframe in reversed(self._known):
            found = find_again(grey, keyframe, self._matrix)
            if found is not None:  # the next picture is followed from there
                self._map = LocalMap.around(keyframe, self._matrix, self._settings)
                self._guess = found[0]
                break
        else:
            waited = stamp - self._lost_since >= self._settings.patience * SECOND
            if waited and (begun := self._begin(grey)) is not None:
                return begun
        return Tracked(
            pose=inverse(self._pose),
            lost=True,
            reason=f"too few of the {len(pixels)} corners that were found agree on a pose",
            points=pixels.astype(np.float32),
            inliers=np.zeros(len(pixels), np.bool_),
        )
