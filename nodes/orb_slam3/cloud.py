"""The points of ORB-SLAM3's maps, gathered from what each image shows of them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Points = npt.NDArray[np.float32]

CELL = 0.05
"""Metres; of each cell of this size, the last point that was seen is kept."""


class Cloud:
    """Points in the frame of the poses, by the map that they belong to.

    Args:
        cell: Metres.
    """

    def __init__(self, cell: float = CELL) -> None:
        self._cell = cell
        self._maps: dict[float, dict[tuple[int, ...], tuple[float, ...]]] = {}

    def __len__(self) -> int:
        return sum(map(len, self._maps.values()))

    def add(self, map_: float, points: Points) -> None:
        """Keep points of a map, shape (n, 3)."""
        cells = np.floor(points / self._cell).astype(np.int64).tolist()
        kept = self._maps.setdefault(map_, {})
        kept.update(zip(map(tuple, cells), map(tuple, points.tolist()), strict=True))

    def forget(self, map_: float) -> None:
        """Leave out the points of a map, which has turned out to lie elsewhere."""
        self._maps.pop(map_, None)

    def points(self) -> Points:
        """Return all points, shape (n, 3)."""
        points = [point for kept in self._maps.values() for point in kept.values()]
        return np.array(points, np.float32).reshape(-1, 3)
