"""RGB-D odometry using nothing but ROS 2: topics in, poses out, over Zenoh.

    python examples/outside_ros2.py [CAMERA]

It stands for the estimator that you have: a process of its own, in which nothing is ours. It
speaks through zenoh-ros2-sdk (pip install zenoh-ros2-sdk opencv-python-headless), as a node under
rmw_zenoh_cpp would: it subscribes to a camera's images, depth and calibration and to /tf_static,
and publishes the pose of base_link in odom with the stamp of each image, on /slam/pose. Of an
image in which it finds no pose, it says on /slam/done that it is done. The run is where rmw_zenohd
would be, at tcp/127.0.0.1:7447, or where ZENOH_CONFIG_OVERRIDE says.
"""

from __future__ import annotations

import queue
import sys
from typing import Any

import cv2
import numpy as np
import zenoh_ros2_sdk as ros
from rosbags.typesys import Stores, get_typestore
from zenoh_ros2_sdk.qos import QosDurability, QosProfile

STORE = get_typestore(Stores.ROS2_JAZZY)
LATCHED = QosProfile(durability=QosDurability.TRANSIENT_LOCAL, history_depth=1)
CORNERS, FEWEST = 800, 0.6
"""Maximum number of corners of a key frame, and minimum share still tracked."""


class Odometry:
    """Tracks corners of a key frame, whose depth is known, and solves for the camera's pose."""

    def __init__(self, matrix: Any) -> None:
        self.matrix = matrix
        self.pose = np.eye(4)  # of the camera in the first one
        self.key: Any = None  # grey image, corners, their points in space, and the key frame's pose
        self.corners: Any = None  # where they were last seen
        self.begun = 0  # how many they were

    def track(self, grey: Any, depth: Any) -> Any:
        """Return the camera's pose in its first image, or None; uint8 and metres, (h, w)."""
        tracked = True if self.key is None else self._follow(grey)
        if self.key is None or not tracked or len(self.corners) < FEWEST * self.begun:
            self._new_key(grey, depth)
        return self.pose if tracked else None

    def _follow(self, grey: Any) -> bool:
        image, corners, points, key_pose = self.key
        seen, there, _ = cv2.calcOpticalFlowPyrLK(
            image, grey, corners, self.corners.copy(), flags=cv2.OPTFLOW_USE_INITIAL_FLOW
        )
        followed = there[:, 0] == 1
        if followed.sum() < 8:
            return False
        solved, turn, shift, inliers = cv2.solvePnPRansac(
            points[followed], seen[followed].astype(float), self.matrix, None, reprojectionError=1.5
        )
        if not solved or inliers is None or len(inliers) < 8:
            return False
        best = np.flatnonzero(followed)[inliers.ravel()]
        turn, shift = cv2.solvePnPRefineLM(
            points[best], seen[best].astype(float), self.matrix, None, turn, shift
        )
        motion = np.eye(4)  # from the key frame's camera to this one
        motion[:3, :3], motion[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
        self.pose = key_pose @ np.linalg.inv(motion)
        self.key, self.corners = (image, corners[best], points[best], key_pose), seen[best]
        return True

    def _new_key(self, grey: Any, depth: Any) -> None:
        corners = cv2.goodFeaturesToTrack(grey, CORNERS, 0.01, 7)
        corners = np.zeros((0, 1, 2), np.float32) if corners is None else corners
        column, row = corners[:, 0].round().astype(int).T
        z = depth[row, column].astype(float)
        near, far = cv2.erode(depth, None, iterations=2), cv2.dilate(depth, None, iterations=2)
        flat = (far - near)[row, column] < 0.05 * z  # no edge, of which the depth is that of both
        known = np.isfinite(z) & (z > 0) & flat
        corners, z = corners[known], z[known]
        rays = np.c_[corners[:, 0], np.ones(len(z))] @ np.linalg.inv(self.matrix).T
        self.key, self.corners = (grey, corners, rays * z[:, None], self.pose), corners
        self.begun = len(corners)


def matrix_of(transform: Any) -> Any:
    """Return a Transform message as a matrix (4, 4)."""
    q, t, matrix = transform.rotation, transform.translation, np.eye(4)
    x, y, z, w = q.x, q.y, q.z, q.w
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = t.x, t.y, t.z
    return matrix


def quaternion(matrix: Any) -> dict[str, float]:
    """Return a rotation (3, 3) as the fields of a Quaternion message."""
    vector = cv2.Rodrigues(np.ascontiguousarray(matrix))[0].ravel()
    angle = float(np.linalg.norm(vector))
    x, y, z = vector * (np.sin(angle / 2) / angle if angle > 1e-12 else 0.5)
    return {"x": x, "y": y, "z": z, "w": float(np.cos(angle / 2))}


def main() -> None:
    """Track, from message to message, until the process is killed."""
    cv2.setNumThreads(1)  # sums then always have the same order
    camera = sys.argv[1] if len(sys.argv) > 1 else "/drone/camera"
    came: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()

    def end(kind: Any, topic: str, type_: str, **more: Any) -> Any:
        definition = STORE.generate_msgdef(type_, ros_version=2)[0]
        given = {"msg_definition": definition, "type_hash": STORE.hash_rihs01(type_)}
        return kind(topic=topic, msg_type=type_, domain_id=0, **given, **more)

    poses = end(ros.ROS2Publisher, "/slam/pose", "geometry_msgs/msg/PoseStamped")
    done = end(ros.ROS2Publisher, "/slam/done", "std_msgs/msg/Header")
    subscribers = [  # each has a thread of its own, so what they take is put together again below
        end(ros.ROS2Subscriber, topic, type_, callback=lambda m, n=name: came.put((n, m)), **more)
        for name, topic, type_, more in (
            ("tf", "/tf_static", "tf2_msgs/msg/TFMessage", {"qos": LATCHED}),
            ("info", f"{camera}/camera_info", "sensor_msgs/msg/CameraInfo", {}),
            ("depth", f"{camera}/depth/image_raw", "sensor_msgs/msg/Image", {}),
            ("colour", f"{camera}/image_raw", "sensor_msgs/msg/Image", {}),
        )
    ]
    print(f"{len(subscribers)} subscriptions", flush=True)
    latest: dict[str, Any] = {}
    frames: dict[tuple[int, int], dict[str, Any]] = {}
    odometry, mount = None, np.eye(4)
    while True:
        name, message = came.get()
        latest[name] = message
        if name in {"colour", "depth"}:
            stamp = message.header.stamp
            frames.setdefault((stamp.sec, stamp.nanosec), {})[name] = message
        if not {"tf", "info"} <= latest.keys():
            continue
        if odometry is None:  # where the camera is on the body, by the tree of frames
            if any(latest["info"].d) or latest["info"].distortion_model == "equidistant":
                sys.exit("expected images without distortion, found a lens: rectify them first")
            odometry = Odometry(latest["info"].k.reshape(3, 3))
            links = {transform.child_frame_id: transform for transform in latest["tf"].transforms}
            frame = latest["info"].header.frame_id
            while frame in links and frame != "base_link":
                mount = matrix_of(links[frame].transform) @ mount
                frame = links[frame].header.frame_id
        for key in sorted(frames):
            if len(frame_set := frames[key]) < 2:
                break
            colour, depth = frame_set["colour"], frame_set["depth"]
            size = colour.height, colour.width
            grey = cv2.cvtColor(colour.data.reshape(*size, 3), cv2.COLOR_RGB2GRAY)
            pose = odometry.track(grey, depth.data.view(np.float32).reshape(size))
            del frames[key]
            header = poses.session_mgr.store.types["std_msgs/msg/Header"]
            if pose is None:
                done.publish(stamp=colour.header.stamp, frame_id="")
                continue
            body = mount @ pose @ np.linalg.inv(mount)  # from the first body to this one
            types = poses.session_mgr.store.types
            point = types["geometry_msgs/msg/Point"](*body[:3, 3])
            turn = types["geometry_msgs/msg/Quaternion"](**quaternion(body[:3, :3]))
            poses.publish(
                header=header(stamp=colour.header.stamp, frame_id="odom"),
                pose=types["geometry_msgs/msg/Pose"](position=point, orientation=turn),
            )


if __name__ == "__main__":
    main()
