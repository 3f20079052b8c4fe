"""Libraries of Monado's interface for visual-inertial tracking (VIT) as estimators.

A library runs in a worker's process, called by ctypes: images and samples go in, poses of the
camera come out, and the clock is held for them. Versions 1 to 3 of the interface are known; source
of names, layouts and numbers: ``vit_interface.h`` of 1.0.1, 2.0.1 and 3.0.0
(gitlab.freedesktop.org/monado/utilities/vit). They differ in what a library may offer besides
poses, of which nothing is used here; all have the velocity beside the pose.
"""

from __future__ import annotations

import contextlib
import ctypes as c
import math
import re
import tempfile
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from msgspec.structs import replace
from scipy.spatial.transform import Rotation

from events import CameraAnnouncement, Image, Imu
from events.camera_info import COEFFICIENTS
from events.geometry import inverse
from nodes.calibration.formats import camera_in_imu, left_out, write_files
from nodes.data.dataset.recording import Rig
from nodes.estimators import (
    Estimator,
    EstimatorConfig,
    MonocularInertialFrame,
    StereoInertialFrame,
    TrackingResult,
)
from nodes.estimators.images import Grey, grey_image
from runtime import Bundle, Duration
from runtime.channels.hold import Hold, HoldConfig, Owed
from runtime.errors import VisnavError
from runtime.paths import InputPath

RESULTS = ("INVALID_VERSION", "INVALID_VALUE", "ALLOCATION_FAILURE", "NOT_SUPPORTED", "NOT_ENABLED")
"""Names of the results -1, -2, … after ``VIT_ERROR_``."""

NONE, RT4, RT5, RT8, KB4 = range(5)
"""Distortion: none, radial-tangential with 4, 5 or 8 coefficients, Kannala-Brandt's."""

_L8 = 1  # format of an image: 8 bits of grey


class VitError(VisnavError):
    """Error for an unusable library, or for input refused by a library."""


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
    members = re.findall(r"(\w+) (\w+)(?:\[(\d+)\])?", declarations)
    fields = [(field, _TYPES[kind] * int(n) if n else _TYPES[kind]) for kind, field, n in members]
    structure = _TYPES[name] = type(name, (c.Structure,), {"_fields_": fields})
    return structure


Config, ImuSample, ImageSample, PoseData, *_calibrations = map(
    _structure, _STRUCTURES.strip().splitlines()
)
CameraCalibration, InertialCalibration, ImuCalibration = _calibrations


class Library:
    """A tracker of a shared library.

    Args:
        config: File with the library's own settings; `None` for its defaults.

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
            actual = ".".join(str(part.value) for part in version)
            raise VitError(f"{path}: expected version 1 to 3 of the VIT interface, found {actual}")
        library_config = Config(None if config is None else str(config).encode(), cameras, 1, False)
        self._call("tracker_create", c.byref(library_config), c.byref(self._tracker))

    def start(self, calibrations: Sequence[c.Structure]) -> None:
        """Add the calibrations to the tracker, and start its threads."""
        for calibration in calibrations:
            kind = "imu" if isinstance(calibration, ImuCalibration) else "camera"
            self._do(f"add_{kind}_calibration", c.byref(calibration))
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
        stamped = [(sample.stamp, sample) for sample in samples]
        if stamped and stamped[-1][0] <= stamp:
            stamped.append((stamp + 1, stamped[-1][1]))
        for at, measurement in stamped:
            sample = ImuSample(at, measurement.linear_acceleration, measurement.angular_velocity)
            self._do("push_imu_sample", c.byref(sample))
        for number, image in enumerate(images):
            (height, width), stride = image.shape, image.strides[0]
            shape = (width, height, stride, image.nbytes)
            sample = ImageSample(number, stamp, image.ctypes.data, *shape, _L8, 0, None)
            self._do("push_img_sample", c.byref(sample))

    def pop(self) -> c.Structure | None:
        """Return the next pose; `None` if none is ready."""
        pose = c.c_void_p()
        self._do("pop_pose", c.byref(pose))
        if pose.value is None:
            return None
        data = PoseData()
        self._call("pose_get_data", pose, c.byref(data))
        self._library.vit_pose_destroy(pose)
        return data

    def reset(self) -> bool:
        """Reset the tracker; return False if the library cannot."""
        return bool(self._library.vit_tracker_reset(self._tracker) == 0)

    def close(self) -> None:
        """Stop and free the tracker."""
        with contextlib.suppress(VitError):
            self._do("stop")
        self._library.vit_tracker_destroy(self._tracker)

    def _do(self, name: str, *arguments: Any) -> None:
        self._call(f"tracker_{name}", self._tracker, *arguments)

    def _call(self, name: str, *arguments: Any) -> None:
        """Call a function; a result above 0 is a remark and no error."""
        result = getattr(self._library, f"vit_{name}")(*arguments)
        if result < 0:
            code = dict(enumerate(RESULTS, 1)).get(-result, result)
            raise VitError(f"{self._path}: expected vit_{name} to succeed, found VIT_ERROR_{code}")


FOLDER = "$VISNAV_FOLDER"  # stands in a configuration for the folder of the calibration's files
_POLL = 0.0005  # real seconds between two polls for a pose, as the interface does not wait
_TOLERANCE = 1000
"""Tolerated nanoseconds between stamps of pose and image: OpenVINS has seconds inside."""


class VitTracker:
    """A library with its threads.

    Args:
        library: Path of the shared library.
        config: Path of its settings; empty for the first of `files`, or its defaults.
        files: Files of the calibration, by name, with their texts; `None`: it is passed by the
            interface.
        rig: The cameras, the left one first, and the IMU.

    Raises:
        VitError: It cannot be used, or refuses the settings.
    """

    def __init__(self, library: str, config: str, files: dict[str, str] | None, rig: Rig) -> None:
        self._rig = rig
        self._camera = camera_in_imu(rig, rig.cameras[0])
        self._world = np.eye(4)  # the library's, in the optical camera at its first pose
        self._pose = np.eye(4)
        self._is_reset = True
        self._maps = 0  # put where the camera was last known to be
        with contextlib.ExitStack() as opened:
            folder = opened.enter_context(tempfile.TemporaryDirectory(prefix="vit_"))
            file = _write(config, files or {}, Path(folder))
            self._library = Library(library, file, len(rig.cameras))
            opened.callback(self._library.close)
            self._library.start(calibrations(rig) if files is None else [])
            self._opened = opened.pop_all()

    def track(
        self,
        stamp: int,  # of the images (ns), on the clock of the IMU
        images: list[npt.NDArray[np.uint8]],  # one of each camera, grey or red, green, blue
        samples: tuple[Imu, ...],  # of the IMU since the last images, up to these
        wait: float,  # real seconds to wait for the pose of this stamp, the last of the result
    ) -> list[tuple[int, TrackingResult]]:
        """Push samples, then images; return stamp and result of each available pose.

        Raises:
            VitError: The library refuses something.
            ValueError: An image has another size than its camera's.
        """
        grey = [
            np.ascontiguousarray(grey_image(camera.info, image))
            for camera, image in zip(self._rig.cameras, images, strict=True)
        ]
        self._library.push(stamp, grey, samples)
        results: list[tuple[int, TrackingResult]] = []
        until = time.monotonic() + wait
        while not results or abs(results[-1][0] - stamp) > _TOLERANCE:
            data = self._library.pop()
            if data is not None:
                results.append((data.stamp, self._result(data)))
            elif time.monotonic() >= until:
                break
            else:
                time.sleep(_POLL)
        return results

    def close(self) -> None:
        """End the library's threads."""
        self._opened.close()

    def _result(self, data: c.Structure) -> TrackingResult:
        """Return the camera's pose; an invalid pose resets the library at the last valid."""
        numbers = np.array([*data.position, *data.orientation, *data.velocity], np.float64)
        if not np.isfinite(numbers).all() or not numbers[3:7].any():
            if self._library.reset():
                self._maps += not self._is_reset
                self._is_reset = True
            return TrackingResult(self._pose, True, "the library's pose is not finite")
        in_world = np.eye(4)
        in_world[:3, :3] = Rotation.from_quat(numbers[3:7]).as_matrix()
        in_world[:3, 3] = numbers[:3]
        in_world = in_world @ self._camera
        if self._is_reset:
            self._world, self._is_reset = self._pose @ inverse(in_world), False
        self._pose = self._world @ in_world
        return TrackingResult(
            self._pose, velocity=self._world[:3, :3] @ numbers[7:], map=self._maps
        )


def _write(config: str, files: dict[str, str], folder: Path) -> Path | None:
    """Write the files, and return the path of the library's settings."""
    text = Path(config).read_text(encoding="utf-8") if config else ""
    if FOLDER in text:
        files = {Path(config).name: text.replace(FOLDER, str(folder)), **files}
    for name, content in files.items():
        (folder / name).write_text(content, encoding="utf-8")
    if config and FOLDER not in text:
        return Path(config)  # beside the files that it may name
    return folder / next(iter(files)) if files else None


def calibrations(rig: Rig) -> list[c.Structure]:
    """Return a rig's calibrations for the interface: cameras and IMU.

    A radial-tangential lens has eight coefficients, and as a ninth the radius (x/z) up to which
    the model is monotonic: Basalt takes no other.

    Raises:
        ValueError: Cameras and IMU are not on one body.
    """
    structures = []
    for number, camera in enumerate(rig.cameras):
        info, lens, model = camera.info, camera.info.distortion, KB4
        if info.is_pinhole:
            lens, model = (), NONE
        elif info.distortion_model != "equidistant":
            radius = math.tan(min(info.widest_angle(), 1.55))
            lens, model = (*(*lens, 0.0, 0.0, 0.0)[:8], radius), RT8
        pinhole = (info.fx, info.fy, info.cx, info.cy)
        pose = tuple(camera_in_imu(rig, camera).ravel().tolist())
        sizes = (number, info.width, info.height, camera.rate)
        structures.append(CameraCalibration(*sizes, pinhole, model, len(lens), lens, pose))
    if (imu := rig.imu) is not None:
        noisy = []
        for kind in ("accelerometer", "gyroscope"):
            names = ("matrix", "random_walk", "noise_density")
            matrix, walk, density = (getattr(imu, f"{kind}_{name}") for name in names)
            corrects = tuple(np.linalg.inv(np.reshape(matrix, (3, 3))).ravel().tolist())
            noisy.append(InertialCalibration(corrects, (0.0,) * 3, (walk,) * 3, (density,) * 3))
        structures.append(ImuCalibration(0, imu.rate, *noisy))
    return structures


class Frame(NamedTuple):
    """Input of both modes: image, or stereo pair, and IMU samples."""

    image: Image
    left: Image
    right: Image
    imu: tuple[Imu, ...]


class VitConfig(EstimatorConfig):
    """Settings of a library with Monado's VIT interface.

    Attributes:
        library: Path of the shared library.
        config: Path of its own settings; ``$VISNAV_FOLDER`` in it stands for the folder with the
            calibration's files. If empty, the first of these, or the library's defaults.
        mode: The sensors that are used.
        calibration: How it gets the calibration: by the ``interface``; from its own ``config``; or
            from files in the format of ``basalt``, ``openvins`` or ``kalibr`` (see ``export``).
        patience: Real seconds that the first image gets, when the library may give no pose and
            does not say so, and by which time stays behind real time up to the first pose. It must
            be longer than the library takes for its start and an image: a first pose that comes
            later marks the run as not reproducible.
        hold: How long simulated time waits for a pose, and what if none comes.
    """

    library: InputPath
    config: InputPath = ""
    mode: Literal["stereo_inertial", "monocular_inertial"] = "stereo_inertial"
    calibration: Literal["interface", "config", "basalt", "openvins", "kalibr"] = "interface"
    patience: Duration = Duration(0.1)  # immutable
    hold: HoldConfig = HoldConfig(initialise=Duration(10.0))


LEAST = 0.1  # least real seconds of patience for each image, if the setting has as many


def patience_left(
    patience: float,
    image: float,  # stamp of the image, seconds after that of the first
    now: float,  # real seconds since the first image came
) -> float:
    """Return the real seconds left to an image for a first pose."""
    return max(image + patience - now, min(patience, LEAST))


class Vit(Estimator[VitConfig]):
    """Estimates the pose of a camera or a stereo rig with an IMU by a library of VIT's interface.

    Each image goes to it after all samples of the IMU up to that image, and simulated time waits
    at the latency until the pose has come. The library's threads may make it vary.
    """

    deterministic: ClassVar[bool] = False
    needs = frozenset({"grey"})
    lenses = frozenset(COEFFICIENTS)  # the library gets the model
    inertial = True
    aligned = False

    frames = Bundle(Frame, keep="latest")

    def __init__(self) -> None:
        stereo = self.config.mode == "stereo_inertial"
        self.read(StereoInertialFrame if stereo else MonocularInertialFrame)
        self.eyes = 2 if stereo else 1
        self.method = Path(self.config.library).stem.removeprefix("lib") or "VIT"
        self._hold: Hold[TrackingResult]
        self._first: tuple[int, float] | None = None  # stamp and real time of the first image
        self._has_result = False
        self._pose = np.eye(4)

    def refusal(self, camera: CameraAnnouncement) -> str:
        """Return an error for a negative time_offset: images would precede their IMU samples."""
        if camera.time_offset >= 0:
            return super().refusal(camera)
        return f"expected a time_offset of at least 0 s, found {camera.time_offset:g} s"

    def check(self) -> Iterable[str]:
        """Yield an error for each missing sensor, library or settings file."""
        yield from super().check()
        for name in ("library", "config"):
            path = getattr(self.config, name)
            if (path or name == "library") and not Path(path).is_file():
                yield f"{name}: expected a file, found none at {path!r}"

    async def on_ready(self) -> None:
        """Start the library, in a process of its own."""
        config = self.config
        body = self.the_camera().source.rpartition("/")[0]
        cameras = (replace(camera, time_offset=0.0) for camera in self.cameras)
        rig = Rig(body, tuple(cameras), self.imu_announcement)
        files: dict[str, str] | None = None if config.calibration == "interface" else {}
        if config.calibration not in {"interface", "config"}:
            try:
                files = write_files(rig, config.calibration, topics=False)
            except ValueError as error:
                self.log.fatal("calibration: %s", error)
            for omission in left_out(rig, config.calibration):
                self.log.warning("calibration: %s", omission)
        self._hold = self.hold(self.name, config.hold, config.latency)
        arguments = config.library, config.config, files, rig
        limit = config.hold.max_wait + 60.0
        start = self.worker(VitTracker, *arguments, latency=config.latency, timeout=limit)
        self._tracker = await start

    async def run(self) -> None:
        """Track each exposure by the library, and answer waiting frames by its poses."""
        hold, config = self._hold, self.config
        async for *images, samples in self.frames:
            stamp = self.exposed_at(images[0])
            now = time.monotonic()
            self._first = (stamp, now) if self._first is None else self._first
            elapsed_stamps, elapsed = (stamp - self._first[0]) / 1e9, now - self._first[1]
            owed = hold.owe(stamp)
            self.start(self._deliver(images[0], owed))
            early = not self._has_result and elapsed_stamps < config.hold.initialise
            wait = (
                patience_left(config.patience, elapsed_stamps, elapsed)
                if early
                else config.hold.max_wait
            )
            pixels = [image.data for image in images]
            arguments = stamp, pixels, samples, float(wait) if hold.expects else 0.0
            for result_stamp, result in await self._tracker.call(VitTracker.track, *arguments):
                self._has_result = True
                hold.answer(result_stamp, result, "lost" if result.lost else "")
            if early and not owed.work.done():
                hold.answer(stamp, None, "initialising")

    async def _deliver(self, image: Image, owed: Owed[TrackingResult]) -> None:
        """Publish the result of an image, or lost tracking if none came after the first."""
        result = await owed
        if result is not None:
            self._pose = result.pose
            self.send_result(image, result)
        elif self._has_result:
            self.send_result(image, TrackingResult(self._pose, True, "the library gave no pose"))
