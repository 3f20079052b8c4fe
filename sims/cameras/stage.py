"""Off-screen rendering of a model for a camera: ideal colour, depth, object numbers, pose.

Nothing happens on import: `open_context` changes the environment, and must run in the thread that
will render, before any other GL context of the process.
"""

from __future__ import annotations

import ctypes
import importlib
import os
from typing import Any, Protocol

import mujoco
import numpy as np
import numpy.typing as npt

from events.base import Quaternion, Vector3
from events.frames import flip_yz, flip_yz_rotation
from runtime.errors import MissingDependencyError

INSTALL = "apt-get install libegl1 libgl1 libgl1-mesa-dri"


class GraphicsError(MissingDependencyError, RuntimeError):
    """Rendering is impossible here: the machine's GL libraries or drivers are missing or broken."""


def keep_memory() -> None:
    """Make glibc's allocator, if here, keep the freed memory of images for reuse.

    glibc maps a large array anew, page by page: a tenth of the time of a plain camera's image.
    """
    if (mallopt := getattr(ctypes.CDLL(None), "mallopt", None)) is not None:
        mallopt(-1, 1 << 30)  # M_TRIM_THRESHOLD of malloc.h
        mallopt(-3, 1 << 25)  # M_MMAP_THRESHOLD: the most that it takes


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


Floats = npt.NDArray[np.float64]
Colours = npt.NDArray[np.uint8]
Depths = npt.NDArray[np.float32]
Size = tuple[int, int]  # height and width, pixels

NEAR = 0.02
FAR = 20_000.0
"""Clipping planes, metres. The depth buffer is float32 and reversed (1 at NEAR, 0 at FAR), so
planes this far apart cost no precision: a step is 10⁻⁷ of the depth, wherever it is."""

RANGE = 500.0
"""Depth beyond this (metres) is ``inf``. MuJoCo's sky is a cube of half width 0.53 · FAR and writes
depth; at the rim of the widest view (170°) that is a planar depth of some 600 m."""

_OUT_OF_VIEW = mujoco.mjNGROUP - 1
"""Group of the geoms outside an image; groups from 3 on are not drawn."""

_SPARE = 1.001  # factor on the size of boxes, so as to keep geoms at the edge of the view

_PLAIN = [int(mujoco.mjtRndFlag.mjRND_SEGMENT), int(mujoco.mjtRndFlag.mjRND_IDCOLOR)]

LOOK = ".look"  # suffix of looks: geom `<name>.look` is the image of geom `<name>`, with its number


class Changing(Protocol):
    """Moving and changing parts of a world, as a stage needs them."""

    @property
    def fog(self) -> bool:
        """Whether there is fog."""

    def apply(self, model: Any, data: Any, seconds: float) -> None:
        """Set the world to its state at a time."""


class Stage:
    """Off-screen stage for the geoms of groups 0 to 2 (MuJoCo's default) of a model.

    Not thread-safe: stay in the thread that made it. The model is changed to be drawn quickly.

    Raises:
        GraphicsError: There is no GL; the message names what to install.
    """

    def __init__(
        self, model: Any, width: int, height: int, threads: int, dynamics: Changing | None = None
    ) -> None:
        self._context: Any = None
        self._axes: Floats | None = None
        self._gl: Any = None
        self.model = model
        self._dynamics = dynamics
        self._data = mujoco.MjData(model)
        _set_quality(model, width, height)
        self._numbers = object_numbers(model)
        self._groups = model.geom_group.copy()
        self._nobody = mujoco.MjvPerturb()
        self._scene = mujoco.MjvScene(model, maxgeom=model.ngeom + 100)
        self._scene.flags[:] = 0
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = 1
        self._scene.flags[mujoco.mjtRndFlag.mjRND_CULL_FACE] = 1
        self._scene.flags[mujoco.mjtRndFlag.mjRND_FOG] = dynamics is not None and dynamics.fog
        self._option = _surfaces_only()
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._gl = open_context(width, height, threads)
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR

    @property
    def closed(self) -> bool:
        """Whether the GL context has been given back."""
        return self._context is None

    def enter(self) -> None:
        """Make this stage's context the thread's."""
        self._gl.make_current()

    def look(self, camera_id: int, qpos: Floats, seconds: float = 0.0, light: float = 1.0) -> None:
        """Set up the scene of a camera for a state and time."""
        model, data = self.model, self._data
        data.qpos[:] = qpos
        if self._dynamics is not None:
            self._dynamics.apply(model, data, seconds)
            if self._dynamics.fog:
                fog, extent = model.vis.map, model.stat.extent
                set_fog(fog.fogstart * extent, fog.fogend * extent)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)  # lights that track something ask for it
        mujoco.mj_camlight(model, data)
        self._axes = None
        self._camera.fixedcamid = camera_id
        category = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(model, data, self._option, None, self._camera, category, self._scene)
        if light != 1.0:
            for source in self._scene.lights[: self._scene.nlight]:
                for part in (source.ambient, source.diffuse, source.specular):
                    part *= light

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

    def move(self, qpos: Floats) -> None:
        """Have `pose` tell of another state, at less cost than `look`; then look before drawing."""
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self._data)
        mujoco.mj_camlight(self.model, self._data)

    def pose(self, camera_id: int) -> tuple[Vector3, Quaternion]:
        """Return a camera's optical pose in ``map``, at the state last looked at."""
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, self._data.cam_xmat[camera_id])
        if quat[0] < 0.0:
            quat = -quat  # the same rotation; one sign for it, so that logs read smoothly
        w, x, y, z = quat.tolist()
        # The half turn about x on both sides also turns MuJoCo's camera (-z ahead) into optical.
        position = flip_yz(tuple(self._data.cam_xpos[camera_id].tolist()))
        return position, flip_yz_rotation((w, x, y, z))

    def close(self) -> None:
        """Give the GL context back. Further calls do nothing."""
        if self._context is not None:
            self._gl.make_current()
            self._context.free()
            self._context = None
        if self._gl is not None:
            self._gl.free()
            self._gl = None

    def _draw(
        self, size: Size, rgb: Colours | None, depth: Depths | None, plain: bool = False
    ) -> None:
        """Draw and read an image, bottom row first; `plain`: each object's number as its colour."""
        self.model.geom_group[:] = np.where(self._in_view(size), self._groups, _OUT_OF_VIEW)
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
    visual.quality.shadowsize = 0
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


def object_numbers(model: Any) -> npt.NDArray[np.int32]:
    """Return each geom's object number: its own id, or for a look its solid's."""
    numbers = np.arange(model.ngeom, dtype=np.int32)
    for geom in range(model.ngeom):
        name = model.geom(geom).name
        if name.endswith(LOOK):
            solid = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name.removesuffix(LOOK))
            if solid >= 0:
                numbers[geom] = solid
    return numbers
