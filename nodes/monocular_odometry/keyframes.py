"""Key frames that are stored for relocalization."""

from __future__ import annotations

import msgspec

from nodes.odometry.images import Floats, Grey


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
