"""RGB-D odometry as a script for AirSim: steps time, follows corners, and publishes poses.

Corners of a key frame, whose places its depth gives, are followed from image to image; the camera's
pose is that from which they are seen where they are (PnP). It needs Cosys-AirSim's client and
OpenCV, and nothing of this project; see `airsim_odometry.toml`. `publish` alone is not AirSim's.
"""

from __future__ import annotations

import sys
from typing import Any

import cosysairsim as airsim
import cv2
import numpy as np

STEP = 0.1  # simulated seconds from image to image
OPTICAL_TO_BODY = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


class Odometry:
    """Odometry of a camera; poses are 4 x 4, from optical frame to first optical frame."""

    def __init__(self, matrix: Any) -> None:
        self.matrix = matrix
        self.pose = np.eye(4)
        self.grey: Any = None

    def track(self, grey: Any, depth: Any) -> Any:
        """Return the camera's pose; grey uint8 (h, w), depth metres (h, w)."""
        if self.grey is not None and len(self.pixels):
            before = self.pixels.astype(np.float32)
            pixels, status, _ = cv2.calcOpticalFlowPyrLK(self.grey, grey, before, None)
            back, again, _ = cv2.calcOpticalFlowPyrLK(grey, self.grey, pixels, None)
            kept = (status[:, 0] & again[:, 0] == 1) & (np.abs(back - before).max(axis=1) < 0.5)
            self.pixels, self.points = pixels[kept], self.points[kept]
        if self.grey is not None and len(self.pixels) >= 8:
            solved, turn, shift, inliers = cv2.solvePnPRansac(
                self.points, self.pixels, self.matrix, None, reprojectionError=1.0
            )
            if solved and inliers is not None and len(inliers) >= 8:
                inliers = inliers[:, 0]
                self.pixels, self.points = self.pixels[inliers], self.points[inliers]
                turn, shift = cv2.solvePnPRefineLM(
                    self.points, self.pixels, self.matrix, None, turn, shift
                )
                to_camera = np.eye(4)
                to_camera[:3, :3], to_camera[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
                self.pose = np.linalg.inv(to_camera)
        self.grey = grey
        if not hasattr(self, "points") or len(self.points) < 80:
            self.begin_key_frame(depth)
        return self.pose

    def begin_key_frame(self, depth: Any) -> None:
        """Take new corners, and where they are by the present pose and depth."""
        corners = cv2.goodFeaturesToTrack(self.grey, 250, 0.01, 6)
        corners = np.zeros((0, 2), np.float32) if corners is None else corners.reshape(-1, 2)
        z = depth[corners[:, 1].astype(int), corners[:, 0].astype(int)]
        near = z < 30.0
        self.pixels, z = corners[near], z[near, None]
        rays = np.c_[self.pixels, np.ones(len(z))] @ np.linalg.inv(self.matrix).T
        self.points = (rays * z) @ self.pose[:3, :3].T + self.pose[:3, 3]


def publish(client: Any, name: str, stamp: int, pose: Any) -> None:
    """Publish a camera's pose, with AirSim's axes: x forward, y right, z down."""
    turn = OPTICAL_TO_BODY @ pose[:3, :3] @ OPTICAL_TO_BODY.T
    axis = cv2.Rodrigues(turn)[0].ravel()
    angle = float(np.linalg.norm(axis))
    x, y, z = (axis / angle * np.sin(angle / 2)).tolist() if angle > 0 else (0.0, 0.0, 0.0)
    place = airsim.Vector3r(*(OPTICAL_TO_BODY @ pose[:3, 3]).tolist())
    rotation = airsim.Quaternionr(x, y, z, float(np.cos(angle / 2)))
    client.client.call("visnavPublishPose", name, stamp, airsim.Pose(place, rotation))


def main(port: int = 41451) -> None:
    """Follow the camera until the drone, flown by another client, has landed again."""
    client: Any = airsim.MultirotorClient(port=port)
    client.confirmConnection()
    client.simPause(True)
    requests = [
        airsim.ImageRequest("0", airsim.ImageType.Scene, False, False),
        airsim.ImageRequest("0", airsim.ImageType.DepthPlanar, True, False),
    ]
    odometry, has_flown, landed, count = None, False, 0, 0
    while landed < 4:  # some images of what stands again
        rgb, depth = client.simGetImages(requests)
        shape = rgb.height, rgb.width
        if odometry is None:
            focal = rgb.width / 2 / np.tan(np.radians(client.simGetCameraInfo("0").fov) / 2)
            centre = (rgb.width - 1) / 2, (rgb.height - 1) / 2
            odometry = Odometry(
                np.array([[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]])
            )
        colours = np.frombuffer(rgb.image_data_uint8, np.uint8).reshape(*shape, 3)
        grey = cv2.cvtColor(colours, cv2.COLOR_RGB2GRAY)
        pose = odometry.track(grey, np.array(depth.image_data_float, np.float32).reshape(shape))
        publish(client, "odometry", rgb.time_stamp, pose)
        count += 1
        flies = client.getMultirotorState().landed_state == airsim.LandedState.Flying
        landed += has_flown and not flies
        has_flown = has_flown or flies
        client.simContinueForTime(STEP)
    print(f"{count} poses")
    client.simPause(False)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
