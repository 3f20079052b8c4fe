"""The images of one exposure of one camera."""

from __future__ import annotations

import msgspec
import numpy as np
import numpy.typing as npt

from events.base import Quaternion, Vector3


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
