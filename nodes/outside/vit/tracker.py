"""A VIT library in a worker's process: images and samples go in, poses of the camera come out."""

from __future__ import annotations

import contextlib
import ctypes as c
import math
import tempfile
import time
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from events import Imu
from events.poses import inverse
from nodes.calibration.formats import camera_in_imu
from nodes.data.dataset.rig import Rig
from nodes.estimators import TrackingResult
from nodes.estimators.odometry.images import grey_image
from nodes.outside.vit import interface
from nodes.outside.vit.interface import (
    CameraCalibration,
    ImuCalibration,
    InertialCalibration,
    Library,
)

FOLDER = "$VISNAV_FOLDER"
"""Stands in a configuration for the folder of the calibration's files."""

_POLL = 0.0005
"""Real seconds between two looks for a pose, for which the interface does not wait."""

_TOLERANCE = 1000
"""Nanoseconds by which a pose's stamp may differ from its image's: OpenVINS has seconds inside."""


class VitTracker:
    """A library with its threads.

    Args:
        library: Path of the shared library.
        config: Path of its settings; empty for the first of `files`, or its defaults.
        files: Files of the calibration, by name, with their texts; `None`: it is passed by the
            interface.
        rig: The cameras, the left one first, and the IMU.

    Raises:
        VitError: It cannot be used, or refuses what it is told.
    """

    def __init__(self, library: str, config: str, files: dict[str, str] | None, rig: Rig) -> None:
        self._rig = rig
        self._camera = camera_in_imu(rig, rig.cameras[0])
        self._world = np.eye(4)  # the library's, in the optical camera at its first pose
        self._pose = np.eye(4)
        self._anew = True
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
        stamp: int,
        images: list[npt.NDArray[np.uint8]],
        samples: tuple[Imu, ...],
        wait: float,
    ) -> list[tuple[int, TrackingResult]]:
        """Push samples and then images, and return the stamps and poses that have come.

        Args:
            stamp: Of the images (ns), on the clock of the IMU.
            images: One of each camera, grey or red, green, blue.
            samples: Of the IMU since the last images, up to these.
            wait: Real seconds after which no pose of this stamp is waited for; it is the last one.

        Raises:
            VitError: The library refuses something.
            ValueError: An image has another size than its camera's.
        """
        grey = [
            np.ascontiguousarray(grey_image(camera.info, image))
            for camera, image in zip(self._rig.cameras, images, strict=True)
        ]
        self._library.push(stamp, grey, samples)
        found: list[tuple[int, TrackingResult]] = []
        until = time.monotonic() + wait
        while not found or abs(found[-1][0] - stamp) > _TOLERANCE:
            data = self._library.pop()
            if data is not None:
                found.append((data.stamp, self._result(data)))
            elif time.monotonic() >= until:
                break
            else:
                time.sleep(_POLL)
        return found

    def close(self) -> None:
        """End the library's threads."""
        self._opened.close()

    def _result(self, data: c.Structure) -> TrackingResult:
        """Return where the camera is; after a pose that is none the library begins anew there."""
        numbers = np.array([*data.position, *data.orientation, *data.velocity], np.float64)
        if not np.isfinite(numbers).all() or not numbers[3:7].any():
            if self._library.reset():
                self._maps += not self._anew
                self._anew = True
            return TrackingResult(self._pose, True, "the library's pose is not finite")
        in_world = np.eye(4)
        in_world[:3, :3] = Rotation.from_quat(numbers[3:7]).as_matrix()
        in_world[:3, 3] = numbers[:3]
        in_world = in_world @ self._camera
        if self._anew:
            self._world, self._anew = self._pose @ inverse(in_world), False
        self._pose = self._world @ in_world
        return TrackingResult(
            self._pose, velocity=self._world[:3, :3] @ numbers[7:], map=self._maps
        )


def _write(config: str, files: dict[str, str], folder: Path) -> Path | None:
    """Write the files, and return that of the library's settings."""
    text = Path(config).read_text(encoding="utf-8") if config else ""
    if FOLDER in text:
        files = {Path(config).name: text.replace(FOLDER, str(folder)), **files}
    for name, each in files.items():
        (folder / name).write_text(each, encoding="utf-8")
    if config and FOLDER not in text:
        return Path(config)  # beside the files that it may name
    return folder / next(iter(files)) if files else None


def calibrations(rig: Rig) -> list[c.Structure]:
    """Return what the interface is told of a rig: its cameras, and its IMU.

    A radial-tangential lens has eight coefficients, and as a ninth the radius (x/z) up to which
    the model is monotonic: Basalt takes no other.

    Raises:
        ValueError: Cameras and IMU are not on one body.
    """
    made = []
    for number, camera in enumerate(rig.cameras):
        info, lens, model = camera.info, camera.info.distortion, interface.KB4
        if info.is_pinhole:
            lens, model = (), interface.NONE
        elif info.distortion_model != "equidistant":
            radius = math.tan(min(info.widest_angle(), 1.55))
            lens, model = (*(*lens, 0.0, 0.0, 0.0)[:8], radius), interface.RT8
        pinhole = (info.fx, info.fy, info.cx, info.cy)
        pose = tuple(camera_in_imu(rig, camera).ravel().tolist())
        sizes = (number, info.width, info.height, camera.rate)
        made.append(CameraCalibration(*sizes, pinhole, model, len(lens), lens, pose))
    if (imu := rig.imu) is not None:
        noisy = []
        for kind in ("accelerometer", "gyroscope"):
            names = ("matrix", "random_walk", "noise_density")
            matrix, walk, density = (getattr(imu, f"{kind}_{name}") for name in names)
            corrects = tuple(np.linalg.inv(np.reshape(matrix, (3, 3))).ravel().tolist())
            noisy.append(InertialCalibration(corrects, (0.0,) * 3, (walk,) * 3, (density,) * 3))
        made.append(ImuCalibration(0, imu.rate, *noisy))
    return made
