"""Monocular odometry on corners: poses from landmarks, landmarks from poses, both adjusted.

In the manner of sparse, semi-direct methods (C. Forster, M. Pizzoli and D. Scaramuzza, "SVO", ICRA
2014): patches are aligned with the last key frame directly, poses come from the landmarks behind
them, and new landmarks from two views far enough apart; the last key frames and all that they see
are then adjusted together. The unit of length is the first map's.
"""

from __future__ import annotations

from collections import deque

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from events import CameraInfo
from nodes.monocular_odometry.beginning import Beginning, FirstMap
from nodes.monocular_odometry.bundle import adjust
from nodes.monocular_odometry.flow import follow, follow_both_ways, inside, new_corners
from nodes.monocular_odometry.settings import MonocularSettings
from nodes.monocular_odometry.tracks import Tracks, View
from nodes.monocular_odometry.views import parallax, rays, reprojection_errors, triangulate
from nodes.visual_odometry.keyframes import Keyframe, find_again
from nodes.visual_odometry.pose import Observations, Solution, solve_pose
from nodes.visual_odometry.tracker import Floats, Grey, inverse

SECOND = 1_000_000_000
_AGREES = 6.0
"""Standard deviations up to which a landmark agrees with a pose."""
_GOOD = 2.0
"""Pixels of reprojection error up to which a landmark is kept."""
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
        lost: Whether the pose is not known; `pose` is then the last one that was.
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
        self._beginning: Beginning | None = Beginning(self._matrix, self._settings)
        self._world = np.eye(4)  # where the next map begins: camera to world
        self._unit = 1.0
        self._pose = np.eye(4)  # world to camera
        self._poses: dict[int, Floats] = {}
        self._newest = -1
        self._image: Grey = np.empty((0, 0), np.uint8)
        self._tracks = Tracks(np.empty((0, 2)), 0)
        self._past: list[tuple[Floats, dict[int, View]]] = []
        self._before: tuple[Grey, Floats, Floats] | None = None
        self._known: deque[Keyframe] = deque(maxlen=_REMEMBERED)
        self._lost_since: int | None = None
        self._maps = 0

    def track(self, stamp: int, image: npt.NDArray[np.uint8]) -> Tracked:
        """Follow the camera by one picture.

        Args:
            stamp: Of the exposure (ns).
            image: Shape (h, w, 3) red, green, blue, or (h, w) grey.

        Raises:
            ValueError: The size is not that of the camera.
        """
        grey = self._grey(image)
        if self._beginning is not None:
            return self._begin(grey, self._beginning)
        expected = self._expect(grey)
        rows, pixels = self._follow(grey, expected)
        known = self._tracks.known[rows]
        solution = self._solve(self._tracks.points[rows][known], pixels[known], expected)
        if solution is None:
            return self._lose(stamp, grey, pixels)
        reason = "" if self._lost_since is None else "against a key frame"
        self._lost_since = None
        self._pose = solution.pose
        agree = np.ones(len(rows), np.bool_)
        agree[known] = solution.errors < _AGREES
        matches = int(agree[known].sum())
        points = self._tracks.points[rows]
        self._before = grey, points[known & agree], pixels[known & agree]
        said = Tracked(
            pose=inverse(self._pose),
            reason=reason,
            points=pixels[known].astype(np.float32),
            inliers=agree[known],
            matches=matches,
        )
        shift = np.linalg.norm(pixels - self._tracks.pixels[rows], axis=1)
        far = float(np.median(shift[agree])) > self._settings.shift
        if far or agree.sum() < self._settings.keep * len(self._tracks):
            self._add_keyframe(grey, rows[agree], pixels[agree])
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

    # The first map.

    def _begin(self, grey: Grey, beginning: Beginning) -> Tracked:
        found = beginning.see(grey)
        if found is not None:
            self._start_map(grey, found)
            self._beginning = None
            self._lost_since = None
            self._maps += 1
        pixels = beginning.pixels.astype(np.float32)
        again = "by a new map: its unit of length differs" if self._maps > 1 else ""
        return Tracked(
            pose=inverse(self._pose),
            initialised=found is not None,
            lost=found is None and self._maps > 0,
            reason=again if found is not None else "initialising",
            points=pixels,
            inliers=np.full(len(pixels), found is not None),
            matches=len(pixels) if found is not None else 0,
        )

    def _start_map(self, grey: Grey, found: FirstMap) -> None:
        """Take over the first map, put where the last one ended."""
        unit, world = self._unit, self._world
        self._poses, self._past = {}, []
        start = inverse(world)
        second = found.second.copy()
        second[:3, 3] *= unit
        points = (unit * found.points) @ world[:3, :3].T + world[:3, 3]
        first_id, second_id = self._newest + 1, self._newest + 2
        self._poses = {first_id: start, second_id: second @ start}
        self._newest = second_id
        self._tracks = Tracks(found.pixels[0], first_id)
        self._tracks.points = points
        self._tracks.see(second_id, found.pixels[1])
        self._pose = self._poses[second_id]
        self._image = grey
        self._remember()
        self._tracks.add(self._more_corners(grey), second_id)
        known = self._tracks.known
        self._before = grey, self._tracks.points[known], self._tracks.pixels[known]

    # Every picture.

    def _expect(self, grey: Grey) -> Floats:
        """Return about where the camera is, by following a few corners from the picture before."""
        if self._before is None:
            return self._pose
        image, points, pixels = self._before
        few = slice(None, None, max(len(pixels) // _FEW, 1))
        settings = self._settings
        there, good = follow(image, grey, pixels[few], settings.window, settings.levels)
        if good.sum() < settings.least:
            return self._pose
        return self._refine(points[few][good], there[good], self._pose).pose

    def _follow(self, grey: Grey, expected: Floats) -> tuple[npt.NDArray[np.int64], Floats]:
        """Find the key frame's corners; those of no known place as if at the median depth."""
        tracks = self._tracks
        fx, fy, cx, cy = self._camera
        keyframe = self._poses[self._newest]
        points, known = tracks.points.copy(), tracks.known
        in_keyframe = points[known] @ keyframe[:3, :3].T + keyframe[:3, 3]
        depth = float(np.median(in_keyframe[:, 2])) if known.any() else 1.0
        supposed = depth * rays(tracks.pixels[~known], self._matrix) - keyframe[:3, 3]
        points[~known] = supposed @ keyframe[:3, :3]
        seen = points @ expected[:3, :3].T + expected[:3, 3]
        z = np.maximum(seen[:, 2], 1e-6)
        guess = np.stack([fx * seen[:, 0] / z + cx, fy * seen[:, 1] / z + cy], axis=1)
        visible = (seen[:, 2] > 1e-3 * depth) & inside(
            guess, grey.shape, self._settings.window // 2
        )
        rows = np.flatnonzero(visible)
        if not len(rows):
            return rows, np.empty((0, 2))
        pixels, good = follow_both_ways(
            self._image, grey, tracks.pixels[rows], guess[rows], self._settings.window, 1
        )
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

    # Key frames.

    def _add_keyframe(self, grey: Grey, rows: npt.NDArray[np.int64], pixels: Floats) -> None:
        """Make this picture a key frame, and all that is known better by it."""
        self._past += self._tracks.keep(rows)
        self._newest += 1
        self._poses[self._newest] = self._pose
        self._tracks.see(self._newest, pixels)
        self._image = grey
        self._place_new_landmarks()
        self._adjust()
        self._pose = self._poses[self._newest]
        self._remember()
        self._tracks.add(self._more_corners(grey), self._newest)
        known = self._tracks.known
        self._before = grey, self._tracks.points[known], self._tracks.pixels[known]

    def _more_corners(self, grey: Grey) -> Floats:
        lacking = self._settings.corners - len(self._tracks)
        return new_corners(grey, self._tracks.pixels, max(lacking, self._settings.corners // 10))

    def _place_new_landmarks(self) -> None:
        """Compute where corners are that by now were seen from places far enough apart."""
        tracks = self._tracks
        by_first: dict[int, list[int]] = {}
        for row in np.flatnonzero(~tracks.known).tolist():
            by_first.setdefault(min(tracks.views[row]), []).append(row)
        pose = self._poses[self._newest]
        for first, rows in by_first.items():
            if first == self._newest:
                continue
            before = self._poses[first]
            there = np.array([tracks.views[row][first] for row in rows])
            here = tracks.pixels[rows]
            a, b = rays(there, self._matrix), rays(here, self._matrix)
            points = triangulate(before, pose, a, b)
            good = parallax(before, pose, a, b) > self._settings.parallax
            for view, pixels in ((before, there), (pose, here)):
                good &= reprojection_errors(view, points, pixels, self._matrix) < _GOOD
            chosen = np.array(rows)[good]
            tracks.points[chosen] = points[good]

    def _adjust(self) -> None:
        """Adjust the last key frames and what they see."""
        window = sorted(self._poses)[-self._settings.keyframes :]
        if len(window) < 3:
            return
        index = {keyframe: i for i, keyframe in enumerate(window)}
        tracks = self._tracks
        self._past = [
            (point, views)
            for point, views in self._past
            if sum(keyframe in index for keyframe in views) > 1
        ]
        live = np.flatnonzero(tracks.known).tolist()
        all_views = [tracks.views[row] for row in live] + [views for _, views in self._past]
        points = np.concatenate(
            [tracks.points[live], np.array([p for p, _ in self._past]).reshape(-1, 3)]
        )
        frame, landmark, pixels = [], [], []
        for number, views in enumerate(all_views):
            for keyframe, pixel in views.items():
                if keyframe in index:
                    frame.append(index[keyframe])
                    landmark.append(number)
                    pixels.append(pixel)
        poses, points, errors = adjust(
            np.stack([self._poses[keyframe] for keyframe in window]),
            points,
            np.array(frame),
            np.array(landmark),
            np.array(pixels),
            self._matrix,
            fixed=2,
            noise=self._settings.pixel_noise,
        )
        for keyframe, pose in zip(window, poses, strict=True):
            self._poses[keyframe] = pose
        worst = np.zeros(len(points))
        np.maximum.at(worst, landmark, errors)
        good = worst < _GOOD
        tracks.points[live] = points[: len(live)]
        past = zip(points[len(live) :], self._past, good[len(live) :], strict=True)
        self._past = [(point, views) for point, (_, views), fits in past if fits]
        drop = np.zeros(len(tracks), np.bool_)
        drop[np.array(live, dtype=np.int64)[~good[: len(live)]]] = True
        tracks.points[drop] = np.nan
        tracks.keep(~drop)

    def _remember(self) -> None:
        """Keep the newest key frame for a camera that is lost one day."""
        known = self._tracks.known
        points, pixels = self._tracks.points[known], self._tracks.pixels[known]
        self._known.append(Keyframe(self._image, self._pose, points, pixels, np.ones(len(points))))

    # Lost.

    def _lose(self, stamp: int, grey: Grey, pixels: Floats) -> Tracked:
        """Look for a place that is known; after a while, begin a new map."""
        if self._lost_since is None:
            self._lost_since = stamp
        self._before = None
        reason = f"too few of {len(pixels)} corners agree, of {self._settings.least} needed"
        for frame in reversed(self._known):
            found = find_again(grey, frame, self._matrix)
            if found is not None:
                self._return_to(frame, found[0])
                break
        else:
            if stamp - self._lost_since >= self._settings.patience * SECOND:
                self._world = inverse(self._pose)
                self._beginning = Beginning(self._matrix, self._settings)
                self._known.clear()
        return Tracked(
            pose=inverse(self._pose),
            lost=True,
            reason=reason,
            points=pixels.astype(np.float32),
            inliers=np.zeros(len(pixels), np.bool_),
        )

    def _return_to(self, frame: Keyframe, pose: Floats) -> None:
        """Go on from a key frame that was found again; the next picture is followed from it."""
        self._newest += 1
        self._poses = {self._newest: frame.pose}
        self._past = []
        self._image, self._pose = frame.image, pose
        self._tracks = Tracks(frame.pixels, self._newest)
        self._tracks.points = frame.landmarks.copy()
