"""The bridge as a node on simulated time, with a plain Zenoh session beside it."""

from __future__ import annotations

import queue
import sys
import threading
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
import pytest
import zenoh

from events import (
    CameraAnnouncement,
    DepthImage,
    EstimatorAnnouncement,
    FluidPressure,
    Image,
    LidarScan,
    MagneticField,
    NavSatFix,
)
from nodes.ros2.bridge.keys import data_key
from nodes.ros2.bridge.node import Ros2Bridge
from nodes.ros2.messages.images import ImageWriter, image_pixels
from nodes.ros2.messages.topics import Topic
from nodes.ros2.messages.typestore import TypeStore
from runtime.errors import ConfigError, FatalError, MissingDependencyError
from runtime.testing import run_node
from tests.nodes.ros2.bridge.mappings import Battery
from tests.nodes.ros2.bridge.network import free_port, zenoh_session
from tests.nodes.ros2.bridge.taken import TakingSession
from tests.nodes.ros2.messages import samples

ANNOUNCED = [samples.vehicle(), samples.camera(), samples.imu(), samples.estimator()]
POSE = "geometry_msgs/msg/PoseStamped"
TWIST = {"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist", "as": "velocity"}


class Listener:
    """A session that hears all, and where it can be reached."""

    def __init__(self, session: zenoh.Session, locator: str) -> None:
        self.session, self.locator = session, locator
        self.samples: queue.SimpleQueue[Any] = queue.SimpleQueue()
        session.declare_subscriber("**", self.samples.put)

    @property
    def config(self) -> dict[str, Any]:
        return {"connect": [self.locator], "listen": []}

    def collect(self, last: str) -> dict[str, list[Any]]:
        """Return the samples by key, up to the first whose key begins like `last`."""
        samples: dict[str, list[Any]] = {}
        while True:
            sample = self.samples.get(timeout=10)
            samples.setdefault(str(sample.key_expr), []).append(sample)
            if str(sample.key_expr).startswith(last):
                return samples


@pytest.fixture
def listener() -> Iterator[Listener]:
    locator = f"tcp/127.0.0.1:{free_port()}"
    with zenoh_session(listen=locator) as session:
        yield Listener(session, locator)


@pytest.mark.slow
def test_a_bridge_of_zenoh_s_for_dds_gets_its_own_keys_and_no_attachment(
    listener: Listener,
) -> None:
    config = listener.config | {"keys": "ros2dds", "namespace": "/fleet"}
    run_node(Ros2Bridge, inputs=[*ANNOUNCED, samples.odometry(1)], config=config, duration=0.1)
    by_key = listener.collect("fleet/drone/odom")
    assert by_key["fleet/drone/odom"][0].attachment is None
    assert set(by_key) <= {"fleet/drone/odom", "tf", "tf_static", "clock"}


def test_only_what_is_asked_for_is_published_under_the_name_that_is_asked_for(
    listener: Listener,
) -> None:
    config = listener.config | {
        "publish": ["images", "odometry"],
        "raw_images": False,
        "compressed_images": "jpeg",
        "topics": {"drone/odom": "/truth"},
    }
    inputs = [*ANNOUNCED, samples.image(10_000_000), samples.odometry(20_000_000)]
    run_node(Ros2Bridge, inputs=inputs, config=config, duration=0.1)
    keys = listener.collect("0/truth/")
    topics = {"/".join(key.split("/")[1:-2]) for key in keys}
    assert topics == {"truth", "drone/camera/camera_info", "drone/camera/image_raw/compressed"}


@pytest.mark.slow
def test_further_sensors_paths_and_mappings_of_the_users_own(listener: Listener) -> None:
    """Each event becomes its message, and a path grows but is sent seldom."""
    mapping = "tests.nodes.ros2.bridge.mappings"
    table = {
        "topic": "battery",
        "type": "sensor_msgs/msg/BatteryState",
        "event": f"{mapping}:Battery",
        "mapping": f"{mapping}:make_battery",
        "transient_local": True,
    }
    publish = ["pressures", "magnetic_fields", "fixes", "lidar_scans", "paths", "depth_images"]
    config = listener.config | {"publications": [table], "publish": publish, "path_rate": 10.0}
    config |= {"compressed_depth": "inverse"}
    optical, points = "drone/camera_optical", np.eye(3, dtype=np.float32)
    depth, ms = np.full((48, 64), 2.5, np.float32), 1_000_000
    inputs = [
        *ANNOUNCED,
        FluidPressure(stamp=1, source="drone", fluid_pressure=1e5),
        MagneticField(stamp=1, source="drone", magnetic_field=(1.0, 2.0, 3.0)),
        NavSatFix(stamp=1, source="drone", latitude=1.0, longitude=2.0, altitude=3.0),
        LidarScan(
            stamp=1,
            source="drone/lidar",
            frame_id="lidar",
            points=points,
            intensities=np.zeros(len(points), np.float32),
            times=np.zeros(len(points), np.float32),
            rings=np.zeros(len(points), np.uint16),
        ),
        DepthImage(stamp=1, source="drone/camera", frame_id=optical, data=depth),
        Battery(stamp=1, source="drone", percentage=0.5),
        Battery(stamp=2, source="drone", percentage=-1.0),
        *[
            msgspec.structs.replace(samples.odometry(t * ms), position=(0.1 * t, 0.0, 0.0))
            for t in range(10, 260)
        ],
        FluidPressure(stamp=300 * ms, source="last", fluid_pressure=1e5),
    ]
    run_node(Ros2Bridge, inputs=inputs, config=config, duration=0.4)
    by_topic = {k.rsplit("/", 2)[0]: v for k, v in listener.collect("0/last/pressure/").items()}
    assert {name: len(samples) for name, samples in by_topic.items()} == {
        "0/drone/pressure": 1,
        "0/drone/mag": 1,
        "0/drone/fix": 1,
        "0/drone/vel": 1,
        "0/drone/lidar/points": 1,
        "0/drone/camera/depth/camera_info": 1,
        "0/drone/camera/depth/image_raw": 1,
        "0/drone/camera/depth/image_raw/compressedDepth": 1,
        "0/battery": 1,
        "0/drone/path": 3,
        "0/last/pressure": 1,
    }
    paths: list[Any] = [
        samples.store().deserialize(sample.payload.to_bytes(), "nav_msgs/msg/Path")
        for sample in by_topic["0/drone/path"]
    ]
    assert [len(path.poses) for path in paths] == [1, 101, 201]
    last = paths[-1].poses[-1]
    assert (last.header.frame_id, last.pose.position.y) == ("map", pytest.approx(21.0))


def test_subscriptions_in_lockstep_are_warned_of_and_announced(
    listener: Listener, caplog: pytest.LogCaptureFixture
) -> None:
    table = {"topic": "slam/pose", "type": POSE, "as": "estimate", "scale_free": True}
    config = listener.config | {"subscriptions": [table]}
    result = run_node(Ros2Bridge, config=config, duration=0.1, name="ros2")
    (announcement,) = result.of(EstimatorAnnouncement)
    assert (announcement.source, announcement.method, announcement.scale_free) == (
        "ros2/slam/pose",
        "ROS 2: /slam/pose",
        True,
    )
    assert any("lockstep" in record.getMessage() for record in caplog.records)


def test_a_camera_of_ros_is_waited_for_and_announced(
    listener: Listener, caplog: pytest.LogCaptureFixture
) -> None:
    """Whatever else comes on its topic first."""
    type_ = "sensor_msgs/msg/CameraInfo"
    topic = Topic(name="/eye/camera_info", type=type_, hash=samples.store().hash(type_))
    info = samples.camera().info
    data = samples.store().serialize(samples.calibration(samples.camera()))
    done = threading.Event()

    def publish() -> None:
        while not done.wait(0.02):
            refused = "calibration refused" in caplog.text  # only then is there a right one
            for payload in (b"", b"garbage", bytes(200_000), *([bytes(data)] if refused else [])):
                listener.session.put(data_key(0, topic), payload)

    common = {"source": "eye"}
    config = listener.config | {
        "max_message_size": 100_000,
        "subscriptions": [
            {"topic": "/eye/camera_info", "type": type_, "as": "camera"} | common,
            {"topic": "/eye/image", "type": "sensor_msgs/msg/Image", "as": "image"} | common,
        ],
    }
    thread = threading.Thread(target=publish)
    thread.start()
    try:
        result = run_node(Ros2Bridge, config=config, duration=0.1)
    finally:
        done.set()
        thread.join()
    (camera,) = result.of(CameraAnnouncement)
    assert (camera.source, camera.images, camera.info) == ("eye", ("rgb",), info)
    assert "/eye/camera_info: calibration refused: " in caplog.text


def test_images_are_read_in_order_beside_the_loop(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Turning the colours of a large one takes longer than a controller can wait."""
    caplog.set_level("INFO")
    threads = []

    def read(message: Any) -> np.ndarray:
        threads.append(threading.current_thread())
        return image_pixels(message)

    writer = ImageWriter(samples.store(), "eye", "bgr8")
    pixels = np.arange(36, dtype=np.uint8).reshape(3, 4, 3)
    images = [bytes(writer.write((0, n), pixels)) for n in range(1, 6)]
    session = TakingSession([*images, b"nonsense"])
    monkeypatch.setattr("nodes.ros2.bridge.node.Session", lambda *_, **__: session)
    monkeypatch.setattr("nodes.ros2.messages.incoming.image_pixels", read)
    table = {"topic": "/eye", "type": "sensor_msgs/msg/Image", "as": "image"}
    received = run_node(Ros2Bridge, config={"subscriptions": [table]}, duration=0.1).of(Image)
    assert [event.stamp for event in received] == [1, 2, 3, 4, 5]
    np.testing.assert_array_equal(received[0].data, pixels[..., ::-1])
    assert len(threads) == 5
    assert threading.current_thread() not in threads
    assert "5 received, 1 refused or dropped" in caplog.text


def test_a_camera_that_never_comes_ends_the_run() -> None:
    table = {"topic": "c", "type": "sensor_msgs/msg/CameraInfo", "as": "camera", "timeout": 0.05}
    config = {"connect": [], "subscriptions": [table]}
    with pytest.raises(FatalError, match=r"/c: expected a calibration within 0\.05 s, found none"):
        run_node(Ros2Bridge, config=config)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"time": "wall"}, 'needs clock = "real"'),
        ({"listen": ["tcp/127.0.0.1:99999"]}, "expected a Zenoh session"),
        ({"zenoh_config": "/no/such/file"}, "expected a file, found none"),
        (
            {"subscriptions": [{"topic": "a", "type": "a/msg/B", "mapping": "a:b"}]},
            "known message type",
        ),
        (
            {"publications": [{"topic": "a", "type": POSE, "event": "a:B", "mapping": "a:b"}]},
            "a: event: expected something that can be imported",
        ),
        ({"definitions": {"a/msg/B": "/no/such/file"}}, "a/msg/B: expected a readable"),
    ],
)
def test_what_cannot_work_ends_the_run_with_a_reason(config: dict[str, Any], message: str) -> None:
    with pytest.raises(FatalError, match=message):
        run_node(Ros2Bridge, config={"connect": []} | config)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"namespace": "fleet"}, "namespace: expected a leading slash"),
        ({"namespace": "/1a"}, "namespace: expected a topic"),
        ({"node_name": "a/b"}, "node_name: expected no slash"),
        ({"node_name": ""}, "node_name: expected a topic"),
        ({"topics": {"a": "1b"}}, 'topics: "a": expected a topic'),
        ({"definitions": {"a/B": "f"}}, "definitions: expected a type"),
        ({"path_length": 10**10}, "path_length"),
        (
            {"subscriptions": [TWIST | {"frame_id": "odom"}]},
            'frame_id: expected "map" or "heading" for a velocity, found \'odom\'',
        ),
        ({"subscriptions": [TWIST | {"timeout": float("inf")}]}, r"subscriptions\[0\].timeout"),
        ({"domain_id": 300}, "domain_id"),
        ({"publish": ["smell"]}, "publish"),
        ({"subscriptions": [{"topic": "a", "type": POSE, "as": "velocity"}]}, "found velocity"),
    ],
)
def test_settings_that_are_wrong_say_where(config: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        run_node(Ros2Bridge, config=config)


def test_a_missing_library_is_named_with_what_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    with pytest.raises(MissingDependencyError, match=r"pip install -e '\.\[ros2\]'"):
        TypeStore()
