"""What an independent viewer gets of each event."""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest

from events import (
    Announcement,
    Event,
    PointCloud,
    PoseStamped,
    Range,
    TrackedFeatures,
    TrackingLost,
)
from extensions.foxglove.tests.client import Viewer, doubles, fields
from nodes.ros2.messages import images
from nodes.ros2.messages.images import LIDAR_POINT, POINT
from tests.nodes.ros2.messages.samples import store
from tests.nodes.viewers.common.samples import (
    CAMERA,
    ESTIMATOR,
    LIDAR,
    MS,
    PERSON,
    SECOND_CAMERA,
    SECOND_VEHICLE,
    UPRIGHT,
    VEHICLE,
    decoded,
    depth,
    estimate,
    features,
    fix,
    image,
    imu,
    odometry,
    scan,
    score,
)
from visnav_foxglove.node import Publishing
from visnav_foxglove.server import FoxgloveConfig, Server

STAMP = 3_000_000_007


class Stage:
    """A server with what a drone announces, and how to look at it."""

    def __init__(self, server: Server, *more: Announcement, **settings: float) -> None:
        self.server = server
        self.publishing = Publishing(server, msgspec.convert(settings, FoxgloveConfig))
        for announcement in (VEHICLE, CAMERA, ESTIMATOR, *more):
            self.publishing.announced(announcement)
        self.publishing.begin()

    def put(self, *events: Event) -> None:
        """Put events as the node does."""
        for event in events:
            if isinstance(event, TrackedFeatures):
                self.publishing.features(event)
            else:
                self.publishing.put(event)

    def look(self, viewer: Viewer, *topics: str) -> None:
        """Subscribe, and wait until the server knows."""
        viewer.subscribe(*topics)
        eventually(lambda: all(self.server.wanted(topic) for topic in topics))


def eventually(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 10.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.002)  # for the server's threads, which have a clock of their own


@pytest.fixture
def server() -> Iterator[Server]:
    server = Server(FoxgloveConfig(port=0), "test")
    yield server
    server.close()


@pytest.fixture
def viewer(server: Server) -> Iterator[Viewer]:
    with Viewer(server.address) as viewer:
        yield viewer


def read(viewer: Viewer, topic: str) -> Any:
    """Return the next message of a topic with one of ROS's types."""
    type_ = viewer.channels[topic]["schemaName"]
    return store().deserialize(viewer.next(topic), type_)


def xyz(vector: Any) -> tuple[float, ...]:
    return vector.x, vector.y, vector.z


def placed(message: Any) -> dict[str, tuple[str, Any]]:
    """Return parent and transform of each frame."""
    transforms = message.transforms
    return {
        transform.child_frame_id: (transform.header.frame_id, transform.transform)
        for transform in transforms
    }


def test_a_viewer_is_told_who_serves_and_what_there_is(server: Server, viewer: Viewer) -> None:
    Stage(server).put(odometry(0))
    viewer.subscribe("/vo/pose", "/drone/odom", "/drone/camera/depth/image_raw", "/scene", "/tf")
    assert viewer.info["name"] == "test"
    assert viewer.info["capabilities"] == ["time"]
    kinds = {topic: channel["schemaName"] for topic, channel in viewer.channels.items()}
    assert kinds == {
        "/scene": "foxglove.SceneUpdate",
        "/log": "foxglove.Log",
        "/tf_static": "tf2_msgs/msg/TFMessage",
        "/drone/odom": "nav_msgs/msg/Odometry",
        "/drone/camera/camera_info": "sensor_msgs/msg/CameraInfo",
        "/drone/camera/image_raw/compressed": "sensor_msgs/msg/CompressedImage",
        "/drone/camera/depth/camera_info": "sensor_msgs/msg/CameraInfo",
        "/drone/camera/depth/image_raw": "sensor_msgs/msg/Image",
        "/vo/pose": "geometry_msgs/msg/PoseStamped",
        "/tf": "tf2_msgs/msg/TFMessage",
    }
    pose = viewer.channels["/vo/pose"]
    assert (pose["encoding"], pose["schemaEncoding"]) == ("cdr", "ros2msg")
    assert "MSG: geometry_msgs/" in pose["schema"]


def test_an_estimate_lands_where_it_was_said(server: Server, viewer: Viewer) -> None:
    stage = Stage(server)
    stage.put(odometry(0))
    stage.look(viewer, "/vo/pose", "/tf")
    stage.put(estimate(STAMP, (5.0, 6.0, -7.0)))
    pose = read(viewer, "/vo/pose")
    assert (pose.header.stamp.sec, pose.header.stamp.nanosec) == (3, 7)
    assert pose.header.frame_id == "map"
    assert xyz(pose.pose.position) == (6.0, 5.0, 7.0)  # east, north, up
    parent, moved = placed(read(viewer, "/tf"))["vo/base_link"]
    assert parent == "map"
    assert xyz(moved.translation) == (6.0, 5.0, 7.0)


def test_a_message_has_the_time_of_its_event(server: Server, viewer: Viewer) -> None:
    stage = Stage(server)
    stage.look(viewer, "/vo/pose", "/drone/camera/depth/image_raw")
    stage.put(depth(STAMP - 1), estimate(STAMP, (0.0, 0.0, 0.0)))
    eventually(lambda: _took(viewer, "/vo/pose"))
    assert viewer.messages["/vo/pose"][0][0] == STAMP
    assert viewer.messages["/drone/camera/depth/image_raw"][0][0] == STAMP - 1


def test_the_truth_is_a_transform_to_the_body(server: Server, viewer: Viewer) -> None:
    stage = Stage(server)
    stage.put(odometry(0))
    stage.look(viewer, "/tf", "/drone/odom")
    stage.put(odometry(STAMP, (1.0, 2.0, -3.0)))
    parent, _ = placed(read(viewer, "/tf"))["base_link"]
    assert parent == "odom"  # which lies in map where the vehicle started
    assert xyz(read(viewer, "/drone/odom").pose.pose.position) == (2.0, 1.0, 3.0)


def test_who_looks_late_gets_what_holds_for_the_whole_run(server: Server, viewer: Viewer) -> None:
    stage = Stage(server)
    for i in range(100):
        stage.put(odometry(i * 10 * MS, (0.02 * i, 0.0, 0.0)))
    viewer.subscribe("/tf_static", "/scene")
    frames = placed(read(viewer, "/tf_static"))
    assert {child: parent for child, (parent, _) in frames.items()} == {
        "odom": "map",
        "camera_link": "base_link",
        "camera_optical_frame": "camera_link",
    }
    entities = [fields(entity) for entity in fields(viewer.next("/scene"))[2]]
    assert [entity[3][0] for entity in entities] == [
        b"drone",
        *[b"truth/drone/%d" % i for i in range(3)],
    ]
    assert [entity[2][0] for entity in entities] == [b"base_link", b"map", b"map", b"map"]
    rotor = fields(fields(entities[0][8][2])[1][0])[1][0]
    assert doubles(rotor, 3) == pytest.approx([-0.14, 0.14, 0.03])  # forward, left, up
    last = fields(entities[3][11][0])[5][-1]
    assert doubles(last, 3) == pytest.approx([0.0, 1.5, 0.0])  # north is y


def test_estimates_in_a_frame_of_their_own_begin_at_the_truth(
    server: Server, viewer: Viewer
) -> None:
    stage = Stage(server)
    stage.put(odometry(0, (1.0, 2.0, -3.0)), estimate(0, (0.0, 0.0, 0.0), "odom"))
    viewer.subscribe("/tf_static", "/vo/pose")
    parent, laid = placed(read(viewer, "/tf_static"))["vo/odom"]
    assert parent == "map"
    assert xyz(laid.translation) == pytest.approx((2.0, 1.0, 3.0))
    none, colours = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    cloud = PointCloud(stamp=0, source="mapping", frame_id="odom", points=none, colors=colours)
    stage.put(cloud)
    viewer.subscribe("/mapping/points")
    assert read(viewer, "/mapping/points").header.frame_id == "vo/odom"


def test_images_are_what_the_camera_saw(server: Server, viewer: Viewer) -> None:
    stage = Stage(server)
    topics = "/drone/camera/image_raw/compressed", "/drone/camera/depth/image_raw"
    stage.look(viewer, *topics, "/drone/camera/camera_info")
    stage.put(image(STAMP), depth(STAMP, 2.5))
    received = read(viewer, topics[0])
    pixels = decoded(received.data.tobytes(), cv2.IMREAD_COLOR)
    assert pixels[3, 4] == pytest.approx([50, 100, 200], abs=4)
    assert received.header.frame_id == "camera_optical_frame"
    raw = read(viewer, topics[1])
    assert (raw.width, raw.height, raw.encoding, raw.step) == (8, 6, "16UC1", 16)
    assert set(raw.data.view("<u2").tolist()) == {2500}
    info = read(viewer, "/drone/camera/camera_info")
    assert info.k.tolist() == [4, 0, 3.5, 0, 4, 2.5, 0, 0, 1]


def test_images_as_they_are_if_no_quality_is_given(server: Server, viewer: Viewer) -> None:
    stage = Stage(server, jpeg_quality=0)
    stage.look(viewer, "/drone/camera/image_raw")
    stage.put(image(STAMP))
    assert read(viewer, "/drone/camera/image_raw").data.tobytes() == image(STAMP).data.tobytes()


def test_images_that_nobody_announced_have_a_topic_too(server: Server, viewer: Viewer) -> None:
    stage = Stage(server)
    stray = msgspec.structs.replace(image(0), source="web/cam", frame_id="web_optical")
    stage.put(stray)
    stage.look(viewer, "/web/cam/image_raw/compressed")
    stage.put(stray)
    assert read(viewer, "/web/cam/image_raw/compressed").header.frame_id == "web_optical"


@pytest.mark.parametrize(("quality", "end"), [(90, "/compressed"), (0, "")])
def test_a_camera_with_both_has_a_topic_for_the_grey_ones(
    server: Server, viewer: Viewer, quality: int, end: str
) -> None:
    both = msgspec.structs.replace(CAMERA, source="drone/eye", images=("rgb", "grey"))
    stage = Stage(server, both, jpeg_quality=quality)
    topic = f"/drone/eye/grey/image_raw{end}"
    stage.look(viewer, f"/drone/eye/image_raw{end}", topic)
    data = np.full((6, 8), 90, np.uint8)
    grey = {"source": "drone/eye/grey", "encoding": "mono8", "data": data}
    stage.put(msgspec.structs.replace(image(0), **grey))
    seen = read(viewer, topic).data
    pixels = decoded(seen.tobytes(), cv2.IMREAD_GRAYSCALE) if quality else seen.reshape(6, 8)
    assert pixels[3, 4] == pytest.approx(90, abs=3)


@pytest.mark.slow
@pytest.mark.parametrize("settings", [{"image_rate": 0}, {"depth": False}])
def test_what_is_not_to_be_shown_has_no_topic(
    server: Server, viewer: Viewer, settings: dict[str, Any]
) -> None:
    Stage(server, **settings)
    viewer.subscribe("/vo/pose")
    assert not any("depth" in topic for topic in viewer.channels)
    assert any("image_raw" in topic for topic in viewer.channels) == ("depth" in settings)


def test_features_clouds_words_and_numbers_come_too(server: Server, viewer: Viewer) -> None:
    stage = Stage(server)
    points = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], np.float32)
    colours = np.array([[1, 2, 3], [4, 5, 6]], np.uint8)
    stage.put(features(0), imu(0), score(0))
    topics = "/drone/camera/features/vo", "/log", "/drone/imu", "/scores/vo/position_error"
    stage.look(viewer, *topics)
    stage.put(
        *(features(STAMP), imu(STAMP), score(STAMP)),
        TrackingLost(stamp=STAMP, source="vo", reason="too dark"),
        PointCloud(stamp=STAMP, source="mapping", points=points, colors=colours),
    )
    groups = fields(viewer.next(topics[0]))[2]
    assert [doubles(fields(group)[3][0], 2) for group in groups] == [[1.0, 2.0], [3.0, 4.0]]
    assert fields(viewer.next("/log"))[3] == [b"TrackingLost (too dark)"]
    assert xyz(read(viewer, "/drone/imu").angular_velocity) == (0.1, -0.2, -0.3)
    assert read(viewer, topics[3]).data == 0.5
    viewer.subscribe("/mapping/points")  # kept
    rows = np.frombuffer(read(viewer, "/mapping/points").data, POINT)
    assert rows["xyz"].tolist() == [[2.0, 1.0, -3.0], [5.0, 4.0, -6.0]]
    assert rows["bgr"][:, ::-1].tolist() == colours.tolist()


def test_lidars_fixes_and_other_sensors_come_too(server: Server, viewer: Viewer) -> None:
    stage = Stage(server, SECOND_VEHICLE, LIDAR)
    far = Range(stamp=STAMP, source="drone/down", range=math.inf, min_range=0.1, max_range=9.0)
    stage.put(far, fix(0), scan(0))
    topics = "/other/lidar/points", "/drone/gnss/fix", "/drone/gnss/vel", "/drone/down/range"
    stage.look(viewer, *topics)
    stage.put(scan(STAMP), fix(STAMP), far)
    cloud = read(viewer, topics[0])
    rows = np.frombuffer(cloud.data, LIDAR_POINT)
    assert (rows["xyz"] * [1, -1, -1]).tolist() == scan(0).points.tolist()
    assert rows["ring"].tolist() == [0, 15]
    assert cloud.header.frame_id == "other/lidar"
    located = read(viewer, topics[1])
    assert located.latitude == 47.5
    assert located.position_covariance[[0, 4, 8]].tolist() == [2.0, 1.0, 3.0]  # east, north, up
    assert xyz(read(viewer, topics[2]).twist.linear) == (2.0, 1.0, -3.0)
    assert read(viewer, topics[3]).range == math.inf
    viewer.subscribe("/tf_static")
    assert placed(read(viewer, "/tf_static"))["other/lidar"][0] == "other/base_link"


def test_each_of_two_vehicles_has_its_cameras_path_and_estimates(
    server: Server, viewer: Viewer
) -> None:
    stage = Stage(server, SECOND_VEHICLE, SECOND_CAMERA, PERSON)
    second = msgspec.structs.replace(odometry(0), source="other", position=(9.0, 0.0, 0.0))
    stage.publishing.put(msgspec.structs.replace(features(0), frame_id="other/camera_optical"))
    stage.put(odometry(0), second, estimate(0, (1.0, 0.0, 0.0), "odom"))
    stage.look(viewer, "/tf_static", "/tf", "/scene")
    frames = placed(read(viewer, "/tf_static"))
    assert frames["drone/camera_link"][0] == "drone/base_link"
    assert frames["other/camera_link"][0] == "other/base_link"
    bodies = [fields(entity) for entity in fields(viewer.next("/scene"))[2]]
    assert [body[2][0] for body in bodies] == [
        *(b"drone/base_link", b"other/base_link", b"world/person"),
    ]
    # The estimator's frame begins where the second vehicle was, not the first.
    assert abs(frames["vo/odom"][1].translation.y - 9.0) <= 1.0
    walker = PoseStamped(
        stamp=STAMP, source="world/person", position=(1.0, 2.0, 3.0), orientation=UPRIGHT
    )
    stage.put(walker)
    assert xyz(placed(read(viewer, "/tf"))["world/person"][1].translation) == (2.0, 1.0, -3.0)


def test_an_estimator_s_frames_keep_their_names(server: Server, viewer: Viewer) -> None:
    """Whichever vehicle it turns out to belong to."""
    stage = Stage(server, SECOND_VEHICLE, SECOND_CAMERA)
    stage.put(odometry(0))
    stage.look(viewer, "/vo/pose", "/tf")
    stage.put(estimate(0, (1.0, 0.0, 0.0), "odom"))
    stage.publishing.put(msgspec.structs.replace(features(0), frame_id="other/camera_optical"))
    stage.put(estimate(MS, (1.0, 0.0, 0.0), "odom"))
    assert [read(viewer, "/vo/pose").header.frame_id for _ in range(2)] == ["vo/odom"] * 2
    for _ in range(2):
        assert placed(read(viewer, "/tf"))["vo/base_link"][0] == "vo/odom"
    viewer.subscribe("/tf_static")
    assert placed(read(viewer, "/tf_static"))["vo/odom"][0] == "map"


def test_the_run_s_time_is_told(server: Server, viewer: Viewer) -> None:
    viewer.subscribe()
    eventually(lambda: _asked(server, viewer))
    assert viewer.times[-1] == STAMP


@pytest.mark.slow
def test_a_viewer_that_vanishes_is_survived(server: Server, viewer: Viewer) -> None:
    stage = Stage(server)
    gone = Viewer(server.address)
    stage.look(gone, "/drone/camera/image_raw/compressed", "/drone/odom")
    gone.connection.socket.shutdown(socket.SHUT_RDWR)  # without a word of goodbye
    for i in range(2000):
        stage.put(odometry(i))
        if i % 20 == 0:
            stage.put(image(i))
    eventually(lambda: not server.wanted("/drone/odom"))
    gone.close()
    stage.look(viewer, "/drone/odom")
    stage.put(odometry(STAMP))
    assert read(viewer, "/drone/odom").header.frame_id == "map"


def test_where_nobody_looks_no_image_is_made(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage = Stage(server)
    for name in ("encode_image", "depth_in_steps"):
        monkeypatch.setattr(images, name, None)
    stage.put(image(STAMP))
    stage.put(depth(STAMP))


def _asked(server: Server, viewer: Viewer) -> bool:
    server.send_time(STAMP)
    try:
        viewer.take(0.05)
    except TimeoutError:
        return False
    return bool(viewer.times)


def _took(viewer: Viewer, topic: str) -> bool:
    viewer.take()
    return bool(viewer.messages[topic])
