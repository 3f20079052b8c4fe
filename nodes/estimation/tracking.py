"""What a tracker finds in one image."""

from __future__ import annotations

import msgspec
import numpy as np
import numpy.typing as npt


class TrackingResult(msgspec.Struct, frozen=True, eq=False):
    """What a tracker finds in one image: the pose of the camera, and the features it is from.

    Attributes:
        pose: The optical camera at this image in the optical camera at the first one: the transform
            from this frame to that one, shape (4, 4). Metres, or the tracker's own unit.
        lost: Whether the pose is not known; `pose` is then the last known one.
        reason: Why tracking was lost, or how it was regained.
        points: Features that were tracked: column and row, float32 pixels, shape (n, 2).
        inliers: Which of them agree with the pose: bool, shape (n,).
    """

    pose: npt.NDArray[np.float64]
    lost: bool = False
    reason: str = ""
    points: npt.NDArray[np.float32] = np.empty((0, 2), np.float32)
    inliers: npt.NDArray[np.bool_] = np.empty(0, np.bool_)
