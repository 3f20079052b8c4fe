"""The map: the last key frames, the corners followed from the newest one, and where they are.

Not here: where the camera is between key frames (`nodes.monocular_odometry.odometry`).
"""

from __future__ import annotations

import numpy as np

from events.poses import inverse
from nodes.monocular_odometry.beginning import FirstMap
from nodes.monocular_odometry.bundle import Indices, adjust
from nodes.monocular_odometry.flow import new_corners
from nodes.monocular_odometry.keyframes import Keyframe
from nodes.monocular_odometry.settings import MonocularSettings
from nodes.monocular_odometry.tracks import Tracks, View
from nodes.monocular_odometry.views import parallax, rays, reprojection_errors, triangulate
from nodes.visual_odometry.tracker import Floats, Grey

_GOOD = 2.0
"""Pixels of reprojection error up to which a landmark is kept."""


class LocalMap:
    """Key frames and landmarks; it grows by one key frame at a time and forgets the oldest.

    Attributes:
        image: Of the newest key frame, grey.
        tracks: The corners that are followed from it.
    """

    def __init__(
        self,
        image: Grey,
        poses: list[Floats],
        tracks: Tracks,
        matrix: Floats,
        settings: MonocularSettings,
    ) -> None:
        self.image = image
        self.tracks = tracks
        self._poses = dict(enumerate(poses))  # by key frame, world to camera
        self._past: list[
            tuple[Floats, dict[int, View]]
        ] = []  # landmarks out of sight: point, views
        self._matrix = matrix
        self._settings = settings

    @classmethod
    def first(
        cls,
        found: FirstMap,
        image: Grey,
        start: Floats,
        unit: float,
        matrix: Floats,
        settings: MonocularSettings,
    ) -> LocalMap:
        """Make a map of its first two key frames.

        Args:
            found: In a frame and a unit of its own.
            image: The second of its pictures, grey.
            start: Where its first camera is in the world: camera to world, shape (4, 4).
            unit: What its unit of length is in the world's.
            matrix: K, shape (3, 3).
            settings: Of the odometry.
        """
        second = found.second.copy()
        second[:3, 3] *= unit
        tracks = Tracks(found.pixels[0], 0)
        tracks.points = unit * found.points @ start[:3, :3].T + start[:3, 3]
        tracks.see(1, found.pixels[1])
        before = inverse(start)
        made = cls(image, [before, second @ before], tracks, matrix, settings)
        made._add_corners()
        return made

    @classmethod
    def around(cls, keyframe: Keyframe, matrix: Floats, settings: MonocularSettings) -> LocalMap:
        """Make a map of a single key frame that is remembered."""
        tracks = Tracks(keyframe.pixels, 0)
        tracks.points = keyframe.landmarks.copy()
        return cls(keyframe.image, [keyframe.pose], tracks, matrix, settings)

    @property
    def keyframes(self) -> list[int]:
        """The numbers of the key frames that are remembered, rising."""
        return sorted(self._poses)

    @property
    def newest(self) -> int:
        """The number of the newest key frame."""
        return max(self._poses)

    @property
    def pose(self) -> Floats:
        """The newest key frame's: world to camera, shape (4, 4)."""
        return self._poses[self.newest]

    @property
    def depth(self) -> float:
        """The median depth of the landmarks that the newest key frame sees; 1 if it sees none."""
        points = self.tracks.points[self.tracks.known]
        if not len(points):
            return 1.0
        return float(np.median((points @ self.pose[:3, :3].T + self.pose[:3, 3])[:, 2]))

    def keyframe(self) -> Keyframe:
        """Return the newest key frame, to be remembered."""
        known = self.tracks.known
        points, pixels = self.tracks.points[known], self.tracks.pixels[known]
        return Keyframe(self.image, self.pose, points, pixels)

    def supposed(self) -> Floats:
        """Return where corners are, shape (n, 3): as if at the median depth, if that is unknown."""
        points, pose, unknown = self.tracks.points.copy(), self.pose, ~self.tracks.known
        seen = self.depth * rays(self.tracks.pixels[unknown], self._matrix)
        points[unknown] = (seen - pose[:3, 3]) @ pose[:3, :3]
        return points

    def add_keyframe(self, image: Grey, pose: Floats, rows: Indices, pixels: Floats) -> None:
        """Take a picture as a key frame, and know all better by it.

        Args:
            image: Grey.
            pose: World to camera, shape (4, 4).
            rows: Which of the tracks it shows, shape (n,), rising.
            pixels: Where it shows them, shape (n, 2).
        """
        number = self.newest + 1
        self._past += self.tracks.keep(rows)
        self._poses[number] = pose
        self.tracks.see(number, pixels)
        self.image = image
        self._place_landmarks()
        self._adjust()
        self._add_corners()
        self._forget()

    def _add_corners(self) -> None:
        wanted = self._settings.corners
        count = max(wanted - len(self.tracks), wanted // 10)
        self.tracks.add(new_corners(self.image, self.tracks.pixels, count), self.newest)

    def _place_landmarks(self) -> None:
        """Compute where corners are that by now were seen from places far enough apart."""
        tracks, pose = self.tracks, self.pose
        by_first: dict[int, list[int]] = {}
        for row in np.flatnonzero(~tracks.known).tolist():
            by_first.setdefault(min(tracks.views[row]), []).append(row)
        for first, rows in by_first.items():
            before = self._poses[first]
            there = np.array([tracks.views[row][first] for row in rows])
            here = tracks.pixels[rows]
            a, b = rays(there, self._matrix), rays(here, self._matrix)
            points = triangulate(before, pose, a, b)
            good = parallax(before, pose, a, b) > self._settings.parallax
            for view, pixels in ((before, there), (pose, here)):
                good &= reprojection_errors(view, points, pixels, self._matrix) < _GOOD
            tracks.points[np.array(rows)[good]] = points[good]

    def _adjust(self) -> None:
        """Adjust the last key frames and what they see."""
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

    def _forget(self) -> None:
        """Forget key frames that are neither adjusted any more nor needed by a track."""
        needed = {min(views) for views in self.tracks.views}
        needed.update(self.keyframes[-self._settings.keyframes :])
        self._poses = {number: pose for number, pose in self._poses.items() if number in needed}
