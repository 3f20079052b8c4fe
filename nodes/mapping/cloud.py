"""From depth to coloured points, and from many points to one in each voxel. Pure numpy.

A voxel holds one measured point, never a mean: the mean of points on both sides of an edge lies on
neither surface. Of several it holds the one that was measured from nearest, because whatever is
wrong with a point (noise of the depth, an angle, the size of a pixel) grows with the distance.
"""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import numpy.typing as npt

from events import CameraInfo
from nodes.mapping.ply import write_ply

Floats = npt.NDArray[np.float64]
Points = npt.NDArray[np.float32]
Colours = npt.NDArray[np.uint8]

_BITS = 21
"""Of a voxel's number along one axis; three of them make a key of 63."""


def rays_of(info: CameraInfo, stride: int) -> Points:
    """Return where the rays of every n-th pixel meet the plane at depth 1.

    Args:
        info: The camera.
        stride: n, along rows and columns alike.

    Returns:
        x and y in the optical frame, shape (ceil(height / n), ceil(width / n), 2); NaN where the
        ray does not meet it, as in the corners of a fisheye.
    """
    rows, columns = np.mgrid[0 : info.height : stride, 0 : info.width : stride]
    rays = info.unproject(np.stack([columns, rows], axis=-1).reshape(-1, 2))
    with np.errstate(divide="ignore", invalid="ignore"):
        met = np.where(rays[:, 2:] > 0.0, rays[:, :2] / rays[:, 2:], np.nan)
    return met.astype(np.float32).reshape(*rows.shape, 2)


def back_project(
    depth: Points, rays: Points, max_depth: float
) -> tuple[Points, npt.NDArray[np.bool_]]:
    """Return the points that a depth image shows.

    Args:
        depth: Metres along the optical z axis, shape (h, w).
        rays: From `rays_of`, shape (h, w, 2).
        max_depth: Metres; what is farther, or was not hit, is left out.

    Returns:
        Points in the optical frame, metres, shape (n, 3); and which pixels they are, shape (h, w).

    Raises:
        ValueError: The shapes do not fit.
    """
    if rays.shape != (*depth.shape, 2):
        raise ValueError(f"depth: expected shape {rays.shape[:2]}, found {depth.shape}")
    seen = (depth > 0.0) & (depth <= max_depth) & np.isfinite(rays[..., 0])
    z = depth[seen]
    return np.column_stack([rays[seen] * z[:, None], z]), seen


class VoxelCloud:
    """One point in each voxel of a grid.

    Args:
        voxel: Edge of a voxel, metres.

    Attributes:
        keys: Numbers of the voxels that hold a point, int64, rising, shape (n,).

    Raises:
        ValueError: The edge is not above zero.
    """

    def __init__(self, voxel: float) -> None:
        if not voxel > 0.0:
            raise ValueError(f"voxel: expected an edge above 0 m, found {voxel}")
        self.voxel = voxel
        self.keys = np.empty(0, np.int64)
        self._slots = np.empty(0, np.int64)
        self._points = np.empty((0, 3), np.float32)
        self._colours = np.empty((0, 3), np.uint8)
        self._distances = np.empty(0, np.float32)

    def __len__(self) -> int:
        return len(self.keys)

    @property
    def points(self) -> Points:
        """Metres, shape (n, 3), in the order in which the voxels were found. Not a copy."""
        return self._points[: len(self)]

    @property
    def colours(self) -> Colours:
        """Of the points: red, green, blue, shape (n, 3). Not a copy."""
        return self._colours[: len(self)]

    def add(self, points: Floats, colours: Colours, distances: Points) -> None:
        """Take in measured points.

        Args:
            points: Metres, shape (n, 3).
            colours: Shape (n, 3).
            distances: From where they were measured, metres, shape (n,).

        Raises:
            ValueError: A point is farther from the origin than voxels can be numbered.
        """
        keys = self._keys_of(points)
        order = np.lexsort((distances, keys))
        keys = keys[order]
        first = np.flatnonzero(np.diff(keys, prepend=-1))  # the nearest of each voxel
        keys, chosen = keys[first], order[first]
        places = np.searchsorted(self.keys, keys)
        known = np.zeros(len(keys), bool)
        inside = places < len(self)
        known[inside] = self.keys[places[inside]] == keys[inside]

        slots, candidates = self._slots[places[known]], chosen[known]
        nearer = distances[candidates] < self._distances[slots]
        self._put(slots[nearer], candidates[nearer], points, colours, distances)

        fresh = ~known
        slots = np.arange(len(self), len(self) + int(fresh.sum()))
        self._make_room(len(self) + len(slots))
        self._put(slots, chosen[fresh], points, colours, distances)
        self.keys = np.insert(self.keys, places[fresh], keys[fresh])
        self._slots = np.insert(self._slots, places[fresh], slots)

    def _keys_of(self, points: Floats) -> npt.NDArray[np.int64]:
        cells = np.floor(points / self.voxel)
        limit = 1 << (_BITS - 1)
        if not (np.abs(cells) < limit).all():
            raise ValueError(
                f"points: expected them within {limit * self.voxel:g} m of the origin, "
                f"found {points[np.abs(cells).max(axis=1).argmax()]}"
            )
        x, y, z = (cells.astype(np.int64) + limit).T
        return np.asarray(x << 2 * _BITS | y << _BITS | z)

    def _put(
        self,
        slots: npt.NDArray[np.int64],
        chosen: npt.NDArray[np.intp],
        points: Floats,
        colours: Colours,
        distances: Points,
    ) -> None:
        self._points[slots] = points[chosen]
        self._colours[slots] = colours[chosen]
        self._distances[slots] = distances[chosen]

    def _make_room(self, count: int) -> None:
        """Have slots for so many voxels; doubling keeps the copying in proportion."""
        if count > len(self._points):
            room = max(count, 2 * len(self._points), 4096)
            for name in ("_points", "_colours", "_distances"):
                old = getattr(self, name)
                new = np.empty((room, *old.shape[1:]), old.dtype)
                new[: len(self)] = old[: len(self)]
                setattr(self, name, new)


class Mapper:
    """Puts depth images into one cloud.

    Args:
        stride: The images that it is given are every n-th pixel of the camera's.
        voxel: Edge of a voxel, metres.
        max_depth: Metres; what is farther is left out.
    """

    def __init__(self, stride: int, voxel: float, max_depth: float) -> None:
        self._rays = functools.lru_cache(maxsize=4)(lambda info: rays_of(info, stride))
        self._max_depth = max_depth
        self._cloud = VoxelCloud(voxel)

    def add(
        self,
        info: CameraInfo,
        depth: npt.NDArray[np.float32],
        image: npt.NDArray[np.uint8],
        pose: npt.NDArray[np.float64],
    ) -> int:
        """Add what one exposure shows.

        Args:
            info: The camera.
            depth: Metres along the optical z axis, shape (h, w).
            image: Its colours, shape (h, w, 3), or greys, shape (h, w).
            pose: The optical frame in the cloud's, shape (4, 4).

        Returns:
            How many points the cloud has now.

        Raises:
            ValueError: The shapes do not fit, or the pose is out of this world.
        """
        if image.shape[:2] != depth.shape:
            raise ValueError(
                f"image: expected {depth.shape} pixels as of the depth, found {image.shape[:2]}"
            )
        points, seen = back_project(depth, self._rays(info), self._max_depth)
        colours = image[seen] if image.ndim == 3 else np.repeat(image[seen][:, None], 3, axis=1)
        placed = points @ pose[:3, :3].T + pose[:3, 3]
        self._cloud.add(placed, colours, points[:, 2])
        return len(self._cloud)

    def cloud(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint8]]:
        """Return points (metres) and colours, each of shape (n, 3)."""
        return self._cloud.points, self._cloud.colours

    def write(self, path: Path, frame_id: str) -> None:
        """Write the cloud as a PLY file."""
        write_ply(path, self._cloud.points, self._cloud.colours, frame_id)
