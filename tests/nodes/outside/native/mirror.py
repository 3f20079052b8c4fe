"""Answers each frame with what it saw of it: see test_clients.py."""

from __future__ import annotations

import sys

import numpy as np
from client import Link, ProtocolError  # type: ignore[import-not-found]


def main() -> None:
    """Answer until the run ends."""
    with Link("mirror") as link:
        camera = link.description["cameras"][0]
        info = camera["info"]
        link.log(
            f"{camera['source']} {info['width']} {info['distortion_model']} "
            f"{len(info['distortion'])} {round(1000 * info['fx'])} "
            f"{link.description['clock']['kind']}"
        )
        link.ready(trajectory=True)
        stamps = []
        for frame in link:
            stamps.append(frame.stamp)
            imu = frame.rows("imu")
            pose = np.eye(4)
            pose[:3, 3] = (
                frame.image("rgb8").sum(),
                frame.image("depth32f").sum(),
                imu["stamp"].sum()
                + imu["angular_velocity"][:, 2].sum()
                + imu["linear_acceleration"][:, 0].sum(),
            )
            case = frame.sequence % 4
            if case == 0:
                link.pose(frame, pose)
            elif case == 1:
                pose[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
                covariance = np.arange(36).reshape(6, 6) + frame.sequence
                link.pose(
                    frame,
                    pose[:3],
                    covariance=covariance,
                    velocity=[frame.sequence, 2, 3],
                    points=[[1, 2], [3, 4]],
                    inliers=[1, 0],
                )
            elif case == 2:
                (link.lost if frame.sequence % 8 == 2 else link.initialising)(frame)
            else:
                link.done(frame)
        poses = np.tile(np.eye(4), (len(stamps), 1, 1))
        poses[:, 0, 3] = np.arange(len(stamps))
        link.trajectory(stamps, poses)


try:
    main()
except ProtocolError as error:
    print(error, file=sys.stderr)
    sys.exit(3)
