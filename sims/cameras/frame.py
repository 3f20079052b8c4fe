"""One exposure of one camera: what a renderer is asked for, its images, and when they arrive."""

from __future__ import annotations

from typing import Any, NamedTuple

import msgspec
import mujoco
import numpy as np
import numpy.typing as npt

from events.base import Quaternion, Vector3
from sims.cameras.noise import generator
from sims.cameras.spec import CameraSpec

Floats = npt.NDArray[np.float64]


class Motion(NamedTuple):
    """True states of the world while a shutter is open.

    Attributes:
        seconds: Times of the states after the exposure's stamp, rising, shape (k,).
        qpos: Generalised positions at these times, shape (k, nq).
    """

    seconds: Floats
    qpos: Floats


class Shot(NamedTuple):
    """One exposure of one camera.

    Attributes:
        camera: Its name, as in its settings.
        stamp: Nanoseconds on the run's clock: the middle row's mid-exposure.
        qpos: The model's generalised positions then, shape (nq,).
        qvel: Its generalised velocities then, shape (nv,): constant while the shutter is open,
            unless `motion` is known. None: at rest.
        motion: The states from the beginning of the first row's exposure to the end of the last
            one's; needed by a rolling shutter.
        exposure: Seconds that the shutter is open.
        gain: Factor of the amplifier.
    """

    camera: str
    stamp: int
    qpos: Floats
    qvel: Floats | None = None
    motion: Motion | None = None
    exposure: float = 0.0
    gain: float = 1.0

    def moves(self) -> bool:
        """Return whether the state may change while the shutter is open."""
        return self.qvel is not None or self.motion is not None

    def state(self, model: Any, seconds: float) -> Floats:
        """Return the generalised positions some seconds after the stamp, shape (nq,).

        Between two known states the velocity is constant, as `mj_integratePos` understands it.
        """
        if seconds == 0.0 or not self.moves():
            return self.qpos
        if self.motion is None:
            assert self.qvel is not None
            start, velocity, since = self.qpos, self.qvel, seconds
        else:
            times, states = self.motion
            if len(times) == 1:
                return np.asarray(states[0])
            after = int(np.clip(np.searchsorted(times, seconds), 1, len(times) - 1))
            start, velocity = states[after - 1], np.empty(model.nv)
            step = float(times[after] - times[after - 1])
            mujoco.mj_differentiatePos(model, velocity, step, start, states[after])
            since = seconds - float(times[after - 1])
        moved: Floats = start.copy()
        mujoco.mj_integratePos(model, moved, velocity, since)
        return moved


class Frame(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """One exposure: all its images and its pose are of the same instant, or are read out alike.

    Images of kinds that the camera's settings do not name are None.

    Attributes:
        stamp: Nanoseconds on the run's clock: the middle of the middle row's exposure.
        position: The optical frame's origin, metres in ``map`` (NED).
        orientation: Rotation from the optical frame to ``map``.
        ends: Of a rolling shutter, position and orientation at the exposure of the first and of
            the last row; None of a global one.
        exposure: Seconds that the shutter was open.
        gain: Factor of the amplifier.
        light: Mean light of the image, if it is metered (`Development.meter`).
        rgb: uint8, shape (height, width, 3).
        grey: uint8, shape (height, width).
        depth: float32 metres along the optical z axis, shape (height, width); ``inf`` where
            nothing was hit.
        segmentation: int32 object numbers (geom ids), shape (height, width); -1 where nothing
            was hit.
        undistorted: The same images without distortion, if they are wanted.
    """

    stamp: int
    position: Vector3
    orientation: Quaternion
    ends: tuple[tuple[Vector3, Quaternion], tuple[Vector3, Quaternion]] | None = None
    exposure: float = 0.0
    gain: float = 1.0
    light: float | None = None
    rgb: npt.NDArray[np.uint8] | None = None
    grey: npt.NDArray[np.uint8] | None = None
    depth: npt.NDArray[np.float32] | None = None
    segmentation: npt.NDArray[np.int32] | None = None
    undistorted: Frame | None = None


def delay_of(spec: CameraSpec, seed: int, stamp_ns: int) -> float | None:
    """Return the seconds from an exposure to its delivery, or None if it is lost.

    Args:
        spec: The camera.
        seed: Seed of the rig.
        stamp_ns: Stamp of the exposure.
    """
    # No camera's name has a slash: what is drawn here and the noise are independent.
    random = generator(seed, f"{spec.name}/delivery", stamp_ns)
    if random.random() < spec.loss:
        return None
    return float(spec.latency) + float(spec.jitter) * random.random()


def stamp_error(spec: CameraSpec, seed: int, stamp_ns: int) -> int:
    """Return the nanoseconds by which the stamps of an exposure are late.

    Args:
        spec: The camera.
        seed: Seed of the rig.
        stamp_ns: True time of the exposure.
    """
    random = generator(seed, f"{spec.name}/stamp", stamp_ns)
    error = float(spec.time_jitter) * random.uniform(-1.0, 1.0) if spec.time_jitter else 0.0
    return round((float(spec.time_offset) + error) * 1e9)
