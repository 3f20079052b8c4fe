"""Monado's interface for visual-inertial tracking (VIT), versions 1 to 3, by ctypes.

Source of names, layouts and numbers: ``vit_interface.h`` of 1.0.1, 2.0.1 and 3.0.0
(gitlab.freedesktop.org/monado/utilities/vit). They differ in what a library may offer besides
poses, of which nothing is used here; all have the velocity beside the pose.
"""

from __future__ import annotations

import contextlib
import ctypes as c
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from events import Imu
from nodes.estimators.odometry.images import Grey
from runtime.errors import VisnavError

RESULTS = ("INVALID_VERSION", "INVALID_VALUE", "ALLOCATION_FAILURE", "NOT_SUPPORTED", "NOT_ENABLED")
"""Names of the results -1, -2, … after ``VIT_ERROR_``."""

NONE, RT4, RT5, RT8, KB4 = range(5)
"""Distortion: none, radial-tangential with 4, 5 or 8 coefficients, Kannala-Brandt's."""

_L8 = 1
"""Format of an image: 8 bits of grey."""


class VitError(VisnavError):
    """A library cannot be used, or has refused what it was given."""


_TYPES: dict[str, Any] = {
    "u32": c.c_uint32,
    "i64": c.c_int64,
    "int": c.c_int,
    "float": c.c_float,
    "double": c.c_double,
    "bool": c.c_bool,
    "text": c.c_char_p,
    "address": c.c_void_p,
}


# ns; m/s²; rad/s; pixels; hertz; matrices row by row. A pose is that of the IMU in the library's
# world, whose z is up, with a quaternion x y z w. Noise is in continuous densities.
_STRUCTURES = """
Config: text file, u32 cameras, u32 imus, bool show_ui
ImuSample: i64 stamp, float acceleration[3], float angular_velocity[3]
ImageSample: u32 camera, i64 stamp, address data, u32 width, u32 height, u32 stride, u32 size, \
    int format, u32 mask_count, address masks
PoseData: i64 stamp, float position[3], float orientation[4], float velocity[3]
CameraCalibration: u32 camera, int width, int height, double rate, double pinhole[4], int model, \
    u32 count, double distortion[32], double transform[16]
InertialCalibration: double transform[9], double offset[3], double bias[3], double noise[3]
ImuCalibration: u32 imu, double rate, InertialCalibration accel, InertialCalibration gyro
"""


def _structure(line: str) -> type[c.Structure]:
    """Return the structure of a line: its name, and its fields as C declares them."""
    name, _, declarations = line.partition(": ")
    found = re.findall(r"(\w+) (\w+)(?:\[(\d+)\])?", declarations)
    fields = [(field, _TYPES[kind] * int(n) if n else _TYPES[kind]) for kind, field, n in found]
    made = _TYPES[name] = type(name, (c.Structure,), {"_fields_": fields})
    return made


Config, ImuSample, ImageSample, PoseData, *_calibrations = map(
    _structure, _STRUCTURES.strip().splitlines()
)
CameraCalibration, InertialCalibration, ImuCalibration = _calibrations


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
            version = [c.c_uint32() for _ in range(3)]
            self._call("api_get_version", *map(c.byref, version))
        except (OSError, AttributeError) as error:
            raise VitError(f"expected a library with the VIT interface, found {error}") from None
        if version[0].value not in {1, 2, 3}:
            found = ".".join(str(part.value) for part in version)
            raise VitError(f"{path}: expected version 1 to 3 of the VIT interface, found {found}")
        given = Config(None if config is None else str(config).encode(), cameras, 1, False)
        self._call("tracker_create", c.byref(given), c.byref(self._tracker))

    def start(self, calibrations: Sequence[c.Structure]) -> None:
        """Start the tracker's threads, after calibrations that it has from nowhere else."""
        for each in calibrations:
            kind = "imu" if isinstance(each, ImuCalibration) else "camera"
            self._do(f"add_{kind}_calibration", c.byref(each))
        self._do("start")

    def push(self, stamp: int, images: Sequence[Grey], samples: Sequence[Imu]) -> None:
        """Push samples of the IMU, and then the images of a stamp (ns), each of shape (h, w).

        If there is none of after the images, one more, equal to the last, is a nanosecond later:
        Basalt integrates up to an image when it has such a sample.
        """
        running = c.c_bool()
        self._do("is_running", c.byref(running))
        if not running.value:
            raise VitError(f"{self._path}: expected a tracker that runs, found one that does not")
        stamped = [(each.stamp, each) for each in samples]
        if stamped and stamped[-1][0] <= stamp:
            stamped.append((stamp + 1, stamped[-1][1]))
        for at, each in stamped:
            sample = ImuSample(at, each.linear_acceleration, each.angular_velocity)
            self._do("push_imu_sample", c.byref(sample))
        for number, image in enumerate(images):
            (height, width), stride = image.shape, image.strides[0]
            shape = (width, height, stride, image.nbytes)
            sample = ImageSample(number, stamp, image.ctypes.data, *shape, _L8, 0, None)
            self._do("push_img_sample", c.byref(sample))

    def pop(self) -> c.Structure | None:
        """Return the next pose, if there is one already."""
        pose = c.c_void_p()
        self._do("pop_pose", c.byref(pose))
        if pose.value is None:
            return None
        data = PoseData()
        self._call("pose_get_data", pose, c.byref(data))
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
            found = dict(enumerate(RESULTS, 1)).get(-result, result)
            raise VitError(f"{self._path}: expected vit_{name} to succeed, found VIT_ERROR_{found}")
