"""Settings of monocular odometry."""

from __future__ import annotations

from typing import Annotated

import msgspec


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
