"""Settings of monocular odometry."""

from __future__ import annotations

from typing import Annotated

import msgspec


class MonocularSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What there is to set.

    Attributes:
        corners: Corners that are followed from a key frame.
        window: Pixels along the side of the neighbourhood that optical flow compares; odd.
        levels: Times that flow halves the picture for large motions between two pictures.
        pixel_noise: Standard deviation of a followed corner, pixels.
        shift: Median pixels of motion at which a new key frame is made, and a first map tried.
        keep: Share of the corners, and of the landmarks, below which a key frame is made, too.
        keyframes: Key frames that are adjusted together.
        parallax: Degrees between two views of a corner from which its place is computed.
        least: Agreeing landmarks below which the camera is lost.
        patience: Seconds that a lost camera looks only for places it knows; then it also begins a
            new map, whose unit of length is a guess.
    """

    corners: Annotated[int, msgspec.Meta(ge=60, le=2000)] = 250
    window: Annotated[int, msgspec.Meta(ge=5, le=51)] = 15
    levels: Annotated[int, msgspec.Meta(ge=0, le=6)] = 4
    pixel_noise: Annotated[float, msgspec.Meta(gt=0)] = 0.25
    shift: Annotated[float, msgspec.Meta(gt=0)] = 25.0
    keep: Annotated[float, msgspec.Meta(gt=0, lt=1)] = 0.7
    keyframes: Annotated[int, msgspec.Meta(ge=3, le=30)] = 8
    parallax: Annotated[float, msgspec.Meta(gt=0)] = 1.5
    least: Annotated[int, msgspec.Meta(ge=8)] = 20
    patience: Annotated[float, msgspec.Meta(ge=0)] = 1.0
