"""Key frames that are remembered, and how a lost camera finds back to one."""

from __future__ import annotations

from typing import Any

import cv2
import msgspec
import numpy as np

from nodes.visual_odometry.tracker import Floats, Grey


class Keyframe(msgspec.Struct, frozen=True, eq=False):
    """A picture and its landmarks.

    Attributes:
        image: Grey.
        pose: World to camera, shape (4, 4).
        landmarks: In the world, shape (n, 3).
        pixels: Where the picture shows them, shape (n, 2).
    """

    image: Grey
    pose: Floats
    landmarks: Floats
    pixels: Floats


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
