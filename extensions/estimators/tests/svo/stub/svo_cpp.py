"""What `svo_cpp` looks like from outside: it moves 0.1 to the camera's right with each image.

A black image is not tracked, a white one ends the process. Poses lie in memory as the library's do:
an object of ctypes, too, has the pointer to its value after its head.
"""

from __future__ import annotations

import ctypes
import enum
import os
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

Floats = npt.NDArray[np.float64]

CONFIG: dict[str, float] = {}
set_svo_config = CONFIG.update
CALLS: list[str] = []


class Stage(enum.Enum):
    PAUSED = 0
    FIRST_FRAME = 1
    SECOND_FRAME = 2
    DEFAULT_FRAME = 3
    RELOCALIZING = 4


class PinholeCamera:
    def __init__(self, *numbers: float) -> None:
        self.numbers = numbers


class SE3d(ctypes.Structure):
    _fields_ = (("quaternion", ctypes.c_double * 4), ("shift", ctypes.c_double * 3))

    @classmethod
    def of(cls, rotation: Rotation, shift: Floats) -> SE3d:
        return cls((ctypes.c_double * 4)(*rotation.as_quat()), (ctypes.c_double * 3)(*shift))

    def translation(self) -> Floats:
        return np.array(self.shift)[:, None]

    def unit_quaternion(self) -> Any:
        raise TypeError("Unable to convert function return value to a Python type!")

    def inverse(self) -> SE3d:
        back = Rotation.from_quat(list(self.quaternion)).inv()
        return SE3d.of(back, -back.apply(np.array(self.shift)))


class Frame:
    def __init__(self, count: int) -> None:
        turn = Rotation.from_rotvec([0.0, 0.0, 0.01 * count])
        self.T_f_w = SE3d.of(turn, -turn.apply([0.1 * count, 0.0, 0.0]))


class SVO:
    def __init__(self, camera: PinholeCamera) -> None:
        self._stage, self._started, self._count = Stage.PAUSED, False, 0

    def start(self) -> None:
        CALLS.append("start")
        self._started = True

    def reset(self) -> None:
        CALLS.append("reset")
        self._stage, self._started = Stage.PAUSED, False

    def stage(self) -> Stage:
        return self._stage

    def lastFrame(self) -> Frame:  # noqa: N802
        return Frame(self._count)

    def addImage(self, image: npt.NDArray[np.uint8], timestamp: float) -> None:  # noqa: N802
        assert image.ndim == 2
        assert image.flags.c_contiguous
        if image.min() == 255:
            os._exit(7)
        if self._started:
            self._stage, self._started, self._count = Stage.FIRST_FRAME, False, 0
        seen = bool(image.any())
        initializing = self._stage in {Stage.FIRST_FRAME, Stage.SECOND_FRAME}
        if self._stage == Stage.PAUSED:
            return
        if initializing and not seen:
            self._stage = Stage.PAUSED
        elif self._stage == Stage.FIRST_FRAME:
            self._stage = Stage.SECOND_FRAME
        else:
            self._stage = Stage.DEFAULT_FRAME if seen else Stage.RELOCALIZING
            self._count += seen
