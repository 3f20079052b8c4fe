"""A cloud that grows: an object for a process of its own, which holds it and writes it."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import numpy.typing as npt

from events import CameraInfo
from nodes.mapping.cloud import VoxelCloud, back_project, rays_of
from nodes.mapping.ply import write_ply


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
