"""Mountings of sensors given as a matrix, ``T_BS``, in place of position and angles.

The name and the layout are those of EuRoC's sensor.yaml (M. Burri et al., IJRR 2016): the transform
that takes points of the sensor (S) to the body (B). The body is always the vehicle's: FRD, in its
centre of mass. EuRoC's own body is its IMU, with other axes.
"""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
import numpy as np
import numpy.typing as npt

from events.base import Quaternion, Vector3
from events.geometry import pose_matrix

_Row = tuple[float, float, float, float]


class EurocMatrix(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Matrix as in a sensor.yaml of EuRoC's.

    Attributes:
        rows: Always 4.
        cols: Always 4.
        data: 16 numbers, row by row.
    """

    rows: Annotated[int, msgspec.Meta(ge=4, le=4)] = 4
    cols: Annotated[int, msgspec.Meta(ge=4, le=4)] = 4
    data: Annotated[tuple[float, ...], msgspec.Meta(min_length=16, max_length=16)]


Matrix = tuple[_Row, _Row, _Row, _Row] | EurocMatrix
"""Transform from a sensor to its body: four rows of four numbers, or as in a sensor.yaml."""


def angles_of(
    given: Matrix,
    axes: Quaternion,  # rotation from the sensor's own axes to those that angles are given of
) -> tuple[Vector3, Vector3]:
    """Return position (metres) and roll, pitch, yaw (degrees) of a mounting.

    Raises:
        ValueError: The matrix is no rigid transform.
    """
    values = given.data if isinstance(given, EurocMatrix) else given
    matrix = np.array(values, np.float64).reshape(4, 4)
    turn = matrix[:3, :3]
    odd = abs(turn @ turn.T - np.eye(3)).max()
    rigid = odd <= 1e-4 and np.linalg.det(turn) > 0.0 and (matrix[3] == (0, 0, 0, 1)).all()
    if not rigid:
        raise ValueError(
            "T_BS: expected a rotation, a position and a last row 0 0 0 1, found "
            f"{matrix.round(6).tolist()}"
        )
    x, y, z = matrix[:3, 3].tolist()
    return (x, y, z), _angles(turn @ pose_matrix((0.0, 0.0, 0.0), axes)[:3, :3].T)


def _angles(turn: npt.NDArray[np.float64]) -> Vector3:
    """Return roll, pitch and yaw, degrees; looking straight up or down, yaw is 0.

    G. G. Slabaugh, "Computing Euler angles from a rotation matrix", 1999, with the roll taken after
    the yaw, which keeps it exact near such a direction.
    """
    level = math.hypot(turn[0, 0], turn[1, 0])
    pitch = math.atan2(-turn[2, 0], level)
    yaw = math.atan2(turn[1, 0], turn[0, 0]) if level > 1e-9 else 0.0
    sine, cosine = math.sin(yaw), math.cos(yaw)
    roll = math.atan2(
        sine * turn[0, 2] - cosine * turn[1, 2], cosine * turn[1, 1] - sine * turn[0, 1]
    )
    return math.degrees(roll), math.degrees(pitch), math.degrees(yaw)


def apply_matrix(mount: msgspec.Struct, axes: Quaternion) -> None:
    """Set position and orientation of settings from their ``T_BS``, which is none from then on.

    Raises:
        ValueError: It is no transform, or position or orientation stand beside it.
    """
    given = getattr(mount, "T_BS", None)
    if given is None:
        return
    for field in msgspec.structs.fields(mount):
        beside = field.name in {"position", "orientation"}
        if beside and getattr(mount, field.name) != field.default:
            raise ValueError(
                f"T_BS: expected it in the place of position and orientation, found {field.name} "
                "beside it"
            )
    position, orientation = angles_of(given, axes)
    for name, value in (("position", position), ("orientation", orientation), ("T_BS", None)):
        msgspec.structs.force_setattr(mount, name, value)
