"""A whole run, seen by a ROS 2 client that nobody here wrote."""

from __future__ import annotations

import json
import queue
import subprocess
from pathlib import Path
from typing import Any

import pytest
import zenoh

from nodes.ros2.bridge.keys import gid, unpack
from tests.nodes.ros2.bridge.network import bridged_run, client, zenoh_session
from tests.nodes.ros2.messages import samples

pytest.importorskip("zenoh_ros2_sdk")

pytestmark = [pytest.mark.slow, pytest.mark.timeout(150)]

TOPICS = {
    "/battery": "sensor_msgs/msg/BatteryState",
    "/clock": "rosgraph_msgs/msg/Clock",
    "/cmd_vel": "geometry_msgs/msg/Twist",
    "/drone/camera/camera_info": "sensor_msgs/msg/CameraInfo",
    "/drone/camera/depth/camera_info": "sensor_msgs/msg/CameraInfo",
    "/drone/camera/depth/image_raw": "sensor_msgs/msg/Image",
    "/drone/camera/depth/image_raw/compressedDepth": "sensor_msgs/msg/CompressedImage",
    "/drone/camera/image_raw": "sensor_msgs/msg/Image",
    "/drone/camera/image_raw/compressed": "sensor_msgs/msg/CompressedImage",
    "/drone/camera/pose": "geometry_msgs/msg/PoseStamped",
    "/drone/fix": "sensor_msgs/msg/NavSatFix",
    "/drone/imu": "sensor_msgs/msg/Imu",
    "/drone/lidar/points": "sensor_msgs/msg/PointCloud2",
    "/drone/mag": "sensor_msgs/msg/MagneticField",
    "/drone/odom": "nav_msgs/msg/Odometry",
    "/drone/path": "nav_msgs/msg/Path",
    "/drone/pressure": "sensor_msgs/msg/FluidPressure",
    "/drone/range": "sensor_msgs/msg/Range",
    "/drone/vel": "geometry_msgs/msg/TwistStamped",
    "/mapper/points": "sensor_msgs/msg/PointCloud2",
    "/scores/vo/ate": "std_msgs/msg/Float64",
    "/slam/pose": "geometry_msgs/msg/PoseStamped",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/vo/path": "nav_msgs/msg/Path",
    "/vo/pose": "geometry_msgs/msg/PoseStamped",
}


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Any, str]:
    """Return what the client saw, what the run heard of it, and the run's log."""
    folder = tmp_path_factory.mktemp("run")
    with bridged_run(folder) as (run, port):
        listing = client(port, len(TOPICS))
        try:
            output, _ = run.communicate(timeout=30)
        except subprocess.TimeoutExpired:
            pytest.fail("the run did not hear what the client said")
    assert run.returncode == 0, output
    (heard,) = folder.rglob("heard.json")
    (log,) = folder.rglob("log.txt")
    return listing, json.loads(heard.read_text()), log.read_text()


def test_the_client_lists_the_node_and_all_topics(seen: tuple[Any, Any, str]) -> None:
    listing, _, _ = seen
    assert {name: types for name, (types,) in listing["topics"].items()} == TOPICS
    assert [token.rsplit("/", 3)[1:] for token in listing["nodes"]] == [["%", "%", "visnav"]]


def test_the_client_decodes_every_topic(seen: tuple[Any, Any, str]) -> None:
    heard = seen[0]["heard"]
    assert set(heard) == set(TOPICS) - {"/cmd_vel", "/slam/pose"}
    assert heard["/drone/imu"]["linear_acceleration"] == {"x": 0.0, "y": 0.0, "z": 9.81}
    assert heard["/drone/odom"]["pose"]["pose"]["position"] == {"x": 2.5, "y": 1.0, "z": 3.0}
    message = heard["/drone/camera/image_raw"]
    first = samples.image().data.ravel()[:4].tolist()
    assert message["data"] == {"size": 48 * 64 * 3, "first": first}
    assert (message["encoding"], message["step"]) == ("rgb8", 192)
    assert heard["/drone/camera/depth/image_raw"]["encoding"] == "32FC1"
    assert heard["/drone/camera/camera_info"]["header"]["frame_id"] == "camera_optical_frame"
    assert heard["/mapper/points"]["width"] == 3
    assert heard["/scores/vo/ate"]["data"] == 0.25
    assert heard["/drone/pressure"]["fluid_pressure"] == 1e5
    assert heard["/drone/mag"]["magnetic_field"] == {"x": 1e-5, "y": -2e-5, "z": -3e-5}
    assert heard["/drone/fix"]["latitude"] == 47.0
    assert [f["name"] for f in heard["/drone/lidar/points"]["fields"]] == [
        *"xyz",
        "intensity",
        "ring",
        "time",
    ]
    assert heard["/battery"]["percentage"] == 0.75
    for path in (heard["/drone/path"], heard["/vo/path"]):
        assert path["header"]["frame_id"] == path["poses"][0]["header"]["frame_id"] == "map"
    assert heard["/drone/path"]["poses"][0]["pose"]["position"] == {"x": 2.5, "y": 1.0, "z": 3.0}
    assert heard["/drone/camera/image_raw/compressed"]["format"] == "rgb8; jpeg compressed bgr8"
    packed = heard["/drone/camera/depth/image_raw/compressedDepth"]
    assert packed["format"] == "32FC1; compressedDepth png"
    assert packed["data"]["first"] == [0, 0, 0, 0]
    assert [t["child_frame_id"] for t in heard["/tf_static"]["transforms"]] == [
        "odom",
        "camera_link",
        "camera_optical_frame",
    ]


def test_the_run_hears_what_the_client_says(seen: tuple[Any, Any, str]) -> None:
    _, heard, log = seen
    assert heard["VelocitySetpoint"]["velocity"] == [1.0, -2.0, -3.0]
    assert heard["VelocitySetpoint"]["yaw_rate"] == -0.5
    assert heard["PoseEstimate"]["source"] == "slam"
    assert heard["PoseEstimate"]["position"] == [2.0, 1.0, -3.0]
    assert heard["PoseEstimate"]["stamp"] == 1
    assert "WARNING" not in log
    assert " 0 refused or dropped" in log


def test_a_late_joiner_gets_the_fixed_transforms_and_whole_attachments(tmp_path: Path) -> None:
    with (
        bridged_run(tmp_path, seconds=60) as (_, port),
        zenoh_session(connect=f"tcp/127.0.0.1:{port}") as session,
    ):
        received: queue.SimpleQueue[Any] = queue.SimpleQueue()
        with session.declare_subscriber("0/drone/odom/**") as other:
            other.recv()  # so the run is well under way
        history = zenoh.ext.HistoryConfig(detect_late_publishers=True)
        _late = zenoh.ext.declare_advanced_subscriber(
            session, "0/tf_static/**", received.put, history=history
        )
        sample = received.get(timeout=10)
        tokens = [
            str(reply.ok.key_expr)
            for reply in session.liveliness().get("@ros2_lv/0/**/%tf_static/**", timeout=5)
            if reply.ok is not None
        ]
    said_by = unpack(sample.attachment.to_bytes())
    assert said_by.sequence == 1
    assert [gid(token) for token in tokens] == [said_by.gid]
    assert tokens[0].endswith("/:1:,1:,:,:,,")
    message = samples.store().deserialize(sample.payload.to_bytes(), "tf2_msgs/msg/TFMessage")
    assert len(message.transforms) == 3
