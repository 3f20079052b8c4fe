"""What a program gets besides images: measurements and estimates, each when it came."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from events import (
    Announcement,
    BarometerAnnouncement,
    Command,
    EstimatorAnnouncement,
    Event,
    FluidPressure,
    Land,
    LidarAnnouncement,
    LidarScan,
    MagneticField,
    MagnetometerAnnouncement,
    NavSatAnnouncement,
    NavSatFix,
    PoseEstimate,
    PositionSetpoint,
    Range,
    RangeAnnouncement,
    Setpoint,
    Takeoff,
    TrackingLost,
    VelocitySetpoint,
)
from nodes.data.dataset.recording import Rig
from nodes.outside.process.program import MOST_BYTES, Inputs
from runtime import Node, NodeConfig, Output, Tick, every, on
from runtime.config.model import NodeSpec
from runtime.errors import ConfigError, VisnavError
from runtime.host import RunEnd
from runtime.testing import spec
from tests.nodes.calibration.samples import IMU, camera
from tests.nodes.outside.process.rig import fly, program

pytestmark = pytest.mark.timeout(120)

FUSION = str(Path(__file__).with_name("fusion.py"))
SENSORS = {
    "barometer": "others/baro",
    "magnetometer": "others/compass",
    "gnss": "others/gnss",
    "range": "others/altimeter",
    "lidar": "others/top",
    "drone/imu": "drone/imu",
    "vio": "vio",
}


def announced() -> list[Announcement]:
    own: dict[str, Any] = {"stamp": 0, "rate": 10.0}
    place: dict[str, Any] = {"latitude": 47.0, "longitude": 8.0, "altitude": 400.0}
    reach: dict[str, Any] = {"noise": 0.01, "min_range": 0.1, "max_range": 30.0}
    scan: dict[str, Any] = {"channels": 1, "columns": 2, "horizontal_fov": 6.0}
    return [
        BarometerAnnouncement(source="others/baro", noise=1.0, altitude=400.0, **own),
        MagnetometerAnnouncement(source="others/compass", noise=1e-7, field=(2e-5, 0, 4e-5), **own),
        NavSatAnnouncement(
            source="others/gnss", horizontal_noise=1.0, vertical_noise=2.0, **place, **own
        ),
        RangeAnnouncement(source="others/altimeter", **reach, **own),
        LidarAnnouncement(source="others/top", elevations=(0.0, 0.0), **scan, **reach, **own),
        EstimatorAnnouncement(stamp=0, source="vio", method="truth"),
    ]


class Others(Node[NodeConfig]):
    """All other sensors, and an estimator that is 40 ms late."""

    measurements = Output(Event)
    count = 0

    def announce(self) -> Iterable[Announcement]:
        return announced()

    @every(hz=10)
    def measure(self, _: Tick) -> None:
        stamp = self.clock.now()
        drone: dict[str, Any] = {"stamp": stamp}
        send = self.measurements.send
        send(FluidPressure(source="others/baro", fluid_pressure=96000.0, variance=1.5, **drone))
        send(MagneticField(source="others/compass", magnetic_field=(1e-5, 2e-5, 3e-5), **drone))
        place: dict[str, Any] = {"latitude": 47.1, "longitude": 8.2, "altitude": 412.0}
        send(NavSatFix(source="others/gnss", velocity=(1.0, 2.0, 3.0), **place, **drone))
        send(Range(source="others/altimeter", range=1.5, min_range=0.1, max_range=30.0, **drone))
        send(
            LidarScan(
                source="others/top",
                frame_id="lidar",
                points=np.array([[1, 2, 3], [4, 5, 6]], np.float32),
                intensities=np.array([0.5, 1.0], np.float32),
                times=np.array([0.001, 0.002], np.float32),
                rings=np.array([0, 7], np.uint16),
                **drone,
            )
        )
        self.start(self._estimate(stamp))

    async def _estimate(self, stamp: int) -> None:
        await self.clock.sleep(0.04)
        who: dict[str, Any] = {"stamp": stamp, "source": "vio"}
        self.count += 1
        if self.count == 3:
            self.measurements.send(TrackingLost(**who))
            return
        where: dict[str, Any] = {"position": (self.count, 0, 0), "orientation": (1, 0, 0, 0)}
        frame = "odom" if self.count < 5 else "odom_1"
        self.measurements.send(PoseEstimate(frame_id=frame, **where, **who))


class Ear(Node[NodeConfig]):
    """Keeps what the program says."""

    heard: ClassVar[list[Event]] = []

    @on(PoseEstimate, Command, Setpoint)
    def events(self, event: Event) -> None:
        if event.source.startswith("slam"):
            self.heard.append(event)


def fusion(*modes: str, **settings: Any) -> NodeSpec:
    return program(command=[sys.executable, FUSION, *modes], images=[], **settings)


def said(out: Path) -> list[str]:
    lines = (out / "log.txt").read_text().splitlines()
    return [line.partition("slam: ")[2] for line in lines if "slam: " in line]


@pytest.fixture(autouse=True)
def deaf() -> None:
    Ear.heard.clear()


OTHERS = (spec(Others, "others"), spec(Ear, "ear"))


class Last(Node[NodeConfig]):
    """Keeps how the run ended."""

    end: ClassVar[RunEnd | None] = None

    async def on_end(self) -> None:
        Last.end = self.run_end


@pytest.mark.slow
def test_a_filter_reads_no_camera(tmp_path: Path) -> None:
    fly(fusion(asks="drone/imu"), tmp_path, 0.1, others=(*OTHERS, spec(Last, "last")))
    assert Last.end is not None
    assert "drone/camera" in Last.end.owners
    assert "drone/camera" not in Last.end.read.get("slam", ())
    assert "slam" in Last.end.estimators


@pytest.mark.slow
def test_a_filter_gets_all_that_came_and_answers_each_tenth_sample(tmp_path: Path) -> None:
    asks = {"asks": "drone/imu", "every": 10}
    slam = fusion("further", reads=[*SENSORS], outputs=["raw"], **asks)
    summary = fly(slam, tmp_path, 0.5, others=OTHERS)
    lines = said(tmp_path)
    assert "inputs " + " ".join(f"{name}:{of}" for name, of in SENSORS.items()) in lines
    outside = summary.outside["slam"]
    assert (outside.answered, outside.open, outside.lost) == (10, 0, 0)
    assert outside.reproducible
    ms = 1_000_000
    assert f"{200 * ms} drone/imu {200 * ms} {[n * 5 * ms for n in range(31, 41)]}" in lines
    assert f"{150 * ms} vio {140 * ms} {[100 * ms]}" in lines  # stamped 0.1 s, came at 0.14 s
    assert f"{150 * ms} lidar {100 * ms} {[101 * ms, 102 * ms]}" in lines
    assert "estimates 424" in lines
    estimates = [event for event in Ear.heard if isinstance(event, PoseEstimate)]
    own = [estimate for estimate in estimates if estimate.source == "slam"]
    raw = [estimate for estimate in estimates if estimate.source == "slam/raw"]
    assert len(own) == 10
    assert [estimate.stamp for estimate in own] == [n * 50 * ms for n in range(10)]
    # The first pose lies on the announced one; the estimate of 0.1 s goes a metre further.
    assert own[0].position == pytest.approx((1.0, 2.0, -0.1))
    assert own[-1].velocity == pytest.approx((1.0, 2.0, 3.0))
    assert np.reshape(own[-1].covariance, (6, 6)) == pytest.approx(np.eye(6) * 1e-4)
    assert [b.position[2] - a.position[2] for a, b in zip(own, raw, strict=True)] == pytest.approx(
        [*range(10)]
    )
    assert raw[-1].velocity == pytest.approx((0.0, 0.0, 5.0))
    assert {"slam", "slam/raw"} <= {
        announcement["source"] for announcement in summary.announcements
    }


@pytest.mark.slow
def test_each_scan_and_each_estimate_may_ask(tmp_path: Path) -> None:
    for name, stamps in {"lidar": [2, 102], "vio": [0, 100]}.items():
        Ear.heard.clear()
        fly(fusion(asks=name), tmp_path / name, 0.18, others=OTHERS)
        assert [event.stamp // 1_000_000 for event in Ear.heard] == stamps


def test_a_lost_estimator_is_a_row_without_a_pose_and_a_new_map_another_frame() -> None:
    inputs = Inputs(["vio"])
    for announcement in announced():
        inputs.record(announcement)
    assert not [*inputs.choose("others", None)]
    where: dict[str, Any] = {"position": (1, 2, 3), "orientation": (1, 0, 0, 0)}
    for n, frame in enumerate(["odom", "odom", "", "odom_1"]):
        event: Event = TrackingLost(stamp=n, source="vio")
        if frame:
            event = PoseEstimate(stamp=n, source="vio", frame_id=frame, **where)
        assert inputs.store(event, n) == ("vio" if frame else "")
    assert inputs.store(PoseEstimate(stamp=9, source="other", **where), 9) == ""
    ((number, arrived, rows),) = inputs.drain()
    assert (number, arrived) == (0, 3)
    assert rows["frame"].tolist() == [0, 0, 0, 1]
    assert np.isnan(rows["pose"]).all(axis=(1, 2)).tolist() == [False, False, True, False]
    assert np.isnan(rows["covariance"]).all()
    assert inputs.drain() == []


@pytest.mark.slow
def test_what_no_frame_takes_along_is_dropped_and_counted() -> None:
    inputs = Inputs(["lidar"])
    for announcement in announced():
        inputs.record(announcement)
    assert not [*inputs.choose("", None)]
    count = MOST_BYTES // 32 // 3
    scan = LidarScan(
        stamp=0,
        source="others/top",
        frame_id="lidar",
        points=np.zeros((count, 3), np.float32),
        intensities=np.zeros(count, np.float32),
        times=np.zeros(count, np.float32),
        rings=np.zeros(count, np.uint16),
    )
    for n in range(5):
        assert inputs.store(scan, n) == "lidar"
    assert inputs.dropped == 2
    assert [row.arrived for row in inputs.drain()] == [2, 3, 4]  # scans stay apart


def test_a_program_flies(tmp_path: Path) -> None:
    fly(fusion("flies", asks="gnss", pilot=True), tmp_path, 0.1, others=OTHERS)
    takeoff, velocity, position, land = Ear.heard
    assert isinstance(takeoff, Takeoff)
    assert (takeoff.altitude, takeoff.stamp) == (2.0, 15_000_000)
    assert isinstance(velocity, VelocitySetpoint)
    assert (velocity.frame_id, velocity.velocity) == ("heading", (1.0, 0.0, 0.0))
    assert velocity.yaw_rate == 0.5
    assert isinstance(position, PositionSetpoint)
    assert (position.position, position.yaw) == ((1.0, 2.0, -3.0), 0.25)
    assert isinstance(land, Land)


@pytest.mark.slow
def test_a_program_that_is_not_the_pilot_does_not_fly(tmp_path: Path) -> None:
    with pytest.raises(VisnavError, match="ORDER: expected none, as the program does not fly"):
        fly(fusion("flies", asks="gnss"), tmp_path, 0.1, others=OTHERS)


@pytest.mark.slow
def test_without_images_poses_are_of_the_body(tmp_path: Path) -> None:
    with pytest.raises(VisnavError, match=r"READY\.pose_of: expected 1, the body"):
        fly(fusion("camera", asks="imu"), tmp_path, 0.1, others=OTHERS)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "problem"),
    [
        ({"asks": "sonar"}, "reads: expected a sensor or an estimator called sonar, found"),
        ({"asks": "imu", "reads": ["slam"]}, "called slam, found drone/imu"),
        ({"asks": "imu", "reads": ["drone/imu"]}, "found drone/imu as drone/imu and as imu"),
        ({"asks": "imu", "calibration": "openvins"}, "calibration: expected a camera, found none"),
        ({"asks": "imu", "cpus": 4096}, "cpus: expected at most the"),
    ],
)
def test_what_is_missing_is_named(tmp_path: Path, settings: dict[str, Any], problem: str) -> None:
    with pytest.raises(VisnavError, match=problem):
        fly(fusion(**settings), tmp_path, 0.1, others=OTHERS)


def test_somebody_has_to_ask() -> None:
    with pytest.raises(ConfigError, match="asks: expected images or the input that asks, found"):
        fusion()
    with pytest.raises(ConfigError, match="asks: expected images or the input that asks, found"):
        program(asks="imu")


@pytest.mark.slow
def test_the_calibration_is_written_and_the_processors_are_few(tmp_path: Path) -> None:
    command = [sys.executable, FUSION, "$VISNAV_FOLDER/calibration.json"]
    fly(
        program(command=command, images=["grey"], calibration="basalt", cpus=1),
        tmp_path,
        0.1,
        images=("grey",),
    )
    assert "processors 1" in said(tmp_path)
    assert "T_imu_cam" in (tmp_path / "programs" / "slam" / "calibration.json").read_text()


def test_a_lens_that_the_program_does_not_know_is_another_in_its_file() -> None:
    """The files are those of ``basalt``, and what was put in the place of what is said."""
    from nodes.outside.process.launch import Launch, ProcessConfig

    rig = Rig("drone", (camera(lens="radtan4"),), IMU)
    kinds: dict[Any, str] = {"basalt": "pinhole-radtan8", "basalt_kb4": "kb4"}
    for form, kind in kinds.items():
        launch = Launch(ProcessConfig(command=("true",), calibration=form), None, None)
        (text,) = launch.texts({}, rig).values()
        assert f'"camera_type": "{kind}"' in text
        remarks = launch.remarks(rig)
        assert len(remarks) == (kind == "kb4")
    assert "drone/left: its lens is written as the nearest kb4, 0." in remarks[0]


def test_each_program_has_processors_of_its_own() -> None:
    if len(os.sched_getaffinity(0)) < 2:
        pytest.skip("a single processor")
    from nodes.outside.process.launch import Launch, ProcessConfig

    taken: list[int] = []
    for _ in range(2):
        launch = Launch(ProcessConfig(command=("true",), cpus=1), None, None)
        assert launch.take_processors(taken) == ""
    assert len({*taken}) == 2
