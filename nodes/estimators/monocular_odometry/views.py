"""Geometry of several views: triangulation, reprojection, and the motion between two views.

Poses are world to camera, shape (4, 4); lengths are in the map's own unit.

Corners of an image, and key frames that are stored for relocalization.

Settings of monocular odometry.
"""

from __future__ import annotations

from typing import Annotated, Any

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from nodes.estimators.odometry.images import Floats, Grey

_PLANE = 3.0
"""Pixels up to which a corner fits a homography."""
_EPIPOLAR = 1.0
"""Pixels up to which it fits an essential matrix."""


def triangulate(first: Floats, second: Floats, a: Floats, b: Floats) -> Floats:
    """Return the midpoints between pairs of rays where these are closest to each other.

    Args:
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


class Keyframe(msgspec.Struct, frozen=True, eq=False):
    """An image and its landmarks.

    Attributes:
        image: Grey.
        pose: World to camera, shape (4, 4).
        landmarks: Points in the world, shape (n, 3).
        pixels: Their pixels in the image, shape (n, 2).
    """

    image: Grey
    pose: Floats
    landmarks: Floats
    pixels: Floats


BORDER = 12
"""Pixels at the edge of the image without new corners: optical flow needs a neighbourhood."""
SPACING = 12
"""Pixels between corners."""
_QUALITY = 0.005


def new_corners(image: Grey, taken: Floats, count: int) -> Floats:
    """Return up to `count` corners that keep away from other ones.

    Args:
        image: Grey.
        taken: The other corners: column and row, shape (k, 2).
        count: At least one.

    Returns:
        Column and row, shape (n, 2).
    """
    mask = np.zeros_like(image)
    mask[BORDER:-BORDER, BORDER:-BORDER] = 255
    for column, row in np.rint(taken).astype(int).tolist():
        cv2.circle(mask, (column, row), SPACING, 0, -1)
    found: Any = cv2.goodFeaturesToTrack(image, count, _QUALITY, SPACING, mask=mask, blockSize=5)
    return np.empty((0, 2)) if found is None else found.reshape(-1, 2).astype(np.float64)


class MonocularSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the method.

    Attributes:
        corners: Corners that are followed from a key frame.
        window: Side of the neighbourhood that optical flow compares, pixels; odd.
        levels: Times that flow halves the image for large motions between two images.
        pixel_noise: Standard deviation of a followed corner, pixels.
        keyframes: Key frames that are adjusted together.
        keyframe_shift: A key frame is made, and initialization tried, at this median motion since
            the last one, pixels,
        keyframe_overlap: or when less than this share of the last one's corners, or of its
            landmarks, is in view.
        min_parallax: Angle between two views of a corner from which its point is computed, degrees.
        min_inliers: Agreeing landmarks below which the camera is lost.
        reset_timeout: Seconds for which a lost camera is only relocalized; then a new map is tried
            as well, whose unit of length is a guess.
    """

    corners: Annotated[int, msgspec.Meta(ge=60, le=2000)] = 250
    window: Annotated[int, msgspec.Meta(ge=5, le=51)] = 15
    levels: Annotated[int, msgspec.Meta(ge=0, le=6)] = 4
    pixel_noise: Annotated[float, msgspec.Meta(gt=0)] = 0.25
    keyframes: Annotated[int, msgspec.Meta(ge=3, le=30)] = 8
    keyframe_shift: Annotated[float, msgspec.Meta(gt=0)] = 25.0
    keyframe_overlap: Annotated[float, msgspec.Meta(gt=0, lt=1)] = 0.7
    min_parallax: Annotated[float, msgspec.Meta(gt=0)] = 1.5
    min_inliers: Annotated[int, msgspec.Meta(ge=8)] = 20
    reset_timeout: Annotated[float, msgspec.Meta(ge=0)] = 1.0
