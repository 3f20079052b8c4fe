"""The node around ORB-SLAM3: what each mode asks for, and what it says of what is missing."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest

from events import (
    CameraAnnouncement,
    CameraInfo,
    EstimatorAnnouncement,
    Event,
    PoseEstimate,
    TrackingLost,
    TrajectoryEstimate,
)
from extensions.estimators.tests.orb_slam3.scene import StubProcess, UnsavedProcess
from runtime.errors import NodeError, RefusedError
from runtime.node import make_node
from runtime.testing import run_nodes, spec
from tests.nodes.estimators.test_estimator import MS, camera, imu, rgbd, sample, vehicle
from tests.runtime.small_events import NoHost
from visnav_estimators.orb_slam3 import OrbSlam3


def announced(mode: str) -> EstimatorAnnouncement:
    """Start a node that ends at once, for want of a vocabulary, and return what it announced."""
    node = make_node(OrbSlam3, "slam", spec(OrbSlam3, "slam", {"mode": mode}).config, NoHost())
    [announcement] = node.announce()
    assert isinstance(announcement, EstimatorAnnouncement)
    return announcement


def run(*events: Event, **config: object) -> None:
    run_nodes([spec(OrbSlam3, "slam", config)], inputs=events, duration=1.0)


@pytest.mark.parametrize(
    ("mode", "scale_free"),
    [
        ("rgbd", False),
        ("monocular", True),
        ("stereo", False),
        ("stereo_inertial", False),
        ("rgbd_inertial", False),
        ("monocular_inertial", False),
    ],
)
def test_only_a_single_camera_alone_has_no_scale(mode: str, scale_free: bool) -> None:
    assert announced(mode).scale_free is scale_free


def test_a_missing_vocabulary_is_an_error_with_the_command_that_makes_one(tmp_path: Path) -> None:
    missing = str(tmp_path / "none.txt")
    with pytest.raises(NodeError, match=r"python -m runtime vocabulary config\.toml"):
        run(camera("drone/front", "rgb", "depth"), vocabulary=missing)


def test_it_is_not_started_without_loop_closing_as_it_would_crash(tmp_path: Path) -> None:
    settings = {"vocabulary": str(tmp_path / "none.txt"), "orb": {"loop_closing": False}}
    with pytest.raises(NodeError, match=r"orb\.loop_closing: expected true, found false"):
        run(camera("drone/front", "rgb", "depth"), **settings)


def test_a_file_in_another_format_is_refused_before_anything_starts(tmp_path: Path) -> None:
    """ORB-SLAM3 would end its process, or read nonsense."""
    other = tmp_path / "other.txt"
    other.write_text("no vocabulary\n")
    with pytest.raises(NodeError, match=r"other\.txt: line 1: expected four whole numbers"):
        run(camera("drone/front", "rgb", "depth"), vocabulary=str(other))


def test_depth_is_asked_for_in_the_modes_that_use_it(tmp_path: Path) -> None:
    missing = str(tmp_path / "none.txt")
    with pytest.raises(NodeError, match="expected a camera with depth, grey images"):
        run(camera("drone/front", "rgb"), mode="rgbd", vocabulary=missing)
    with pytest.raises(NodeError, match="vocabulary"):  # it came that far
        run(camera("drone/front", "rgb"), mode="monocular", vocabulary=missing)


def test_a_named_camera_without_depth_is_refused() -> None:
    node = spec(OrbSlam3, "slam", inputs={"frames": "drone/front"})
    with pytest.raises(RefusedError, match="found none with depth"):
        run_nodes([node], inputs=[camera("drone/front", "rgb")], duration=1.0)


LENSED = CameraInfo.from_fov(8, 6, math.pi / 2)
LENSED = msgspec.structs.replace(LENSED, distortion=(-0.28, 0.075, 0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("mode", "known"), [("rgbd", True), ("monocular", True), ("stereo", False)]
)
def test_of_a_stereo_pair_only_images_without_distortion_are_taken(mode: str, known: bool) -> None:
    """It compares rows before it removes any distortion."""
    node = make_node(OrbSlam3, "slam", spec(OrbSlam3, "slam", {"mode": mode}).config, NoHost())
    seen = camera("drone/front", "grey", info=LENSED)
    assert isinstance(seen, CameraAnnouncement)
    assert (node.refusal(seen) == "") is known


def pair(**right: Any) -> list[Event]:
    return [
        camera("drone/left", "grey"),
        camera("drone/right", "grey", **{"position": (0.2, 0.1, 0.0), **right}),
    ]


NAMED = {"frames.left": "drone/left", "frames.right": "drone/right"}


@pytest.fixture
def stub(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("visnav_estimators.orb_slam3.node.OrbSlam3Process", StubProcess)
    monkeypatch.setattr("visnav_estimators.orb_slam3.node.find_vocabulary", Path)


def test_a_pair_that_may_not_be_rectified_is_refused_before_it_flies(stub: None) -> None:
    node = spec(OrbSlam3, "slam", {"mode": "stereo", "rectify": False}, inputs=NAMED)
    with pytest.raises(NodeError, match="expected its rows aligned with those of drone/left"):
        run_nodes([node], inputs=pair(position=(0.25, 0.1, 0.0)), duration=1.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mode", "inputs", "given"),
    [
        ("rgbd", {"frames": "drone/front"}, "depth (6, 8)"),
        ("monocular", {"frames": "drone/front"}, ""),
        ("stereo", NAMED, "right (6, 8)"),
        ("rgbd_inertial", {"frames": "drone/front"}, "depth (6, 8), imu (2, 7)"),
        ("monocular_inertial", {"frames": "drone/front"}, "imu (2, 7)"),
        ("stereo_inertial", NAMED, "right (6, 8), imu (2, 7)"),
    ],
)
def test_each_mode_gets_its_sensors_and_says_its_trajectory_twice(
    stub: None, mode: str, inputs: dict[str, str], given: str
) -> None:
    cameras = [camera("drone/front", "rgb", "depth"), *pair()]
    flown = [
        event
        for k in range(10, 60, 10)
        for event in (
            *rgbd(k * MS, "drone/left")[:1],
            *rgbd(k * MS, "drone/right")[:1],
            *rgbd(k * MS, "drone/front"),
            sample((k - 5) * MS),
            sample(k * MS),
        )
    ]
    node = spec(OrbSlam3, "slam", {"mode": mode, "latency": "1ms"}, inputs=inputs)
    announced = [*cameras, *([imu()] if "inertial" in mode else [])]
    sent = run_nodes([node], inputs=[vehicle(), *announced, *flown], duration=1.0)
    assert [e.stamp for e in sent.of(PoseEstimate)] == [10 * MS, 20 * MS, 40 * MS, 50 * MS]
    [lost] = sent.of(TrackingLost)
    assert lost.reason == given
    [final] = sent.of(TrajectoryEstimate)
    assert final.stamps.tolist() == [k * MS for k in (10, 20, 30, 40, 50)]
    causal = np.array([e.position for e in sent.of(PoseEstimate)])
    assert np.linalg.norm(causal[-1] - causal[0]) == pytest.approx(4.0)
    assert np.linalg.norm(final.positions[-1] - causal[0]) == pytest.approx(2.0)


@pytest.mark.slow
def test_what_it_said_counts_though_its_final_trajectory_cannot_be_saved(
    stub: None, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("visnav_estimators.orb_slam3.node.OrbSlam3Process", UnsavedProcess)
    cameras = [vehicle(), camera("drone/front", "rgb", "depth")]
    flown = [event for k in (10, 20) for event in rgbd(k * MS, "drone/front")]
    node = spec(OrbSlam3, "slam", {"latency": "1ms"}, inputs={"frames": "drone/front"})
    sent = run_nodes([node], inputs=[*cameras, *flown], duration=1.0)
    assert [e.stamp for e in sent.of(PoseEstimate)] == [10 * MS, 20 * MS]
    assert not sent.of(TrajectoryEstimate)
    assert "failed to save its final trajectory: Invalid argument" in caplog.text


def test_its_runs_do_not_promise_their_digest() -> None:
    assert OrbSlam3.deterministic is False


@pytest.mark.parametrize(("clock", "seconds"), [("lockstep", 0.7), ("real", 0.0)])
async def test_images_wait_for_its_mapping_in_lockstep_alone(
    monkeypatch: pytest.MonkeyPatch, clock: str, seconds: float
) -> None:
    told: list[Any] = []

    async def worker(node: OrbSlam3, of: type, *given: Any, **_: Any) -> None:
        told.append(given[-1])

    monkeypatch.setattr(OrbSlam3, "worker", worker)
    settings = spec(OrbSlam3, "slam", {"mapping_timeout": "700ms"}).config
    node = make_node(OrbSlam3, "slam", settings, NoHost())
    node.clock = SimpleNamespace(kind=clock)  # type: ignore[assignment]
    node._settings, node._vocabulary = None, None  # type: ignore[assignment]
    await node.on_ready()
    assert told == pytest.approx([seconds])
