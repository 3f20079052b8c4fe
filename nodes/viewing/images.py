"""Which pictures are shown, and what is made of them: JPEG, PNG, points. No Rerun here."""

from __future__ import annotations

from collections import deque

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from events import CameraInfo, DepthImage, Image, PoseStamped
from events.poses import pose_matrix
from nodes.mapping.cloud import back_project, rays_of

SECOND = 1_000_000_000

CENTIMETRES = 100.0
"""Steps of a depth picture per metre. Finer ones would show noise, which makes files large."""

_REMEMBERED = 64
"""Pictures whose features may still come, for each camera."""


class Thinning:
    """Chooses pictures by their stamps, so that of one exposure all are kept or none.

    Args:
        rate: Pictures a second at most; 0: none.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._last: dict[tuple[str, str], int] = {}
        self._kept: dict[str, deque[int]] = {}

    def picture(self, kind: str, source: str, frame_id: str, stamp: int) -> bool:
        """Tell whether to keep a picture: it is the first of its source in its share of time."""
        if not self._rate:
            return False
        share = int(stamp * self._rate // SECOND)
        if self._last.get((kind, source)) == share:
            return False
        self._last[kind, source] = share
        self._kept.setdefault(frame_id, deque(maxlen=_REMEMBERED)).append(stamp)
        return True

    def belongs(self, frame_id: str, stamp: int) -> bool:
        """Tell whether a picture of this exposure was kept."""
        return stamp in self._kept.get(frame_id, ())


def jpeg(data: npt.NDArray[np.uint8], quality: int) -> bytes:
    """Return a picture, shape (h, w, 3) red, green, blue or (h, w) grey, as JPEG."""
    ordered = cv2.cvtColor(data, cv2.COLOR_RGB2BGR) if data.ndim == 3 else data
    _, coded = cv2.imencode(".jpg", ordered, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return coded.tobytes()


def depth_png(depth: npt.NDArray[np.float32]) -> bytes:
    """Return depth (metres, shape (h, w)) as PNG of 16 bits, centimetres; 0 where there is none."""
    steps = np.where(np.isfinite(depth), depth * np.float32(CENTIMETRES), 0.0)
    steps = np.where((steps >= 0) & (steps <= 65535), steps, 0.0)
    _, coded = cv2.imencode(
        ".png", np.round(steps).astype(np.uint16), [cv2.IMWRITE_PNG_COMPRESSION, 1]
    )
    return coded.tobytes()


class Points(msgspec.Struct, frozen=True, eq=False):
    """Coloured points in the world.

    Attributes:
        stamp: Of the exposure (ns).
        points: float32 metres, shape (n, 3), in the pose's parent frame.
        colours: uint8 red, green, blue, shape (n, 3).
    """

    stamp: int
    points: npt.NDArray[np.float32]
    colours: npt.NDArray[np.uint8]


class Surroundings:
    """Puts depth and colours of one camera into the world, now and then.

    Args:
        info: The camera.
        rate: Sets a second at most; 0: none.
        stride: Take every n-th pixel of every n-th row.
        reach: Metres; what is farther from the camera is left out.
        above: Metres; what is so much higher than the camera is left out.
    """

    def __init__(
        self, info: CameraInfo, rate: float, stride: int, reach: float, above: float
    ) -> None:
        self._rate, self._stride, self._reach, self._above = rate, stride, reach, above
        self._info = info
        self._rays = rays_of(info, stride)
        self._done = -1
        self._image: Image | None = None
        self._depth: DepthImage | None = None
        self._poses: deque[PoseStamped] = deque(maxlen=_REMEMBERED)

    def take(self, event: Image | DepthImage | PoseStamped) -> Points | None:
        """Take in what comes, and return the points if they are complete and due."""
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
        share = int(image.stamp * self._rate // SECOND)
        if pose is None or share == self._done or not self._rate:
            return None
        self._done = share
        return self._points(image, depth, pose)

    def _points(self, image: Image, depth: DepthImage, pose: PoseStamped) -> Points | None:
        pixels = slice(None, None, self._stride)
        size = (self._info.height, self._info.width)
        if depth.data.shape != size or image.data.shape[:2] != size:
            return None
        seen, where = back_project(depth.data[pixels, pixels], self._rays, self._reach)
        colours = image.data[pixels, pixels][where]
        if colours.ndim == 1:
            colours = np.repeat(colours[:, None], 3, axis=1)
        placed = pose_matrix(pose.position, pose.orientation)
        points = seen.astype(np.float64) @ placed[:3, :3].T + placed[:3, 3]
        low = points[:, 2] > pose.position[2] - self._above  # z points down
        return Points(image.stamp, points[low].astype(np.float32), colours[low])
