"""Rectification: images of distorting lenses as pinhole images; stereo pairs row-aligned.

A single camera keeps optical axis, principal point and size. Both eyes of a stereo rig get one
orientation: x from the left to the right one, z between both optical axes (A. Fusiello et al., "A
compact algorithm for rectification of stereo pairs", 2000), and one matrix: disparity is f ·
baseline / z. **The focal length** is the shortest, of square pixels, without black pixels in the
new image, at most `WIDEST` across: the middle keeps about its resolution, the rim of a wide lens is
cut off. A lens with less than a quarter left is refused.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any, TypeVar

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from events import CameraAnnouncement, CameraInfo, DepthImage, Event, Image
from events.geometry import pose_matrix, pose_tuples

Floats = npt.NDArray[np.float64]
F = TypeVar("F", bound=tuple[Any, ...] | Event)
WIDEST = math.radians(110.0)  # greatest field of view of a new image, along its longer side
ALIGNED = 0.1  # largest violation of the rule above by a point's images in a rectified pair, pixels
_NO_MAP: Any = None  # both coordinates stand in one
_NARROWEST = 2.0  # largest ratio of the new focal length to the old


class Eye(msgspec.Struct, frozen=True, dict=True, eq=False):
    """A camera and its pinhole replacement."""

    lens: CameraInfo
    pinhole: CameraInfo  # intrinsics of the rectified images
    turn: Floats  # rotation from the rectified to the announced optical frame, shape (3, 3)

    def original(self, pixels: npt.ArrayLike) -> Floats:
        """Return the announced camera's pixels, NaN outside, of rectified pixels, shape (n, 2)."""
        uv = np.asarray(pixels, np.float64).reshape(-1, 2)
        info = self.pinhole
        x, y = (uv - (info.cx, info.cy)).T / [[info.fx], [info.fy]]
        return self.lens.project(np.column_stack([x, y, np.ones(len(uv))]) @ self.turn.T)

    @cached_property
    def _map(self) -> npt.NDArray[np.float32]:
        """Pixel in the lens's image of each new pixel, shape (h, w, 2)."""
        rows, columns = np.mgrid[0 : self.pinhole.height, 0 : self.pinhole.width]
        places = self.original(np.column_stack([columns.ravel(), rows.ravel()]))
        # Far outside where there is nothing.
        return np.nan_to_num(places, nan=-100.0).astype(np.float32).reshape(*rows.shape, 2)

    @cached_property
    def _fixed(self) -> Any:
        return cv2.convertMaps(self._map, _NO_MAP, cv2.CV_16SC2)

    def rectify(self, event: Image | DepthImage) -> Image | DepthImage:
        """Return an image as taken by the pinhole camera.

        Depth is the nearest pixel's, along the optical axis, so this is for depth only if the axis
        stays.

        Raises:
            ValueError: The image is not of the announced size.
        """
        height, width = event.data.shape[:2]
        if (width, height) != (self.lens.width, self.lens.height):
            raise ValueError(
                f"{event.source}: expected {self.lens.width}×{self.lens.height} pixels, as the "
                f"camera announced, found {width}×{height}"
            )
        if isinstance(event, DepthImage):
            data: Any = cv2.remap(
                event.data, self._map, _NO_MAP, cv2.INTER_NEAREST, borderValue=math.inf
            )
        else:
            places, shares = self._fixed
            data = cv2.remap(event.data, places, shares, cv2.INTER_LINEAR)
        return msgspec.structs.replace(event, data=data)

    def __str__(self) -> str:
        info, lens = self.pinhole, self.lens
        model = "pinhole"
        if not lens.is_pinhole:
            coefficients = ", ".join(f"{value:.3g}" for value in lens.distortion)
            model = f"{lens.distortion_model} with {coefficients}"
        across, down = (
            math.degrees(2 * math.atan(n / 2 / info.fx)) for n in (info.width, info.height)
        )
        return f"{model} to pinhole, focal length {info.fx:.1f} px, {across:.0f}° × {down:.0f}°"


class Rectification:
    """The pinhole cameras in the place of a camera, or of both eyes of a stereo rig.

    Args:
        cameras: One, or the left and the right one.

    Raises:
        ValueError: No pinhole image shows enough, or both eyes are not side by side; says why.
    """

    def __init__(self, cameras: Sequence[CameraAnnouncement]) -> None:
        first = cameras[0].info
        poses = [pose_matrix(camera.position, camera.orientation) for camera in cameras]
        common = poses[0][:3, :3] if len(poses) == 1 else _common_axes(cameras, poses)
        turns = [matrix[:3, :3].T @ common for matrix in poses]
        info = CameraInfo(
            width=first.width,
            height=first.height,
            fx=1.0,
            fy=1.0,
            cx=float(np.mean([camera.info.cx for camera in cameras])),
            cy=float(np.mean([camera.info.cy for camera in cameras])),
        )
        lenses = [camera.info for camera in cameras]
        focal = _focal(info, list(zip(lenses, turns, strict=True)))
        info = msgspec.structs.replace(info, fx=focal, fy=focal)
        self.eyes = tuple(Eye(lens, info, t) for lens, t in zip(lenses, turns, strict=True))
        frame = np.eye(4)
        frame[:3, :3] = common
        orientation = pose_tuples(frame)[1]
        self.cameras = tuple(
            msgspec.structs.replace(c, info=info, orientation=orientation) for c in cameras
        )  # the same with the pinhole cameras' intrinsics and orientations

    def frame(self, frame: F) -> F:
        """Return a frame, or a single image, with rectified images.

        Of a stereo rig the right eye's are those of the field `right`.
        """
        value: Any = frame
        rectified: Any
        if isinstance(value, Event):
            right = len(self.cameras) > 1 and value.source.startswith(self.cameras[1].source)
            rectified = self.eyes[right].rectify(value)  # type: ignore[arg-type]
        else:
            rectified = type(value)._make(
                self.eyes[name == "right"].rectify(part)
                if isinstance(part, Image | DepthImage)
                else part
                for name, part in zip(value._fields, value, strict=True)
            )
        result: F = rectified
        return result


def misalignment(left: CameraAnnouncement, right: CameraAnnouncement) -> float:
    """Return the largest row or disparity error (px) of a pinhole pair; ``inf`` if incomparable."""
    info = left.info
    if (info.width, info.height) != (right.info.width, right.info.height):
        return math.inf
    u, v, z = np.meshgrid([0, info.width - 1], [0, info.height - 1], [1.0, 1e9])
    pixels = np.column_stack([u.ravel(), v.ravel()])
    rays = info.unproject(pixels)
    points = rays / rays[:, 2:] * z.reshape(-1, 1)
    places = [pose_matrix(camera.position, camera.orientation) for camera in (left, right)]
    across = np.linalg.inv(places[1]) @ places[0]
    projected = right.info.project(points @ across[:3, :3].T + across[:3, 3])
    shift = info.fx * math.dist(left.position, right.position) / z.ravel()
    off = np.abs(projected - np.column_stack([pixels[:, 0] - shift, pixels[:, 1]])).max()
    return float(off) if np.isfinite(off) else math.inf


def _common_axes(cameras: Sequence[CameraAnnouncement], poses: Sequence[Floats]) -> Floats:
    """Return the common axes (right, down, ahead; columns) of both eyes, shape (3, 3)."""
    x = poses[1][:3, 3] - poses[0][:3, 3]
    length = float(np.linalg.norm(x))
    ahead = poses[0][:3, 2] + poses[1][:3, 2]
    rights = min(float(x @ pose[:3, 0]) for pose in poses)
    if length == 0.0 or rights < 0.5 * length or poses[0][:3, 2] @ poses[1][:3, 2] < 0.5:
        raise ValueError(
            f"expected {cameras[1].source} to the right of {cameras[0].source}, and both to look "
            "the same way, found other poses"
        )
    x = x / length
    z = ahead - (ahead @ x) * x
    z /= np.linalg.norm(z)
    return np.column_stack([x, np.cross(z, x), z])


def _focal(info: CameraInfo, eyes: list[tuple[CameraInfo, Floats]]) -> float:
    """Return the shortest focal length without empty pixels in the eyes' new images."""
    across, down = np.arange(info.width), np.arange(info.height)
    rim = np.concatenate(
        [np.column_stack([across, np.full_like(across, v)]) for v in (0, info.height - 1)]
        + [np.column_stack([np.full_like(down, u), down]) for u in (0, info.width - 1)]
    )

    def is_full(focal: float) -> bool:
        pinhole = msgspec.structs.replace(info, fx=focal, fy=focal)
        for lens, turn in eyes:
            places = Eye(lens, pinhole, turn).original(rim)
            size = lens.width - 1, lens.height - 1
            if not ((places >= 0).all() and (places <= size).all()):
                return False
        return True

    lens = eyes[0][0]
    low = (max(info.width, info.height) - 1) / 2 / math.tan(WIDEST / 2)
    high = _NARROWEST * max(lens.fx, lens.fy, low)
    if is_full(low):
        return low
    if not is_full(high):
        raise ValueError(
            "expected a lens of which a pinhole image can show a quarter or more, found "
            f"{lens.distortion_model} with {', '.join(f'{k:g}' for k in lens.distortion)}, focal "
            f"length {lens.fx:g} px and {lens.width}×{lens.height} pixels"
        )
    while high - low > 1e-3 * low:
        middle = (low + high) / 2
        low, high = (low, middle) if is_full(middle) else (middle, high)
    return high
