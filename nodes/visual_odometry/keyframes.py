"""Key frames: a picture, the landmarks seen in it, and how a lost camera finds back to it."""

from __future__ import annotations

from typing import Any

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from nodes.visual_odometry.depth import back_project, inverse_depth_at
from nodes.visual_odometry.tracker import Depth, Floats, Grey

BORDER = 12
"""Pixels at the rim that hold no corner: optical flow needs a neighbourhood."""
SPACING = 10
"""Pixels between corners."""
_QUALITY = 0.005
_BLOCK = 5
_FUSED_AT_MOST = 10.0
"""A landmark's mean goes on moving: after this many readings the newest counts a tenth."""


class Keyframe(msgspec.Struct, frozen=True, eq=False):
    """A picture and its landmarks.

    Attributes:
        image: Grey.
        pose: World to camera, shape (4, 4).
        landmarks: Metres in the world, shape (n, 3).
        pixels: Where the picture shows them, shape (n, 2).
        readings: How many depths each landmark is the mean of, shape (n,).
    """

    image: Grey
    pose: Floats
    landmarks: Floats
    pixels: Floats
    readings: Floats

    def __len__(self) -> int:
        return len(self.landmarks)


def make_keyframe(
    image: Grey,
    depth: Depth,
    pose: Floats,
    camera: tuple[float, ...],
    count: int,
    kept: Keyframe | None = None,
) -> Keyframe:
    """Make a key frame of the landmarks that are kept and of new corners between them.

    Args:
        image: Grey, shape (h, w).
        depth: Metres, shape (h, w).
        pose: World to camera, shape (4, 4).
        camera: fx, fy, cx, cy.
        count: Landmarks wanted.
        kept: Landmarks that were followed into this picture.
    """
    mask = np.zeros_like(image)
    mask[BORDER:-BORDER, BORDER:-BORDER] = 255
    if kept is not None:
        for column, row in np.rint(kept.pixels).astype(int).tolist():
            cv2.circle(mask, (column, row), SPACING, 0, -1)
    wanted = max(count - (0 if kept is None else len(kept)), count // 8)
    found: Any = cv2.goodFeaturesToTrack(
        image, wanted, _QUALITY, SPACING, mask=mask, blockSize=_BLOCK
    )
    corners = np.empty((0, 2)) if found is None else found.reshape(-1, 2).astype(np.float64)
    inverse, good = inverse_depth_at(depth, corners)
    corners = corners[good]
    landmarks = to_world(back_project(corners, inverse[good], camera), pose)
    readings = np.ones(len(corners))
    if kept is None:
        return Keyframe(image, pose, landmarks, corners, readings)
    return Keyframe(
        image,
        pose,
        np.concatenate([kept.landmarks, landmarks]),
        np.concatenate([kept.pixels, corners]),
        np.concatenate([kept.readings, readings]),
    )


def fuse(
    landmarks: Floats,
    readings: Floats,
    again: Floats,
    distance: Floats,
    good: npt.NDArray[np.bool_],
) -> tuple[Floats, Floats]:
    """Return landmarks moved to the mean of all readings of their depth, and how many those are.

    Args:
        landmarks: As known, metres, shape (n, 3).
        readings: How many depths each is the mean of, shape (n,).
        again: The same landmarks as this picture's depth has them, shape (n, 3).
        distance: From the camera, metres, shape (n,).
        good: Where there is a depth.
    """
    near = np.linalg.norm(again - landmarks, axis=1) < 0.02 + 0.03 * distance
    use = good & near
    share = np.where(use, 1.0 / (readings + 1.0), 0.0)
    moved = landmarks + np.where(use[:, None], again - landmarks, 0.0) * share[:, None]
    return moved, np.minimum(readings + use, _FUSED_AT_MOST)


def to_world(points: Floats, pose: Floats) -> Floats:
    """Take points, shape (n, 3), from the camera of a pose (world to camera) to the world."""
    return np.asarray((points - pose[:3, 3]) @ pose[:3, :3])


def find_again(image: Grey, keyframe: Keyframe, matrix: Floats) -> tuple[Floats, int] | None:
    """Return the pose of a picture against a key frame, with no idea where the camera is.

    ORB descriptors at the key frame's landmarks are matched with those of the picture, and a pose
    is found by RANSAC.

    Args:
        image: Grey.
        keyframe: What to look for.
        matrix: K, shape (3, 3).

    Returns:
        World to camera, shape (4, 4), and how many landmarks agree; `None` if too few do.
    """
    orb = cv2.ORB.create(1000)
    # Given points, ORB would not compute their orientation, but the picture's own have one.
    angles = _orientations(keyframe.image, keyframe.pixels)
    wanted = [
        cv2.KeyPoint(float(x), float(y), 31.0, float(angle), class_id=row)
        for row, ((x, y), angle) in enumerate(zip(keyframe.pixels, angles, strict=True))
    ]
    at: Any
    known: Any
    seen: Any  # there are none in a blank picture
    at, known = orb.compute(keyframe.image, wanted)
    seen_at, seen = orb.detectAndCompute(image, None)
    if known is None or seen is None:
        return None
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(known, seen)
    if len(matches) < _ENOUGH:
        return None
    landmarks = keyframe.landmarks[[at[m.queryIdx].class_id for m in matches]]
    pixels = np.array([seen_at[m.trainIdx].pt for m in matches])
    cv2.setRNGSeed(1)
    inliers: Any  # there are none if nothing was found
    found, turn, shift, inliers = cv2.solvePnPRansac(
        landmarks, pixels, matrix, None, iterationsCount=300, reprojectionError=3.0
    )
    if not found or inliers is None or len(inliers) < _ENOUGH:
        return None
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
    return pose, len(inliers)


_ENOUGH = 15
"""Agreeing landmarks below which a pose is chance."""


def _orientations(image: Grey, pixels: Floats) -> Floats:
    """Return the directions from corners to the centroids of their neighbourhoods, degrees.

    The intensity centroid of E. Rublee et al., "ORB", ICCV 2011, section 3.2; shape (n,).
    """
    side = np.arange(-_RADIUS, _RADIUS + 1)
    dx, dy = (axis.ravel() for axis in np.meshgrid(side, side))
    disc = dx**2 + dy**2 <= _RADIUS**2
    dx, dy = dx[disc], dy[disc]
    columns, rows = np.rint(pixels).astype(np.int64).T
    x = np.clip(columns[:, None] + dx, 0, image.shape[1] - 1)
    y = np.clip(rows[:, None] + dy, 0, image.shape[0] - 1)
    weights = image[y, x].astype(np.float64)
    return np.asarray(np.degrees(np.arctan2(weights @ dy, weights @ dx)) % 360.0)


_RADIUS = 15
"""Pixels around a corner that tell its orientation, as ORB has it."""
