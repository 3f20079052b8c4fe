"""KISS-ICP as an estimator on a lidar: what it reads and says, with a stub and with the library."""

from __future__ import annotations

import sys
import types
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from events import (
    EstimatorAnnouncement,
    Event,
    LidarAnnouncement,
    LidarScan,
    PoseEstimate,
    TrackedFeatures,
    TrackingLost,
    TrackingRegained,
)
from nodes.estimators import TrackingResult
from nodes.estimators.kiss_icp import KissIcp, KissIcpProcess, KissIcpSettings
from runtime import Node
from runtime.errors import ConfigError, MissingDependencyError, NodeError
from runtime.testing import run_node
from tests.nodes.estimators.conformance import in_process

Floats = npt.NDArray[np.float64]
PERIOD = 100_000_000
DOWN = tuple(Rotation.from_euler("y", -90, degrees=True).as_quat(scalar_first=True).tolist())


def lidar(source: str = "drone/top") -> LidarAnnouncement:
    return LidarAnnouncement(
        stamp=0,
        source=source,
        rate=10.0,
        frame_id="top",
        position=(0.0, 0.0, -0.1),
        orientation=DOWN,  # its x is down
        channels=16,
        columns=64,
        horizontal_fov=6.28,
        elevations=(-0.3, 0.3),
        noise=0.0,
        min_range=0.5,
        max_range=50.0,
    )


def scan(
    number: int, points: Floats, source: str = "drone/top", span: float = 0.09375
) -> LidarScan:
    count = len(points)
    return LidarScan(
        stamp=number * PERIOD,
        source=source,
        frame_id="top",
        points=points.astype(np.float32),
        intensities=np.ones(count, np.float32),
        times=np.linspace(0.0, span, count, dtype=np.float32),
        rings=np.zeros(count, np.uint16),
    )


class Stub:
    """Takes the library's place: it moves 1 m along x with each scan."""

    def __init__(self, config: Any) -> None:
        self.config, self.last_pose, self.last_delta = config, np.eye(4), np.eye(4)
        self.calls: list[tuple[Floats, Floats]] = []

    def register_frame(self, frame: Floats, timestamps: Floats) -> None:
        if self.calls:
            self.last_pose = self.last_pose.copy()
            self.last_pose[0, 3] += 1.0
        if frame[0, 0] == 49.0:
            self.last_pose = np.full((4, 4), np.nan)
        self.calls.append((frame, timestamps))


@pytest.fixture
def library(monkeypatch: pytest.MonkeyPatch) -> None:
    config, module = types.ModuleType("kiss_icp.config"), types.ModuleType("kiss_icp.kiss_icp")
    config.KISSConfig = types.SimpleNamespace  # type: ignore[attr-defined]
    module.KissICP = Stub  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "kiss_icp", types.ModuleType("kiss_icp"))
    monkeypatch.setitem(sys.modules, "kiss_icp.config", config)
    monkeypatch.setitem(sys.modules, "kiss_icp.kiss_icp", module)
    monkeypatch.setattr(Node, "worker", in_process)


CLOUD = np.tile([[2.0, 0.0, 0.0], [0.0, 3.0, 1.0]], (60, 1))


def fly(*events: Event, **config: Any) -> Any:
    return run_node(KissIcp, inputs=events, config=config, duration=1.0, name="kiss")


@pytest.mark.usefixtures("library")
def test_the_body_goes_where_the_lidar_goes_with_the_stamp_of_the_last_ray() -> None:
    result = fly(lidar(), *(scan(k, CLOUD) for k in range(1, 4)))
    (said,) = result.of(EstimatorAnnouncement)
    assert (said.reads, said.lenses, said.rectifies) == (("lidar",), (), False)
    estimates = result.of(PoseEstimate)
    assert [each.stamp for each in estimates] == [k * PERIOD + 93_750_000 for k in (1, 2, 3)]
    np.testing.assert_allclose([each.position for each in estimates][-1], (0, 0, 2), atol=1e-9)
    assert {each.frame_id for each in estimates} == {"odom"}
    assert not result.of(TrackedFeatures)


@pytest.mark.usefixtures("library")
def test_a_scan_of_few_points_is_lost_and_none_is_said_before_the_first_good_one() -> None:
    few, none = CLOUD[:20], CLOUD[:0]
    scans = [scan(k + 1, c) for k, c in enumerate([few, none, CLOUD, CLOUD, few, none, CLOUD])]
    result = fly(lidar(), *scans)
    assert [each.stamp // PERIOD for each in result.of(PoseEstimate)] == [3, 4, 7]
    assert [each.stamp // PERIOD for each in result.of(TrackingLost)] == [5]
    assert [each.stamp // PERIOD for each in result.of(TrackingRegained)] == [7]


@pytest.mark.usefixtures("library")
def test_of_several_lidars_it_reads_the_first_or_the_one_that_is_named() -> None:
    scans = [scan(1, CLOUD), scan(1, CLOUD, "drone/front"), scan(2, CLOUD)]
    both = [lidar(), lidar("drone/front")]
    assert len(fly(*both, *scans).of(PoseEstimate)) == 2
    from runtime.testing import run_nodes, spec

    node = spec(KissIcp, "kiss", inputs={"frames": "drone/front"})
    assert len(run_nodes([node], inputs=[*both, *scans]).of(PoseEstimate)) == 1


def test_without_a_lidar_it_is_refused_in_a_sentence() -> None:
    with pytest.raises(NodeError, match="expected a lidar, found none"):
        fly()


@pytest.mark.usefixtures("library")
def test_what_is_out_of_range_or_no_number_never_reaches_it() -> None:
    tracker = KissIcpProcess(lidar(), KissIcpSettings(min_points=100))
    bad = np.array([[0.1, 0, 0], [60.0, 0, 0], [np.nan, 0, 0], [np.inf, 0, 0]])
    points = np.vstack([CLOUD, bad]).astype(np.float32)
    times = np.arange(len(points), dtype=np.float32)
    assert not tracker.track(points, times).lost
    ((frame, stamps),) = tracker._odometry.calls
    np.testing.assert_array_equal(frame, CLOUD)
    np.testing.assert_array_equal(stamps, np.arange(len(CLOUD)))


@pytest.mark.usefixtures("library")
def test_a_pose_that_is_no_number_is_lost_and_forgotten() -> None:
    tracker = KissIcpProcess(lidar(), KissIcpSettings(min_points=100))
    times = np.zeros(len(CLOUD), np.float32)
    tracker.track(CLOUD.astype(np.float32), times)
    assert len(tracker._odometry.calls[0][1]) == 0  # of one time: nothing to correct
    bad = CLOUD.astype(np.float32)
    bad[0] = 49.0, 0.0, 0.0
    found: TrackingResult = tracker.track(bad, times)
    assert found.lost
    np.testing.assert_array_equal(found.pose, np.eye(4))
    assert tracker.track(CLOUD.astype(np.float32), times).pose[0, 3] == 1.0


@pytest.mark.usefixtures("library")
def test_settings_and_the_lidars_range_reach_the_library() -> None:
    config = KissIcpProcess(lidar(), KissIcpSettings())._odometry.config
    assert (config.data["min_range"], config.data["max_range"]) == (0.5, 50.0)
    assert config.mapping["voxel_size"] == 0.5
    assert config.registration == {"max_num_threads": 1}
    config = KissIcpProcess(lidar(), KissIcpSettings(voxel_size=0.2, max_range=9.0))._odometry
    assert (config.config.data["max_range"], config.config.mapping["voxel_size"]) == (9.0, 0.2)


def test_a_missing_library_is_an_error_with_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "kiss_icp", None)
    with pytest.raises(MissingDependencyError, match="kiss-icp"):
        KissIcpProcess(lidar(), KissIcpSettings())


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(ConfigError, match="voxel_size"):
        run_node(KissIcp, config={"kiss": {"voxel_size": -1.0}})


def room(pose: Floats) -> Floats:
    """Return what a lidar sees of a room of 8 by 6 by 4 m and a pillar, shape (n, 3)."""
    rng = np.random.default_rng(1)
    walls = rng.uniform((-4, -3, -2), (4, 3, 2), (12_000, 3))
    side = rng.integers(3, size=len(walls))
    rows = np.arange(len(walls))
    walls[rows, side] = np.sign(walls[rows, side]) * np.array([4.0, 3.0, 2.0])[side]
    angle, height = rng.uniform(0, 2 * np.pi, 2000), rng.uniform(-2, 2, 2000)
    pillar = np.stack([2.5 + 0.4 * np.cos(angle), 1.5 + 0.4 * np.sin(angle), height], axis=1)
    points = np.vstack([walls, pillar])
    return np.asarray((points - pose[:3, 3]) @ pose[:3, :3])


@pytest.mark.slow
def test_the_library_follows_a_room_and_repeats_itself() -> None:
    pytest.importorskip("kiss_icp")
    truth = []
    for k in range(25):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("zx", (0.03 * k, 0.005 * k)).as_matrix()
        pose[:3, 3] = 0.05 * k, 0.02 * k, -0.01 * k
        truth.append(pose)
    outcomes = []
    for _ in range(2):
        tracker = KissIcpProcess(lidar(), KissIcpSettings(voxel_size=0.25, deskew=False))
        results = [
            tracker.track(cloud.astype(np.float32), np.zeros(len(cloud), np.float32))
            for cloud in map(room, truth)
        ]
        assert not any(each.lost for each in results)
        outcomes.append(np.array([each.pose for each in results]))
    np.testing.assert_array_equal(outcomes[0], outcomes[1])
    off = np.linalg.norm(outcomes[0][:, :3, 3] - np.array(truth)[:, :3, 3], axis=1)
    assert off.max() < 0.02
