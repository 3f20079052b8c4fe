"""Estimators in ROS 2 for which time waits, played by a stub that answers well or badly."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import msgspec
import numpy as np
import pytest

from events import DepthImage, Event, Imu, PoseEstimate
from nodes.ros2.bridge.node import Ros2Bridge
from runtime import Node
from runtime.errors import ConfigError, FatalError, NodeError
from runtime.testing import NodeResult, run_node, run_nodes, spec
from tests.nodes.ros2.bridge.network import free_port, zenoh_session
from tests.nodes.ros2.bridge.outside import TYPES, Outside
from tests.nodes.ros2.messages import samples

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
        image = msgspec.structs.replace(
            samples.image(stamp), data=np.full((4, 6, 3), n % 256, np.uint8)
        )
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
    return [(estimate.stamp, estimate.position[0]) for estimate in result.of(PoseEstimate)]


ALL = [(n * PERIOD, float(n)) for n in range(FRAMES)]
SOME = [row for row in ALL if row[1] % 3 != 1]
WHY_NOT = {
    "twice": ["frames were answered twice, differently"],
    "in_turns": ["several publishers answer at /slam/pose"],
}
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
        ("twice", {}, ALL, {"answered": 12, "contradicting": 12}),
        ("in_turns", {}, ALL, {"answered": 12}),
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
    second = {"repeated": 0, "contradicting": 0}
    for kind in second:  # of which the last one may come after the end
        number = counts.get(kind, 0)
        assert answers.counts.get(kind, 0) in {number, max(number - 1, 0)}
    assert answers.counts | second == counts | second
    assert answers.inputs() == reference.outside["slam"].inputs()
    assert [*answers.why_not] == WHY_NOT.get(behaviour, [])
    if expected == ALL:
        assert result.of(PoseEstimate) == reference.of(PoseEstimate)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("behaviour", "hold", "message"),
    [
        ("stops", {"max_wait": 0.3}, r"an answer to the frame of 0\.165000 s within 0\.3 s"),
        ("dies", {"max_wait": 60.0}, r"slam: nobody publishes /slam/pose any more"),
        ("loses_one", {}, r"/slam/pose: expected message 5 of its publisher, found 6"),
    ],
)
def test_an_answer_that_never_comes_ends_the_run_at_once(
    behaviour: str, hold: dict[str, Any], message: str
) -> None:
    with pytest.raises(NodeError, match=message):
        fly(behaviour, hold=hold)


@pytest.mark.slow
def test_frames_of_an_estimator_that_died_are_lost_and_counted() -> None:
    result, _ = fly("dies", hold={"max_wait": 60.0, "on_missing": "lost"})
    assert estimates(result) == ALL[:4]
    assert dict(result.outside["slam"].counts) == {"answered": 4, "lost": 8}


@pytest.mark.slow
def test_an_estimator_that_stops_is_gone_on_without() -> None:
    result, _ = fly("stops", hold={"max_wait": 0.3, "on_missing": "continue"})
    assert estimates(result) == ALL[:5]
    assert result.outside["slam"].why_not


class Pace(Node):
    """Lets the run wait for an estimator that comes back, which takes real time."""

    outside: Outside

    async def run(self) -> None:
        while self.outside.images < 8:
            await self.clock.sleep(0.033)
            await self.offload(time.sleep, 0.033)  # what is waited for is in threads of Zenoh


@pytest.mark.slow
def test_an_estimator_that_comes_back_is_held_for_again() -> None:
    with stub("comes_back") as (outside, port):
        Pace.outside = outside
        config = settings(port, hold={"max_wait": 60.0, "on_missing": "lost"})
        result = run_nodes(
            [spec(Ros2Bridge, "node", config), spec(Pace, "pace")],
            inputs=[*ANNOUNCED, *flight(300)],
            duration=10.0,
        )
    answers = result.outside["slam"]
    assert answers.counts["lost"] > 0
    assert answers.counts["answered"] == 300 - answers.counts["lost"]
    assert estimates(result)[:4] == ALL[:4]
    assert estimates(result)[-1] == (299 * PERIOD, 299 % 256)


@pytest.mark.slow
def test_images_before_it_has_initialised_are_no_losses(reference: NodeResult) -> None:
    result, _ = fly("initialises", hold={"initialise": "1s"})
    answers = result.outside["slam"]
    assert answers.inputs() == reference.outside["slam"].inputs()
    assert estimates(result)[-6:] == ALL[-6:]
    assert answers.counts["lost"] == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("needs", "missing"),
    [
        ([IMAGES, "/odd"], f"a subscription to {IMAGES} and /odd within 0.4 s, found none"),
        ([], "a subscription to /drone/camera/image_raw or "),
    ],
)
def test_what_is_missing_at_the_start_is_named(needs: list[str], missing: str) -> None:
    port = free_port()
    with zenoh_session(listen=f"tcp/127.0.0.1:{port}"):
        config = settings(port, needs=needs, timeout=0.4)
        with pytest.raises(FatalError, match=f"expected a publisher of /slam/pose and {missing}"):
            run_node(Ros2Bridge, inputs=[*ANNOUNCED, *flight()], config=config)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"answers_to": "drone/cam"}, r'found "drone/cam" \(there are: drone/camera\)'),
        (
            {"hold": {"skips": "allowed"}, "latency": "30ms"},
            r"above the period of drone/camera \(33\.33 ms\), found 30 ms",
        ),
    ],
)
def test_what_could_never_be_answered_is_refused_before_the_run(
    changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(NodeError, match=message):
        run_node(Ros2Bridge, inputs=ANNOUNCED, config=settings(free_port(), **changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"as": "velocity", "type": "geometry_msgs/msg/Twist"}, 'as = "estimate" or "done"'),
        ({"reliable": False}, "and reliable"),
        ({"hold": {"skips": "some"}}, "skips"),
        (
            {"answers_to": "", "as": "done", "type": "std_msgs/msg/Header", "needs": []},
            "expected answers_to, found none",
        ),
        ({"answers_to": ""}, "needs, hold: expected answers_to beside them"),
        ({"answers_to": "", "needs": [], "hold": {"max_wait": 3}}, "needs, hold: expected"),
        ({"as": "done", "type": "std_msgs/msg/Header"}, "expected one estimate with the same"),
    ],
)
def test_settings_that_make_no_sense_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        run_node(Ros2Bridge, config=settings(1, **changes))


@pytest.mark.slow
def test_only_what_is_not_held_is_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    with stub("at_once") as (_, port):
        config = settings(port)
        run_node(Ros2Bridge, inputs=[*ANNOUNCED, *flight(1)], config=config, duration=0.1)
        assert "at their own time" not in caplog.text
        config["subscriptions"].append(
            {"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist", "as": "velocity"}
        )
        run_node(Ros2Bridge, inputs=[*ANNOUNCED, *flight(1)], config=config, duration=0.1)
    assert "messages of ROS on /cmd_vel come at their own time" in caplog.text


@pytest.mark.slow
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
