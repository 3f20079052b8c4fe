"""Where the frame of an estimator lies in the world."""

from __future__ import annotations

import numpy as np

from events import PoseEstimate, Quaternion, Vector3
from events.poses import pose_matrix, pose_tuples
from nodes.trajectory import RecentPoses


def estimate_frame(
    event: PoseEstimate, truth: RecentPoses | None
) -> tuple[Vector3, Quaternion] | None:
    """Return the pose of an estimate's frame in ``map``, from its first estimate.

    The first pose lies where the body truly was, as evaluation aligns it; `None` if that is not
    known.
    """
    found = None if truth is None else truth.at(event.stamp)
    if found is None:
        return None
    estimated = pose_matrix(event.position, event.orientation)
    return pose_tuples(pose_matrix(*found) @ np.linalg.inv(estimated))
