"""The first map: corners are followed until two views tell how the camera has moved."""

from __future__ import annotations

import msgspec
import numpy as np

from nodes.monocular_odometry.bundle import adjust
from nodes.monocular_odometry.flow import follow_both_ways, new_corners
from nodes.monocular_odometry.settings import MonocularSettings
from nodes.monocular_odometry.views import (
    hypotheses,
    parallax,
    rays,
    reprojection_errors,
    triangulate,
)
from nodes.visual_odometry.pose import Observations, solve_pose
from nodes.visual_odometry.tracker import Floats, Grey

_SNAPSHOT = 5.0
"""Median pixels of motion between the views that are remembered on the way."""
_GOOD = 2.0
"""Pixels of reprojection error up to which a corner fits a motion."""


class FirstMap(msgspec.Struct, frozen=True, eq=False):
    """Two key frames and what both see; the median depth from the first is 1.

    Attributes:
        first: The first picture; its camera is the world.
        second: Pose of the second, world to camera, shape (4, 4).
        pixels: In the first and in the second picture, shape (2, n, 2).
        points: Landmarks in the world, shape (n, 3).
    """

    first: Grey
    second: Floats
    pixels: Floats
    points: Floats


class Beginning:
    """Follows corners from a first picture until there is a map.

    Args:
        matrix: K, shape (3, 3).
        settings: Of the odometry.
    """

    def __init__(self, matrix: Floats, settings: MonocularSettings) -> None:
        self._matrix = matrix
        self._settings = settings
        self._first: Grey | None = None
        self._before: Grey | None = None
        self._views: list[Floats] = []  # of the corners still followed; the first, …, the newest
        self._count = 0

    def see(self, image: Grey) -> FirstMap | None:
        """Take the next picture, grey; return a map once there is one.

        It begins again with this picture if too few corners are left, or if a long motion gave no
        map: turning alone does not.
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
        if good.sum() < max(self._settings.least, 0.5 * self._count):
            self._restart(image)
            return None
        if len(self._views) > 1 and _median_shift(self._views[-2], newest) < _SNAPSHOT:
            self._views[-1] = newest
        else:
            self._views.append(newest)
        moved = _median_shift(self._views[0], newest)
        if moved < self._settings.shift:
            return None
        found = self._build()
        if found is None and moved > 4 * self._settings.shift:
            self._restart(image)
        return found

    def _restart(self, image: Grey) -> None:
        corners = new_corners(image, np.empty((0, 2)), self._settings.corners)
        self._first = self._before = image
        self._views = [corners]
        self._count = len(corners)

    def _build(self) -> FirstMap | None:
        """Try all motions that the first and the newest view allow, and keep the one that fits."""
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
        wide = parallax(np.eye(4), second, a[fits], b[fits]) > 0.5 * self._settings.parallax
        good &= (points[:, 2] > 0) & wide
        if good.sum() < max(self._settings.least, 0.4 * len(first)):
            return None
        unit = float(np.median(points[good, 2]))
        second[:3, 3] /= unit
        return FirstMap(
            self._first, second, np.stack([views[0][good], views[1][good]]), points[good] / unit
        )

    def _fits(self, points: Floats, pose: Floats) -> np.ndarray:
        first = reprojection_errors(np.eye(4), points, self._views[0], self._matrix)
        last = reprojection_errors(pose, points, self._views[-1], self._matrix)
        return np.asarray((first < _GOOD) & (last < _GOOD))

    def _cost(self, points: Floats, pose: Floats) -> float | None:
        """Return how badly a motion explains all views, or `None` if it explains too little."""
        fits = self._fits(points, pose)
        if fits.sum() < max(self._settings.least, 0.5 * len(points)):
            return None
        total = float(np.sum(~fits)) * _GOOD**2 * len(self._views)
        for view in self._views[1:]:
            seen = self._pose_of(points[fits], view[fits])
            errors = reprojection_errors(seen, points[fits], view[fits], self._matrix)
            total += float(np.sum(np.minimum(errors, _GOOD) ** 2))
        return total

    def _pose_of(self, points: Floats, pixels: Floats) -> Floats:
        matrix = self._matrix
        camera = (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
        none = np.zeros(len(points))
        seen = Observations(points, pixels, none, none.astype(np.bool_))
        return solve_pose(seen, np.eye(4), camera, self._settings.pixel_noise, 1.0).pose


def _median_shift(before: Floats, after: Floats) -> float:
    return float(np.median(np.linalg.norm(after - before, axis=1)))
