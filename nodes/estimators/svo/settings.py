"""Settings of SVO, and the names that its own configuration has for them."""

from __future__ import annotations

from typing import Annotated

import msgspec

Count = Annotated[int, msgspec.Meta(ge=1)]
Positive = Annotated[float, msgspec.Meta(gt=0)]


class SvoSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """SVO's own settings (``config.cpp``), besides the calibration; its names are in brackets.

    Attributes:
        features: Landmarks that are matched in an image, at most (``max_fts``).
        grid_size: Side of the cells of which each gives one landmark, pixels (``grid_size``).
        levels: Levels of the image pyramid (``n_pyr_levels``).
        corner_score: Least score of a corner that becomes a landmark (``triang_min_corner_score``).
        init_disparity: Median motion of the corners since the first image at which the map is
            made, pixels (``init_min_disparity``).
        keyframe_distance: Distance from all key frames in view at which another is made, as a share
            of the mean depth of the scene (``kfselect_mindist``).
        keyframes: Key frames that are kept, the nearest ones; 0 for all (``max_n_kfs``).
        reprojection_threshold: Pixels by which an agreeing landmark misses its corner at most
            (``reproj_thresh``, ``poseoptim_thresh``).
        min_features: Matched landmarks below which the camera is lost (``quality_min_fts``).
        max_feature_drop: Landmarks fewer than in the image before, above which it is lost
            (``quality_max_drop_fts``).
        reset_timeout: Seconds for which a lost camera is only relocalized; then a new map is made,
            whose unit of length is a guess.
    """

    features: Count = 120
    grid_size: Annotated[int, msgspec.Meta(ge=5, le=200)] = 25
    levels: Annotated[int, msgspec.Meta(ge=1, le=6)] = 3
    corner_score: Positive = 20.0
    init_disparity: Positive = 50.0
    keyframe_distance: Positive = 0.12
    keyframes: Annotated[int, msgspec.Meta(ge=0)] = 0
    reprojection_threshold: Positive = 2.0
    min_features: Count = 50
    max_feature_drop: Count = 40
    reset_timeout: Annotated[float, msgspec.Meta(ge=0)] = 1.0

    def native(self) -> dict[str, float]:
        """Return the settings by SVO's own names."""
        return {
            "max_fts": self.features,
            "grid_size": self.grid_size,
            "n_pyr_levels": self.levels,
            "triang_min_corner_score": self.corner_score,
            "init_min_disparity": self.init_disparity,
            "kfselect_mindist": self.keyframe_distance,
            "max_n_kfs": self.keyframes,
            "reproj_thresh": self.reprojection_threshold,
            "poseoptim_thresh": self.reprojection_threshold,
            "quality_min_fts": self.min_features,
            "quality_max_drop_fts": self.max_feature_drop,
        }
