"""Answers of a linked program, checked field by field.

Also the JSON text of WELCOME: the description of the run's cameras, inputs and outputs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from events import Announcement, CameraAnnouncement
from events.covariance import cross_matrix, moved_covariance
from events.geometry import inverse, pose_matrix
from nodes.outside.native.client import (
    AXES,
    COVARIANCE,
    DONE_BODY,
    ORDER_BODY,
    ORDERS,
    POSE_HEAD,
    STAMPED_POSE,
    STATUS,
    VELOCITY,
)
from nodes.outside.native.rows import described_row
from runtime.errors import VisnavError

TOLERANCE = 1e-4  # tolerated deviation from orthonormality, for rotations in single precision
FARTHEST = 1e9  # largest accepted coordinate of a pose, metres

MATRIX, POINT = 12 * 8, 2 * 4 + 1  # bytes of a pose, and of a point with its flag
FOLLOWS = (COVARIANCE, 36), (VELOCITY, 3)
"""Optional fields after a pose: flag, and count of numbers."""


class LinkError(VisnavError):
    """A program is missing, or does not keep to the protocol; or a run has the socket already."""


class LinkOrder(msgspec.Struct, frozen=True):
    """An order to the vehicle."""

    sequence: int
    stamp: int
    order: str  # ``takeoff``, ``land``, ``position`` or ``velocity``
    axes: str  # ``map`` or ``heading``, of a velocity
    position: tuple[float, float, float]  # metres in ``map``
    velocity: tuple[float, float, float]  # metres per second along the axes
    yaw: float  # radians
    yaw_rate: float  # radians per second


class LinkAnswer(msgspec.Struct, frozen=True, eq=False):
    """The answer to a frame."""

    sequence: int  # number of the frame
    stamp: int  # stamp of the frame (ns)
    # ``done``: the program says no more about this frame.
    status: Literal["tracked", "lost", "initialising", "done"]
    # The optical camera 0 (the body, without a camera) in that of the program's first pose, shape
    # (4, 4); `None` if the status is not ``tracked``.
    pose: npt.NDArray[np.float64] | None = None
    # Of the error of that pose: a shift of the camera and a rotation about it, along the axes of
    # the camera (or body) of the first pose, shape (6, 6); `None` without any.
    covariance: npt.NDArray[np.float64] | None = None
    # Along the same axes, m/s, shape (3,); `None` without any.
    velocity: npt.NDArray[np.float64] | None = None
    # Features that were tracked: column and row, float32 pixels, shape (n, 2).
    points: npt.NDArray[np.float32] = np.empty((0, 2), np.float32)
    # Which of them agree with the pose: bool, shape (n,).
    inliers: npt.NDArray[np.bool_] = np.empty(0, np.bool_)
    output: int = 0  # number of the output; 0 is the answer itself
    # Further outputs and orders that came before the answer to the same frame.
    before: tuple[LinkAnswer | LinkOrder, ...] = ()


class LinkTrajectory(NamedTuple):
    """Final trajectory of a program."""

    stamps: npt.NDArray[np.int64]  # those of frames (ns), strictly rising, shape (n,)
    # The optical camera 0 (the body, without a camera) in that of the program's first pose, shape
    # (n, 4, 4).
    poses: npt.NDArray[np.float64]


def read_done(body: bytearray) -> LinkAnswer:
    """Read the body of a DONE.

    Raises:
        LinkError: It is not as the protocol says.
    """
    if len(body) != DONE_BODY.size:
        raise LinkError(f"DONE: expected {DONE_BODY.size} bytes, found {len(body)}")
    sequence, stamp = DONE_BODY.unpack(body)
    return LinkAnswer(sequence, stamp, "done")


def read_order(body: bytearray) -> LinkOrder:
    """Read the body of an ORDER.

    Raises:
        LinkError: It is not as the protocol says, or not finite.
    """
    if len(body) != ORDER_BODY.size:
        raise LinkError(f"ORDER: expected {ORDER_BODY.size} bytes, found {len(body)}")
    sequence, stamp, order, axes, *numbers = ORDER_BODY.unpack(body)
    if order not in ORDERS.values() or axes not in AXES.values():
        raise LinkError(f"ORDER: expected an order 0 to 3 with axes 0 or 1, found {order}, {axes}")
    _finite("ORDER", np.array(numbers))
    (x, y, z, u, v, w, yaw, rate), names = numbers, ([*ORDERS][order], [*AXES][axes])
    return LinkOrder(sequence, stamp, *names, (x, y, z), (u, v, w), yaw, rate)


def read_pose(body: bytearray) -> LinkAnswer:
    """Read the body of a POSE; pose, covariance and velocity are as the program gave them.

    Raises:
        LinkError: It is not as the protocol says, or not finite, or has no rotation.
    """
    if len(body) < POSE_HEAD.size + MATRIX:
        raise LinkError(f"POSE: expected {POSE_HEAD.size + MATRIX} bytes, found {len(body)}")
    sequence, stamp, number, follows, count, output = POSE_HEAD.unpack_from(body)
    status = next((name for name, code in STATUS.items() if code == number), None)
    if status is None:
        raise LinkError(f"POSE.status: expected one of {[*STATUS.values()]}, found {number}")
    if follows > COVARIANCE | VELOCITY:
        raise LinkError(f"POSE.follows: expected 0 to 3, found {follows}")
    numbers = sum(n for flag, n in FOLLOWS if follows & flag)
    expected = POSE_HEAD.size + MATRIX + 8 * numbers + count * POINT
    if len(body) != expected:
        raise LinkError(f"POSE: expected {expected} bytes for {count} points, found {len(body)}")
    pose, at = None, POSE_HEAD.size
    if status == "tracked":
        pose = _checked_poses("POSE.pose", np.frombuffer(body, "<f8", 12, at).reshape(1, 3, 4))[0]
    at += MATRIX
    arrays = np.split(np.frombuffer(body, "<f8", numbers, at), [36] if follows & COVARIANCE else [])
    covariance = arrays[0].reshape(6, 6) if follows & COVARIANCE else None
    velocity = arrays[-1] if follows & VELOCITY else None
    _finite("POSE.covariance", covariance)
    _finite("POSE.velocity", velocity)
    at += 8 * numbers
    points = np.frombuffer(body, "<f4", 2 * count, at).reshape(-1, 2)
    _finite("POSE.points", points)
    inliers = np.frombuffer(body, "u1", count, at + 8 * count) != 0
    fields: Any = status, pose, covariance, velocity, points, inliers, output
    return LinkAnswer(sequence, stamp, *fields)


def read_trajectory(body: bytearray) -> LinkTrajectory:
    """Read the body of a TRAJECTORY; poses are as the program gave them.

    Raises:
        LinkError: It is not as the protocol says, or not finite, or has no rotation.
    """
    if len(body) % STAMPED_POSE.itemsize:
        raise LinkError(
            f"TRAJECTORY: expected {STAMPED_POSE.itemsize} bytes a pose, found {len(body)} in all"
        )
    rows = np.frombuffer(body, STAMPED_POSE)
    stamps = rows["stamp"].astype(np.int64)
    if (falls := np.flatnonzero(stamps[1:] <= stamps[:-1])).size:
        before, after = stamps[falls[0]], stamps[falls[0] + 1]
        raise LinkError(
            f"TRAJECTORY.stamp: expected them to rise strictly, found {after} after {before}"
        )
    return LinkTrajectory(stamps, _checked_poses("TRAJECTORY.pose", rows["pose"]))


def _checked_poses(field: str, rows: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return transforms, shape (n, 4, 4), of their first three rows, shape (n, 3, 4)."""
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows
    _finite(field, poses)
    if (far := np.abs(poses).max(initial=0.0)) > FARTHEST:
        raise LinkError(f"{field}: expected at most {FARTHEST:g} m, found {far:g}")
    turns = poses[:, :3, :3]
    misses = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    miss = np.maximum(misses, 1.0 - np.linalg.det(turns)).max(initial=0.0)
    if miss > TOLERANCE:
        raise LinkError(f"{field}: expected a rotation within {TOLERANCE:g}, off by {miss:g}")
    return poses


def _finite(field: str, values: npt.NDArray[np.floating] | None) -> None:
    if values is not None and not (good := np.isfinite(values)).all():
        raise LinkError(f"{field}: expected finite numbers, found {values[~good][0]}")


class CameraPoses:
    """Turns a program's poses into those of the optical camera in that of the first pose.

    Args:
        body_from_camera: Transform, shape (4, 4), if the program's poses are of the body and there
            is a camera; else `None`.
    """

    def __init__(self, body_from_camera: npt.NDArray[np.float64] | None) -> None:
        self._body_from_camera = body_from_camera
        self._origins: dict[int, npt.NDArray[np.float64]] = {}  # inverse first pose, by output

    def of(self, answer: LinkAnswer) -> LinkAnswer:
        """Return an answer with pose, covariance and velocity in the frame of the first pose."""
        if answer.pose is None:
            return answer
        pose, lever = answer.pose, np.zeros(3)
        if self._body_from_camera is not None:
            pose = answer.pose @ self._body_from_camera
            lever = pose[:3, 3] - answer.pose[:3, 3]  # from body to camera, in the program's frame
        origin = self._origins.setdefault(answer.output, inverse(pose))
        turn, covariance, velocity = origin[:3, :3], answer.covariance, answer.velocity
        if covariance is not None:
            covariance = moved_covariance(covariance, turn, -turn @ cross_matrix(lever))
        return msgspec.structs.replace(
            answer,
            pose=origin @ pose,
            covariance=covariance,
            velocity=None if velocity is None else turn @ velocity,
        )

    def of_trajectory(self, trajectory: LinkTrajectory) -> LinkTrajectory:
        """Return a trajectory in the frame of the first pose, or of its own first without one."""
        stamps, poses = trajectory
        if self._body_from_camera is not None:
            poses = poses @ self._body_from_camera
        origin = self._origins.get(0)
        if origin is None and len(poses):
            origin = inverse(poses[0])
        return trajectory if origin is None else LinkTrajectory(stamps, origin @ poses)


def describe(
    cameras: Sequence[tuple[CameraAnnouncement, Sequence[str]]],
    inputs: Sequence[tuple[str, str, Announcement]],
    clock: Mapping[str, Any],
    outputs: Sequence[str] = (),  # names of the further outputs
) -> dict[str, Any]:
    """Return the description of a run: the announcements' fields, and transforms to the body (FRD).

    Args:
        cameras: Each with the kinds of image that will be sent of it (``rgb8``, ``depth32f``, …).
        inputs: Name, kind (of its rows) and announcement of each.
        clock: ``kind`` of the run's clock (``lockstep`` or ``real``), and what else is known.
    """
    return {
        "clock": dict(clock),
        "cameras": [
            {**_sensor(camera, "body_from_camera"), "images": list(kinds)}
            for camera, kinds in cameras
        ],
        "inputs": [
            {
                "name": name,
                "kind": kind,
                **described_row(kind),
                **_sensor(announced, "body_from_sensor"),
            }
            for name, kind, announced in inputs
        ],
        "outputs": [*outputs],
    }


def _sensor(announced: Announcement, transform: str) -> dict[str, Any]:
    fields: dict[str, Any] = msgspec.to_builtins(announced)
    if "position" not in fields:
        return fields
    return {**fields, transform: pose_matrix(fields["position"], fields["orientation"]).tolist()}
