"""Monado's interface for visual-inertial tracking (VIT), versions 1 and 2, by ctypes.

Source of names, layouts and numbers: ``vit_interface.h`` of 1.0.1 and 2.0.1
(gitlab.freedesktop.org/monado/utilities/vit). The two differ in what a library may offer besides
poses, of which nothing is used here; both have the velocity beside the pose.
"""

from __future__ import annotations

import contextlib
import ctypes as c
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from runtime.errors import VisnavError

VERSIONS = (1, 2)
"""Major versions that are known."""

RESULTS = {-1: "INVALID_VERSION", -2: "INVALID_VALUE", -3: "ALLOCATION_FAILURE"} | {
    -4: "NOT_SUPPORTED",
    -5: "NOT_ENABLED",
}
"""Names of errors, after ``VIT_ERROR_``."""

NONE, RT4, RT5, RT8, KB4 = range(5)
"""Distortion: none, radial-tangential with 4, 5 or 8 coefficients, Kannala-Brandt's."""

_L8 = 1
"""Format of an image: 8 bits of grey."""


class VitError(VisnavError):
    """A library cannot be used, or has refused what it was given."""


_int, _double, _pointer = c.c_int, c.c_double, c.c_void_p
_u32, _i64, _3floats, _3doubles = c.c_uint32, c.c_int64, c.c_float * 3, c.c_double * 3


class Config(c.Structure):
    """What a tracker is made with."""

    _fields_ = (("file", c.c_char_p), ("cameras", _u32), ("imus", _u32), ("show_ui", c.c_bool))


class ImuSample(c.Structure):
    """Stamp (ns), specific force (m/s²) and angular velocity (rad/s)."""

    _fields_ = (("stamp", _i64), ("acceleration", _3floats), ("angular_velocity", _3floats))


class ImageSample(c.Structure):
    """An image; those of one stamp (ns) come in the order of the cameras."""

    _fields_ = (
        *(("camera", _u32), ("stamp", _i64), ("data", _pointer), ("width", _u32)),
        *(("height", _u32), ("stride", _u32), ("size", _u32), ("format", _int)),
        *(("mask_count", _u32), ("masks", _pointer)),
    )


class PoseData(c.Structure):
    """The IMU in the library's world, whose z is up: metres, x y z w, metres per second."""

    _fields_ = (
        *(("stamp", _i64), ("position", _3floats)),
        *(("orientation", c.c_float * 4), ("velocity", _3floats)),
    )


class CameraCalibration(c.Structure):
    """A camera: pixels, hertz, lens, and its pose in the IMU's frame, row by row."""

    _fields_ = (
        *(("camera", _u32), ("width", _int), ("height", _int), ("rate", _double)),
        *(("intrinsics", _double * 4), ("model", _int), ("distortion_count", _u32)),
        *(("distortion", _double * 32), ("transform", _double * 16)),
    )


class InertialCalibration(c.Structure):
    """What makes true values of measured ones, and their noise, continuous densities."""

    _fields_ = (
        *(("transform", _double * 9), ("offset", _3doubles)),
        *(("bias_std", _3doubles), ("noise_std", _3doubles)),
    )


class ImuCalibration(c.Structure):
    """An IMU."""

    _fields_ = (
        *(("imu", _u32), ("rate", _double)),
        *(("accelerometer", InertialCalibration), ("gyroscope", InertialCalibration)),
    )


_FUNCTIONS = {
    "api_get_version": (c.POINTER(_u32),) * 3,
    "tracker_create": (c.POINTER(Config), c.POINTER(_pointer)),
    "tracker_destroy": (_pointer,),
    "tracker_start": (_pointer,),
    "tracker_stop": (_pointer,),
    "tracker_reset": (_pointer,),
    "tracker_is_running": (_pointer, c.POINTER(c.c_bool)),
    "tracker_push_imu_sample": (_pointer, c.POINTER(ImuSample)),
    "tracker_push_img_sample": (_pointer, c.POINTER(ImageSample)),
    "tracker_add_imu_calibration": (_pointer, c.POINTER(ImuCalibration)),
    "tracker_add_camera_calibration": (_pointer, c.POINTER(CameraCalibration)),
    "tracker_pop_pose": (_pointer, c.POINTER(_pointer)),
    "pose_destroy": (_pointer,),
    "pose_get_data": (_pointer, c.POINTER(PoseData)),
}
"""Arguments of the functions, which return a result, but for those that destroy."""


class Library:
    """A tracker of a shared library.

    Args:
        path: Of the library.
        config: File with the library's own settings; `None` for its defaults.
        cameras: Their number.

    Raises:
        VitError: It is no such library, or of another version, or makes no tracker.
    """

    def __init__(self, path: str, config: Path | None, cameras: int) -> None:
        self._path, self._tracker = path, c.c_void_p()
        try:
            self._library = c.CDLL(path)
            for name, arguments in _FUNCTIONS.items():
                function = getattr(self._library, f"vit_{name}")
                function.restype = None if name.endswith("destroy") else _int
                function.argtypes = arguments
        except (OSError, AttributeError) as error:
            raise VitError(f"expected a library with the VIT interface, found {error}") from None
        version = [_u32() for _ in range(3)]
        self._call("api_get_version", *map(c.byref, version))
        if version[0].value not in VERSIONS:
            found = ".".join(str(part.value) for part in version)
            known = " or ".join(map(str, VERSIONS))
            raise VitError(f"{path}: expected version {known} of the VIT interface, found {found}")
        given = Config(None if config is None else str(config).encode(), cameras, 1, False)
        self._call("tracker_create", c.byref(given), c.byref(self._tracker))

    def start(self, calibrations: Sequence[CameraCalibration | ImuCalibration]) -> None:
        """Start the tracker's threads, after calibrations that it has from nowhere else."""
        for each in calibrations:
            kind = "imu" if isinstance(each, ImuCalibration) else "camera"
            self._do(f"add_{kind}_calibration", c.byref(each))
        self._do("start")

    def push(
        self,
        stamp: int,
        images: Sequence[npt.NDArray[np.uint8]],
        samples: npt.NDArray[np.float64],
    ) -> None:
        """Push samples, shape (n, 7): ns, rad/s, m/s²; and then the images of a stamp, (h, w)."""
        running = c.c_bool()
        self._do("is_running", c.byref(running))
        if not running.value:
            raise VitError(f"{self._path}: expected a tracker that runs, found one that does not")
        for of, *w, ax, ay, az in samples.tolist():
            sample = ImuSample(int(of), (ax, ay, az), tuple(w))
            self._do("push_imu_sample", c.byref(sample))
        for number, image in enumerate(images):
            (height, width), stride = image.shape, image.strides[0]
            shape = (width, height, stride, image.nbytes)
            pushed = ImageSample(number, stamp, image.ctypes.data, *shape, _L8, 0, None)
            self._do("push_img_sample", c.byref(pushed))

    def pop(self) -> PoseData | None:
        """Return the next pose, if there is one already."""
        pose = c.c_void_p()
        self._do("pop_pose", c.byref(pose))
        if pose.value is None:
            return None
        data = PoseData()
        try:
            self._call("pose_get_data", pose, c.byref(data))
        finally:
            self._library.vit_pose_destroy(pose)
        return data

    def reset(self) -> bool:
        """Have the tracker begin anew; return whether it can."""
        return bool(self._library.vit_tracker_reset(self._tracker) == 0)

    def close(self) -> None:
        """Stop the tracker, and free it."""
        with contextlib.suppress(VitError):
            self._do("stop")
        self._library.vit_tracker_destroy(self._tracker)

    def _do(self, name: str, *arguments: Any) -> None:
        self._call(f"tracker_{name}", self._tracker, *arguments)

    def _call(self, name: str, *arguments: Any) -> None:
        """Call a function; a result above 0 is a remark and no error."""
        result = getattr(self._library, f"vit_{name}")(*arguments)
        if result < 0:
            found = f"VIT_ERROR_{RESULTS[result]}" if result in RESULTS else f"result {result}"
            raise VitError(f"{self._path}: expected vit_{name} to succeed, found {found}")
