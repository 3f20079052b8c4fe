"""Geometry of several views: triangulation, reprojection, and the motion between two views.

Poses are world to camera, shape (4, 4); lengths are in the map's own unit.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from nodes.estimators.odometry.images import Floats

_PLANE = 3.0
"""Pixels up to which a corner fits a homography."""
_EPIPOLAR = 1.0
"""Pixels up to which it fits an essential matrix."""


def triangulate(first: Floats, second: Floats, a: Floats, b: Floats) -> Floats:
    """Return the midpoints between pairs of rays where these are closest to each other.

    Args:
        first: Pose of the first camera.
        second: Pose of the second camera.
        a: Rays in the first, shape (n, 3).
        b: Rays in the second, shape (n, 3).

    Returns:
        Points in the world, shape (n, 3); not finite where the rays are parallel.
    """
    centre_a, centre_b = centre(first), centre(second)
    u, v = a @ first[:3, :3], b @ second[:3, :3]
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    base = centre_b - centre_a
    cosine = np.sum(u * v, axis=1)
    along_u, along_v = u @ base, v @ base
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (along_u - cosine * along_v) / (1.0 - cosine**2)
        t = (cosine * along_u - along_v) / (1.0 - cosine**2)
    return np.asarray(0.5 * (centre_a + s[:, None] * u + centre_b + t[:, None] * v))


def parallax(first: Floats, second: Floats, a: Floats, b: Floats) -> Floats:
    """Return the angles between pairs of rays, degrees, shape (n,); arguments as `triangulate`."""
    u, v = a @ first[:3, :3], b @ second[:3, :3]
    sine = np.linalg.norm(np.cross(u, v), axis=1)
    return np.asarray(np.degrees(np.arctan2(sine, np.sum(u * v, axis=1))))


def reprojection_errors(pose: Floats, points: Floats, pixels: Floats, matrix: Floats) -> Floats:
    """Return the distances between projected points and their observed pixels.

    Args:
        pose: Pose of the camera.
        points: Points in the world, shape (n, 3).
        pixels: Their observed pixels, shape (n, 2).
        matrix: K, shape (3, 3).

    Returns:
        Pixels, shape (n,); ``inf`` behind the camera and for a point that is not finite.
    """
    seen = points @ pose[:3, :3].T + pose[:3, 3]
    ahead = seen[:, 2] > 1e-6
    z = np.where(ahead, seen[:, 2], 1.0)
    x = matrix[0, 0] * seen[:, 0] / z + matrix[0, 2] - pixels[:, 0]
    y = matrix[1, 1] * seen[:, 1] / z + matrix[1, 2] - pixels[:, 1]
    return np.where(ahead & np.isfinite(x) & np.isfinite(y), np.hypot(x, y), np.inf)


def centre(pose: Floats) -> Floats:
    """Return the position of a camera, shape (3,)."""
    return np.asarray(-pose[:3, :3].T @ pose[:3, 3])


def hypotheses(first: Floats, second: Floats, matrix: Floats) -> list[Floats]:
    """Return the motions that two views of the same corners allow.

    A homography (the corners lie on a plane; up to four motions: E. Malis and M. Vargas, "Deeper
    understanding of the homography decomposition", INRIA 2007) and an essential matrix (they do
    not: D. Nistér, "An efficient solution to the five-point relative pose problem", PAMI 2004) are
    both fitted; which of all is right shows in further views.

    Args:
        first: Pixels in the first view, shape (n, 2).
        second: Pixels in the second, shape (n, 2).
        matrix: K, shape (3, 3).

    Returns:
        Poses of the second camera in the first's frame, with a baseline of 1.
    """
    found: list[Floats] = []
    cv2.setRNGSeed(1)
    plane: Any
    plane, _ = cv2.findHomography(first, second, cv2.RANSAC, _PLANE)
    if plane is not None:
        _, turns, shifts, _ = cv2.decomposeHomographyMat(plane, matrix)
        for turn, shift in zip(turns, shifts, strict=True):
            if (length := float(np.linalg.norm(shift))) > 1e-6:
                found.append(_pose(turn, shift / length))
    essential: Any
    essential, _ = cv2.findEssentialMat(first, second, matrix, cv2.RANSAC, 0.999, _EPIPOLAR)
    if essential is not None and essential.shape == (3, 3):
        one, other, shift = cv2.decomposeEssentialMat(essential)
        found += [_pose(turn, sign * shift) for turn in (one, other) for sign in (1.0, -1.0)]
    return found


def _pose(turn: npt.NDArray[Any], shift: npt.NDArray[Any]) -> Floats:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, np.asarray(shift).ravel()
    return pose
