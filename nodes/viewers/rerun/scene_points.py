"""Depth images with colours as points in the world. No Rerun here."""

from __future__ import annotations

from collections import deque

import msgspec
import numpy as np
import numpy.typing as npt

from events import CameraInfo, DepthImage, Image, PoseStamped
from events.poses import pose_matrix
from nodes.mapping.cloud import back_project, rays_of
from nodes.viewers.common.selection import REMEMBERED
from runtime.time.schedule import SECOND


class ColouredPoints(msgspec.Struct, frozen=True, eq=False):
    """Coloured points in the world.

    Attributes:
        stamp: Of the exposure (ns).
        points: float32 metres, shape (n, 3), in the pose's parent frame.
        colours: uint8 red, green, blue, shape (n, 3).
    """

    stamp: int
    points: npt.NDArray[np.float32]
    colours: npt.NDArray[np.uint8]


class ScenePoints:
    """Makes points in the world of the depth and colours of one camera, at a bounded rate.

    Args:
        info: The camera.
        rate: Sets a second at most; 0: none.
        stride: Take every n-th pixel of every n-th row.
        max_distance: Metres; what is farther from the camera is left out.
        max_height: Metres; what is so much higher than the camera is left out.
    """

    def __init__(
        self, info: CameraInfo, rate: float, stride: int, max_distance: float, max_height: float
    ) -> None:
        self._rate, self._stride = rate, stride
        self._max_distance, self._max_height = max_distance, max_height
        self._info = info
        self._rays = rays_of(info, stride)
        self._done = -1
        self._image: Image | None = None
        self._depth: DepthImage | None = None
        self._poses: deque[PoseStamped] = deque(maxlen=REMEMBERED)

    def take(self, event: Image | DepthImage | PoseStamped) -> ColouredPoints | None:
        """Take one of the three parts; return the points when all are there and a set is due."""
        match event:
            case Image():
                self._image = event
            case DepthImage():
                self._depth = event
            case PoseStamped():
                self._poses.append(event)
        image, depth = self._image, self._depth
        if image is None or depth is None or image.stamp != depth.stamp:
            return None
        pose = next((each for each in self._poses if each.stamp == image.stamp), None)
        period = int(image.stamp * self._rate // SECOND)
        if pose is None or period == self._done or not self._rate:
            return None
        self._done = period
        return self._points(image, depth, pose)

    def _points(self, image: Image, depth: DepthImage, pose: PoseStamped) -> ColouredPoints | None:
        pixels = slice(None, None, self._stride)
        size = (self._info.height, self._info.width)
        if depth.data.shape != size or image.data.shape[:2] != size:
            return None
        seen, where = back_project(depth.data[pixels, pixels], self._rays, self._max_distance)
        colours = image.data[pixels, pixels][where]
        if colours.ndim == 1:
            colours = np.repeat(colours[:, None], 3, axis=1)
        placed = pose_matrix(pose.position, pose.orientation)
        points = seen.astype(np.float64) @ placed[:3, :3].T + placed[:3, 3]
        low = points[:, 2] > pose.position[2] - self._max_height  # z points down
        return ColouredPoints(image.stamp, points[low].astype(np.float32), colours[low])
