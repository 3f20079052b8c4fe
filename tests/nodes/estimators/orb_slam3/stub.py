"""In the place of ORB-SLAM3's process: says what it was given."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from nodes.estimators.orb_slam3.process import OrbSlam3Result, check_arrays
from nodes.estimators.orb_slam3.settings import Settings


class StubProcess:
    """Takes what `OrbSlam3Process` does; each image is a metre further than the last one.

    The reason of a result names the arrays that came; the final trajectory is half as long.
    """

    def __init__(self, settings: Settings, vocabulary: Path, mapping_timeout: float) -> None:
        self._settings = settings
        self._stamps: list[int] = []

    def track(self, stamp: int, image: Any, depth: Any, right: Any, imu: Any) -> OrbSlam3Result:
        check_arrays(self._settings, image, depth, right, imu)
        pose = np.eye(4)
        pose[2, 3] = len(self._stamps)
        self._stamps.append(stamp)
        lost = len(self._stamps) == 3
        given = {"depth": depth, "right": right, "imu": imu}
        shapes = [f"{name} {a.shape}" for name, a in given.items() if a is not None]
        return OrbSlam3Result(
            pose=pose, lost=lost, reason=", ".join(shapes), first_keyframe=self._stamps[0]
        )

    def trajectory(self) -> tuple[Any, Any]:
        poses = np.tile(np.eye(4), (len(self._stamps), 1, 1))
        poses[:, 2, 3] = 0.5 * np.arange(len(self._stamps))
        return np.array(self._stamps), poses

    def close(self) -> None:
        pass
