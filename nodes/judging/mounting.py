"""Mounting of a camera: the transform from its optical frame to the body."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nodes.data.export import mounting
from nodes.judging.evaluation.metrics import Floats
from nodes.kalibr import mounting_of_kalibr
from nodes.trajectory import Trajectory, not_rotations
from nodes.trajectory_files import Row, read_tum
from runtime.run.results import newest


def read_mounting(text: str, run: str) -> Floats:
    """Return the transform from a camera's optical frame to the body, shape (4, 4).

    Given as ``tx ty tz qx qy qz qw`` (metres, the scalar last), a TUM file with one pose, a chain
    of Kalibr's (``camchain.yaml``, ``camchain.yaml:cam1``), a sensor.yaml of EuRoC's, or the name
    of a camera that the run announced. In files of Kalibr and EuRoC the body is the IMU.

    Raises:
        ValueError: It is none of these.
    """
    if (mounted := mounting_of_kalibr(text)) is not None:
        return mounted
    if Path(text).is_file():
        return np.asarray(read_tum(Path(text)).matrices()[0])
    row = Row("--body-from-camera", text.replace(",", " ").split())
    if len(row.fields) == 1 and Path(run).is_dir():
        return mounting(newest(Path(run)), text)
    if len(row.fields) != 7:
        row.wrong(
            '"tx ty tz qx qy qz qw", a file (TUM, Kalibr, a sensor.yaml), or a camera of the run '
            "that is the truth",
            text,
        )
    values = np.array([row.numbers(0, 7)])
    pose = Trajectory(np.array([0]), values[:, :3], values[:, [6, 3, 4, 5]])
    return np.asarray(pose.matrices()[0])


def mounting_of(matrix: Floats) -> Floats:
    """Return a transform of shape (4, 4) as it is; a `ValueError` if it is none."""
    if matrix.shape != (4, 4) or not_rotations(matrix[None, :3, :3]) or matrix[3, 3] != 1.0:
        raise ValueError(
            "body_from_camera: expected a transform of shape (4, 4), found "
            f"{matrix.tolist() if matrix.shape == (4, 4) else matrix.shape}"
        )
    return matrix
