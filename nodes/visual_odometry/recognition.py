"""Knowing a place again with no idea where the camera is: ORB descriptors of points with depth.

E. Rublee et al., "ORB: an efficient alternative to SIFT or SURF", ICCV 2011. The same detector
finds the points of both pictures, so that they are the same points turned the same way.
"""

from __future__ import annotations

from typing import Any

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from events.poses import inverse
from nodes.visual_odometry.surfaces import rays, surfaces_at
from nodes.visual_odometry.tracker import Depth, Floats, Grey

_POINTS = 500
_NEAREST = 3.0
"""Pixels by which a point may miss its place in the pose found."""
_ENOUGH = 15
"""Agreeing points below which a pose is chance."""


class Place(msgspec.Struct, frozen=True, eq=False):
    """Points of a picture by which to know it again.

    Attributes:
        points: Metres in the world, shape (n, 3).
        descriptors: uint8, shape (n, 32).
    """

    points: Floats
    descriptors: npt.NDArray[np.uint8]


def describe(image: Grey) -> tuple[Floats, npt.NDArray[np.uint8]]:
    """Return points of a picture (column, row), shape (n, 2), and descriptors, shape (n, 32)."""
    orb = cv2.ORB.create(_POINTS)
    no_mask: Any = None
    found: Any  # there are none in a blank picture
    keys, found = orb.detectAndCompute(image, no_mask)
    if found is None:
        return np.empty((0, 2)), np.empty((0, 32), np.uint8)
    return np.array([key.pt for key in keys], np.float64), found


def remember(
    image: Grey, inverse_of: Depth, pose: Floats, camera: tuple[float, ...], noise: float
) -> Place:
    """Return what there is to remember of a picture.

    Args:
        image: Grey, shape (h, w).
        inverse_of: As `surfaces.inverse_depth` gives it, shape (h, w).
        pose: World to camera, shape (4, 4).
        camera: fx, fy, cx, cy.
        noise: Standard deviation of one pixel's inverse depth, 1/m.
    """
    pixels, descriptors = describe(image)
    seen = surfaces_at(inverse_of, pixels, noise)
    whole, back = seen.whole, inverse(pose)
    points = rays(pixels[whole], camera) / seen.inverse[whole, None]
    return Place(points @ back[:3, :3].T + back[:3, 3], descriptors[whole])


def recognise(
    pixels: Floats, descriptors: npt.NDArray[np.uint8], place: Place, matrix: Floats
) -> Floats | None:
    """Return the pose from which a picture shows a place, world to camera, if it does.

    Args:
        pixels: Points of the picture, as `describe` gives them, shape (n, 2).
        descriptors: Theirs, shape (n, 32).
        place: Where it may be.
        matrix: K, shape (3, 3).
    """
    if min(len(pixels), len(place.points)) < _ENOUGH:
        return None
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
    matches = matcher.match(place.descriptors, descriptors)
    if len(matches) < _ENOUGH:
        return None
    inliers: Any  # there are none if nothing was found
    found, turn, shift, inliers = cv2.solvePnPRansac(
        place.points[[match.queryIdx for match in matches]],
        pixels[[match.trainIdx for match in matches]],
        matrix,
        None,
        iterationsCount=300,
        reprojectionError=_NEAREST,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not found or inliers is None or len(inliers) < _ENOUGH:
        return None
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
    return pose
