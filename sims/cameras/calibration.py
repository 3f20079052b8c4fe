"""Errors of a camera's calibration: what is announced of a camera differs from what is drawn.

A simulator that announces its exact calibration flatters estimators that live off it. Real
calibrations err: by some tenths of a pixel in focal length and principal point, and by a few
hundredths of a degree between two eyes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import msgspec
import numpy as np

from events import CameraAnnouncement, CameraInfo, Quaternion, Vector3
from runtime.units import Latency
from sims.calibration import (
    Error,
    MountingError,
    check_lists,
    errors_of,
    generator_of,
    mounting_off,
)


class CalibrationError(MountingError, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the errors of a camera's announced calibration.

    A number is a standard deviation: each error is drawn once a run, from the run's seed, for each
    eye of a stereo rig by itself. A list has the errors themselves, a rig's left eye's first. An
    error is what is announced less what is true.

    Attributes:
        focal: Of fx and fy, pixels.
        centre: Of the principal point cx and cy, pixels.
        distortion: Of the coefficients k1 and k2; that of all others (p1, p2, k3, …) is a tenth
            of it, and none of k3 and beyond where these are 0, as they are then not calibrated.
            A list has all coefficients of the lens's model.
        rotation: Of the mounting, about each axis of the optical frame, degrees.
        position: Of the mounting, along each axis of the body, metres.
        time: Of the time offset. All cameras of a vehicle share the draw, as they share a trigger.
    """

    focal: Error = 0.0
    centre: Error = 0.0
    distortion: Error = 0.0
    rotation: Error = 0.0
    position: Error = 0.0
    time: Latency = Latency(0)  # immutable

    @property
    def of_lens(self) -> bool:
        """Whether the announced intrinsics err."""
        return any(np.any(errors) for errors in (self.focal, self.centre, self.distortion))

    def of_eye(self, number: int) -> CalibrationError:
        """Return the errors of an eye of a stereo rig: 0 for the left one, 1 for the right."""
        halves = {}
        for name in ("focal", "centre", "distortion", "rotation", "position"):
            values = getattr(self, name)
            if isinstance(values, tuple):
                half = len(values) // 2
                halves[name] = values[number * half : (number + 1) * half]
        return msgspec.structs.replace(self, **halves)


USUAL = CalibrationError(
    # focal, centre: Kalibr reports standard deviations of 0.08 to 0.11 px and of 0.02 to 0.7 px for
    # rigs of its users (github.com/ethz-asl/kalibr, issues 137 and 502).
    # rotation, position: two published calibrations of one rig, the data set's own (in OpenVINS
    # 6948812, config/*/kalibr_imucam_chain.yaml) and Basalt's (basalt-mirror 9656344,
    # data/*_ds_calib.json), differ in the pose between the eyes as if each eye erred by 0.023
    # degrees and 0.17 mm (EuRoC), by 0.015 degrees and 0.13 mm (TUM VI): half of the rms over the
    # axes, as two eyes err twice.
    # distortion, time: estimates: 0.14 px at 45 degrees with fx 460; a tenth of an IMU's period
    # ("a fraction of the smallest measurement period": Furgale et al., IROS 2013).
    # For comparison, OpenVINS' simulator, whose filter refines them all, draws 1 px, 0.005, 0.057
    # degrees, 1 cm, 10 ms (ov_msckf/src/sim/Simulator.cpp, perturb_parameters).
    focal=0.15, centre=0.15, distortion=3e-4, rotation=0.01, position=2e-4, time=Latency(0.0005),
)  # fmt: skip
"""Errors of ``calibration_error = true``: a good calibration of a pair of cameras."""


class Calibration(NamedTuple):
    """Intrinsics, mounting and clock of a camera."""

    info: CameraInfo
    position: Vector3  # in the body's frame, metres
    orientation: Quaternion  # optical frame to the body's
    time_offset: float  # seconds, as `events.CameraAnnouncement` has it


def announced(
    true: Calibration, error: CalibrationError, parent: np.random.Generator, name: str
) -> Calibration:
    """Return the calibration that is announced of a camera.

    Args:
        parent: Generator of the node; its state stays.
        name: Name of the camera, which together with the node's seed decides the draws.
    """
    info = true.info
    count = len(info.distortion)
    generator = generator_of(parent, f"{name} calibration")
    # All are drawn whatever is asked for: one setting changes no other's errors.
    draws = [generator.standard_normal(size) for size in (2, 2, count, 3, 3)]
    late = float(error.time) * float(generator_of(parent, "calibrated clock").standard_normal())
    shares = np.array([1.0, 1.0, *[0.1] * (count - 2)])
    shares[4:] *= np.array(info.distortion[4:]) != 0.0  # as radtan, which most programs read alone
    focal = errors_of(error.focal, draws[0])
    centre = errors_of(error.centre, draws[1])
    lens = errors_of(error.distortion, draws[2] * shares)
    changed = msgspec.structs.replace(
        info,
        fx=info.fx + focal[0],
        fy=info.fy + focal[1],
        cx=info.cx + centre[0],
        cy=info.cy + centre[1],
        distortion=tuple(k + e for k, e in zip(info.distortion, lens, strict=True)),
    )
    mounting = mounting_off(true.position, true.orientation, error, draws[3], draws[4])
    return Calibration(changed if error.of_lens else info, *mounting, true.time_offset + late)


def check(error: CalibrationError, coefficients: int, eyes: int) -> None:
    """Check the lengths of lists; raise a `ValueError` that names the setting."""
    sizes = {"focal": 2, "centre": 2, "distortion": coefficients, "rotation": 3, "position": 3}
    check_lists(error, {name: size * eyes for name, size in sizes.items()})


def difference(announced: CameraAnnouncement, true: Calibration) -> dict[str, Any]:
    """Return the true calibration behind an announcement, for a run's summary."""
    return {"true": _facts(true), "announced": _facts(announced)}


def _facts(known: CameraAnnouncement | Calibration) -> dict[str, Any]:
    info = known.info
    return {
        "intrinsics": [info.fx, info.fy, info.cx, info.cy],
        "distortion": list(info.distortion),
        "position": list(known.position),
        "orientation": list(known.orientation),
        "time_offset": known.time_offset,
    }
