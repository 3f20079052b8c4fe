"""The images of one exposure of one camera, and when they arrive, if they do."""

from __future__ import annotations

import msgspec
import numpy as np
import numpy.typing as npt

from events.base import Quaternion, Vector3
from sims.cameras.noise import generator
from sims.cameras.spec import CameraSpec


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
