"""AirSim's types of image, made of what a camera sees: colours, depth and object numbers.

As numbers, the types that are coloured give their red channel, 0 to 1. As colours, the types that
are numbers are greys from black, 0, to white, 1 and more. Where nothing is, as in the sky, depth
is `SKY`, the ID is 0, and there is no normal.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Literal, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from events import CameraInfo
from sims.airsim import wire
from sims.cameras.stage import Colours, Depths, Floats
from sims.cameras.view import Drawn

Form = Literal["float", "rgb", "bgr", "png"]

SKY = 65504.0
"""Depth where nothing is, metres: the greatest half float, which AirSim sends there."""

FARTHEST_VISIBLE = 100.0
"""Depth from which on DepthVis is white, metres."""

BASELINE = 0.25
"""Distance of AirSim's default stereo cameras, to which disparities are referred, metres."""


class ImageType(IntEnum):
    """The types that are drawn here, by AirSim's numbers.

    Attributes:
        SCENE: Colours.
        DEPTH_PLANAR: Metres along the optical axis.
        DEPTH_PERSPECTIVE: Metres along each pixel's ray.
        DEPTH_VIS: Planar depth as a share of 100 m, at most 1.
        DISPARITY: Disparity of cameras 0.25 m apart as a share of the image's width, at most 1.
        SEGMENTATION: Colour of the object's segmentation ID, by `palette`.
        SURFACE_NORMALS: Normal n towards the camera, in ``map``: red is (n_north + 1) / 2, green
            that of n_east, blue that of n_down; black where nothing is.
        INFRARED: The object's segmentation ID as a grey level.
    """

    SCENE = 0
    DEPTH_PLANAR = 1
    DEPTH_PERSPECTIVE = 2
    DEPTH_VIS = 3
    DISPARITY = 4
    SEGMENTATION = 5
    SURFACE_NORMALS = 6
    INFRARED = 7


OF_DEPTH = frozenset({1, 2, 3, 4, 6})
"""Types that are made of depth."""

OF_NUMBERS = frozenset({5, 7})
"""Types that are made of object numbers."""


class Seen(NamedTuple):
    """What a camera sees, and what is known of it.

    Attributes:
        drawn: Colours, depth and object numbers, as far as they are needed.
        info: The camera's intrinsics.
        ids: Segmentation ID of each object number, and last of nothing, shape (n + 1,).
        turn: Rotation from the optical frame to ``map``, shape (3, 3).
    """

    drawn: Drawn
    info: CameraInfo
    ids: npt.NDArray[np.uint8]
    turn: Floats


def palette() -> Colours:
    """Return the colour of each segmentation ID, RGB, shape (256, 3).

    Bits 0, 3 and 6 of an ID are the highest bits of red, the lowest one first; bits 1, 4 and 7
    those of green; bits 2 and 5 those of blue. This is the colour map of PASCAL VOC (M. Everingham,
    J. Winn, "The PASCAL Visual Object Classes Challenge 2012 Development Kit"); AirSim's differs.
    """
    ids, colours = np.arange(256), np.zeros((256, 3), np.uint8)
    for bit in range(8):
        colours[:, bit % 3] |= ((ids >> bit & 1) << (7 - bit // 3)).astype(np.uint8)
    return colours


_PALETTE = palette()


def packed(kind: ImageType, seen: Seen, form: Form) -> npt.NDArray[np.uint8]:
    """Return an image as it is sent.

    Args:
        kind: Its type.
        seen: What it is made of.
        form: ``float``: an array of msgpack; ``rgb`` or ``bgr``: three bytes for each pixel, rows
            from the top; ``png``: a PNG with red, green, blue and an alpha of 255.
    """
    if form == "float":
        return np.frombuffer(wire.float_array(as_numbers(kind, seen)), np.uint8)
    colours = as_colours(kind, seen)
    if form == "png":
        opaque = cv2.cvtColor(colours, cv2.COLOR_RGB2BGRA)  # OpenCV's own order
        return cv2.imencode(".png", opaque, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].ravel()
    return np.ascontiguousarray(colours if form == "rgb" else colours[..., ::-1]).ravel()


def as_numbers(kind: ImageType, seen: Seen) -> Depths:
    """Return an image as numbers, shape (h, w)."""
    depth, info = seen.drawn.depth, seen.info
    if kind not in OF_DEPTH or kind is ImageType.SURFACE_NORMALS or depth is None:
        return np.asarray(as_colours(kind, seen)[..., 0] / 255.0, np.float32)
    if kind is ImageType.DEPTH_PERSPECTIVE:
        columns, rows = _slopes(info)
        depth = depth * np.sqrt(1.0 + columns**2 + rows**2)
    depth = np.minimum(depth, SKY)
    if kind is ImageType.DEPTH_VIS:
        depth = np.minimum(depth / FARTHEST_VISIBLE, 1.0)
    elif kind is ImageType.DISPARITY:
        depth = np.minimum(BASELINE * info.fx / info.width / depth, 1.0)
    return np.asarray(depth, np.float32)


def as_colours(kind: ImageType, seen: Seen) -> Colours:
    """Return an image as colours, RGB, shape (h, w, 3)."""
    colours, depth, numbers = seen.drawn
    if kind is ImageType.SCENE and colours is not None:
        return colours
    if kind in OF_NUMBERS and numbers is not None:
        grey = seen.ids[numbers]  # the number of nothing is -1
        if kind is ImageType.SEGMENTATION:
            return np.asarray(_PALETTE[grey])
    elif kind is ImageType.SURFACE_NORMALS and depth is not None:
        turned = surface_normals(depth, seen.info) @ seen.turn.T.astype(np.float32)
        levels = np.rint((turned + np.float32(1.0)) * np.float32(127.5))
        return np.where(np.isfinite(depth)[..., None], levels, 0.0).astype(np.uint8)
    else:
        grey = np.rint(np.minimum(as_numbers(kind, seen), 1.0) * 255.0).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=-1)


def surface_normals(depth: Depths, info: CameraInfo) -> Depths:
    """Return the unit normals, towards the camera, in its optical frame, shape (h, w, 3).

    On a plane the inverse of the depth is affine in the pixel, and its gradient gives the normal.
    Where nothing is they mean nothing.

    Args:
        depth: Planar depth, metres, shape (h, w); ``inf`` where nothing is.
        info: The camera's intrinsics.
    """
    inverse = np.reciprocal(depth)
    columns, rows = _slopes(info)
    across = np.float32(info.fx) * _slope_along(inverse)
    down = np.float32(info.fy) * _slope_along(inverse.T).T
    inward = np.stack([across, down, inverse - columns * across - rows * down], axis=-1)
    length = np.sqrt(np.einsum("ijk,ijk->ij", inward, inward))[..., None]
    return np.asarray(-inward / np.maximum(length, np.finfo(np.float32).tiny))


def _slope_along(values: Depths) -> Depths:
    """Return the differences of each value in a row to the last or to the next one.

    Of the two it is the one that changes less further on: at the edge of an object that is on the
    side of the pixel's own surface.
    """
    if values.shape[1] < 2:
        return np.zeros_like(values)
    steps = np.pad(np.diff(values), ((0, 0), (2, 2)), "edge")
    bends = np.abs(np.diff(steps))
    return np.where(bends[:, :-2] <= bends[:, 2:], steps[:, 1:-2], steps[:, 2:-1])


def _slopes(info: CameraInfo) -> tuple[Depths, Depths]:
    """Return x/z of each column, shape (w,), and y/z of each row, shape (h, 1)."""
    columns = (np.arange(info.width) - info.cx) / info.fx
    rows = (np.arange(info.height)[:, None] - info.cy) / info.fy
    return columns.astype(np.float32), rows.astype(np.float32)
