"""Errors of the calibration of an IMU and of a lidar: what is announced differs from the truth."""

from __future__ import annotations

from typing import Any, TypeVar

import msgspec
import numpy as np

from events import ImuAnnouncement, LidarAnnouncement
from sims.calibration import Error, MountingError, errors_of, generator_of, mounting_off


class ImuCalibrationError(MountingError, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the errors of an IMU's announced calibration.

    A number is a standard deviation: each error is drawn once a run, from the run's seed. A list
    has the errors themselves, the gyroscope's first. An error is what is announced less what is
    true.

    Attributes:
        rotation: Of the mounting, about each axis of the IMU's frame, degrees.
        position: Of the mounting, along each axis of the body, metres.
        scale: On the diagonals of `gyroscope_matrix` and `accelerometer_matrix`. A list has 6.
        misalignment: Beside the diagonals, rad: the gyroscope's six, row by row, and the
            accelerometer's three below the diagonal, as its axes define the IMU's frame (those
            above it would be a rotation of the mounting). A list has 9.
    """

    scale: Error = 0.0
    misalignment: Error = 0.0


class LidarCalibrationError(MountingError, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the errors of a lidar's announced mounting.

    A number is a standard deviation: each error is drawn once a run, from the run's seed. A list
    has the three errors themselves. An error is what is announced less what is true.

    Attributes:
        rotation: About each axis of the lidar's frame, degrees.
        position: Along each axis of the body, metres.
    """


LIDAR_SIZES = {"rotation": 3, "position": 3}
"""Number of errors in a list of each setting."""

IMU_SIZES = LIDAR_SIZES | {"scale": 6, "misalignment": 9}

_ASIDE = np.array([1, 2, 3, 5, 6, 7, 9 + 3, 9 + 6, 9 + 7])
"""Places of `misalignment` in both matrices' 18 numbers; the accelerometer's below its diagonal."""

_DIAGONAL = np.array([0, 4, 8, 9, 9 + 4, 9 + 8])

A = TypeVar("A", bound=ImuAnnouncement | LidarAnnouncement)


def announced(true: A, error: MountingError, parent: np.random.Generator, name: str) -> A:
    """Return what is announced of a sensor in place of its true announcement.

    Args:
        parent: Generator of the node; its state stays.
        name: Name of the sensor, which together with the node's seed decides the draws.
    """
    generator = generator_of(parent, f"{name} calibration")
    # All are drawn whatever is asked for: one setting changes no other's errors.
    turns, shifts, scale, aside = (generator.standard_normal(size) for size in (3, 3, 6, 9))
    position, orientation = mounting_off(true.position, true.orientation, error, turns, shifts)
    changes: dict[str, Any] = {"position": position, "orientation": orientation}
    if isinstance(true, ImuAnnouncement) and isinstance(error, ImuCalibrationError):
        numbers = np.array([*true.gyroscope_matrix, *true.accelerometer_matrix])
        numbers[_DIAGONAL] += errors_of(error.scale, scale)
        numbers[_ASIDE] += errors_of(error.misalignment, aside)
        gyroscope, accelerometer = numbers.reshape(2, 9).tolist()
        changes["gyroscope_matrix"] = tuple(gyroscope)
        changes["accelerometer_matrix"] = tuple(accelerometer)
    return msgspec.structs.replace(true, **changes)


def difference(
    announced: ImuAnnouncement | LidarAnnouncement, true: ImuAnnouncement | LidarAnnouncement
) -> dict[str, Any]:
    """Return the true calibration behind an announcement, for a run's summary."""
    return {"true": _facts(true), "announced": _facts(announced)}


def _facts(known: ImuAnnouncement | LidarAnnouncement) -> dict[str, Any]:
    names = ["position", "orientation"]
    if isinstance(known, ImuAnnouncement):
        names += ["gyroscope_matrix", "accelerometer_matrix"]
    return {name: list(getattr(known, name)) for name in names}


USUAL_IMU = ImuCalibrationError(
    # rotation, position: the calibrations compared in sims/cameras/calibration.py differ in the
    # cameras' poses in the IMU as if each had a standard deviation of 0.13 degrees and 3.2 mm
    # (EuRoC), of 0.012 degrees and 0.7 mm (TUM VI).
    # misalignment: 0.05 degrees, 9e-4 rad, are typical from axis to axis of an IMU calibrated by
    # its maker (data sheets of ADIS16445 and ADIS16465); half of it.
    # scale: estimate. For comparison, OpenVINS' simulator draws 0.004 of both.
    rotation=0.03, position=2e-3, scale=1e-3, misalignment=5e-4,
)  # fmt: skip
"""Errors of ``calibration_error = true``: a good calibration of an IMU beside cameras."""

USUAL_LIDAR = LidarCalibrationError(
    # position: lidar_align's results of four recordings with one planar lidar have standard
    # deviations of 7 and 8 mm (github.com/ethz-asl/lidar_align, issue 31); LI-Init's are reported
    # 6 mm off a drawing, 1 to 2 cm are acceptable to its author
    # (github.com/hku-mars/LiDAR_IMU_Init, issue 15).
    # rotation: estimate; of LI-Init 1 to 2 degrees are reported where settings differ (issue 103).
    rotation=0.1, position=5e-3,
)  # fmt: skip
"""Errors of ``calibration_error = true``: a good calibration of a lidar."""
