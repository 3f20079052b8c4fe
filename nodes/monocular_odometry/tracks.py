"""Corners followed through key frames: their pixels in each, and their points in the world."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nodes.odometry.images import Floats

Mask = npt.NDArray[np.bool_]
View = tuple[float, float]


class Tracks:
    """Corners that are followed.

    Attributes:
        pixels: Column and row in the newest key frame, shape (n, 2).
        points: Points in the world, shape (n, 3); not a number while they are unknown.
        views: Pixels of each by key frame.
    """

    def __init__(self, pixels: Floats, keyframe: int) -> None:
        self.pixels = pixels
        self.points = np.full((len(pixels), 3), np.nan)
        self.views: list[dict[int, View]] = [{keyframe: (x, y)} for x, y in pixels.tolist()]

    def __len__(self) -> int:
        return len(self.pixels)

    @property
    def known(self) -> Mask:
        """Which have a known point in the world, shape (n,)."""
        return np.asarray(np.isfinite(self.points[:, 0]))

    def keep(self, rows: npt.NDArray[np.int64]) -> list[tuple[Floats, dict[int, View]]]:
        """Keep some; return points and views of those others whose point is known."""
        kept = np.zeros(len(self), np.bool_)
        kept[rows] = True
        gone = np.flatnonzero(~kept & self.known)
        retired = [(self.points[row], self.views[row]) for row in gone.tolist()]
        self.drop(np.flatnonzero(~kept))
        return retired

    def drop(self, rows: npt.NDArray[np.int64]) -> None:
        """Follow some no longer."""
        kept = np.ones(len(self), np.bool_)
        kept[rows] = False
        self.views = [self.views[row] for row in np.flatnonzero(kept).tolist()]
        self.pixels, self.points = self.pixels[kept], self.points[kept]

    def add_view(self, keyframe: int, pixels: Floats) -> None:
        """Add their pixels in a new key frame, shape (n, 2)."""
        self.pixels = pixels
        for views, (x, y) in zip(self.views, pixels.tolist(), strict=True):
            views[keyframe] = (x, y)

    def add(self, pixels: Floats, keyframe: int) -> None:
        """Begin to follow new corners of a key frame, shape (m, 2)."""
        more = Tracks(pixels, keyframe)
        self.pixels = np.concatenate([self.pixels, more.pixels])
        self.points = np.concatenate([self.points, more.points])
        self.views += more.views
