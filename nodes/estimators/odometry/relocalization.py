"""Relocalization: the pose of a lost camera, by ORB descriptors of points whose place is known.

E. Rublee et al., "ORB: an efficient alternative to SIFT or SURF", ICCV 2011.
"""

from __future__ import annotations

from typing import Any

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from nodes.estimators.odometry.images import Floats, Grey
from nodes.estimators.odometry.pose import from_rotation_vector

Descriptors = npt.NDArray[np.uint8]

_MAX_ERROR = 3.0
"""Pixels by which a point may miss its place in the pose found."""
_MIN_INLIERS = 15
"""Agreeing points below which a pose may be chance."""
_RADIUS = 15
"""Pixels around a corner that give its orientation, as in ORB."""


class DescribedPoints(msgspec.Struct, frozen=True, eq=False):
    """Points of the world and what they look like.

    Attributes:
        points: Metres (or the map's unit) in the world, shape (n, 3).
        descriptors: uint8, shape (n, 32).
    """

    points: Floats
    descriptors: Descriptors


def detect_and_describe(image: Grey, count: int) -> tuple[Floats, Descriptors]:
    """Return up to `count` points of an image (column, row), shape (n, 2), and descriptors."""
    no_mask: Any = None
    found: Any  # there are none in a blank image
    keys, found = cv2.ORB.create(count).detectAndCompute(image, no_mask)
    if found is None:
        return np.empty((0, 2)), np.empty((0, 32), np.uint8)
    return np.array([key.pt for key in keys], np.float64), found


def describe(image: Grey, pixels: Floats, points: Floats) -> DescribedPoints:
    """Return the described points at given pixels; those too near to the edge are left out.

    Args:
        image: Grey.
        pixels: Column and row, shape (n, 2).
        points: Their places in the world, shape (n, 3).
    """
    # For given points ORB does not compute the orientation, as it does for those that it detects.
    keys = [
        cv2.KeyPoint(float(x), float(y), 31.0, float(angle), class_id=row)
        for row, ((x, y), angle) in enumerate(
            zip(pixels, _orientations(image, pixels), strict=True)
        )
    ]
    found: Any  # there are none if all are near to the edge
    kept, found = cv2.ORB.create().compute(image, keys)
    if found is None:
        return DescribedPoints(np.empty((0, 3)), np.empty((0, 32), np.uint8))
    return DescribedPoints(points[[key.class_id for key in kept]], found)


def relocalize(
    pixels: Floats,
    descriptors: Descriptors,
    known: DescribedPoints,
    matrix: Floats,
    method: int = cv2.SOLVEPNP_ITERATIVE,
) -> Floats | None:
    """Return the pose from which an image shows known points, world to camera, if it does.

    Args:
        pixels: Points of the image, as `detect_and_describe` gives them, shape (n, 2).
        descriptors: Descriptors of these, shape (n, 32).
        known: Points that the image may show.
        matrix: K, shape (3, 3).
        method: OpenCV's solver of a pose from points.
    """
    if min(len(pixels), len(known.points)) < _MIN_INLIERS:
        return None
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
    matches = matcher.match(known.descriptors, descriptors)
    if len(matches) < _MIN_INLIERS:
        return None
    cv2.setRNGSeed(1)
    inliers: Any  # there are none if nothing was found
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        known.points[[match.queryIdx for match in matches]],
        pixels[[match.trainIdx for match in matches]],
        matrix,
        None,
        iterationsCount=300,
        reprojectionError=_MAX_ERROR,
        flags=method,
    )
    if not found or inliers is None or len(inliers) < _MIN_INLIERS:
        return None
    return from_rotation_vector(rotation, translation)


def _orientations(image: Grey, pixels: Floats) -> Floats:
    """Return the directions from corners to the centroids of their neighbourhoods, degrees.

    The intensity centroid of "ORB", section 3.2; shape (n,).
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
