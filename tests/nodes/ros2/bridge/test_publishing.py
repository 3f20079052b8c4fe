"""What the node puts, and on which topics: in lockstep, with no network."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest

from events import Event, Image, PointCloud, PoseEstimate, TrackedFeatures
from nodes.ros2.bridge.node import Ros2Bridge
from runtime.testing import run_node
from tests.nodes.ros2.bridge.mappings import Battery
from tests.nodes.ros2.bridge.taken import TakingSession
from tests.nodes.ros2.messages import samples

ANNOUNCED: list[Event] = [samples.vehicle(), samples.camera(), samples.imu(), samples.estimator()]
HERE = "tests.nodes.ros2.bridge.mappings"

Bridge = Callable[..., TakingSession]


@pytest.fixture
def bridge(monkeypatch: pytest.MonkeyPatch) -> Bridge:
    """Return what runs a bridge with some inputs and settings, and returns what it put."""

    def run(inputs: list[Event], duration: float = 0.4, **config: Any) -> TakingSession:
        session = TakingSession()
        monkeypatch.setattr("nodes.ros2.bridge.node.Session", lambda *_, **__: session)
        monkeypatch.setattr("nodes.ros2.bridge.node.TypeStore", lambda *_: samples.store())
        run_node(Ros2Bridge, inputs=inputs, config=config, duration=duration)
        return session

    return run


def stamps(messages: list[Any]) -> list[int]:
    return [message.header.stamp.sec * 10**9 + message.header.stamp.nanosec for message in messages]


def test_in_lockstep_every_image_is_published_in_order(bridge: Bridge) -> None:
    sent = [samples.image(10_000_000 * (i + 1)) for i in range(20)]
    session = bridge([*ANNOUNCED, *sent])
    (images,), (info,), (clock,) = map(
        session.on, ("/drone/camera/image_raw", "/drone/camera/camera_info", "/clock")
    )
    messages = images.read()
    assert stamps(messages) == stamps(info.read()) == [image.stamp for image in sent]
    assert messages[0].data.tobytes() == sent[0].data.tobytes()
    assert clock.sent >= 39


def test_sensors_are_best_effort_and_fixed_frames_are_kept(bridge: Bridge) -> None:
    """As rclcpp's SensorDataQoS and tf2's broadcasters have it."""
    session = bridge([*ANNOUNCED, samples.odometry(1)])
    sensor, plain = "2::,5:,:,:,,", "::,10:,:,:,,"
    assert {publisher.topic.name: publisher.topic.qos.text() for publisher in session.taken} == {
        "/drone/camera/camera_info": sensor,
        "/drone/camera/image_raw": sensor,
        "/drone/camera/depth/camera_info": sensor,
        "/drone/camera/depth/image_raw": sensor,
        "/drone/imu": sensor,
        "/drone/odom": plain,
        "/drone/camera/pose": plain,
        "/vo/pose": plain,
        "/drone/path": "::,1:,:,:,,",
        "/vo/path": "::,1:,:,:,,",
        "/tf": "::,100:,:,:,,",
        "/tf_static": ":1:,1:,:,:,,",
        "/clock": "2::,1:,:,:,,",
    }
    session = bridge(ANNOUNCED, sensor_qos="reliable")
    (imu,) = session.on("/drone/imu")
    assert imu.topic.qos.text() == "::,5:,:,:,,"


def test_a_source_may_change_what_its_images_are(bridge: Bridge) -> None:
    """A message says what is in it, and not what was in the first."""
    grey = Image(
        stamp=20_000_000,
        source="eye",
        frame_id="other",
        encoding="mono8",
        data=np.full((4, 6), 7, np.uint8),
    )
    colour = Image(
        stamp=10_000_000, source="eye", frame_id="f", data=np.full((4, 6, 3), 9, np.uint8)
    )
    (images,) = bridge([colour, grey]).on("/eye/image_raw")
    assert [(m.encoding, m.step, m.header.frame_id) for m in images.read()] == [
        ("rgb8", 18, "f"),
        ("mono8", 6, "other"),
    ]


def test_publications_of_one_topic_have_a_publisher_each(bridge: Bridge) -> None:
    """Or their messages would be numbered, and typed, as those of the other."""
    table = {"topic": "battery", "type": "sensor_msgs/msg/BatteryState", "event": f"{HERE}:Battery"}
    tell = table | {"mapping": f"{HERE}:make_battery"}
    number = {"type": "std_msgs/msg/Float64", "mapping": f"{HERE}:make_another_type"}
    session = bridge(
        [Battery(stamp=1, source=source, percentage=0.5) for source in ("one", "two")],
        publications=[tell | {"source": "one"}, tell | {"source": "two"}, table | number],
    )
    one, two, three = session.on("/battery")
    assert [publisher.sent for publisher in (one, two, three)] == [1, 1, 2]
    assert three.topic.type == "std_msgs/msg/Float64"
    assert [message.data for message in three.read()] == [0.5, 0.5]


def test_points_of_a_camera_s_optical_frame_stay_as_they_are(bridge: Bridge) -> None:
    points = np.array([[1.0, 2.0, 3.0]], np.float32)
    none = np.zeros((0, 3), np.uint8)
    clouds: list[Event] = [
        PointCloud(stamp=1, source="c", frame_id=frame, points=points.copy(), colors=none)
        for frame in ("eye_optical_frame", "base_link", "map")
    ]
    (publisher,) = bridge(clouds).on("/c/points")
    rows = [message.data[:12].view(np.float32).tolist() for message in publisher.read()]
    assert rows == [[1.0, 2.0, 3.0], [1.0, -2.0, -3.0], [2.0, 1.0, -3.0]]


def test_two_vehicles_have_topics_and_frames_of_their_own(bridge: Bridge) -> None:
    other = msgspec.structs.replace(samples.vehicle(), source="other", position=(9.0, 0.0, 0.0))
    moved = msgspec.structs.replace(samples.odometry(1), source="other")
    cameras = [samples.camera(), samples.camera("other/camera")]
    session = bridge([samples.vehicle(), other, *cameras, samples.odometry(1), moved])
    for name in ("drone", "other"):
        (odometry,) = session.on(f"/{name}/odom")
        assert [m.child_frame_id for m in odometry.read()] == [f"{name}/base_link"]
        assert len(session.on(f"/{name}/camera/image_raw")) == 1
    (tf,), (static,) = session.on("/tf"), session.on("/tf_static")
    children = [t.child_frame_id for m in tf.read() for t in m.transforms]
    assert children == ["drone/base_link", "other/base_link"]
    children = [t.child_frame_id for t in static.read()[-1].transforms]
    assert len(children) == len(set(children)) == 6


def test_an_estimate_is_in_the_frames_of_the_vehicle_whose_camera_it_follows(
    bridge: Bridge,
) -> None:
    other = msgspec.structs.replace(samples.vehicle(), source="other")
    cameras = [samples.camera(), samples.camera("other/camera")]
    features = TrackedFeatures(
        stamp=1,
        source="vo",
        frame_id="other/camera_optical",
        points=np.zeros((0, 2), np.float32),
        inliers=np.zeros(0, np.bool_),
    )
    estimate = PoseEstimate(
        stamp=1, source="vo", position=(0.0, 0.0, 0.0), orientation=(1.0, 0.0, 0.0, 0.0)
    )
    session = bridge([samples.vehicle(), other, *cameras, features, estimate])
    (pose,) = session.on("/vo/pose")
    assert [message.header.frame_id for message in pose.read()] == ["other/odom"]


@pytest.mark.parametrize(
    ("config", "line"),
    [
        ({"tf": "v"}, 'tf: expected an estimator that is announced, found "v" (there are: vo)'),
        ({"tf": "vO"}, 'tf: expected an estimator that is announced, found "vO" (there are: vo)'),
        ({"vehicle": "dron"}, 'found "dron" (there are: drone)'),
        ({"topics": {"/drone/odomm": "truth"}}, 'topics: expected the name of a topic, found "/dr'),
        ({"topics": {"/drone/odom": "truth"}}, ""),
        ({"tf": "vo", "vehicle": "drone"}, ""),
    ],
)
def test_names_that_nothing_has_are_told_of(
    bridge: Bridge, config: dict[str, Any], line: str, caplog: pytest.LogCaptureFixture
) -> None:
    bridge([*ANNOUNCED, samples.odometry(1)], duration=0.01, **config)
    warned = [r.getMessage() for r in caplog.records if r.levelname == "WARNING"]
    assert len(warned) == bool(line)
    assert line in "".join(warned)
