"""Geometry of several views: two-view motion, triangulation, and bundle adjustment.

Poses are world to camera, shape (4, 4); lengths are in the map's own unit. Bundle adjustment:
Gauss-Newton on reprojection errors with Huber weights and a little damping; landmarks are
eliminated by the Schur complement (B. Triggs et al., "Bundle adjustment: a modern synthesis", 2000,
section 6.1).
"""

from __future__ import annotations

from typing import Annotated, Any

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from nodes.estimators.images import Floats, Grey
from nodes.estimators.pose import huber, transform

Indices = npt.NDArray[np.int64]

_HUBER = 2.0  # Huber threshold of a residual, standard deviations
_DAMPING = 1e-4


def adjust(
    poses: Floats,  # world to camera, shape (k, 4, 4)
    landmarks: Floats,  # points in the world, shape (l, 3)
    frame: Indices,  # index of the pose of each observation, shape (m,)
    landmark: Indices,
    pixels: Floats,  # column and row of each observation, shape (m, 2)
    matrix: Floats,  # K, shape (3, 3)
    *,
    fixed: int,  # number of first poses that stay; two fix position, rotation and scale
    noise: float,  # standard deviation of an observation, pixels
    steps: int = 4,
) -> tuple[Floats, Floats, Floats]:
    """Return poses and landmarks after bundle adjustment, and reprojection errors (pixels, (m,)).

    Args:
        landmark: Index of its landmark, ascending, shape (m,): each has observations, at most one
            in each frame.
    """
    poses, landmarks = poses.copy(), landmarks.copy()
    free = len(poses) - fixed
    scale = np.array([matrix[0, 0], matrix[1, 1]]) / noise
    target = (pixels - matrix[:2, 2]) / (matrix[0, 0], matrix[1, 1])
    moves = frame >= fixed
    begins = np.flatnonzero(np.diff(landmark, prepend=-1))
    for _ in range(steps):
        residuals, by_pose, by_point, weights = linearise(
            poses, landmarks, frame, landmark, target, scale
        )
        weighted_pose = by_pose * weights[:, None, None]
        weighted_point = by_point * weights[:, None, None]
        h_point = np.add.reduceat(np.swapaxes(weighted_point, 1, 2) @ by_point, begins)
        g_point = np.add.reduceat(np.einsum("mij,mi->mj", weighted_point, residuals), begins)
        h_point += _DAMPING * np.eye(3) * (1.0 + np.trace(h_point, axis1=1, axis2=2))[:, None, None]
        inverse = np.linalg.inv(h_point)
        step_pose = np.zeros((free, 6))
        if free:
            k = frame[moves] - fixed
            h_pose, g_pose = np.zeros((free, 6, 6)), np.zeros((free, 6))
            for index in range(free):
                rows = frame == fixed + index
                weighted = weighted_pose[rows].reshape(-1, 6)
                h_pose[index] = weighted.T @ by_pose[rows].reshape(-1, 6)
                g_pose[index] = weighted.T @ residuals[rows].reshape(-1)
            cross = np.zeros((free, 6, len(landmarks), 3))
            cross[k, :, landmark[moves]] = np.swapaxes(weighted_pose[moves], 1, 2) @ by_point[moves]
            reduced = np.matmul(np.moveaxis(cross, 2, 0).reshape(-1, 6 * free, 3), inverse)
            reduced = np.moveaxis(reduced, 0, 1).reshape(6 * free, -1)
            flat = cross.reshape(6 * free, -1)
            normal = -reduced @ flat.T
            for index in range(free):
                block = slice(6 * index, 6 * index + 6)
                normal[block, block] += h_pose[index]
            normal += _DAMPING * np.diag(np.maximum(np.diag(normal), 1.0))
            right = g_pose.reshape(-1) - reduced @ g_point.reshape(-1)
            step_pose = -np.linalg.solve(normal, right).reshape(free, 6)
            g_point = g_point + (step_pose.reshape(-1) @ flat).reshape(-1, 3)
        landmarks = landmarks - np.einsum("lij,lj->li", inverse, g_point)
        for index in range(free):
            turn = Rotation.from_rotvec(step_pose[index, 3:]).as_matrix()
            pose = poses[fixed + index]
            pose[:3, :3] = turn @ pose[:3, :3]
            pose[:3, 3] = turn @ pose[:3, 3] + step_pose[index, :3]
    residuals, *_ = linearise(poses, landmarks, frame, landmark, target, scale)
    return poses, landmarks, np.asarray(noise * np.linalg.norm(residuals, axis=1))


def linearise(
    poses: Floats,
    landmarks: Floats,
    frame: Indices,
    landmark: Indices,
    target: Floats,  # each observation as a ray with z = 1, shape (m, 2)
    scale: Floats,  # standard deviations in its unit, shape (2,)
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the residuals of all observations (see `adjust`), and their derivatives.

    Returns:
        Residuals in standard deviations, shape (m, 2); their derivatives by a small motion of the
        camera's frame (translation, then rotation; left perturbation), shape (m, 2, 6), and by the
        landmark, shape (m, 2, 3); Huber's weights, shape (m,), 0 behind the camera.
    """
    turns, shifts = poses[frame, :3, :3], poses[frame, :3, 3]
    points = np.einsum("mij,mj->mi", turns, landmarks[landmark]) + shifts
    ahead = points[:, 2] > 1e-3
    inverse = 1.0 / np.where(ahead, points[:, 2], 1.0)
    x, y = points[:, 0] * inverse, points[:, 1] * inverse
    residuals = (np.stack([x, y], axis=1) - target) * scale
    zero = np.zeros_like(x)
    by_camera = np.stack(
        [
            np.stack([inverse, zero, -x * inverse], axis=1),
            np.stack([zero, inverse, -y * inverse], axis=1),
        ],
        axis=1,
    )
    by_camera *= scale[:, None]
    turning = np.stack(
        [np.stack([-x * y, 1.0 + x * x, -y], axis=1), np.stack([-1.0 - y * y, x * y, x], axis=1)],
        axis=1,
    )
    turning *= scale[:, None]
    by_pose = np.concatenate([by_camera, turning], axis=2)
    by_point = by_camera @ turns
    size = np.linalg.norm(residuals, axis=1)
    weights = np.where(ahead, huber(size, _HUBER), 0.0)
    return residuals, by_pose, by_point, weights


_PLANE = 3.0  # inlier threshold of a corner under a homography, pixels
_EPIPOLAR = 1.0  # inlier threshold of a corner under an essential matrix, pixels


def triangulate(
    first: Floats,
    second: Floats,  # pose of the second camera
    a: Floats,  # rays in the first, shape (n, 3)
    b: Floats,  # rays in the second, shape (n, 3)
) -> Floats:
    """Return the midpoints (n, 3) between pairs of rays where closest; not finite if parallel."""
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
    """Return distances (n,) of points (n, 3) from pixels (n, 2); ``inf`` behind the camera."""
    in_camera = points @ pose[:3, :3].T + pose[:3, 3]
    ahead = in_camera[:, 2] > 1e-6
    z = np.where(ahead, in_camera[:, 2], 1.0)
    x = matrix[0, 0] * in_camera[:, 0] / z + matrix[0, 2] - pixels[:, 0]
    y = matrix[1, 1] * in_camera[:, 1] / z + matrix[1, 2] - pixels[:, 1]
    return np.where(ahead & np.isfinite(x) & np.isfinite(y), np.hypot(x, y), np.inf)


def centre(pose: Floats) -> Floats:
    """Return the position of a camera, shape (3,)."""
    return np.asarray(-pose[:3, :3].T @ pose[:3, 3])


def hypotheses(first: Floats, second: Floats, matrix: Floats) -> list[Floats]:
    """Return the second camera's possible poses, baseline 1, from corners (n, 2) in both views.

    A homography (corners on a plane; up to four motions: E. Malis and M. Vargas, "Deeper
    understanding of the homography decomposition", INRIA 2007) and an essential matrix (D. Nistér,
    "An efficient solution to the five-point relative pose problem", PAMI 2004) are both fitted;
    further views decide which is right.
    """
    motions: list[Floats] = []
    cv2.setRNGSeed(1)
    plane: Any
    plane, _ = cv2.findHomography(first, second, cv2.RANSAC, _PLANE)
    if plane is not None:
        _, turns, shifts, _ = cv2.decomposeHomographyMat(plane, matrix)
        for turn, shift in zip(turns, shifts, strict=True):
            if (length := float(np.linalg.norm(shift))) > 1e-6:
                motions.append(transform(turn, shift / length))
    essential: Any
    essential, _ = cv2.findEssentialMat(first, second, matrix, cv2.RANSAC, 0.999, _EPIPOLAR)
    if essential is not None and essential.shape == (3, 3):
        first_turn, second_turn, shift = cv2.decomposeEssentialMat(essential)
        motions += [
            transform(turn, sign * shift)
            for turn in (first_turn, second_turn)
            for sign in (1.0, -1.0)
        ]
    return motions


class Keyframe(msgspec.Struct, frozen=True, eq=False):
    """An image and its landmarks."""

    image: Grey
    pose: Floats  # world to camera, shape (4, 4)
    landmarks: Floats  # points in the world, shape (n, 3)
    pixels: Floats  # their pixels in the image, shape (n, 2)


BORDER = 12  # pixels at the edge without new corners: flow needs a neighbourhood
SPACING = 12  # pixels between corners
_QUALITY = 0.005


def new_corners(image: Grey, existing: Floats, count: int) -> Floats:
    """Return up to `count` (at least one) new corners (n, 2) away from those taken (k, 2)."""
    mask = np.zeros_like(image)
    mask[BORDER:-BORDER, BORDER:-BORDER] = 255
    for column, row in np.rint(existing).astype(int).tolist():
        cv2.circle(mask, (column, row), SPACING, 0, -1)
    corners: Any = cv2.goodFeaturesToTrack(image, count, _QUALITY, SPACING, mask=mask, blockSize=5)
    return np.empty((0, 2)) if corners is None else corners.reshape(-1, 2).astype(np.float64)


class MonocularSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the method.

    Attributes:
        corners: Corners followed from a key frame.
        window: Side of the neighbourhood that optical flow compares, pixels; odd.
        levels: Times that flow halves the image for large motions between two images.
        pixel_noise: Standard deviation of a followed corner, pixels.
        keyframes: Key frames adjusted together.
        keyframe_shift: Median motion since the last key frame at which one is made, and
            initialization tried, pixels,
        keyframe_overlap: or share of its corners, or landmarks, in view below which one is made.
        min_parallax: Angle between two views of a corner from which its point is computed, degrees.
        min_inliers: Agreeing landmarks below which the camera is lost.
        reset_timeout: Seconds of mere relocalization of a lost camera; then a new map, of a guessed
            unit of length, is tried as well.
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
