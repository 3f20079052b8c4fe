"""Drawing what cameras see: one GL context, one pass for colour and depth, one for numbers.

Made for a worker process (a context belongs to the thread that made it), but works in-process.
Contexts are in `sims.cameras.graphics`, noise in `sims.cameras.noise`.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from events.base import Quaternion, Vector3
from sims.cameras.frame import Frame
from sims.cameras.graphics import open_context
from sims.cameras.noise import generator, grey_of, noisy_depth, noisy_image
from sims.cameras.spec import CameraSpec
from sims.frames import half_turn_quaternion, half_turn_vector

NEAR = 0.02
FAR = 20_000.0
"""Clipping planes, metres. The depth buffer is float32 and reversed (1 at NEAR, 0 at FAR), so
planes this far apart cost no precision: a step is 10⁻⁷ of the depth, wherever it is."""

RANGE = 500.0
"""Depth beyond this (metres) is ``inf``. MuJoCo's sky is a cube of half width 0.53 · FAR and writes
depth; at the rim of the widest view (170°) that is a planar depth of some 600 m."""

LOOK = ".look"
"""A geom `<name>.look` is the picture of the geom `<name>`, and is numbered as that one is."""


def model_to_bytes(model: Any) -> bytes:
    """Return a compiled model, textures and all, as bytes to send to another process."""
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


def model_from_bytes(data: bytes) -> Any:
    """Return the model that `model_to_bytes` wrote.

    Raises:
        ValueError: The bytes are none, or were written by another version of MuJoCo.
    """
    return mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": data})


class CameraRenderer:
    """Draws the cameras of one model, and in them the geoms of groups 0 to 2 (MuJoCo's default).

    Not thread-safe: stay in the thread that made it.

    Args:
        model_bytes: From `model_to_bytes`; has a camera `<prefix><name>` for each spec.
        cameras: What to draw.
        prefix: Goes before the cameras' names in the model.
        seed: Of the noise.
        threads: Of the software renderer, if this is the process's first GL context.

    Raises:
        GraphicsError: No GL here; the message says what to install.
        ValueError: The bytes are no model, or the model lacks one of the cameras.
    """

    def __init__(
        self,
        model_bytes: bytes,
        cameras: tuple[CameraSpec, ...],
        prefix: str,
        seed: int,
        threads: int = 1,
    ) -> None:
        self._context: Any = None
        self._gl: Any = None
        self._model = model_from_bytes(model_bytes)
        self._data = mujoco.MjData(self._model)
        self._seed = seed
        self._prefix = prefix
        self._cameras = {spec.name: (spec, self._fixed_camera(spec)) for spec in cameras}
        width = max((spec.width for spec in cameras), default=1)
        height = max((spec.height for spec in cameras), default=1)
        self._set_quality(width, height)
        self._numbers = _object_numbers(self._model)
        self._scene = mujoco.MjvScene(self._model, maxgeom=self._model.ngeom + 100)
        self._scene.flags[:] = 0
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = 1
        self._scene.flags[mujoco.mjtRndFlag.mjRND_CULL_FACE] = 1
        self._option = _surfaces_only()
        self._gl = open_context(width, height, threads)
        self._context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR

    def render(
        self, stamp_ns: int, qpos: npt.NDArray[np.float64], names: tuple[str, ...]
    ) -> dict[str, Frame]:
        """Draw some cameras at one state.

        Args:
            stamp_ns: Nanoseconds on the run's clock; goes into the frames and into the noise.
            qpos: The model's generalised positions, shape (nq,).
            names: Which cameras, by the names in their specs.

        Returns:
            A frame for each name. The same arguments give the same bits.

        Raises:
            RuntimeError: After `close`.
            KeyError: A name that no spec has.
            ValueError: `qpos` has another length than the model's.
        """
        if self._context is None:
            raise RuntimeError("render: expected an open renderer, found a closed one")
        if qpos.shape != (self._model.nq,):
            raise ValueError(f"qpos: expected shape ({self._model.nq},), found {qpos.shape}")
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)  # lights that track something ask for it
        mujoco.mj_camlight(self._model, self._data)
        self._gl.make_current()
        frames: dict[str, Frame] = {}
        for name in names:
            spec, camera = self._cameras[name]
            if not frames:
                category = mujoco.mjtCatBit.mjCAT_ALL
                mujoco.mjv_updateScene(
                    self._model, self._data, self._option, None, camera, category, self._scene
                )
            else:  # the same geoms, seen from elsewhere
                mujoco.mjv_updateCamera(self._model, self._data, camera, self._scene)
            frames[name] = self._expose(stamp_ns, spec, camera.fixedcamid)
        return frames

    def close(self) -> None:
        """Give the GL context back. Further calls do nothing."""
        if self._context is not None:
            self._gl.make_current()
            self._context.free()
            self._context = None
        if self._gl is not None:
            self._gl.free()
            self._gl = None

    def _expose(self, stamp_ns: int, spec: CameraSpec, camera_id: int) -> Frame:
        rgb, depth = self._colour_and_depth(spec)
        numbers = self._segmentation(spec) if "segmentation" in spec.images else None
        random = generator(self._seed, spec.name, stamp_ns)
        position, orientation = self._optical_pose(camera_id)
        grey = None
        if rgb is not None and "grey" in spec.images:
            grey = noisy_image(grey_of(rgb), spec.noise, random)
        if rgb is not None and "rgb" in spec.images:
            rgb = noisy_image(rgb, spec.noise, random)
        return Frame(
            stamp=stamp_ns,
            position=position,
            orientation=orientation,
            rgb=rgb if "rgb" in spec.images else None,
            grey=grey,
            depth=None if depth is None else noisy_depth(depth, spec.depth_noise, random),
            segmentation=numbers,
        )

    def _colour_and_depth(
        self, spec: CameraSpec
    ) -> tuple[npt.NDArray[np.uint8] | None, npt.NDArray[np.float32] | None]:
        """Draw once and read both; a camera that gives numbers only isn't drawn here at all."""
        kinds = set(spec.images)
        size = (spec.height, spec.width)
        rgb = np.empty((*size, 3), np.uint8) if kinds & {"rgb", "grey"} else None
        depth = np.empty(size, np.float32) if "depth" in kinds else None
        if rgb is None and depth is None:
            return None, None
        self._draw(spec, rgb, depth)
        # GL counts rows from the bottom.
        return (
            None if rgb is None else np.ascontiguousarray(rgb[::-1]),
            None if depth is None else metric_depth(depth[::-1]),
        )

    def _segmentation(self, spec: CameraSpec) -> npt.NDArray[np.int32]:
        code = np.empty((spec.height, spec.width, 3), np.uint8)
        flags = self._scene.flags
        saved = flags.copy()
        flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = 1
        flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = 1
        try:
            self._draw(spec, code, None)
        finally:
            flags[:] = saved
        wide = code[::-1].astype(np.int32)
        index = wide[..., 0] | wide[..., 1] << 8 | wide[..., 2] << 16
        return np.asarray(self._numbers_in_scene()[index], dtype=np.int32)

    def _numbers_in_scene(self) -> npt.NDArray[np.int32]:
        """Return the object number of each drawn colour: colour 0 is nothing, n is segid n-1."""
        table = np.full(self._scene.ngeom + 1, -1, np.int32)
        for geom in self._scene.geoms[: self._scene.ngeom]:
            if geom.segid >= 0 and geom.objtype == mujoco.mjtObj.mjOBJ_GEOM:
                table[geom.segid + 1] = self._numbers[geom.objid]
        return table

    def _draw(
        self,
        spec: CameraSpec,
        rgb: npt.NDArray[np.uint8] | None,
        depth: npt.NDArray[np.float32] | None,
    ) -> None:
        viewport = mujoco.MjrRect(0, 0, spec.width, spec.height)
        mujoco.mjr_render(viewport, self._scene, self._context)
        mujoco.mjr_readPixels(rgb, depth, viewport, self._context)

    def _optical_pose(self, camera_id: int) -> tuple[Vector3, Quaternion]:
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, self._data.cam_xmat[camera_id])
        if quat[0] < 0.0:
            quat = -quat  # the same rotation; one sign for it, so that logs read smoothly
        w, x, y, z = quat.tolist()
        # The half turn about x on both sides also turns MuJoCo's camera (-z ahead) into optical.
        position = half_turn_vector(tuple(self._data.cam_xpos[camera_id].tolist()))
        return position, half_turn_quaternion((w, x, y, z))

    def _fixed_camera(self, spec: CameraSpec) -> Any:
        name = f"{self._prefix}{spec.name}"
        camera_id = mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_CAMERA, name)
        if camera_id < 0:
            known = ", ".join(self._model.camera(i).name for i in range(self._model.ncam))
            raise ValueError(f"camera {name}: expected one of the model's ({known or 'none'})")
        camera = mujoco.MjvCamera()
        camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        camera.fixedcamid = camera_id
        return camera

    def _set_quality(self, width: int, height: int) -> None:
        """Leave out what costs much in software, and set the clipping planes."""
        visual = self._model.vis
        visual.quality.offsamples = 0  # multisampling would also blur depth and numbers
        visual.quality.shadowsize = 0
        visual.global_.offwidth = max(visual.global_.offwidth, width)
        visual.global_.offheight = max(visual.global_.offheight, height)
        visual.map.znear = NEAR / self._model.stat.extent
        visual.map.zfar = FAR / self._model.stat.extent


def metric_depth(buffer: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return planar depth in metres from a reversed depth buffer, shape (h, w).

    With reversed z the projection writes ``d = near (far - z) / (z (far - near))``, which is 1 at
    the near plane and 0 at the far one; solved for z. Exact to float32.
    """
    depth = np.float32(NEAR * FAR) / (buffer * np.float32(FAR - NEAR) + np.float32(NEAR))
    depth[depth > RANGE] = np.inf
    return np.asarray(depth, dtype=np.float32)


def _surfaces_only() -> Any:
    """Return the options that show geoms with their textures, and no sites, tendons or arrows."""
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


def _object_numbers(model: Any) -> npt.NDArray[np.int32]:
    """Return each geom's object number: its own id, or its namesake's if it is a look."""
    numbers = np.arange(model.ngeom, dtype=np.int32)
    for geom in range(model.ngeom):
        name = model.geom(geom).name
        if name.endswith(LOOK):
            solid = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name.removesuffix(LOOK))
            if solid >= 0:
                numbers[geom] = solid
    return numbers
