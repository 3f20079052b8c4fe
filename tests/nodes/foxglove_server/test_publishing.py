"""What an independent viewer gets of each event."""

from __future__ import annotations

import json
import math
import socket
import struct
import time
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest

from events import PointCloud, PoseStamped, Range, TrackingLost
from nodes.foxglove_server import messages
from nodes.foxglove_server.publishing import Publishing
from nodes.foxglove_server.server import Server
from nodes.foxglove_server.settings import FoxgloveConfig
from nodes.ros_messages.images import LIDAR_POINT
from tests.nodes.foxglove_server.client import Viewer, doubles, fields
from tests.nodes.viewing.samples import (
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

STAMP = 3_000_000_007


class Stage:
    """A server with what a drone announces, and how to look at it."""

    def __init__(self, server: Server, **settings: int) -> None:
        self.server = server
        self.publishing = Publishing(server, msgspec.convert(settings, FoxgloveConfig))
        for each in (VEHICLE, CAMERA, ESTIMATOR):
            self.publishing.announced(each)

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


def test_a_viewer_is_told_who_serves_and_what_there_is(server: Server, viewer: Viewer) -> None:
    Stage(server)
    viewer.subscribe("/vo/pose", "/drone/odometry", "/drone/camera/image", "/scene")
    assert viewer.info["name"] == "test"
    assert viewer.info["capabilities"] == ["time"]
    kinds = {topic: each["schemaName"] for topic, each in viewer.channels.items()}
    assert kinds == {
        "/tf": "foxglove.FrameTransforms",
        "/tf_static": "foxglove.FrameTransforms",
        "/scene": "foxglove.SceneUpdate",
        "/log": "foxglove.Log",
        "/drone/odometry": "foxglove.Odometry",
        "/drone/camera/image": "foxglove.CompressedImage",
        "/drone/camera/depth": "foxglove.RawImage",
        "/drone/camera/camera_info": "foxglove.CameraCalibration",
        "/vo/pose": "foxglove.PoseInFrame",
    }
    assert b"foxglove.PoseInFrame" in viewer.schema("/vo/pose") or b"PoseInFrame" in viewer.schema(
        "/vo/pose"
    )


def test_an_estimate_lands_where_it_was_said(server: Server, viewer: Viewer) -> None:
    stage = Stage(server)
    stage.look(viewer, "/vo/pose", "/tf")
    stage.publishing.estimate(estimate(STAMP, (5.0, 6.0, -7.0)))
    found = fields(viewer.next("/vo/pose"))
    sent = fields(found[1][0])
    assert (sent[1], sent[2]) == ([3], [7])
    assert found[2] == [b"map"]
    position, orientation = fields(found[3][0])[1][0], fields(found[3][0])[2][0]
    assert doubles(position, 3) == [5.0, 6.0, -7.0]
    assert doubles(orientation, 4) == [0.0, 0.0, 0.0, 1.0]  # w last
    moved = fields(fields(viewer.next("/tf"))[1][0])
    assert (moved[2], moved[3]) == ([b"map"], [b"vo/base_link"])


def test_the_truth_is_a_transform_from_map_to_the_body(server: Server, viewer: Viewer) -> None:
    stage = Stage(server)
    stage.look(viewer, "/tf", "/drone/odometry")
    stage.publishing.odometry(odometry(STAMP, (1.0, 2.0, -3.0)))
    moved = fields(fields(viewer.next("/tf"))[1][0])
    assert (moved[2], moved[3]) == ([b"map"], [b"base_link"])
    assert doubles(moved[4][0], 3) == [1.0, 2.0, -3.0]
    assert doubles(moved[5][0], 4) == pytest.approx([0.1, 0.7, 0.5, 0.5])
    assert viewer.messages["/drone/odometry"] or viewer.next("/drone/odometry")


def test_who_looks_late_gets_what_holds_for_the_whole_run(server: Server, viewer: Viewer) -> None:
    stage = Stage(server)
    for i in range(100):
        stage.publishing.odometry(odometry(i * 10 * MS, (0.02 * i, 0.0, 0.0)))
    viewer.subscribe("/tf_static", "/scene", "/drone/camera/camera_info")
    frames = [fields(each) for each in fields(viewer.next("/tf_static"))[1]]
    assert [(f[2][0], f[3][0]) for f in frames] == [
        (b"world", b"map"),
        (b"base_link", b"drone/camera_optical"),
    ]
    up = doubles(frames[0][5][0], 4)
    assert up == pytest.approx([0.5**0.5, 0.5**0.5, 0.0, 0.0])  # down in map is -z in world
    calibration = fields(viewer.next("/drone/camera/camera_info"))
    assert struct.unpack("<9d", calibration[6][0]) == (4, 0, 3.5, 0, 4, 2.5, 0, 0, 1)
    names = [fields(each)[3][0] for each in fields(viewer.next("/scene"))[2]]
    assert names == [b"drone", *[b"truth/drone/%d" % i for i in range(3)]]


def test_estimates_in_a_frame_of_their_own_begin_at_the_truth(
    server: Server, viewer: Viewer
) -> None:
    stage = Stage(server)
    stage.publishing.odometry(odometry(0, (1.0, 2.0, -3.0)))
    stage.publishing.estimate(estimate(0, (0.0, 0.0, 0.0), "odom"))
    viewer.subscribe("/tf_static")
    laid = fields(fields(viewer.next("/tf_static"))[1][-1])
    assert (laid[2], laid[3]) == ([b"map"], [b"vo/odom"])
    assert doubles(laid[4][0], 3) == [1.0, 2.0, -3.0]
    none, colours = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    cloud = PointCloud(stamp=0, source="mapping", frame_id="odom", points=none, colors=colours)
    stage.publishing.cloud(cloud)
    viewer.subscribe("/mapping/cloud")
    assert fields(viewer.next("/mapping/cloud"))[2] == [b"vo/odom"]


def test_images_are_what_the_camera_saw(server: Server, viewer: Viewer) -> None:
    stage = Stage(server)
    stage.look(viewer, "/drone/camera/image", "/drone/camera/depth")
    stage.publishing.image(image(STAMP))
    stage.publishing.depth(depth(STAMP, 2.5))
    found = fields(viewer.next("/drone/camera/image"))
    assert decoded(found[2][0], cv2.IMREAD_COLOR_RGB)[3, 4] == pytest.approx([200, 100, 50], abs=4)
    assert (found[3], found[4]) == ([b"jpeg"], [b"drone/camera_optical"])
    raw = fields(viewer.next("/drone/camera/depth"))
    assert (raw[2], raw[3], raw[4], raw[5]) == ([8], [6], [b"16UC1"], [16])
    assert set(np.frombuffer(raw[6][0], "<u2").tolist()) == {2500}


def test_images_that_nobody_announced_have_a_topic_too(server: Server, viewer: Viewer) -> None:
    stage = Stage(server)
    stray = msgspec.structs.replace(image(0), source="web/cam", frame_id="web_optical")
    stage.publishing.image(stray)
    stage.look(viewer, "/web/cam/image")
    stage.publishing.image(stray)
    assert fields(viewer.next("/web/cam/image"))[4] == [b"web_optical"]


def test_a_camera_with_both_has_a_topic_for_the_grey_ones(server: Server, viewer: Viewer) -> None:
    stage = Stage(server)
    both = msgspec.structs.replace(CAMERA, source="drone/eye", images=("rgb", "grey"))
    stage.publishing.announced(both)
    stage.look(viewer, "/drone/eye/image", "/drone/eye/grey")
    data = np.full((6, 8), 90, np.uint8)
    stage.publishing.image(
        msgspec.structs.replace(image(0), source="drone/eye/grey", encoding="mono8", data=data)
    )
    grey = decoded(fields(viewer.next("/drone/eye/grey"))[2][0], cv2.IMREAD_GRAYSCALE)
    assert grey[3, 4] == pytest.approx(90, abs=3)


def test_features_clouds_words_and_numbers_come_too(server: Server, viewer: Viewer) -> None:
    stage = Stage(server)
    say = stage.publishing
    points = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], np.float32)
    colours = np.array([[1, 2, 3], [4, 5, 6]], np.uint8)
    say.features(features(0))
    say.small(imu(0))
    say.score(score(0))
    topics = "/drone/camera/features/vo", "/log", "/drone/imu", "/scores/vo/position_error"
    stage.look(viewer, *topics)
    say.features(features(STAMP))
    say.small(imu(STAMP))
    say.score(score(STAMP))
    say.logged(TrackingLost(stamp=STAMP, source="vo", reason="too dark"))
    say.cloud(PointCloud(stamp=STAMP, source="mapping", points=points, colors=colours))
    groups = fields(viewer.next(topics[0]))[2]
    assert [doubles(fields(each)[3][0], 2) for each in groups] == [[1.0, 2.0], [3.0, 4.0]]
    assert fields(viewer.next("/log"))[3] == [b"TrackingLost (too dark)"]
    measured = json.loads(viewer.next("/drone/imu"))
    assert measured["angular_velocity"] == {"x": 0.1, "y": 0.2, "z": 0.3}
    assert measured["timestamp"] == {"sec": 3, "nsec": 7}
    assert json.loads(viewer.next(topics[3]))["value"] == 0.5
    viewer.subscribe("/mapping/cloud")  # latched
    cloud = fields(viewer.next("/mapping/cloud"))
    rows = np.frombuffer(cloud[6][0], np.dtype([("xyz", "<f4", 3), ("rgba", "u1", 4)]))
    assert rows["xyz"].tolist() == points.tolist()
    assert rows["rgba"][:, :3].tolist() == colours.tolist()


def test_lidars_fixes_and_other_sensors_come_too(server: Server, viewer: Viewer) -> None:
    stage = Stage(server)
    say = stage.publishing
    for each in (SECOND_VEHICLE, LIDAR):
        say.announced(each)
    far = Range(stamp=STAMP, source="drone/down", range=math.inf, min_range=0.1, max_range=9.0)
    for event in (far, fix(0)):
        say.small(event)
    say.scan(scan(0))
    stage.look(viewer, "/other/lidar/points", "/drone/gnss/fix", "/drone/gnss", "/drone/down")
    say.scan(scan(STAMP))
    cloud = fields(viewer.next("/other/lidar/points"))
    rows = np.frombuffer(cloud[6][0], LIDAR_POINT)
    assert rows["xyz"].tolist() == scan(0).points.tolist()
    assert rows["ring"].tolist() == [0, 15]
    assert cloud[2] == [b"other/lidar"]
    say.small(fix(STAMP))
    located = fields(viewer.next("/drone/gnss/fix"))
    assert located[1] == [47.5]
    assert np.frombuffer(located[4][0])[[0, 4, 8]].tolist() == [2.0, 1.0, 3.0]  # east, north, up
    assert json.loads(viewer.next("/drone/gnss"))["velocity"] == {"x": 1.0, "y": 2.0, "z": 3.0}
    say.small(far)
    assert json.loads(viewer.next("/drone/down"))["range"] is None
    viewer.subscribe("/tf_static")
    fixed = [fields(each) for each in fields(viewer.next("/tf_static"))[1]]
    placed = {each[3][0]: each[2][0] for each in fixed}
    assert placed[b"other/lidar"] == b"other/base_link"


def test_each_of_two_vehicles_has_its_cameras_path_and_estimates(
    server: Server, viewer: Viewer
) -> None:
    stage = Stage(server)
    say = stage.publishing
    for each in (SECOND_VEHICLE, SECOND_CAMERA, PERSON):
        say.announced(each)
    say.tracked(msgspec.structs.replace(features(0), frame_id="other/camera_optical"))
    second = msgspec.structs.replace(odometry(0), source="other", position=(9.0, 0.0, 0.0))
    for event in (odometry(0), second, estimate(0, (1.0, 0.0, 0.0), "odom")):
        say.small(event)
    stage.look(viewer, "/tf_static", "/tf")
    fixed = [fields(each) for each in fields(viewer.next("/tf_static"))[1]]
    placed = {each[3][0]: each for each in fixed}
    assert placed[b"drone/camera_optical"][2] == [b"base_link"]
    assert placed[b"other/camera_optical"][2] == [b"other/base_link"]
    # The estimator's frame begins where the second vehicle was, not the first.
    origin = fields(placed[b"vo/odom"][4][0])
    assert abs(origin[1][0] - 9.0) <= 1.0
    walker = PoseStamped(
        stamp=STAMP, source="world/person", position=(1.0, 2.0, 3.0), orientation=UPRIGHT
    )
    say.small(walker)
    (moved,) = fields(viewer.next("/tf"))[1]
    assert fields(moved)[3] == [b"world/person"]


@pytest.mark.parametrize(
    ("model", "count", "called"),
    [
        ("plumb_bob", 5, b"plumb_bob"),
        ("rational_polynomial", 8, b"rational_polynomial"),
        ("equidistant", 4, b"kannala_brandt"),
    ],
)
def test_a_calibration_has_its_distortion(
    server: Server, viewer: Viewer, model: Any, count: int, called: bytes
) -> None:
    stage = Stage(server)
    info = msgspec.structs.replace(CAMERA.info, distortion_model=model, distortion=(0.01,) * count)
    stage.publishing.announced(
        msgspec.structs.replace(CAMERA, source="drone/right", info=info, baseline=0.1)
    )
    stage.look(viewer, "/drone/right/camera_info")
    found = fields(viewer.next("/drone/right/camera_info"))
    assert found[4] == [called]
    assert np.frombuffer(found[5][0]).tolist() == [0.01] * count
    assert np.frombuffer(found[8][0])[3] == pytest.approx(-4.0 * 0.1)


def test_the_run_s_time_is_told(server: Server, viewer: Viewer) -> None:
    viewer.subscribe()
    eventually(lambda: _asked(server, viewer))
    assert viewer.times[-1] == STAMP


def test_a_viewer_that_vanishes_is_survived(server: Server, viewer: Viewer) -> None:
    stage = Stage(server)
    gone = Viewer(server.address)
    stage.look(gone, "/drone/camera/image", "/drone/odometry")
    gone.connection.socket.shutdown(socket.SHUT_RDWR)  # without a word of goodbye
    for i in range(2000):
        stage.publishing.odometry(odometry(i))
        if i % 20 == 0:
            stage.publishing.image(image(i))
    eventually(lambda: not server.wanted("/drone/odometry"))
    gone.close()
    stage.look(viewer, "/drone/odometry")
    stage.publishing.odometry(odometry(STAMP))
    assert fields(viewer.next("/drone/odometry"))[2] == [b"map"]


def test_where_nobody_looks_no_image_is_made(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage = Stage(server)
    monkeypatch.setattr(messages, "encode_image", None)
    stage.publishing.image(image(STAMP))
    stage.publishing.depth(depth(STAMP))


def _asked(server: Server, viewer: Viewer) -> bool:
    server.send_time(STAMP)
    try:
        viewer.take(0.05)
    except TimeoutError:
        return False
    return bool(viewer.times)
