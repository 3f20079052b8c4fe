"""Declared latency of an estimator: kept wherever its tracker runs, also in `run` itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import visnav
from events import Image, LidarScan, PoseEstimate, TrackedFeatures
from nodes.estimators import Estimator, MonocularFrame, TrackingResult
from runtime import Bundle, Input, Node, Output, on
from runtime.config.model import Config, RunConfig
from runtime.run.execute import execute
from runtime.testing import run_nodes, spec
from runtime.units import Duration
from tests.nodes.estimators.conformance import in_process
from tests.nodes.estimators.lidar_samples import lidar, scan
from tests.nodes.estimators.test_estimator import MS, camera, rgbd

ROOT = Path(__file__).parents[3]
Came = list[tuple[int, int, float]]
"""Stamp of each estimate, when it came (both ms), and how far ahead it is (m)."""


class Steps:
    """Tracker that moves a metre with each image."""

    def __init__(self) -> None:
        self.count = 0

    def track(self, _: Any) -> TrackingResult:
        self.count += 1
        pose = np.eye(4)
        pose[2, 3] = self.count
        return TrackingResult(pose)


class InRun(Estimator):
    """Computes in `run` itself."""

    needs = frozenset({"grey"})
    method = "steps"
    frames = Bundle(MonocularFrame, keep="latest")

    async def on_ready(self) -> None:
        self.steps = Steps()

    async def run(self) -> None:
        async for (image,) in self.frames:
            self.publish(image, await self.track(image))

    async def track(self, image: Image) -> TrackingResult:
        return self.steps.track(image)


class InThread(InRun):
    """Computes in a thread, in no simulated time."""

    async def track(self, image: Image) -> TrackingResult:
        return await self.offload(self.steps.track, image)


class InTimedThread(InRun):
    """Computes in a thread that takes the latency."""

    async def track(self, image: Image) -> TrackingResult:
        return await self.offload_for(self.config.latency, self.steps.track, image)


class InWorker(InRun):
    """Computes in a worker with the latency."""

    async def on_ready(self) -> None:
        self.tracker = await self.start_tracker(Steps)

    async def track(self, image: Image) -> TrackingResult:
        return await self.tracker.call(Steps.track, image)


class Changing(InRun):
    """Changes its pose in place once it has published."""

    async def run(self) -> None:
        pose = np.eye(4)
        async for (image,) in self.frames:
            pose[2, 3] += 1.0
            self.publish(image, TrackingResult(pose))
            pose[2, 3] += 0.5


class Ears(Node):
    """Notes when poses come."""

    def __init__(self) -> None:
        self.came: Came = self.share("came", list)
        CAME.append(self.came)

    @on(PoseEstimate)
    def hear(self, event: PoseEstimate) -> None:
        now = self.clock.now() // MS
        self.came.append((event.stamp // MS, now, round(event.position[0], 9)))


CAME: list[Came] = []


def track(
    node: type[Estimator[Any]], latency: float, images: list[int], duration: float = 2.0
) -> Came:
    """Return what an estimator gives for images at some times (ms)."""
    frames = [event for stamp in images for event in rgbd(stamp * MS)[:1]]
    seen = camera("drone/front", "grey")
    nodes = [spec(node, "est", {"latency": latency}), spec(Ears, "ears")]
    CAME.clear()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Node, "worker", in_process)
        run_nodes(nodes, inputs=[seen, *frames], duration=duration)
    return CAME[0]


WAYS = [InRun, InThread, InTimedThread, InWorker]


@pytest.mark.parametrize("node", WAYS)
def test_an_estimate_goes_out_when_its_latency_is_over(node: type[InRun]) -> None:
    every = [0, 100, 200, 300, 400]
    assert track(node, 0.015, every) == [(t, t + 15, 1 + t / 100) for t in every]
    # Busy for 250 ms, it skips what arrives meanwhile, but for the newest.
    assert track(node, 0.25, every) == [(0, 250, 1), (200, 500, 2), (400, 750, 3)]
    assert track(node, 0.0, every) == [(t, t, 1 + t / 100) for t in every]


@pytest.mark.parametrize("node", WAYS)
def test_what_is_due_after_the_end_is_not_sent(node: type[InRun]) -> None:
    assert [stamp for stamp, *_ in track(node, 0.2, [0, 300, 790], duration=1.0)] == [0, 300, 790]
    assert [stamp for stamp, *_ in track(node, 0.2, [0, 300, 850], duration=1.0)] == [0, 300]


@given(
    st.lists(st.integers(1, 300), min_size=1, max_size=12),
    st.integers(0, 500),
    st.sampled_from([InRun, InThread, InTimedThread]),
)
@pytest.mark.slow
def test_it_is_the_same_as_in_a_worker(
    gaps: list[int], latency: int, node: type[Estimator[Any]]
) -> None:
    images = np.cumsum(gaps).tolist()
    expected = track(InWorker, latency / 1000, images, duration=5.0)
    assert track(node, latency / 1000, images, duration=5.0) == expected


def test_a_pose_changed_after_it_was_published_goes_out_as_it_was() -> None:
    assert track(Changing, 0.015, [0, 100]) == [(0, 15, 1.0), (100, 115, 2.5)]


class Batches(InRun):
    """Publishes the images in pairs, the newer one first."""

    async def run(self) -> None:
        before = None
        async for (image,) in self.frames:
            if before is not None:
                self.publish(image, self.steps.track(image))
                self.publish(before, self.steps.track(before))
            before = None if before is not None else image


def test_results_keep_their_order() -> None:
    results = track(Batches, 0.05, [0, 100, 200, 300])
    assert results == [(100, 150, 1), (0, 150, 2), (300, 350, 3), (200, 350, 4)]


class OfScans(Estimator):
    """Computes a pose of each scan in `run`."""

    needs = frozenset({"lidar"})
    method = "scans"
    frames = Input(LidarScan, keep="latest")

    async def run(self) -> None:
        async for event in self.frames:
            self.publish(event, TrackingResult(np.eye(4)))


def test_scans_have_a_latency_too() -> None:
    CAME.clear()
    nodes = [spec(OfScans, "est", {"latency": 0.25}), spec(Ears, "ears")]
    points = np.ones((2, 3))
    scans = [scan(number, points) for number in range(5)]
    run_nodes(nodes, inputs=[lidar(), *scans], duration=2.0)
    (came,) = CAME
    gaps = np.diff([at for _, at, _ in came])
    assert gaps.tolist() == [250, 250], came


class FromHandler(Estimator):
    """Computes in a handler, which knows nothing of frames."""

    needs = frozenset({"grey"})
    method = "handler"

    @on(Image)
    def images(self, image: Image) -> None:
        self.publish(image, TrackingResult(np.eye(4)))

    async def run(self) -> None: ...


def test_an_image_that_frames_did_not_give_is_told(caplog: pytest.LogCaptureFixture) -> None:
    assert [at for _, at, _ in track(FromHandler, 0.25, [0, 100])] == [0, 100]
    (record,) = [r for r in caplog.records if "latency is not kept" in r.message]
    assert "expected an image read from frames, found one of drone/front at 0.000 s" in (
        record.message
    )


def test_points_without_inliers_all_agree() -> None:
    class Points(InRun):
        async def track(self, image: Image) -> TrackingResult:
            return TrackingResult(np.eye(4), points=np.ones((3, 2), np.float32))

    seen = camera("drone/front", "grey")
    result = run_nodes([spec(Points, "est")], inputs=[seen, *rgbd(1)[:1]])
    (features,) = result.of(TrackedFeatures)
    assert features.inliers.tolist() == [True] * 3


def test_in_real_time_it_comes_no_earlier() -> None:
    class Camera(Node):
        images = Output(Image)

        def announce(self) -> Any:
            yield camera("cam/front", "grey")

        async def run(self) -> None:
            for number in range(4):
                data = np.full((6, 8), 9, np.uint8)
                stamp = self.clock.now()
                self.images.send(
                    Image(
                        stamp=stamp, source="cam/front", frame_id="f", encoding="mono8", data=data
                    )
                )
                await self.clock.sleep(0.02 if number < 3 else 0.06)
            self.stop("all are sent")

    CAME.clear()
    nodes = (spec(Camera, "cam"), spec(InRun, "est", {"latency": 0.05}), spec(Ears, "ears"))
    execute(Config(run=RunConfig(duration=Duration(5.0), clock="real"), nodes=nodes))
    (came,) = CAME
    assert came
    assert all(at - stamp >= 49 for stamp, at, _ in came), came


OWN = """
from examples.own_estimator import FlowOdometry, OwnEstimator


class InRun(OwnEstimator):
    async def on_ready(self):
        self.flow = FlowOdometry(self.the_camera().info.matrix(), self.config.corners)

    async def run(self):
        async for image, depth in self.frames:
            self.publish(image, self.flow.track(image.data, depth.data))
"""


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_sweep_over_the_latency_is_no_flat_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "in_run.py").write_text(OWN)
    text = (ROOT / "examples" / "own_estimator.toml").read_text()
    text = text.replace("own_estimator:OwnEstimator", "in_run:InRun").replace("20s", "6s")
    text = text.replace("rate = 20", "rate = 10").partition('[[nodes]]\nname = "report"')[0]
    text = text.replace("VisualOdometry", "SyntheticOdometry")
    (tmp_path / "flight.toml").write_text(text)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    latencies = [0.0, 0.03, 0.4]
    table = visnav.sweep("flight.toml", {"own.latency": latencies}, out=tmp_path / "sweep", jobs=1)
    rows = table if isinstance(table, list) else table.to_dict("records")
    own = [row for row in rows if row["estimator"] == "own"]
    # The camera's 40 ms, then the estimator's own.
    declared = [40 + 1000 * latency for latency in latencies]
    assert [row["latency_p50_ms"] for row in own[:2]] == pytest.approx(declared[:2])
    assert own[2]["latency_p50_ms"] >= declared[2]  # images wait while it is busy
    newest = [row["newest_pose_rmse_m"] for row in own]
    assert newest[0] < 0.9 * newest[1] < 0.4 * newest[2], newest
