"""Pipelines of evalio on a lidar: what they read and say, with a stub and with the library."""

from __future__ import annotations

import re
import sys
import types
from pathlib import Path
from typing import Any, get_args

import msgspec
import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from events import (
    EstimatorAnnouncement,
    Event,
    Imu,
    ImuAnnouncement,
    LidarScan,
    PoseEstimate,
    TrackedFeatures,
    TrackingLost,
    TrackingRegained,
)
from nodes.estimators import TrackingResult
from runtime import Node
from runtime.config.model import Config, RunConfig
from runtime.errors import MissingDependencyError, NodeError
from runtime.testing import run_node, run_nodes, spec
from runtime.tools.preflight import of_nodes
from tests.nodes.estimators.conformance import in_process
from tests.nodes.estimators.lidar_samples import PERIOD, lidar, scan
from visnav_estimators.evalio import Evalio, EvalioConfig, EvalioProcess, Name

Floats = npt.NDArray[np.float64]


def imu(source: str = "drone/imu") -> ImuAnnouncement:
    return ImuAnnouncement(
        stamp=0,
        source=source,
        rate=200.0,
        frame_id="imu",
        gyroscope_noise_density=1e-4,
        gyroscope_random_walk=1e-5,
        accelerometer_noise_density=1e-3,
        accelerometer_random_walk=1e-4,
    )


class Stamp(int):
    """A time in nanoseconds, with the library's methods."""

    @classmethod
    def from_nsec(cls, stamp: int) -> Stamp:
        return cls(stamp)

    @classmethod
    def from_sec(cls, seconds: float) -> Stamp:
        return cls(round(seconds * 1e9))

    def to_nsec(self) -> int:
        return int(self)


class Matrix:
    """A transform, with the library's methods."""

    def __init__(self, rotation: Floats, translation: Floats) -> None:
        self.matrix = np.eye(4)
        self.matrix[:3, :3], self.matrix[:3, 3] = rotation, translation

    @staticmethod
    def from_mat(rotation: Floats) -> Floats:
        return rotation

    def to_mat(self) -> Floats:
        return self.matrix


class Stub:
    """Takes a pipeline's place: its IMU moves 1 m along x with each scan."""

    made: list[Stub] = []  # noqa: RUF012

    def __init__(self) -> None:
        self.scans: list[Any] = []
        self.samples: list[Any] = []
        self.estimates: list[tuple[Stamp, Matrix]] = []
        self.made.append(self)

    @staticmethod
    def default_params() -> dict[str, Any]:
        return {"voxel_size": 1.0, "deskew": False, "num_threads": 0, "realtime": True, "name": "x"}

    def set_params(self, parameters: dict[str, Any]) -> None:
        self.parameters = parameters

    def set_lidar_params(self, lidar: Any) -> None:
        self.lidar = lidar

    def set_imu_params(self, imu: Any) -> None:
        self.imu = imu

    def set_imu_T_lidar(self, pose: Any) -> None:  # noqa: N802
        self.pose = pose

    def initialize(self) -> None:
        pass

    def add_imu(self, sample: Any) -> None:
        self.samples.append(sample)

    def add_lidar(self, scan: Any) -> None:
        bad = any(point.x == 49.0 for point in scan.points)
        where = np.full(3, np.nan) if bad else np.array([len(self.scans), 0.0, 0.0])
        self.scans.append(scan)
        self.estimates.append((scan.stamp, Matrix(np.eye(3), where)))

    def saved_estimates(self) -> list[tuple[Stamp, Matrix]]:
        estimates, self.estimates = self.estimates, []
        return estimates


@pytest.fixture
def library(monkeypatch: pytest.MonkeyPatch) -> None:
    def measured(stamp: int, *values: Any) -> Any:
        names = ("points",) if len(values) == 1 else ("gyro", "accel")
        return types.SimpleNamespace(stamp=stamp, **dict(zip(names, values, strict=True)))

    kinds = dict.fromkeys(("Point", "LidarParams", "ImuParams"), types.SimpleNamespace)
    known = types.SimpleNamespace(
        Stamp=Stamp,
        Duration=Stamp,
        SE3=Matrix,
        SO3=Matrix,
        LidarMeasurement=measured,
        ImuMeasurement=measured,
        **kinds,
    )
    package = types.ModuleType("evalio")
    package.types = known  # type: ignore[attr-defined]
    package.pipelines = types.SimpleNamespace(get_pipeline=lambda _: Stub)  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "evalio", package)
    monkeypatch.setattr(Node, "worker", in_process)
    Stub.made.clear()


CLOUD = np.tile([[2.0, 0.0, 0.0], [0.0, 3.0, 1.0]], (60, 1))


def fly(*events: Event, **config: Any) -> Any:
    return run_node(Evalio, inputs=events, config=config, duration=1.0, name="lo")


def tracker(**settings: Any) -> EvalioProcess:
    return EvalioProcess(EvalioConfig(**settings), lidar(), None)


def track(made: EvalioProcess, points: Floats, stamp: int = 0) -> TrackingResult:
    count = len(points)
    times, rings = np.linspace(0.0, 0.09375, count), np.arange(count) % 16
    none = np.empty((0, 7))
    args = points.astype(np.float32), times.astype(np.float32), rings.astype(np.uint16), none
    return made.track(stamp, *args)


@pytest.mark.usefixtures("library")
@pytest.mark.parametrize(
    ("config", "share"),
    [
        ({"pipeline": "kiss"}, 1.0),
        ({"pipeline": "genz", "parameters": {"deskew": False}}, 0.5),
        ({"pipeline": "loam"}, 0.5),
        ({"pipeline": "ct"}, 0.0),
    ],
)
def test_the_body_goes_where_the_lidar_goes_at_the_pipelines_time_in_a_scan(
    config: dict[str, Any], share: float
) -> None:
    result = fly(lidar(), *(scan(k, CLOUD) for k in range(1, 4)), **config)
    (said,) = result.of(EstimatorAnnouncement)
    assert (said.reads, said.lenses, said.rectifies) == (("lidar",), (), False)
    assert said.method == f"{config['pipeline']} (evalio)"
    estimates = result.of(PoseEstimate)
    after = round(share * 93_750_000)
    assert [estimate.stamp for estimate in estimates] == [k * PERIOD + after for k in (1, 2, 3)]
    # The library's x is the body's, which stands for the IMU.
    np.testing.assert_allclose(
        [estimate.position for estimate in estimates][-1], (2, 0, 0), atol=1e-9
    )
    assert {estimate.frame_id for estimate in estimates} == {"odom"}
    assert not result.of(TrackedFeatures)


@pytest.mark.usefixtures("library")
def test_a_scan_of_few_points_is_lost_and_none_is_said_before_the_first_good_one() -> None:
    few, none = CLOUD[:20], CLOUD[:0]
    scans = [scan(k + 1, c) for k, c in enumerate([few, none, CLOUD, CLOUD, few, none, CLOUD])]
    result = fly(lidar(), *scans, min_points=60)
    assert [event.stamp // PERIOD for event in result.of(PoseEstimate)] == [3, 4, 7]
    assert [event.stamp // PERIOD for event in result.of(TrackingLost)] == [5]
    assert [event.stamp // PERIOD for event in result.of(TrackingRegained)] == [7]


@pytest.mark.usefixtures("library")
def test_a_pose_of_lio_sam_is_that_of_the_scan_two_before() -> None:
    """It holds two scans back; few points are none of them."""
    clouds = [CLOUD, CLOUD, CLOUD[:20], CLOUD, CLOUD]
    scans = [scan(k, cloud) for k, cloud in enumerate(clouds, 1)]
    result = fly(lidar(), imu(), *scans, pipeline="liosam")
    estimates = result.of(PoseEstimate)
    assert [estimate.stamp for estimate in estimates] == [k * PERIOD + 46_875_000 for k in (1, 2)]
    np.testing.assert_allclose([estimate.position[0] for estimate in estimates], (0, 1), atol=1e-9)


@pytest.mark.usefixtures("library")
def test_of_several_lidars_it_reads_the_first_or_the_one_that_is_named() -> None:
    scans = [scan(1, CLOUD), scan(1, CLOUD, "drone/front"), scan(2, CLOUD)]
    both = [lidar(), lidar("drone/front")]
    assert len(fly(*both, *scans).of(PoseEstimate)) == 2
    node = spec(Evalio, "lo", inputs={"frames": "drone/front"})
    assert len(run_nodes([node], inputs=[*both, *scans]).of(PoseEstimate)) == 1


def test_without_a_lidar_it_is_refused_in_a_sentence() -> None:
    with pytest.raises(NodeError, match="expected a lidar, found none"):
        fly()


@pytest.mark.usefixtures("library")
def test_an_inertial_pipeline_gets_each_sample_of_its_imu_once_and_in_its_axes() -> None:
    still, turning = (0.0, 0.0, 0.0), (0.1, 0.2, 0.3)
    samples: list[Event] = [
        Imu(
            stamp=k * PERIOD // 10,
            source=source,
            frame_id="imu",
            angular_velocity=turning if source == "drone/imu" else still,
            linear_acceleration=(0.0, 0.0, -9.81),
        )
        for k in range(1, 40)
        for source in ("drone/imu", "other/imu")
    ]
    named = {"drone/imu": imu(), "other/imu": imu("other/imu")}
    script = sorted([*samples, *(scan(k, CLOUD) for k in (1, 2, 3))], key=lambda e: e.stamp)
    fly(*reversed(named.values()), lidar(), *script, pipeline="dlio")
    (made,) = Stub.made
    assert made.imu.rate == 200.0
    stamps = [sample.stamp for sample in made.samples]
    assert stamps == sorted(set(stamps))
    assert stamps[0] == PERIOD // 10
    assert stamps[-1] <= 3 * PERIOD + 93_750_000
    np.testing.assert_allclose(made.samples[0].gyro, (0.1, -0.2, -0.3))
    np.testing.assert_allclose(made.samples[0].accel, (0.0, 0.0, 9.81))
    with pytest.raises(NodeError, match="expected an IMU beside drone/top, found other/imu"):
        fly(lidar(), imu("other/imu"), pipeline="dlio")
    node = spec(Evalio, "lo", {"pipeline": "dlio"}, inputs={"imu": "other/imu"})
    run_nodes([node], inputs=[imu(), imu("other/imu"), lidar(), *script], duration=1.0)
    assert not any(Stub.made[-1].samples[0].gyro)


@pytest.mark.usefixtures("library")
def test_what_is_out_of_range_or_no_number_never_reaches_it() -> None:
    made = tracker(pipeline="loam")
    bad = np.array([[0.1, 0, 0], [60.0, 0, 0], [np.nan, 0, 0], [np.inf, 0, 0]])
    assert not track(made, np.vstack([CLOUD, bad])).lost
    points = Stub.made[0].scans[0].points
    assert len(points) == 16 * 64  # all rays, row by row
    assert [(p.row, p.col) for p in points[:65]] == [*((0, k) for k in range(64)), (1, 0)]
    there = {(p.x, p.y, p.z) for p in points if p.range}
    assert there == {(2.0, 0.0, 0.0), (0.0, -3.0, -1.0)}
    assert {p.range for p in points} == {0, 2000, 3162}
    track(tracker(pipeline="kiss"), CLOUD)
    points = Stub.made[1].scans[0].points  # in the order of time
    assert [(p.row, p.col) for p in points[:17]] == [*((k, 0) for k in range(16)), (0, 1)]


@pytest.mark.usefixtures("library")
def test_a_pose_that_is_no_number_is_lost_and_the_next_one_counts() -> None:
    made = tracker()
    assert not track(made, CLOUD).lost
    bad = CLOUD.copy()
    bad[0] = 49.0, 0.0, 0.0
    assert track(made, bad).lost
    assert not track(made, CLOUD).lost


@pytest.mark.usefixtures("library")
def test_parameters_and_the_lidars_range_reach_the_library_with_one_thread() -> None:
    tracker(parameters={"voxel_size": 2}, max_range=9.0)
    (made,) = Stub.made
    fixed = {"num_threads": 1, "realtime": False}
    assert made.parameters == {"voxel_size": 2.0, "deskew": True, "name": "x", **fixed}
    assert (made.lidar.min_range, made.lidar.max_range, made.lidar.num_rows) == (0.5, 9.0, 16)


@pytest.mark.usefixtures("library")
@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        (
            {"voxel": 1.0},
            "parameters.voxel: expected one of kiss's: voxel_size, .*mean .voxel_size",
        ),
        ({"voxel_size": "fine"}, "parameters.voxel_size: expected float, found 'fine'"),
        ({"deskew": 1}, "parameters.deskew: expected bool, found 1"),
        ({"num_threads": 4}, "parameters.num_threads: expected one of kiss's: voxel_size, deskew"),
    ],
)
def test_wrong_parameters_are_refused(parameters: dict[str, Any], said: str) -> None:
    """At the start, and by a mere check."""
    with pytest.raises(ValueError, match=said):
        tracker(parameters=parameters)
    wrong = spec(Evalio, "lo", {"parameters": parameters})
    (error,) = of_nodes(Config(run=RunConfig(), nodes=(wrong,))).errors
    assert re.search(said, error)


def test_a_missing_library_is_an_error_with_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "evalio", None)
    with pytest.raises(MissingDependencyError, match=r"kiss needs evalio .*evalio"):
        tracker()


CRASHES = """
import os, signal
from unittest.mock import MagicMock
pipelines, types = MagicMock(), MagicMock()
pipeline = pipelines.get_pipeline()()
pipeline.default_params.return_value = {}
pipeline.add_lidar.side_effect = lambda scan: os.kill(os.getpid(), signal.SIGSEGV)
"""


@pytest.mark.slow
def test_a_pipeline_that_crashes_takes_nothing_along_but_its_own_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "evalio.py").write_text(CRASHES)
    monkeypatch.syspath_prepend(str(tmp_path))  # which a worker takes over
    monkeypatch.delitem(sys.modules, "evalio", raising=False)
    inputs = [lidar(), *(scan(k, CLOUD) for k in (1, 2, 3))]
    with pytest.raises(NodeError, match=r"lo: worker .*killed by signal 11"):
        fly(*inputs)
    dropped = run_nodes([spec(Evalio, "lo", on_error="drop")], inputs=inputs, duration=1.0)
    assert dropped.reason == "duration"
    assert not dropped.of(PoseEstimate)


SENSOR = msgspec.structs.replace(
    lidar(), position=(0.0, 0.0, 0.0), orientation=(1.0, 0.0, 0.0, 0.0), channels=32, columns=256
)


def room(number: int, pose: Floats) -> LidarScan:
    """Return a scan in a room of 8 by 6 by 4 m with a pillar, with 2 mm of noise.

    The vehicle stands during a scan, whatever the times of the rays; the rings are at other
    heights in the next one.
    """
    angles = np.linspace(-np.pi, np.pi, 256, endpoint=False) + 1e-3  # along no wall
    rng = np.random.default_rng(number)
    heights = np.linspace(0.5, -0.51, 32) + rng.uniform(-0.016, 0.016)
    rows, columns = (grid.ravel() for grid in np.meshgrid(heights, angles, indexing="ij"))
    rays = np.stack([np.cos(rows) * np.cos(columns), np.cos(rows) * np.sin(columns), -np.sin(rows)])
    rays, start = pose[:3, :3] @ rays, pose[:3, 3:]
    walls = np.array([[4.0], [3.0], [2.0]])
    with np.errstate(divide="ignore"):
        far = np.min((np.sign(rays) * walls - start) / rays, axis=0)
    a = (rays[:2] ** 2).sum(axis=0)
    apart = start[:2] - [[2.5], [1.5]]
    b = (rays[:2] * apart).sum(axis=0)
    hit = b**2 - a * ((apart**2).sum() - 0.4**2)
    near = np.where(hit > 0, (-b - np.sqrt(np.maximum(hit, 0))) / a, np.inf)
    far = np.where(near > 0, np.minimum(far, near), far)
    far += rng.normal(0.0, 0.002, far.shape)
    points = (pose[:3, :3].T @ (rays * far)).T.astype(np.float32)
    return LidarScan(
        stamp=number * PERIOD,
        source="drone/top",
        frame_id="top",
        points=points,
        intensities=np.ones(len(points), np.float32),
        times=np.tile(np.arange(256, dtype=np.float32) / 2560, 32),
        rings=np.repeat(np.arange(32, dtype=np.uint16), 256),
    )


PARAMETERS = {
    "dlio": {"imu_calib_time": 0.3, "wait_until_move": False},
    "genz": {"deskew": False, "voxel_size": 0.25},
    "kiss": {"deskew": False, "voxel_size": 0.25},
    "mad": {"deskew": False},
}
"""For a room, in which the vehicle stands during each scan."""


@pytest.mark.slow
@pytest.mark.timeout(120)
@pytest.mark.parametrize("pipeline", get_args(Name))
def test_each_pipeline_of_the_library_follows_a_room_and_repeats_itself(pipeline: Name) -> None:
    """Those with an IMU stand in it; KISS-ICP takes rings on walls for what they were before."""
    pytest.importorskip("evalio")
    inertial = pipeline in {"dlio", "liosam"}
    truth = []
    for k in range(25):
        pose = np.eye(4)
        if not inertial:
            pose[:3, :3] = Rotation.from_euler("zx", (0.01 * k, 0.002 * k)).as_matrix()
            pose[:3, 3] = 0.02 * k, 0.01 * k, -0.005 * k
        truth.append(pose)
    rng = np.random.default_rng(1)
    still = [
        Imu(
            stamp=k * PERIOD // 20,
            source="drone/imu",
            frame_id="imu",
            angular_velocity=tuple(rng.normal(0.0, 0.003, 3).tolist()),
            linear_acceleration=tuple(rng.normal((0.0, 0.0, -9.81), 0.03).tolist()),
        )
        for k in range(540)
    ]
    scans = [room(k + 1, pose) for k, pose in enumerate(truth)]
    script = sorted([*still, *scans], key=lambda event: event.stamp)
    config = {"pipeline": pipeline, "parameters": PARAMETERS.get(pipeline, {})}
    first, second = (
        run_node(Evalio, inputs=[SENSOR, imu(), *script], config=config, duration=3.0).of(
            PoseEstimate
        )
        for _ in range(2)
    )
    assert len(first) == len(truth) - (2 if pipeline == "liosam" else 0)
    assert [estimate.position for estimate in first] == [estimate.position for estimate in second]
    assert [estimate.orientation for estimate in first] == [
        estimate.orientation for estimate in second
    ]
    off = np.array([estimate.position for estimate in first]) - np.array(truth)[: len(first), :3, 3]
    known = off[:, :2] if pipeline == "kiss" else off
    assert np.linalg.norm(known, axis=1).max() < 0.05
