"""AirSim's types of image, and the worker process to draw clients' images.

As numbers, coloured types give their red channel, 0 to 1; as colours, types of numbers are greys
from black, 0, to white, 1 and more. Where nothing is, depth is `SKY`, the ID 0, without normal.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from functools import cached_property, partial
from typing import Any, Literal, NamedTuple

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from events import CameraInfo
from events.base import Quaternion, Vector3
from events.frames import OPTICAL_TO_FRD, flip_yz, flip_yz_rotation, multiply
from events.geometry import pose_matrix
from sims.cameras.packed import Packed
from sims.cameras.renderer import open_stage, opened
from sims.cameras.spec import CameraSpec, camera_info, is_plain, vertical_fov
from sims.cameras.stage import (
    Changing,
    Colours,
    Depths,
    Drawn,
    Floats,
    RendererName,
    Stage,
    View,
    keep_memory,
)
from visnav_airsim import wire

Form = Literal["float", "rgb", "bgr", "png"]
Mount = tuple[Vector3, Quaternion]
"""Position on the body, metres FRD, and rotation of the camera's axes (FRD) to the body's."""

SKY = 65504.0  # metres where nothing is: the greatest half float, which AirSim sends there
FARTHEST_VISIBLE = 100.0  # metres from which on DepthVis is white
BASELINE = 0.25  # metres between AirSim's default stereo cameras, to which disparities are referred


class ImageType(IntEnum):
    """Image types drawn here, by AirSim's numbers."""

    SCENE = 0  # colours
    DEPTH_PLANAR = 1  # metres along the optical axis
    DEPTH_PERSPECTIVE = 2  # metres along each pixel's ray
    DEPTH_VIS = 3  # planar depth as a share of 100 m, at most 1
    DISPARITY = 4  # disparity of cameras 0.25 m apart as a share of the image's width, at most 1
    SEGMENTATION = 5  # colour of the object's segmentation ID, by `palette`
    # Normal n towards the camera, in ``map``: red is (n_north + 1) / 2, green that of n_east, blue
    # that of n_down; black where nothing is.
    SURFACE_NORMALS = 6
    INFRARED = 7  # the object's segmentation ID as a grey level


OF_DEPTH = frozenset({1, 2, 3, 4, 6})  # types that are made of depth
OF_NUMBERS = frozenset({5, 7})  # types that are made of object numbers


class Seen(NamedTuple):
    """View of a camera, with its calibration, IDs and orientation."""

    drawn: Drawn  # colours, depth and object numbers, as far as they are needed
    info: CameraInfo
    # Segmentation ID of each object number, and last of nothing, shape (n + 1,).
    ids: npt.NDArray[np.uint8]
    turn: Floats  # rotation from the optical frame to ``map``, shape (3, 3)


def palette() -> Colours:
    """Return the colour of each segmentation ID, RGB, shape (256, 3): PASCAL VOC's colour map.

    Bits 0, 3 and 6 of an ID are the highest bits of red, the lowest one first; bits 1, 4 and 7
    those of green; bits 2 and 5 those of blue (M. Everingham, J. Winn, "The PASCAL Visual Object
    Classes Challenge 2012 Development Kit"); AirSim's differs.
    """
    ids, colours = np.arange(256), np.zeros((256, 3), np.uint8)
    for bit in range(8):
        colours[:, bit % 3] |= ((ids >> bit & 1) << (7 - bit // 3)).astype(np.uint8)
    return colours


_SHADES = {
    ImageType.SEGMENTATION: palette(),
    ImageType.INFRARED: np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1),
}
"""Colour of each segmentation ID, RGB, shape (256, 3), by type of image."""


def packed(kind: ImageType, view: Seen, form: Form) -> npt.NDArray[np.uint8]:
    """Return an image encoded for sending.

    Args:
        form: ``float``: an array of msgpack; ``rgb`` or ``bgr``: three bytes for each pixel, rows
            from the top; ``png``: a PNG with red, green, blue and an alpha of 255.
    """
    if form == "float":
        return np.frombuffer(wire.float_array(as_numbers(kind, view)), np.uint8)
    colours = as_colours(kind, view)
    if form == "png":
        opaque = cv2.cvtColor(colours, cv2.COLOR_RGB2BGRA)  # OpenCV's own order
        png = cv2.imencode(".png", opaque, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
        return np.asarray(png, np.uint8).ravel()
    if form == "bgr":
        colours = np.asarray(cv2.cvtColor(colours, cv2.COLOR_RGB2BGR), np.uint8)
    return colours.ravel()


def as_numbers(kind: ImageType, view: Seen) -> Depths:
    """Return an image as numbers, shape (h, w)."""
    depth, info = view.drawn.depth, view.info
    if kind not in OF_DEPTH or kind is ImageType.SURFACE_NORMALS or depth is None:
        return np.asarray(as_colours(kind, view)[..., 0] / 255.0, np.float32)
    if kind is ImageType.DEPTH_PERSPECTIVE:
        columns, rows = _slopes(info)
        depth = depth * np.sqrt(1.0 + columns**2 + rows**2)
    depth = np.minimum(depth, SKY)
    if kind is ImageType.DEPTH_VIS:
        depth = np.minimum(depth / FARTHEST_VISIBLE, 1.0)
    elif kind is ImageType.DISPARITY:
        depth = np.minimum(BASELINE * info.fx / info.width / depth, 1.0)
    return np.asarray(depth, np.float32)


def as_colours(kind: ImageType, view: Seen) -> Colours:
    """Return an image as colours, RGB, shape (h, w, 3)."""
    colours, depth, numbers = view.drawn
    if kind is ImageType.SCENE and colours is not None:
        return colours
    if kind in OF_NUMBERS and numbers is not None:
        shades = np.pad(_SHADES[kind][view.ids], ((0, 0), (0, 1)))  # a word each: that is quicker
        words = np.take(shades.view(np.uint32), numbers, mode="wrap")  # that of nothing is -1
        pixels = words.view(np.uint8).reshape(*words.shape, 4)
        return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGBA2RGB), np.uint8)
    if kind is ImageType.SURFACE_NORMALS and depth is not None:
        turned = surface_normals(depth, view.info) @ view.turn.T.astype(np.float32)
        levels = np.rint((turned + np.float32(1.0)) * np.float32(127.5))
        return np.where(np.isfinite(depth)[..., None], levels, 0.0).astype(np.uint8)
    grey = np.rint(np.minimum(as_numbers(kind, view), 1.0) * 255.0).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=-1)


def surface_normals(depth: Depths, info: CameraInfo) -> Depths:
    """Return the unit normals, towards the camera, in its optical frame, shape (h, w, 3).

    On a plane the inverse of the depth (planar, metres, ``inf`` for nothing) is affine in the
    pixel, and its gradient gives the normal. Where nothing is they mean nothing.
    """
    inverse = np.reciprocal(depth)
    columns, rows = _slopes(info)
    across = np.float32(info.fx) * _slope_along(inverse)
    down = np.float32(info.fy) * _slope_along(inverse.T).T
    inward = np.stack([across, down, inverse - columns * across - rows * down], axis=-1)
    length = np.sqrt(np.einsum("ijk,ijk->ij", inward, inward))[..., None]
    return np.asarray(-inward / np.maximum(length, np.finfo(np.float32).tiny))


def _slope_along(values: Depths) -> Depths:
    """Return the difference of each value to the flatter side's neighbour in its row."""
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


class Eye(NamedTuple):
    """Source of an image: body, mount and camera settings."""

    body: int  # number in the model of the body that carries the camera
    mount: Mount  # where on it
    spec: CameraSpec  # size, field of view or intrinsics, and light; an ideal pinhole


class Wanted(NamedTuple):
    """Requested image: eye, type, and form for sending."""

    eye: Eye
    kind: ImageType
    form: Form


class Renderer:
    """Draws images of a model from any place on its bodies.

    Not thread-safe: stay in the thread that made it.

    Args:
        world: Of the simulator's process, or from `model_to_bytes`.
        camera: Name of a camera of the model, which is moved to where it is needed.
        infos: The largest cameras.
        threads: Threads of the software renderer, if this is the process's first GL context.
        renderer: What draws.
    """

    def __init__(
        self,
        world: Packed | bytes,
        camera: str,
        infos: tuple[CameraInfo, ...],
        threads: int = 1,
        dynamics: Changing | None = None,
        renderer: RendererName = "raster",
    ) -> None:
        keep_memory()
        model, drawable = opened(world)
        self._model: Any = model
        self._camera = int(self._model.camera(camera).id)
        self._make = partial(open_stage, renderer, self._model, infos, threads, dynamics, drawable)

    def render(
        self, stamp: int, qpos: Floats, ids: npt.NDArray[np.uint8], wanted: Sequence[Wanted]
    ) -> list[npt.NDArray[np.uint8]]:
        """Return images of a single state, encoded for sending; each view is drawn once.

        Args:
            ids: Segmentation ID of each object number, and last of nothing, shape (ngeom + 1,).

        Raises:
            GraphicsError: What draws is missing; the message names what to install.
        """
        self._stage.enter()
        images: dict[int, npt.NDArray[np.uint8]] = {}
        places: dict[Eye, list[int]] = {}
        for number, request in enumerate(wanted):
            places.setdefault(request.eye, []).append(number)
        for eye, numbers in places.items():
            view = self._see(eye, stamp, qpos, ids, {wanted[n].kind for n in numbers})
            images |= {n: packed(wanted[n].kind, view, wanted[n].form) for n in numbers}
        return [images[n] for n in range(len(wanted))]

    def answer(
        self,
        stamp: int,
        qpos: Floats,
        ids: npt.NDArray[np.uint8],
        wanted: Sequence[Wanted],
        responses: bytes,
    ) -> npt.NDArray[np.uint8]:
        """Return the msgpack of responses with images: of those in `responses`, without them.

        All work on pixels is done here: it would hold up the run's loop.
        """
        replies = msgspec.msgpack.decode(responses)
        images = self.render(stamp, qpos, ids, wanted)
        for response, request, image in zip(replies, wanted, images, strict=True):
            if request.form == "float":
                response["image_data_float"] = msgspec.Raw(image.data)
            else:
                response["image_data_uint8"] = image.data
        return np.frombuffer(msgspec.msgpack.encode(replies), np.uint8)

    def close(self) -> None:
        """Release the renderer's resources."""
        if "_stage" in self.__dict__:
            self._stage.close()

    @cached_property
    def _stage(self) -> Stage:
        return self._make()  # by the first images: without it, all else is served

    def _see(
        self, eye: Eye, stamp: int, qpos: Floats, ids: npt.NDArray[np.uint8], kinds: set[ImageType]
    ) -> Seen:
        model, number, (position, turn) = self._model, self._camera, eye.mount
        model.cam_bodyid[number] = eye.body
        model.cam_pos[number] = flip_yz(position)
        model.cam_quat[number] = flip_yz_rotation(multiply(turn, OPTICAL_TO_FRD))
        model.cam_fovy[number] = vertical_fov(eye.spec)
        self._stage.look(number, qpos, stamp * 1e-9, eye.spec.light)
        view = View(camera_info(eye.spec), is_plain(eye.spec))
        drawn = self._stage.draw(
            view, ImageType.SCENE in kinds, bool(kinds & OF_DEPTH), bool(kinds & OF_NUMBERS)
        )
        return Seen(drawn, view.info, ids, pose_matrix(*self._stage.pose(number))[:3, :3])
