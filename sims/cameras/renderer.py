"""Rendering: what a camera sees, and the effects of its lens, shutter and sensor.

Made for a worker process (a GL context belongs to the thread that made it), but works in-process.
The drawing is in `sims.cameras.stage`, effects on images are in `sims.cameras.optics` and
`sims.cameras.noise`.
"""

from __future__ import annotations

import math
import time
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from sims.cameras.frame import Frame
from sims.cameras.noise import generator, grey_of, noisy_depth, noisy_image
from sims.cameras.optics import defocused, mean, moments
from sims.cameras.spec import CameraSpec, camera_info
from sims.cameras.stage import NEAR, RANGE, Colours, Depths, Floats, Stage


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
    """Renders the images of the cameras of one model.

    Not thread-safe: stay in the thread that made it.

    Args:
        model_bytes: From `model_to_bytes`; has a camera `<prefix><name>` for each spec.
        cameras: Settings of the cameras.
        prefix: Prefix of the cameras' names in the model.
        seed: Seed of the noise.
        threads: Threads of the software renderer, if this is the process's first GL context.

    Raises:
        GraphicsError: There is no GL; the message names what to install.
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
        model = model_from_bytes(model_bytes)
        self._model = model
        self._seed = seed
        self._cameras = {spec.name: (spec, _number(model, prefix + spec.name)) for spec in cameras}
        width = max((spec.width for spec in cameras), default=1)
        height = max((spec.height for spec in cameras), default=1)
        self._stage = Stage(model, width, height, threads)

    def render(
        self,
        stamp_ns: int,
        qpos: Floats,
        names: tuple[str, ...],
        qvel: Floats | None = None,
    ) -> dict[str, Frame]:
        """Expose some cameras at one state.

        Args:
            stamp_ns: Nanoseconds on the run's clock; goes into the frames and into the noise.
            qpos: The model's generalised positions, shape (nq,).
            names: Names of the cameras, as in their settings.
            qvel: Its generalised velocities, shape (nv,), for motion blur; None: at rest.

        Returns:
            A frame for each name. The same arguments give the same bits.

        Raises:
            RuntimeError: After `close`.
            KeyError: A name that no spec has.
            ValueError: `qpos` or `qvel` has another length than the model's.
        """
        if self._stage.closed:
            raise RuntimeError("render: expected an open renderer, found a closed one")
        _check("qpos", qpos, self._model.nq)
        if qvel is not None:
            _check("qvel", qvel, self._model.nv)
        self._stage.enter()
        frames: dict[str, Frame] = {}
        for name in names:
            spec, number = self._cameras[name]
            due = time.monotonic() + spec.render_time
            frames[name] = self._expose(stamp_ns, spec, number, qpos, qvel)
            # In real time, and not on the run's clock: it stands for a slow renderer.
            time.sleep(max(due - time.monotonic(), 0.0))
        return frames

    def close(self) -> None:
        """Give the GL context back. Further calls do nothing."""
        self._stage.close()

    def _expose(
        self, stamp_ns: int, spec: CameraSpec, number: int, qpos: Floats, qvel: Floats | None
    ) -> Frame:
        kinds, stage, size = set(spec.images), self._stage, (spec.height, spec.width)
        coloured = not kinds.isdisjoint({"rgb", "grey"})
        motion = qvel if coloured and spec.exposure > 0.0 else None
        stage.look(number, qpos, spec.light)
        position, orientation = stage.pose(number)
        rgb, depth = stage.colour_and_depth(size, coloured, "depth" in kinds or motion is not None)
        numbers = stage.segmentation(size) if "segmentation" in kinds else None
        if rgb is not None:
            if motion is not None and depth is not None:
                rgb = self._smeared(spec, number, qpos, motion, rgb, depth)
            rgb = defocused(rgb, spec.blur)
        random = generator(self._seed, spec.name, stamp_ns)
        grey = None
        if rgb is not None and "grey" in kinds:
            grey = noisy_image(grey_of(rgb), spec.noise, random)
        if rgb is not None and "rgb" in kinds:
            rgb = noisy_image(rgb, spec.noise, random)
        if depth is not None and "depth" in kinds:
            depth = noisy_depth(depth, spec.depth_noise, random)
        return Frame(
            stamp=stamp_ns,
            position=position,
            orientation=orientation,
            rgb=rgb if "rgb" in kinds else None,
            grey=grey,
            depth=depth if "depth" in kinds else None,
            segmentation=numbers,
        )

    def _smeared(
        self,
        spec: CameraSpec,
        number: int,
        qpos: Floats,
        qvel: Floats,
        middle: Colours,
        depth: Depths,
    ) -> Colours:
        """Return the mean of what a camera sees while its shutter is open.

        Args:
            spec: The camera.
            number: Number of the camera in the model.
            qpos: The state in the middle of the exposure.
            qvel: Its velocity, taken to be constant meanwhile.
            middle: The image in the middle of the exposure.
            depth: Its depth.
        """
        images = []
        for moment in moments(spec.exposure, self._shift(spec, number, qpos, qvel, depth)):
            if moment == 0.0:
                images.append(middle)
                continue
            self._stage.look(number, self._later(qpos, qvel, moment), spec.light)
            image, _ = self._stage.colour_and_depth((spec.height, spec.width), True, False)
            assert image is not None
            images.append(image)
        return mean(images)

    def _shift(
        self, spec: CameraSpec, number: int, qpos: Floats, qvel: Floats, depth: Depths
    ) -> float:
        """Return the approximate motion of the image while the shutter is open, pixels."""
        poses = []
        for moment in (-0.5 * spec.exposure, 0.5 * spec.exposure):
            self._stage.look(number, self._later(qpos, qvel, moment))
            poses.append(self._stage.pose(number))
        (here, turn), (there, other) = poses
        angle = 2.0 * math.acos(min(abs(sum(a * b for a, b in zip(turn, other, strict=True))), 1.0))
        nearest = float(np.quantile(np.minimum(depth[::8, ::8], RANGE), 0.05))
        return camera_info(spec).fx * (angle + math.dist(here, there) / max(nearest, NEAR))

    def _later(self, qpos: Floats, qvel: Floats, seconds: float) -> Floats:
        """Return the state some seconds later (or earlier) at constant velocity."""
        moved: Floats = qpos.copy()
        mujoco.mj_integratePos(self._model, moved, qvel, seconds)
        return moved


def _number(model: Any, name: str) -> int:
    """Return the number of a model's camera."""
    number: int = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, name)
    if number < 0:
        known = ", ".join(model.camera(i).name for i in range(model.ncam))
        raise ValueError(f"camera {name}: expected one of the model's ({known or 'none'})")
    return number


def _check(what: str, array: npt.NDArray[np.float64], length: int) -> None:
    if array.shape != (length,):
        raise ValueError(f"{what}: expected shape ({length},), found {array.shape}")
