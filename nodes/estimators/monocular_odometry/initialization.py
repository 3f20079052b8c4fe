"""Initialization: corners are followed until two views show how the camera has moved."""

from __future__ import annotations

import msgspec
import numpy as np

from nodes.estimators.monocular_odometry.bundle import adjust
from nodes.estimators.monocular_odometry.views import (
    MonocularSettings,
    hypotheses,
    new_corners,
    parallax,
    reprojection_errors,
    triangulate,
)
from nodes.estimators.odometry.images import Floats, Grey, follow_both_ways
from nodes.estimators.odometry.pose import Observations, rays, solve_pose

_SNAPSHOT = 5.0
"""Median pixels of motion between the views that are stored."""
_GOOD = 2.0
"""Pixels of reprojection error up to which a corner agrees with a motion."""


class InitialMap(msgspec.Struct, frozen=True, eq=False):
    """Two key frames and the landmarks that both see; the median depth from the first is 1.

    Attributes:
        first: The first image; its camera is the world.
        second: Pose of the second, world to camera, shape (4, 4).
        pixels: Pixels in the first and in the second image, shape (2, n, 2).
        points: Landmarks in the world, shape (n, 3).
    """

    first: Grey
    second: Floats
    pixels: Floats
    points: Floats


class Initialization:
    """Follows corners from a first image until there is a map.

    Args:
        matrix: K, shape (3, 3).
    """

    def __init__(self, matrix: Floats, settings: MonocularSettings) -> None:
        self._matrix = matrix
        self._settings = settings
        self._first: Grey | None = None
        self._before: Grey | None = None
        self._views: list[Floats] = []  # of the corners still followed; the first, …, the newest
        self._count = 0

    def add(self, image: Grey) -> InitialMap | None:
        """Add the next image, grey; return a map once there is one.

        It starts again with this image if too few corners are left, or if a long motion gave no
        map, as rotation alone does not.
        """
        if self._first is None or self._before is None:
            self._restart(image)
            return None
        now = self._views[-1]
        if not len(now):
            self._restart(image)
            return None
        there, good = follow_both_ways(
            self._before, image, now, now, self._settings.window, self._settings.levels
        )
        self._before = image
        self._views = [view[good] for view in self._views]
        newest = there[good]
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
        found = self._build()
        if found is None and moved > 4 * self._settings.keyframe_shift:
            self._restart(image)
        return found

    def _restart(self, image: Grey) -> None:
        corners = new_corners(image, np.empty((0, 2)), self._settings.corners)
        self._first = self._before = image
        self._views = [corners]
        self._count = len(corners)

    def _build(self) -> InitialMap | None:
        """Try all motions that the first and the newest view allow, and keep the best one."""
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
            poses.append(self._pose_of(points[fits], view[fits]))
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
        """Return the error of a motion over all views; `None` if too few corners agree with it."""
        fits = self._fits(points, pose)
        if fits.sum() < max(self._settings.min_inliers, 0.5 * len(points)):
            return None
        total = float(np.sum(~fits)) * _GOOD**2 * len(self._views)
        for view in self._views[1:]:
            seen = self._pose_of(points[fits], view[fits])
            errors = reprojection_errors(seen, points[fits], view[fits], self._matrix)
            total += float(np.sum(np.minimum(errors, _GOOD) ** 2))
        return total

    def _pose_of(self, points: Floats, pixels: Floats) -> Floats:
        seen = Observations.without_depth(points, pixels)
        return solve_pose(seen, np.eye(4), self._matrix, self._settings.pixel_noise, 1.0).pose


def _median_shift(before: Floats, after: Floats) -> float:
    return float(np.median(np.linalg.norm(after - before, axis=1)))
