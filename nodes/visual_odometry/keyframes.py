"""Key frames: where landmarks were first seen, and by which a lost camera is relocalized."""

from __future__ import annotations

import functools

import msgspec

from events.poses import inverse
from nodes.odometry.images import Depth, Floats, Grey
from nodes.odometry.pose import rays
from nodes.odometry.relocalization import DescribedPoints, detect_and_describe
from nodes.visual_odometry.surfaces import surfaces_at

ORB_POINTS = 500
"""Points by which an image is described."""


class Keyframe(msgspec.Struct, frozen=True, eq=False):
    """An image in which landmarks were first seen.

    Attributes:
        image: Grey.
        pose: World to camera, shape (4, 4).
    """

    image: Grey
    pose: Floats


class Described:
    """A key frame's points for relocalization, described when a lost camera first asks for them.

    Args:
        frame: The key frame.
        inverse_of: Its inverse depth, as `inverse_depth` gives it; released once described.
        matrix: K, shape (3, 3).
        noise: Standard deviation of inverse depth, 1/m.
    """

    def __init__(self, frame: Keyframe, inverse_of: Depth, matrix: Floats, noise: float) -> None:
        self._source: tuple[Keyframe, Depth] | None = frame, inverse_of
        self._matrix = matrix
        self._noise = noise

    @functools.cached_property
    def points(self) -> DescribedPoints:
        """The points, in the world."""
        assert self._source is not None
        (frame, inverse_of), self._source = self._source, None
        pixels, descriptors = detect_and_describe(frame.image, ORB_POINTS)
        seen = surfaces_at(inverse_of, pixels, self._noise)
        continuous, back = seen.continuous, inverse(frame.pose)
        points = rays(pixels[continuous], self._matrix) / seen.inverse[continuous, None]
        return DescribedPoints(points @ back[:3, :3].T + back[:3, 3], descriptors[continuous])
