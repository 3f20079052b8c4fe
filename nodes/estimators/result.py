"""Result of a tracker for an image, sent from a worker's process to the node."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt


class TrackingResult(msgspec.Struct, frozen=True, eq=False):
    """Result of a tracker for an image: camera pose, and the features used.

    Attributes:
        pose: The optical camera at this image in that at the first one, shape (4, 4); metres, or
            the tracker's own unit.
        lost: Whether `pose` is just the last known one.
        reason: Why tracking was lost, or how it was regained.
        points: Tracked features: column and row, float32 pixels, shape (n, 2).
        inliers: Mask of those that agree with the pose: bool, shape (n,).
        velocity: Of the optical camera, in that at the first image, m/s, shape (3,); `None` if
            unknown.
        covariance: Of the pose's error (x, y, z, roll, pitch, yaw) in the optical camera at the
            first image, m², m rad and rad², shape (6, 6): a shift of the camera and a rotation
            about it, along that frame's axes; `None` if unknown.
        map: Number of the pose's map; a new map of guessed pose or unit counts it up, an earlier
            map found again has its old number. Poses of each map are sent in a frame of their own.
    """

    pose: npt.NDArray[np.float64]
    lost: bool = False
    reason: str = ""
    points: npt.NDArray[np.float32] = np.empty((0, 2), np.float32)
    inliers: npt.NDArray[np.bool_] = np.empty(0, np.bool_)
    velocity: npt.NDArray[np.float64] | None = None
    covariance: npt.NDArray[np.float64] | None = None
    map: int = 0


_NOT_RIGID = 1e-2  # by how much a rotation's columns may miss length 1 and right angles


def check_result(result: Any) -> str:
    """Return a complaint on the first non-finite number, or nothing; or raise a `ValueError`."""
    if not isinstance(result, TrackingResult):
        raise ValueError(f"expected a TrackingResult, found {_kind(result)}")
    if result.lost:
        return ""
    given: dict[str, tuple[Any, tuple[int, ...]]] = {"pose": (result.pose, (4, 4))}
    given |= {"velocity": (result.velocity, (3,))} if result.velocity is not None else {}
    given |= {"covariance": (result.covariance, (6, 6))} if result.covariance is not None else {}
    for name, (array, shape) in given.items():
        _check_shape(name, array, shape)
    for name, (array, _) in given.items():
        if not np.isfinite(array).all():
            return f"{name}: expected finite numbers, found {array[~np.isfinite(array)][0]}"
    _check_transform("pose", result.pose)
    return ""


def check_trajectory(stamps: npt.NDArray[np.int64], poses: npt.NDArray[np.float64]) -> None:
    """Raise `ValueError` if these are no poses, shape (n, 4, 4), for stamps (ns), shape (n,)."""
    _check_shape("poses", poses, (len(stamps), 4, 4))
    for pose, stamp in zip(poses, stamps.tolist(), strict=True):
        which = f"pose at {stamp / 1e9:.3f} s"
        if not np.isfinite(pose).all():
            raise ValueError(f"{which}: expected finite numbers, found others")
        _check_transform(which, pose)


def _check_shape(name: str, array: Any, shape: tuple[int, ...]) -> None:
    numbers = isinstance(array, np.ndarray) and array.dtype.kind in "fiu"
    if not numbers or array.shape != shape:
        raise ValueError(
            f"{name}: expected a numpy array of numbers of shape {shape}, found {_kind(array)}"
        )


def _check_transform(name: str, pose: npt.NDArray[Any]) -> None:
    """Raise `ValueError` if a matrix of finite numbers, shape (4, 4), is no rigid transform."""
    turn = pose[:3, :3]
    off = np.abs(turn.T @ turn - np.eye(3)).max()
    if off > _NOT_RIGID or np.linalg.det(turn) < 0:
        lengths = ", ".join(f"{length:.3g}" for length in np.linalg.norm(turn, axis=0))
        raise ValueError(
            f"{name}[:3, :3]: expected a rotation (columns of length 1 at right angles, "
            f"determinant 1), found columns of length {lengths}, determinant "
            f"{np.linalg.det(turn):.3g}"
        )
    if np.abs(pose[3] - (0, 0, 0, 1)).max() > _NOT_RIGID:
        raise ValueError(f"{name}[3]: expected 0, 0, 0, 1, found {pose[3].tolist()}")


def _kind(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"shape {value.shape} of {value.dtype}"
    return "None" if value is None else f"a {type(value).__name__}"
