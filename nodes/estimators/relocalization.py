"""Relocalization by ORB descriptors of known points.

E. Rublee et al., "ORB: an efficient alternative to SIFT or SURF", ICCV 2011.
"""

from __future__ import annotations

from typing import Any

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from nodes.estimators.images import Floats, Grey
from nodes.estimators.pose import transform

Descriptors = npt.NDArray[np.uint8]

_MAX_ERROR = 3.0  # largest error of a point in the found pose, pixels
_MIN_INLIERS = 15  # least number of agreeing points; a pose from fewer may be chance
_RADIUS = 15  # radius of the patch for a corner's orientation, pixels, as in ORB


class DescribedPoints(msgspec.Struct, frozen=True, eq=False):
    """World points with their descriptors."""

    points: Floats  # metres (or the map's unit) in the world, shape (n, 3)
    descriptors: Descriptors  # uint8, shape (n, 32)


def detect_and_describe(image: Grey, count: int) -> tuple[Floats, Descriptors]:
    """Return up to `count` points of an image (column, row), shape (n, 2), and descriptors."""
    no_mask: Any = None
    descriptors: Any  # there are none in a blank image
    keys, descriptors = cv2.ORB.create(count).detectAndCompute(image, no_mask)
    if descriptors is None:
        return np.empty((0, 2)), np.empty((0, 32), np.uint8)
    return np.array([key.pt for key in keys], np.float64), descriptors


def describe(image: Grey, pixels: Floats, points: Floats) -> DescribedPoints:
    """Return points (n, 3) with descriptors at pixels (n, 2); without those near to the edge."""
    # For given points ORB does not compute the orientation, as it does for those that it detects.
    keys = [
        cv2.KeyPoint(float(x), float(y), 31.0, float(angle), class_id=row)
        for row, ((x, y), angle) in enumerate(
            zip(pixels, _orientations(image, pixels), strict=True)
        )
    ]
    descriptors: Any  # there are none if all are near to the edge
    described, descriptors = cv2.ORB.create().compute(image, keys)
    if descriptors is None:
        return DescribedPoints(np.empty((0, 3)), np.empty((0, 32), np.uint8))
    return DescribedPoints(points[[key.class_id for key in described]], descriptors)


def relocalize(
    pixels: Floats,  # points of the image, as of `detect_and_describe`, shape (n, 2)
    descriptors: Descriptors,  # theirs, shape (n, 32)
    described: DescribedPoints,
    matrix: Floats,  # K, shape (3, 3)
    method: int = cv2.SOLVEPNP_ITERATIVE,  # OpenCV's solver of a pose from points
) -> Floats | None:
    """Return an image's pose by known points, world to camera; `None` if not found."""
    if min(len(pixels), len(described.points)) < _MIN_INLIERS:
        return None
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
    matches = matcher.match(described.descriptors, descriptors)
    if len(matches) < _MIN_INLIERS:
        return None
    cv2.setRNGSeed(1)
    inliers: Any  # there are none if nothing was found
    solved, rotation, translation, inliers = cv2.solvePnPRansac(
        described.points[[match.queryIdx for match in matches]],
        pixels[[match.trainIdx for match in matches]],
        matrix,
        None,
        iterationsCount=300,
        reprojectionError=_MAX_ERROR,
        flags=method,
    )
    if not solved or inliers is None or len(inliers) < _MIN_INLIERS:
        return None
    return transform(cv2.Rodrigues(rotation)[0], translation)


def _orientations(image: Grey, pixels: Floats) -> Floats:
    """Return corners' directions to their intensity centroids ("ORB", section 3.2), degrees."""
    side = np.arange(-_RADIUS, _RADIUS + 1)
    dx, dy = (axis.ravel() for axis in np.meshgrid(side, side))
    disc = dx**2 + dy**2 <= _RADIUS**2
    dx, dy = dx[disc], dy[disc]
    columns, rows = np.rint(pixels).astype(np.int64).T
    x = np.clip(columns[:, None] + dx, 0, image.shape[1] - 1)
    y = np.clip(rows[:, None] + dy, 0, image.shape[0] - 1)
    weights = image[y, x].astype(np.float64)
    return np.asarray(np.degrees(np.arctan2(weights @ dy, weights @ dx)) % 360.0)
