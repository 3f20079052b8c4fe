"""Estimators in ROS 2 for which time waits, played by a stub that answers well or badly."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import msgspec
import numpy as np
import pytest

from events import DepthImage, Event, Imu, PoseEstimate
from nodes.ros2_bridge.node import Ros2Bridge
from runtime.testing import NodeResult, run_node
from tests.nodes.ros2_bridge.network import free_port
from tests.nodes.ros2_bridge.outside import TYPES, Outside
from tests.nodes.ros_messages import samples

POSE = "geometry_msgs/msg/PoseStamped"
ANNOUNCED = [samples.vehicle(), samples.camera(), samples.imu()]
MS = 1_000_000
PERIOD = 33 * MS
FRAMES = 12
LATENCY = 15 * MS
SUBSCRIPTION = {
    "topic": "/slam/pose",
    "type": POSE,
    "as": "estimate",
    "source": "slam",
    "answers_to": "drone/camera",
}
IMAGES, DEPTH = "/drone/camera/image_raw", "/drone/camera/depth/image_raw"


def flight(frames: int = FRAMES) -> list[Event]:
    """Return what a camera and an IMU send; the first image is there when the run begins."""
    events: list[Event] = []
    for n in range(frames):
        stamp = n * PERIOD
        image = msgspec.structs.replace(samples.image(stamp), data=np.full((4, 6, 3), n, np.uint8))
        depth = DepthImage(
            stamp=stamp,
            source=image.source,
            frame_id=image.frame_id,
            data=np.full((4, 6), n, np.float32),
        )
        imu = [
            Imu(
                stamp=stamp + k * 5 * MS,
                source="drone",
                angular_velocity=(0.0, 0.0, 0.1 * k),
                linear_acceleration=(0.0, 0.0, -9.8),
            )
            for k in range(6)
        ]
        events += [imu[0], image, depth, *imu[1:]]
    return events


def settings(port: int, **changes: Any) -> dict[str, Any]:
    subscription = SUBSCRIPTION | {"needs": [IMAGES, DEPTH], "timeout": 10.0} | changes
    endpoint = f"tcp/127.0.0.1:{port}"
    return {"connect": [endpoint], "listen": [], "subscriptions": [subscription]}


@contextmanager
def stub(behaviour: str) -> Iterator[tuple[Outside, int]]:
    port = free_port()
    made = Outside(behaviour, listen=f"tcp/127.0.0.1:{port}")
    try:
        yield made, port
    finally:
        made.leave()


def fly(
    behaviour: str, *, done: bool = False, frames: int = FRAMES, **changes: Any
) -> tuple[NodeResult, Outside]:
    with stub(behaviour) as (outside, port):
        config = settings(port, **changes)
        if done:
            table = {"topic": "/slam/done", "type": "std_msgs/msg/Header", "as": "done"}
            config["subscriptions"].append(table | {"answers_to": "drone/camera"})
        inputs = [*ANNOUNCED, *flight(frames)]
        seconds = (frames * PERIOD + 200 * MS) / 1e9
        return run_node(Ros2Bridge, inputs=inputs, config=config, duration=seconds), outside


def estimates(result: NodeResult) -> list[tuple[int, float]]:
    """Return stamp and content of each estimate: its x is what was said."""
    return [(each.stamp, each.position[0]) for each in result.of(PoseEstimate)]


ALL = [(n * PERIOD, float(n)) for n in range(FRAMES)]
SOME = [each for each in ALL if each[1] % 3 != 1]
SKIPS = {"hold": {"skips": "allowed"}, "latency": "40ms"}


@pytest.fixture(scope="module")
def reference() -> NodeResult:
    return fly("at_once")[0]


@pytest.mark.parametrize(
    ("behaviour", "changes", "expected", "counts"),
    [
        ("at_once", {}, ALL, {"answered": 12}),
        ("slowly", {}, ALL, {"answered": 12}),
        ("out_of_order", {"latency": "40ms"}, ALL, {"answered": 12}),
        ("twice", {}, ALL, {"answered": 12, "repeated": 12}),
        ("through_a_double", {}, ALL, {"answered": 12}),
        ("stamps_of_the_future", {}, ALL, {"answered": 12, "unknown": 12}),
        ("floods", {}, ALL, {"answered": 12, "unknown": 3600}),
        ("not_a_number", {}, SOME, {"answered": 8, "empty": 4}),
        (
            "skips",
            SKIPS,
            SOME,
            {"answered": 8, "skipped": 4},
        ),
        (
            "says_done",
            {"done": True},
            SOME,
            {"answered": 8, "empty": 4, "repeated": 8},
        ),
    ],
)
def test_answers_are_what_they_say_however_they_come(
    behaviour: str,
    changes: dict[str, Any],
    expected: list[tuple[int, float]],
    counts: dict[str, int],
    reference: NodeResult,
) -> None:
    result, _ = fly(behaviour, **changes)
    assert estimates(result) == expected
    answers = result.outside["slam"]
    assert dict(answers.counts) == counts
    assert answers.inputs() == reference.outside["slam"].inputs()
    assert not answers.why_not
    if expected == ALL:
        assert result.of(PoseEstimate) == reference.of(PoseEstimate)


def test_all_that_is_sent_arrives_in_the_order_of_its_events_after_its_time() -> None:
    """IMU, images and the time come from publishers of their own, and yet in one order."""
    _, outside = fly("slowly")
    order, times = [], []
    for name, data in outside.heard:
        message: Any = samples.store().deserialize(data, TYPES[name])
        stamp = message.clock if name == "/clock" else message.header.stamp
        nanoseconds = stamp.sec * 10**9 + stamp.nanosec
        if name == "/clock":
            times.append(nanoseconds)
        else:
            order.append((nanoseconds, name))
            assert name == "/drone/imu" or times[-1] == nanoseconds
    expected = []
    for n in range(FRAMES):
        imu = [(n * PERIOD + k * 5 * MS, "/drone/imu") for k in range(6)]
        expected += [imu[0], (n * PERIOD, IMAGES), (n * PERIOD, DEPTH), *imu[1:]]
    assert order == expected
    assert times == sorted(times)
