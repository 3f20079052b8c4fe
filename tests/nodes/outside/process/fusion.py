"""A program for tests that is fed with all inputs but images, and says what it got."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from nodes.outside.native.client import Link
else:
    from client import Link  # $PYTHONPATH is the folder of that one file


def main() -> None:
    """Answer that the body moves with the first estimate, and fly."""
    modes = sys.argv[1:]
    with Link("fusion") as link:
        link.log(f"processors {len(os.sched_getaffinity(0))}")
        link.log(
            "inputs " + " ".join(f"{e['name']}:{e['source']}" for e in link.description["inputs"])
        )
        link.ready("camera" if "camera" in modes else "body")
        position = np.zeros(3)
        for frame in link:
            for batch in frame.inputs:
                link.log(
                    f"{frame.stamp} {batch.name} {batch.arrived} {batch.rows['stamp'].tolist()}"
                )
            if "vio" in frame.kinds:
                for row in frame.rows("vio"):
                    if np.isfinite(row["pose"]).all():
                        position = row["pose"][:, 3]
            if frame.sequence == 0:
                for name in frame.kinds:
                    fields = [
                        np.ravel(frame.rows(name)[f]).tolist()
                        for f in frame.rows(name).dtype.names or ()
                    ]
                    link.log(f"first {name} {fields[1:]}")
                link.log(
                    f"estimates {frame.rows('vio').dtype.itemsize if 'vio' in frame.kinds else 0}"
                )
            pose = np.eye(4)
            pose[:3, 3] = position
            if "flies" in modes:
                link.order(frame, "takeoff", position=[0, 0, -2.0])
                link.order(frame, "velocity", velocity=[1, 0, 0], yaw_rate=0.5, axes="heading")
                link.order(frame, "position", position=[1, 2, -3], yaw=0.25)
                link.order(frame, "land")
                link.done(frame)
                continue
            if "further" in modes:
                pose[2, 3] += frame.sequence
                link.pose(frame, pose, velocity=[0, 0, 5], output="raw")
                pose[2, 3] -= frame.sequence
            link.pose(frame, pose, velocity=[1, 2, 3], covariance=np.eye(6) * 1e-4)


main()
