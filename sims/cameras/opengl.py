"""MuJoCo's renderer, by OpenGL: ideal colour, depth and object numbers of pinhole drawings.

Nothing happens on import: `open_context` changes the environment, and must run in the thread that
will render, before any other GL context of the process.
"""

from __future__ import annotations

import functools
import importlib
import logging
import math
import os
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from events import CameraInfo
from runtime.typed import override
from sims.cameras.optics import MARGIN, Face, Maps, faces
from sims.cameras.stage import (
    FAR,
    NEAR,
    RANGE,
    SHADOW_SIZE,
    Changing,
    Colours,
    Depths,
    Drawn,
    Floats,
    GraphicsError,
    Stage,
    View,
    looked_up,
    object_numbers,
)
from sims.cameras.surfaces import undrawn_by_mujoco

INSTALL = "apt-get install libegl1 libgl1 libgl1-mesa-dri"


def open_context(width: int, height: int, threads: int) -> Any:
    """Return a current off-screen GL context: EGL's, or OSMesa's if MUJOCO_GL says so.

    Args:
        threads: Threads of the software renderer; takes effect with the first context only.

    Raises:
        GraphicsError: There is no GL; the message names what to install.
    """
    # Read by llvmpipe when its first screen is made; by default it takes every core.
    os.environ["LP_NUM_THREADS"] = str(threads)
    backend = "osmesa" if os.environ.get("MUJOCO_GL", "").lower() == "osmesa" else "egl"
    os.environ.setdefault("MUJOCO_GL", backend)
    try:
        context = importlib.import_module(f"mujoco.{backend}").GLContext(width, height)
        context.make_current()
    except Exception as error:  # PyOpenGL and the drivers fail in many ways
        raise GraphicsError(
            f"cannot render: expected a working {backend.upper()}, found none "
            f"({type(error).__name__}: {error}). On Debian or Ubuntu: {INSTALL} "
            "(or libosmesa6, and MUJOCO_GL=osmesa in the environment)"
        ) from error
    return context


def gl_renderer() -> str:
    """Return the name of the present context's renderer: ``llvmpipe (LLVM 15.0.6, 256 bits)``."""
    gl = importlib.import_module("OpenGL.GL")
    return bytes(gl.glGetString(gl.GL_RENDERER)).decode(errors="replace")


def set_fog(start: float, end: float) -> None:
    """Set start and end (metres) of the present context's fog; MuJoCo sets them only once."""
    gl = importlib.import_module("OpenGL.GL")
    gl.glFogf(gl.GL_FOG_START, start)
    gl.glFogf(gl.GL_FOG_END, end)


Size = tuple[int, int]  # height and width, pixels

# The depth buffer is float32 and reversed (1 at NEAR, 0 at FAR), so planes this far apart cost no
# precision: a step is 10⁻⁷ of the depth, wherever it is. MuJoCo's sky is a cube of half width
# 0.53 · FAR and writes depth; at the rim of the widest view (170°) that is a planar depth of some
# 600 m, beyond RANGE.

_OUT_OF_VIEW = mujoco.mjNGROUP - 1
"""Group of the geoms outside an image; groups from 3 on are not drawn."""

_SPARE = 1.001  # factor on the size of boxes, so as to keep geoms at the edge of the view

_PLAIN = [int(mujoco.mjtRndFlag.mjRND_SEGMENT), int(mujoco.mjtRndFlag.mjRND_IDCOLOR)]


class OpenGL(Stage):
    """Stage of MuJoCo's renderer; the model is changed to be drawn quickly.

    Raises:
        GraphicsError: There is no GL; the message names what to install.
    """

    def __init__(
        self,
        model: Any,
        infos: tuple[CameraInfo, ...],
        threads: int,
        dynamics: Changing | None = None,
    ) -> None:
        super().__init__(model, dynamics)
        if undrawn := undrawn_by_mujoco(model):
            logging.getLogger("visnav.cameras").warning(
                'renderer = "mujoco" does not draw %s; "raster" does', ", ".join(undrawn)
            )
        width, height = _largest(infos)
        self._context: Any = None
        self._axes: Floats | None = None
        self._gl: Any = None
        _set_quality(model, width, height)
        self._numbers = object_numbers(model)
        self._groups = model.geom_group.copy()
        self._nobody = mujoco.MjvPerturb()
        self._scene.flags[:] = 0
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = 1
        self._scene.flags[mujoco.mjtRndFlag.mjRND_CULL_FACE] = 1
        self._shadows = model.vis.quality.shadowsize > 0 and bool(model.light_castshadow.any())
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = self._shadows
        self._scene.flags[mujoco.mjtRndFlag.mjRND_FOG] = dynamics is not None and dynamics.fog
        self._option = _surfaces_only()
        self._gl = open_context(width, height, threads)
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR

    @property
    @override
    def closed(self) -> bool:
        return self._context is None

    @property
    @override
    def name(self) -> str:
        self.enter()
        return gl_renderer()

    @override
    def enter(self) -> None:
        self._gl.make_current()

    @override
    def close(self) -> None:
        if self._context is not None:
            self._gl.make_current()
            self._context.free()
            self._context = None
        if self._gl is not None:
            self._gl.free()
            self._gl = None

    @override
    def draw(
        self,
        view: View,
        colour: bool,
        depth: bool,
        numbers: bool,
        rows: tuple[int, int] | None = None,
    ) -> Drawn:
        drawings = _faces(view.info)
        first, last = rows or (0, view.info.height)
        size = last - first, view.info.width
        if view.framed and rows is None:
            return self._drawn(size, colour, depth, numbers)
        if len(drawings) == 1 and drawings[0].columns is None:
            self._aim(drawings[0], 0, first, *size[::-1])
            return self._drawn(size, colour, depth, numbers)
        seen = Drawn(
            np.zeros((*size, 3), np.uint8) if colour else None,
            np.full(size, np.inf, np.float32) if depth else None,
            np.full(size, -1, np.int32) if numbers else None,
        )
        for face in drawings:
            self._add(seen, face, first, last)
        return seen

    @override
    def _update(self) -> None:
        if (fog := self._fog()) is not None:
            set_fog(*fog)
        self._axes = None
        category = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(
            self.model, self._data, self._option, None, self._camera, category, self._scene
        )

    def aim(self, turn: Floats, left: float, right: float, top: float, bottom: float) -> None:
        """Replace the camera's own view frame until the next `look`.

        Args:
            turn: Axes of the view (right, down, ahead) in the optical frame, shape (3, 3). The
                other arguments are the image's edges, as coordinates x/z and y/z in these axes.
        """
        if self._axes is None:
            own = self._scene.camera[0]
            ahead, up = np.array(own.forward, np.float64), np.array(own.up, np.float64)
            self._axes = np.array([np.cross(ahead, up), -up, ahead])
        _, down, ahead = turn @ self._axes
        for camera in self._scene.camera:  # of both eyes; an image is drawn from their mean
            near = float(camera.frustum_near)
            camera.forward[:], camera.up[:] = ahead, -down
            camera.frustum_center = 0.5 * (left + right) * near
            camera.frustum_width = 0.5 * (right - left) * near  # half of it
            camera.frustum_top, camera.frustum_bottom = -top * near, -bottom * near

    def colour_and_depth(
        self, size: Size, colour: bool, depth: bool
    ) -> tuple[Colours | None, Depths | None]:
        """Draw once and read colour and depth as requested; None for the other."""
        rgb = np.empty((*size, 3), np.uint8) if colour else None
        buffer = np.empty(size, np.float32) if depth else None
        if rgb is None and buffer is None:
            return None, None
        self._draw(size, rgb, buffer, plain=not colour and self._opaque())
        # GL counts rows from the bottom.
        return (
            None if rgb is None else np.ascontiguousarray(rgb[::-1]),
            None if buffer is None else metric_depth(buffer[::-1]),
        )

    def segmentation(self, size: Size) -> npt.NDArray[np.int32]:
        """Draw object numbers."""
        code = np.empty((*size, 3), np.uint8)
        self._draw(size, code, None, plain=True)
        wide = code[::-1].astype(np.int32)
        index = wide[..., 0] | wide[..., 1] << 8 | wide[..., 2] << 16
        return np.asarray(self._numbers_in_scene()[index], dtype=np.int32)

    def _add(self, seen: Drawn, face: Face, first: int, last: int) -> None:
        """Draw the part of a face needed for some rows of an image, into `seen`."""
        assert face.columns is not None
        assert face.rows is not None
        assert face.mask is not None
        mask = face.mask[first:last]
        if not mask.any():
            return
        columns, rows = face.columns[first:last], face.rows[first:last]
        left, right = _span(columns[mask], face.width)
        top, bottom = _span(rows[mask], face.height)
        self._aim(face, left, top, right - left, bottom - top)
        wanted = (image is not None for image in seen)
        drawn = self._drawn((bottom - top, right - left), *wanted)
        part = looked_up(drawn, columns - np.float32(left), rows - np.float32(top))
        if part.depth is not None and face.steepness is not None:
            part = part._replace(depth=part.depth * face.steepness[first:last])
        for whole, piece in zip(seen, part, strict=True):
            if whole is not None and piece is not None:
                whole[mask] = piece[mask]

    def _aim(self, face: Face, left: int, top: int, width: int, height: int) -> None:
        """Have a stage draw a rectangle of a face's pixels."""
        (across, down), x, y = face.pitch, face.left, face.top
        edges = x + left * across, x + (left + width) * across
        self.aim(face.turn, *edges, y + top * down, y + (top + height) * down)

    def _drawn(self, size: tuple[int, int], colour: bool, depth: bool, numbers: bool) -> Drawn:
        colours, planar = self.colour_and_depth(size, colour, depth)
        return Drawn(colours, planar, self.segmentation(size) if numbers else None)

    def _draw(
        self, size: Size, rgb: Colours | None, depth: Depths | None, plain: bool = False
    ) -> None:
        """Draw and read an image, bottom row first; `plain`: each object's number as its colour."""
        drawn = self._in_view(size) | (self._shadows and not plain)  # others may throw theirs here
        self.model.geom_group[:] = np.where(drawn, self._groups, _OUT_OF_VIEW)
        scene, category = self._scene, mujoco.mjtCatBit.mjCAT_ALL
        scene.ngeom = 0
        mujoco.mjv_addGeoms(self.model, self._data, self._option, self._nobody, category, scene)
        scene.flags[_PLAIN] = plain
        scene.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = not plain
        viewport = mujoco.MjrRect(0, 0, size[1], size[0])
        mujoco.mjr_render(viewport, scene, self._context)
        mujoco.mjr_readPixels(rgb, depth, viewport, self._context)

    def _opaque(self) -> bool:
        model = self.model
        return bool((model.geom_rgba[:, 3] >= 1.0).all() and (model.mat_rgba[:, 3] >= 1.0).all())

    def _in_view(self, size: Size) -> npt.NDArray[np.bool_]:
        """Return a mask of the geoms in view: their boxes are not beyond an edge."""
        model, data, camera = self.model, self._data, self._scene.camera[0]
        near, up = camera.frustum_near, np.array(camera.up, np.float64)
        ahead = np.array(camera.forward, np.float64)
        half = camera.frustum_width or (
            0.5 * (camera.frustum_top - camera.frustum_bottom) * size[1] / size[0]
        )
        right, up, ahead = np.cross(ahead, up) * near, up * near, ahead
        # Each edge and the camera span a plane; these are their normals, to the inside.
        normals = np.array(
            [
                right - (camera.frustum_center - half) * ahead,
                (camera.frustum_center + half) * ahead - right,
                up - camera.frustum_bottom * ahead,
                camera.frustum_top * ahead - up,
            ]
        )
        eye = 0.5 * (np.array(camera.pos) + self._scene.camera[1].pos)
        axes = data.geom_xmat.reshape(-1, 3, 3)
        boxes = model.geom_aabb.reshape(-1, 2, 3)  # centre and half sizes, in the geom's axes
        middle = data.geom_xpos - eye + (axes @ boxes[:, 0, :, None])[..., 0]
        reach = (np.abs(normals @ axes) @ boxes[:, 1, :, None])[..., 0]
        inside = (middle @ normals.T + reach * _SPARE >= 0.0).all(axis=1)
        return np.asarray(inside | (model.geom_rbound <= 0.0))  # a plane has no box

    def _numbers_in_scene(self) -> npt.NDArray[np.int32]:
        """Return the object number of each drawn colour: colour 0 is nothing, n is segid n-1."""
        table = np.full(self._scene.ngeom + 1, -1, np.int32)
        for geom in self._scene.geoms[: self._scene.ngeom]:
            if geom.segid >= 0 and geom.objtype == mujoco.mjtObj.mjOBJ_GEOM:
                table[geom.segid + 1] = self._numbers[geom.objid]
        return table


def metric_depth(buffer: Depths) -> Depths:
    """Return planar depth, metres, from ``d = near (far - z) / (z (far - near))``, shape (h, w)."""
    depth = buffer * np.float32(FAR - NEAR)
    depth += np.float32(NEAR)
    np.divide(np.float32(NEAR * FAR), depth, out=depth)
    depth[depth > RANGE] = np.inf
    return depth


def _set_quality(model: Any, width: int, height: int) -> None:
    """Switch off costly effects of software rendering, and set the clipping planes."""
    visual = model.vis
    visual.quality.offsamples = 0  # multisampling would also blur depth and numbers
    visual.quality.shadowsize = min(visual.quality.shadowsize, SHADOW_SIZE)
    visual.global_.offwidth = max(visual.global_.offwidth, width)
    visual.global_.offheight = max(visual.global_.offheight, height)
    visual.map.znear = NEAR / model.stat.extent
    visual.map.zfar = FAR / model.stat.extent


def _surfaces_only() -> Any:
    option = mujoco.MjvOption()
    option.flags[:] = 0
    option.flags[mujoco.mjtVisFlag.mjVIS_TEXTURE] = 1
    option.flags[mujoco.mjtVisFlag.mjVIS_STATIC] = 1
    option.flags[mujoco.mjtVisFlag.mjVIS_SKIN] = 1
    option.sitegroup[:] = 0
    option.tendongroup[:] = 0
    option.jointgroup[:] = 0
    option.actuatorgroup[:] = 0
    return option


def _span(places: Maps, length: int) -> tuple[int, int]:
    first, last = math.floor(places.min()) - MARGIN + 1, math.ceil(places.max()) + MARGIN
    return max(first, 0), min(last, length)


@functools.lru_cache(maxsize=64)
def _faces(info: CameraInfo) -> tuple[Face, ...]:
    return faces(info)


def _largest(infos: tuple[CameraInfo, ...]) -> tuple[int, int]:
    """Return width and height of a buffer for all drawings of some cameras, pixels."""
    drawings = [face for info in infos for face in _faces(info)]
    width = max((face.width for face in drawings), default=1)
    return width, max((face.height for face in drawings), default=1)
