"""Settings of the method on features."""

from __future__ import annotations

from typing import Annotated

import msgspec


class FeatureSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the method on features.

    Attributes:
        spacing: Side of the squares of the image of which each holds one landmark, pixels. Time
            grows with their number.
        window: Side of the patches that are compared, pixels; odd.
        levels: Times that flow halves the image for large motions between two images.
        pixel_noise: Standard deviation of a patch's position, pixels.
        depth_noise: Standard deviation of inverse depth, 1/m: k of a sensor with sigma = k z².
        keyframes: Key frames that are stored. One takes the memory of a grey image.
        keyframe_overlap: A key frame is made when less than this share of the last one's landmarks
            is in view,
        keyframe_rotation: or at this rotation since the last one, degrees,
        keyframe_shift: or at this motion since the last one, pixels at the median depth.
        min_inliers: Agreeing landmarks below which the camera is lost.
        reset_timeout: Seconds for which a lost camera is only relocalized; then a new map starts at
            its last pose.
    """

    spacing: Annotated[int, msgspec.Meta(ge=12, le=128)] = 28
    window: Annotated[int, msgspec.Meta(ge=7, le=31)] = 11
    levels: Annotated[int, msgspec.Meta(ge=0, le=6)] = 4
    pixel_noise: Annotated[float, msgspec.Meta(gt=0)] = 0.3
    depth_noise: Annotated[float, msgspec.Meta(gt=0)] = 0.002
    keyframes: Annotated[int, msgspec.Meta(ge=2, le=10_000)] = 200
    keyframe_overlap: Annotated[float, msgspec.Meta(gt=0, lt=1)] = 0.6
    keyframe_rotation: Annotated[float, msgspec.Meta(gt=0)] = 12.0
    keyframe_shift: Annotated[float, msgspec.Meta(gt=0)] = 40.0
    min_inliers: Annotated[int, msgspec.Meta(ge=6)] = 15
    reset_timeout: Annotated[float, msgspec.Meta(ge=0)] = 1.0
