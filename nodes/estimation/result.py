"""What a tracker says of one image; it crosses from a worker's process to the node."""

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
        velocity: Of the optical camera at this image, in the optical camera at the first one,
            metres per second, shape (3,); `None` if the tracker does not know it.
        covariance: Of the pose's error (x, y, z, roll, pitch, yaw) in the optical camera at the
            first image, m², m rad and rad², shape (6, 6): a shift of the camera and a rotation
            about it, both along that frame's axes; `None` if the tracker does not know it.
        map: Number of the map that the pose is in. A tracker that begins a new map at a pose, or
            with a unit of length, that it only guesses counts it up; one that finds an earlier map
            again says that one's number. Poses of each map are sent in a frame of their own.
    """

    pose: npt.NDArray[np.float64]
    lost: bool = False
    reason: str = ""
    points: npt.NDArray[np.float32] = np.empty((0, 2), np.float32)
    inliers: npt.NDArray[np.bool_] = np.empty(0, np.bool_)
    velocity: npt.NDArray[np.float64] | None = None
    covariance: npt.NDArray[np.float64] | None = None
    map: int = 0
