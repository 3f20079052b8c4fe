"""Settings of KISS-ICP."""

from __future__ import annotations

from typing import Annotated

import msgspec

NotNegative = Annotated[float, msgspec.Meta(ge=0)]
Positive = Annotated[float, msgspec.Meta(gt=0)]


class KissIcpSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """KISS-ICP's own settings.

    Attributes:
        voxel_size: Side of the map's voxels, metres; 0 for a hundredth of the range.
        max_points_per_voxel: Points that a voxel of the map holds, at most.
        max_range: Points farther away are left out, metres; 0 for the lidar's own range.
        deskew: Whether scans are corrected for the motion during a turn, which is taken to be that
            of the turn before.
        initial_threshold: Distance up to which points are first matched, metres.
        min_motion: Deviation from constant motion below which the threshold is not adapted, metres.
        min_points: Points of a scan below which the lidar is lost.
    """

    voxel_size: NotNegative = 0.0
    max_points_per_voxel: Annotated[int, msgspec.Meta(ge=1)] = 20
    max_range: NotNegative = 0.0
    deskew: bool = True
    initial_threshold: Positive = 2.0
    min_motion: Positive = 0.1
    min_points: Annotated[int, msgspec.Meta(ge=10)] = 100
