"""The map: its initialization from two views, the last key frames, their corners and points."""

from __future__ import annotations

import msgspec
import numpy as np
import numpy.typing as npt

from events.geometry import inverse
from nodes.estimators.images import Floats, Grey
from nodes.estimators.monocular_odometry.geometry import (
    Indices,
    Keyframe,
    MonocularSettings,
    adjust,
    hypotheses,
    new_corners,
    parallax,
    reprojection_errors,
    triangulate,
)
from nodes.estimators.optical_flow import follow_both_ways
from nodes.estimators.pose import rays, solve_pose

_SNAPSHOT = 5.0  # median motion between stored views, pixels
_GOOD = 2.0  # largest reprojection error of a corner in agreement with a motion, pixels


class InitialMap(msgspec.Struct, frozen=True, eq=False):
    """Two key frames and their common landmarks; the median depth from the first is 1."""

    first: Grey  # the first image; its camera is the world
    second: Floats  # pose of the second, world to camera, shape (4, 4)
    pixels: Floats  # pixels in the first and in the second image, shape (2, n, 2)
    points: Floats  # landmarks in the world, shape (n, 3)


class Initialization:
    """Follower of corners from a first image until there is a map."""

    def __init__(self, matrix: Floats, settings: MonocularSettings) -> None:
        self._matrix, self._settings = matrix, settings
        self._first: Grey | None = None
        self._before: Grey | None = None
        self._views: list[Floats] = []  # of the corners still followed; the first, …, the newest
        self._count = 0

    def add(self, image: Grey) -> InitialMap | None:
        """Add the next image, grey, or start again with it; return a map once available."""
        if self._first is None or self._before is None:
            self._restart(image)
            return None
        now = self._views[-1]
        if not len(now):
            self._restart(image)
            return None
        pixels, good = follow_both_ways(
            self._before, image, now, now, self._settings.window, self._settings.levels
        )
        self._before = image
        self._views = [view[good] for view in self._views]
        newest = pixels[good]
        if good.sum() < max(self._settings.min_inliers, 0.5 * self._count):
            self._restart(image)
            return None
        if len(self._views) > 1 and _median_shift(self._views[-2], newest) < _SNAPSHOT:
            self._views[-1] = newest
        else:
            self._views.append(newest)
        moved = _median_shift(self._views[0], newest)
        if moved < self._settings.keyframe_shift:
            return None
        built = self._build()
        if built is None and moved > 4 * self._settings.keyframe_shift:
            self._restart(image)
        return built

    def _restart(self, image: Grey) -> None:
        corners = new_corners(image, np.empty((0, 2)), self._settings.corners)
        self._first = self._before = image
        self._views = [corners]
        self._count = len(corners)

    def _build(self) -> InitialMap | None:
        """Try all motions between the first and newest view; return the best map."""
        first, *between, last = self._views
        assert self._first is not None
        best: tuple[float, Floats, Floats] | None = None
        a, b = rays(first, self._matrix), rays(last, self._matrix)
        for pose in hypotheses(first, last, self._matrix):
            points = triangulate(np.eye(4), pose, a, b)
            cost = self._cost(points, pose)
            if cost is not None and (best is None or cost < best[0]):
                best = cost, pose, points
        if best is None:
            return None
        _, pose, points = best
        fits = self._fits(points, pose)
        poses = [np.eye(4), pose]
        views = [first[fits], last[fits]]
        for view in between:
            poses.append(self._solve_pose(points[fits], view[fits]))
            views.append(view[fits])
        count = int(fits.sum())
        adjusted, points, errors = adjust(
            np.stack(poses),
            points[fits],
            np.tile(np.arange(len(poses)), count),
            np.repeat(np.arange(count), len(poses)),
            np.stack(views, axis=1).reshape(-1, 2),
            self._matrix,
            fixed=1,
            noise=self._settings.pixel_noise,
            steps=8,
        )
        good = errors.reshape(count, len(poses)).max(axis=1) < _GOOD
        second = adjusted[1]
        wide = parallax(np.eye(4), second, a[fits], b[fits]) > 0.5 * self._settings.min_parallax
        good &= (points[:, 2] > 0) & wide
        if good.sum() < max(self._settings.min_inliers, 0.4 * len(first)):
            return None
        unit = float(np.median(points[good, 2]))
        second[:3, 3] /= unit
        return InitialMap(
            self._first, second, np.stack([views[0][good], views[1][good]]), points[good] / unit
        )

    def _fits(self, points: Floats, pose: Floats) -> np.ndarray:
        first = reprojection_errors(np.eye(4), points, self._views[0], self._matrix)
        last = reprojection_errors(pose, points, self._views[-1], self._matrix)
        return np.asarray((first < _GOOD) & (last < _GOOD))

    def _cost(self, points: Floats, pose: Floats) -> float | None:
        """Return a motion's error over all views; `None` if too few corners agree."""
        fits = self._fits(points, pose)
        if fits.sum() < max(self._settings.min_inliers, 0.5 * len(points)):
            return None
        total = float(np.sum(~fits)) * _GOOD**2 * len(self._views)
        for view in self._views[1:]:
            view_pose = self._solve_pose(points[fits], view[fits])
            errors = reprojection_errors(view_pose, points[fits], view[fits], self._matrix)
            total += float(np.sum(np.minimum(errors, _GOOD) ** 2))
        return total

    def _solve_pose(self, points: Floats, pixels: Floats) -> Floats:
        noise = self._settings.pixel_noise
        return solve_pose(points, pixels, np.eye(4), self._matrix, noise)[0]


def _median_shift(before: Floats, after: Floats) -> float:
    return float(np.median(np.linalg.norm(after - before, axis=1)))


Mask = npt.NDArray[np.bool_]
View = tuple[float, float]


class Tracks:
    """Corners followed from image to image."""

    def __init__(self, pixels: Floats, keyframe: int) -> None:
        self.pixels = pixels  # column and row in the newest key frame, shape (n, 2)
        # Points in the world, shape (n, 3); not a number while they are unknown.
        self.points = np.full((len(pixels), 3), np.nan)
        # Pixels of each by key frame.
        self.views: list[dict[int, View]] = [{keyframe: (x, y)} for x, y in pixels.tolist()]

    def __len__(self) -> int:
        return len(self.pixels)

    @property
    def known(self) -> Mask:
        """Mask of corners with a known point in the world, shape (n,)."""
        return np.asarray(np.isfinite(self.points[:, 0]))

    def retain(self, rows: npt.NDArray[np.int64]) -> list[tuple[Floats, dict[int, View]]]:
        """Drop all other corners; return the points, if known, and views of those dropped."""
        retained = np.zeros(len(self), np.bool_)
        retained[rows] = True
        lost = np.flatnonzero(~retained & self.known)
        retired = [(self.points[row], self.views[row]) for row in lost.tolist()]
        self.drop(np.flatnonzero(~retained))
        return retired

    def drop(self, rows: npt.NDArray[np.int64]) -> None:
        """Stop following some corners."""
        remaining = np.ones(len(self), np.bool_)
        remaining[rows] = False
        self.views = [self.views[row] for row in np.flatnonzero(remaining).tolist()]
        self.pixels, self.points = self.pixels[remaining], self.points[remaining]

    def add_view(self, keyframe: int, pixels: Floats) -> None:
        """Add their pixels in a new key frame, shape (n, 2)."""
        self.pixels = pixels
        for views, (x, y) in zip(self.views, pixels.tolist(), strict=True):
            views[keyframe] = (x, y)

    def add(self, pixels: Floats, keyframe: int) -> None:
        """Start following new corners of a key frame, shape (m, 2)."""
        more = Tracks(pixels, keyframe)
        self.pixels = np.concatenate([self.pixels, more.pixels])
        self.points = np.concatenate([self.points, more.points])
        self.views += more.views


class LocalMap:
    """Key frames and landmarks; adding a key frame may remove the oldest."""

    def __init__(
        self,
        image: Grey,
        poses: list[Floats],
        tracks: Tracks,
        matrix: Floats,
        settings: MonocularSettings,
    ) -> None:
        self.image, self.tracks = image, tracks
        self._poses = dict(enumerate(poses))  # by key frame, world to camera
        # Landmarks that are no longer followed: point and views of each.
        self._past: list[tuple[Floats, dict[int, View]]] = []
        self._matrix, self._settings = matrix, settings

    @classmethod
    def first(
        cls,
        initial: InitialMap,  # in a frame and a unit of its own
        image: Grey,  # the second of its images, grey
        start: Floats,  # pose of its first camera: camera to world, shape (4, 4)
        unit: float,  # its unit of length in that of the world
        matrix: Floats,
        settings: MonocularSettings,
    ) -> LocalMap:
        """Make a map of its first two key frames."""
        second = initial.second.copy()
        second[:3, 3] *= unit
        tracks = Tracks(initial.pixels[0], 0)
        tracks.points = unit * initial.points @ start[:3, :3].T + start[:3, 3]
        tracks.add_view(1, initial.pixels[1])
        before = inverse(start)
        local_map = cls(image, [before, second @ before], tracks, matrix, settings)
        local_map._add_corners()
        return local_map

    @classmethod
    def around(cls, keyframe: Keyframe, matrix: Floats, settings: MonocularSettings) -> LocalMap:
        """Make a map of a single stored key frame."""
        tracks = Tracks(keyframe.pixels, 0)
        tracks.points = keyframe.landmarks.copy()
        return cls(keyframe.image, [keyframe.pose], tracks, matrix, settings)

    @property
    def keyframes(self) -> list[int]:
        """The numbers of the key frames, ascending."""
        return sorted(self._poses)

    @property
    def newest(self) -> int:
        """The number of the newest key frame."""
        return max(self._poses)

    @property
    def pose(self) -> Floats:
        """Pose of the newest key frame: world to camera, shape (4, 4)."""
        return self._poses[self.newest]

    @property
    def depth(self) -> float:
        """Median depth of the newest key frame's landmarks; 1 without any."""
        points = self.tracks.points[self.tracks.known]
        if not len(points):
            return 1.0
        return float(np.median((points @ self.pose[:3, :3].T + self.pose[:3, 3])[:, 2]))

    def keyframe(self) -> Keyframe:
        """Return the newest key frame, to be stored."""
        known = self.tracks.known
        points, pixels = self.tracks.points[known], self.tracks.pixels[known]
        return Keyframe(self.image, self.pose, points, pixels)

    def approximate_points(self) -> Floats:
        """Return the points of the corners, shape (n, 3); unknown ones at the median depth."""
        points, pose, unknown = self.tracks.points.copy(), self.pose, ~self.tracks.known
        in_camera = self.depth * rays(self.tracks.pixels[unknown], self._matrix)
        points[unknown] = (in_camera - pose[:3, 3]) @ pose[:3, :3]
        return points

    def add_keyframe(self, image: Grey, pose: Floats, rows: Indices, pixels: Floats) -> None:
        """Add an image as a key frame, and refine the map.

        Args:
            pose: World to camera, shape (4, 4).
            rows: Indices of the visible tracks, shape (n,), ascending.
            pixels: Their pixels, shape (n, 2).
        """
        number = self.newest + 1
        self._past += self.tracks.retain(rows)
        self._poses[number] = pose
        self.tracks.add_view(number, pixels)
        self.image = image
        self._triangulate()
        self._adjust()
        self._add_corners()
        self._remove_keyframes()

    def _add_corners(self) -> None:
        corners = self._settings.corners
        count = max(corners - len(self.tracks), corners // 10)
        self.tracks.add(new_corners(self.image, self.tracks.pixels, count), self.newest)

    def _triangulate(self) -> None:
        tracks, pose = self.tracks, self.pose
        by_first: dict[int, list[int]] = {}
        for row in np.flatnonzero(~tracks.known).tolist():
            by_first.setdefault(min(tracks.views[row]), []).append(row)
        for first, rows in by_first.items():
            before = self._poses[first]
            first_pixels = np.array([tracks.views[row][first] for row in rows])
            last_pixels = tracks.pixels[rows]
            a, b = rays(first_pixels, self._matrix), rays(last_pixels, self._matrix)
            points = triangulate(before, pose, a, b)
            good = parallax(before, pose, a, b) > self._settings.min_parallax
            for view, pixels in ((before, first_pixels), (pose, last_pixels)):
                good &= reprojection_errors(view, points, pixels, self._matrix) < _GOOD
            tracks.points[np.array(rows)[good]] = points[good]

    def _adjust(self) -> None:
        window = self.keyframes[-self._settings.keyframes :]
        if len(window) < 3:
            return
        index = {keyframe: i for i, keyframe in enumerate(window)}
        tracks = self.tracks
        self._past = [
            (point, views)
            for point, views in self._past
            if sum(keyframe in index for keyframe in views) > 1
        ]
        live = np.flatnonzero(tracks.known)
        all_views = [tracks.views[row] for row in live.tolist()]
        all_views += [views for _, views in self._past]
        past = np.array([point for point, _ in self._past]).reshape(-1, 3)
        frame, landmark, pixels = [], [], []
        for number, views in enumerate(all_views):
            for keyframe, pixel in views.items():
                if keyframe in index:
                    frame.append(index[keyframe])
                    landmark.append(number)
                    pixels.append(pixel)
        poses, points, errors = adjust(
            np.stack([self._poses[keyframe] for keyframe in window]),
            np.concatenate([tracks.points[live], past]),
            np.array(frame),
            np.array(landmark),
            np.array(pixels),
            self._matrix,
            fixed=2,
            noise=self._settings.pixel_noise,
        )
        self._poses.update(zip(window, poses, strict=True))
        worst = np.zeros(len(points))
        np.maximum.at(worst, landmark, errors)
        good = worst < _GOOD
        count = len(live)
        tracks.points[live] = points[:count]
        self._past = [
            (point, views)
            for point, (_, views), fits in zip(
                points[count:], self._past, good[count:], strict=True
            )
            if fits
        ]
        tracks.drop(live[~good[:count]])

    def _remove_keyframes(self) -> None:
        """Remove key frames neither adjusted any more nor needed by a track."""
        needed = {min(views) for views in self.tracks.views}
        needed.update(self.keyframes[-self._settings.keyframes :])
        self._poses = {number: pose for number, pose in self._poses.items() if number in needed}
