"""The evaluation node: scores while it runs, figures, thresholds and files at the end."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest

from events import (
    Announcement,
    CameraAnnouncement,
    CameraInfo,
    Collision,
    EstimatorAnnouncement,
    Event,
    Image,
    Odometry,
    PlannedPose,
    PoseEstimate,
    PositionSetpoint,
    Score,
    TrackedFeatures,
    VehicleAnnouncement,
)
from nodes.judging.evaluation import Evaluation
from nodes.judging.evaluation.files import read_errors
from nodes.trajectory_files import read_tum
from runtime import Duration, Node, Output
from runtime.config.model import Config, RunConfig
from runtime.errors import ConfigError, NodeError
from runtime.run.execute import execute
from runtime.source_files import source_file
from runtime.testing import run_node, run_nodes, spec
from tests.nodes.judging.evaluation.flights import (
    MS,
    SECOND,
    announced,
    estimate,
    lost,
    place,
    regained,
    truth,
)


def judged(out: Path, *groups: list[Event], late: int = 0, **config: Any) -> dict[str, Any]:
    """Run the node on events that come `late` nanoseconds after their stamps; give its verdict."""
    run(out, *groups, late=late, **config)
    verdict: dict[str, Any] = json.loads((out / "evaluation" / "verdict.json").read_text())
    return verdict


def run(out: Path, *groups: list[Event], late: int = 0, **config: Any) -> list[Score]:
    links = {"estimates": {"delay": late / 1e9}, "tracking_events": {"delay": late / 1e9}}
    script = sorted((e for group in groups for e in group), key=lambda e: e.stamp)
    node = spec(Evaluation, "evaluation", config, links=links if late else {})
    return run_nodes([node], inputs=script, duration=11.0, out=out).of(Score)


FRAMES = range(0, 10 * SECOND + 1, 100 * MS)


def test_a_constant_error_is_found_everywhere(tmp_path: Path) -> None:
    estimates: list[Event] = [estimate(s, error=(0.3, 0.0, 0.4)) for s in FRAMES]
    figures = judged(tmp_path, announced(), truth(10), estimates)["estimators"]["est"]
    assert figures["alignment"] == "none"
    assert figures["ate_rmse_m"] == pytest.approx(0.5)
    assert figures["ate_max_m"] == pytest.approx(0.5)
    assert figures["path_m"] == pytest.approx(4 * math.pi, rel=1e-3)
    assert figures["ate_percent"] == pytest.approx(50 / (4 * math.pi), rel=1e-3)
    assert figures["rpe_1m_trans_percent"] == pytest.approx(0.0, abs=1e-9)
    assert figures["lost_seconds"] == 0.0
    assert figures["estimates"] == 101
    assert figures["rate_hz"] == pytest.approx(10.0)


@pytest.mark.slow
def test_an_estimate_in_odom_is_laid_on_the_first_pose(tmp_path: Path) -> None:
    estimates: list[Event] = [estimate(s, error=(7.0, 0.0, 0.0), frame_id="odom") for s in FRAMES]
    scores = run(tmp_path, announced(), truth(10), estimates)
    assert max(s.value for s in scores if s.metric == "position_error") < 1e-9
    verdict = json.loads((tmp_path / "evaluation" / "verdict.json").read_text())
    assert verdict["estimators"]["est"]["alignment"] == "origin"
    assert verdict["estimators"]["est"]["ate_rmse_m"] < 1e-9


def test_a_scale_free_estimate_is_scaled_and_its_scale_told(tmp_path: Path) -> None:
    estimates: list[Event] = [estimate(s, scale=0.25) for s in FRAMES]
    figures = judged(tmp_path, announced(scale_free=True), truth(10), estimates)
    assert figures["estimators"]["est"]["scale"] == pytest.approx(4.0)
    assert figures["estimators"]["est"]["ate_rmse_m"] < 1e-6


def test_scores_come_with_each_estimate(tmp_path: Path) -> None:
    estimates: list[Event] = [
        estimate(s, error=(0.1 * (i + 1), 0.0, 0.0)) for i, s in enumerate(FRAMES[:3])
    ]
    scores = run(tmp_path, announced(), truth(1), estimates)
    errors = [s.value for s in scores if s.metric == "position_error"]
    so_far = [s.value for s in scores if s.metric == "ate_rmse"]
    percent = [s.value for s in scores if s.metric == "ate_percent"]
    assert errors == pytest.approx([0.1, 0.2, 0.3])
    assert so_far == pytest.approx([0.1, math.sqrt(0.05 / 2), math.sqrt(0.14 / 3)])
    flown = [4 * math.pi / 10 * s / SECOND for s in FRAMES[1:3]]
    assert percent == pytest.approx([100 * so_far[1] / flown[0], 100 * so_far[2] / flown[1]], 1e-3)
    assert {s.subject for s in scores} == {"est"}


def test_the_pose_there_was_is_worse_by_its_age(tmp_path: Path) -> None:
    estimates: list[Event] = [estimate(s) for s in FRAMES]
    figures = judged(tmp_path, announced(), truth(10), estimates, late=80 * MS)
    score = figures["estimators"]["est"]
    assert score["ate_rmse_m"] < 1e-9
    assert score["latency_p50_ms"] == pytest.approx(80.0)
    # The pose is 80 to 180 ms old, at 4π m in 10 s: the root mean square of a uniform age.
    age = math.sqrt((0.18**3 - 0.08**3) / (3 * 0.1))
    assert score["newest_pose_rmse_m"] == pytest.approx(4 * math.pi / 10 * age, rel=0.02)
    assert score["newest_pose_age_ms"] == pytest.approx(130.0, rel=0.03)


def test_lost_time_is_by_word_and_by_silence(tmp_path: Path) -> None:
    kept = [
        s for s in FRAMES if not 2 * SECOND < s < 3 * SECOND and not 5 * SECOND < s < 7 * SECOND
    ]
    said: list[Event] = [lost(2100 * MS), regained(3 * SECOND)]
    estimates: list[Event] = [estimate(s) for s in kept]
    figures = judged(tmp_path, announced(), truth(10), estimates, said)["estimators"]["est"]
    assert figures["lost_count"] == 2
    assert figures["lost_seconds"] == pytest.approx(1.0 + 2.0)


@pytest.mark.slow
def test_an_estimator_that_falls_silent_is_lost_until_the_end(tmp_path: Path) -> None:
    estimates: list[Event] = [estimate(s) for s in FRAMES if s <= 4 * SECOND]
    figures = judged(tmp_path, announced(), truth(10), estimates)["estimators"]["est"]
    assert figures["lost_seconds"] == pytest.approx(6.0)


@pytest.mark.parametrize(("limit", "passed"), [(0.6, True), (0.4, False)])
def test_thresholds_decide(tmp_path: Path, limit: float, passed: bool) -> None:
    estimates: list[Event] = [estimate(s, error=(0.5, 0.0, 0.0)) for s in FRAMES]
    verdict = judged(tmp_path, announced(), truth(10), estimates, thresholds={"ate_rmse_m": limit})
    assert verdict["passed"] is passed
    assert verdict["estimators"]["est"]["passed"] is passed
    failed = verdict["estimators"]["est"]["failed"]
    assert failed == ([] if passed else ["ate_rmse_m: expected at most 0.4, found 0.5"])


def test_an_estimator_that_says_nothing_has_failed(tmp_path: Path) -> None:
    verdict = judged(tmp_path, announced(), truth(2))
    assert verdict["passed"] is False
    assert verdict["estimators"]["est"]["estimates"] == 0


def test_without_a_truth_there_is_no_verdict_but_a_reason(tmp_path: Path) -> None:
    verdict = judged(tmp_path, announced(), [estimate(0)])
    assert "no odometry" in verdict["estimators"]["est"]["failed"][0]


@pytest.mark.slow
def test_the_flight_is_held_against_its_plan(tmp_path: Path) -> None:
    """Half a metre aside, and once two metres; set-points are no plan."""
    estimates: list[Event] = [estimate(s) for s in FRAMES]
    orders: list[Event] = [PositionSetpoint(stamp=0, source="tour", position=(9.0, 9.0, 9.0))]
    figures = judged(tmp_path, announced(), truth(10), estimates, orders)["estimators"]["est"]
    assert "plan_rmse_m" not in figures
    plan: list[Event] = [
        PlannedPose(stamp=s, source="pilot", position=(x, y, z + (2.0 if n == 5 else 0.5)), yaw=0.0)
        for n, s in enumerate(FRAMES)
        for x, y, z in [place(s)]
    ]
    limits = {"plan_rmse_m": 0.1}
    verdict = judged(tmp_path, announced(), truth(10), estimates, plan, orders, thresholds=limits)
    figures = verdict["estimators"]["est"]
    rmse = math.sqrt((100 * 0.25 + 4.0) / 101)
    assert figures["plan_rmse_m"] == pytest.approx(rmse, abs=1e-6)
    assert figures["plan_max_m"] == pytest.approx(2.0, abs=1e-6)
    expected = [f"plan_rmse_m: expected at most 0.1, found {rmse:.4g}"]
    assert verdict["flights"]["drone"]["failed"] == expected


@pytest.mark.slow
def test_files_hold_what_was_said(tmp_path: Path) -> None:
    estimates: list[Event] = [estimate(s, error=(0.3, 0.0, 0.0)) for s in FRAMES]
    plan: list[Event] = [
        PositionSetpoint(stamp=s, source="tour", position=place(s)) for s in FRAMES
    ]
    judged(tmp_path, announced(), truth(10), estimates, plan)
    said = read_tum(tmp_path / "trajectories" / "est.tum")
    assert said.stamps.tolist() == list(FRAMES)
    np.testing.assert_allclose(said.positions[7], np.add(place(FRAMES[7]), (0.3, 0, 0)), atol=1e-9)
    assert len(read_tum(tmp_path / "trajectories" / "truth.tum")) == 2001
    assert len(read_tum(tmp_path / "trajectories" / "plan.tum")) == len(FRAMES)
    errors = read_errors(tmp_path / "evaluation" / "est.csv")
    np.testing.assert_allclose(errors.position, 0.3, atol=1e-8)
    ticks = read_errors(tmp_path / "evaluation" / "est.ticks.csv")
    assert len(ticks.stamps) == 4001


def test_each_estimator_has_files_of_its_own_whatever_it_and_its_frame_are_called(
    tmp_path: Path,
) -> None:
    sources = ["truth", "plan", "a/b", "a_b", "a.lost", "é"]
    sent: list[Event] = [
        estimate(stamp, error=(float(n), 0.0, 0.0), source=source, frame_id="odom\n1 2 é")
        for stamp in FRAMES[:9]
        for n, source in enumerate(sources)
    ]
    judged(tmp_path, announced(), truth(1), sent)
    for n, source in enumerate(sources):
        said = read_tum(tmp_path / "trajectories" / f"{source_file(source)}.tum")
        assert said.positions[0, 0] - place(0)[0] == pytest.approx(n)
        assert (tmp_path / "evaluation" / f"{source_file(source)}.lost.csv").is_file()
    assert len(read_tum(tmp_path / "trajectories" / "truth.tum")) > 100
    assert len([*(tmp_path / "evaluation").glob("*.aligned.tum")]) == len(sources)


def test_a_second_map_with_more_poses_is_what_is_judged_scored_and_written(tmp_path: Path) -> None:
    sent: list[Event] = [
        estimate(stamp, error=(5.0, 0.0, 0.0), frame_id="odom" if n < 3 else "odom_1")
        for n, stamp in enumerate(FRAMES[:11])
    ]
    scores = run(tmp_path, announced(), truth(1), sent)
    scored = [s.stamp for s in scores if s.metric == "position_error"]
    assert scored == [*FRAMES[:3], *FRAMES[6:11]]  # those of the map that had most poses then
    written = tmp_path / "trajectories" / "est.tum"
    assert read_tum(written).stamps.tolist() == [*FRAMES[3:11]]
    assert "in odom_1, as it was sent" in written.read_text()
    first_map = read_tum(tmp_path / "evaluation" / "est.first_map.tum")
    assert first_map.stamps.tolist() == [*FRAMES[:3]]
    figures = json.loads((tmp_path / "evaluation" / "verdict.json").read_text())["estimators"][
        "est"
    ]
    assert (figures["estimates"], figures["restarts"]) == (8, 1)
    assert figures["ate_rmse_m"] == pytest.approx(0.0, abs=1e-9)


def test_of_many_images_a_few_are_kept_with_their_features(tmp_path: Path) -> None:
    events: list[Event] = []
    for stamp in FRAMES:
        data = np.full((60, 80), 128, np.uint8)
        events.append(
            Image(stamp=stamp, source="c", frame_id="c_optical", encoding="mono8", data=data)
        )
        events.append(
            TrackedFeatures(
                stamp=stamp,
                source="est",
                frame_id="c_optical",
                points=np.array([[20, 30], [60, 30]], np.float32),
                inliers=np.array([True, False]),
            )
        )
    run(tmp_path, announced(), truth(1), events, image_count=4)
    files = sorted((tmp_path / "frames").iterdir())
    assert 2 <= len(files) <= 4
    drawn = cv2.imread(str(files[0]))
    assert drawn is not None
    left, right = drawn[:, :40].astype(int), drawn[:, 40:].astype(int)
    assert (left[..., 1] - left[..., 2]).max() > 60  # a green ring
    assert (right[..., 2] - right[..., 1]).max() > 60  # a red one


def test_of_a_camera_that_nobody_tracks_a_few_images_are_kept(tmp_path: Path) -> None:
    data = np.full((60, 80), 128, np.uint8)
    events: list[Event] = [
        Image(stamp=s, source="drone/eye", frame_id="eye", encoding="mono8", data=data)
        for s in FRAMES
    ]
    run(tmp_path, announced(), truth(10), events, image_count=4)
    names = sorted(path.name for path in (tmp_path / "frames").iterdir())
    assert 2 <= len(names) <= 4
    assert names[0] == "drone+eye_000000000000000.jpg"


OFFSET = (5.0, -3.0, 1.0)
"""From the first vehicle to the second, metres."""


def camera_of(vehicle: str) -> CameraAnnouncement:
    return CameraAnnouncement(
        stamp=0,
        source=f"{vehicle}/eye",
        images=("grey",),
        info=CameraInfo.from_fov(80, 60, 1.5),
        rate=10.0,
        latency=0.0,
        frame_id=f"{vehicle}/eye_optical",
        parent_frame_id="base_link",
        position=(0.0, 0.0, 0.0),
        orientation=(0.5, 0.5, 0.5, 0.5),
    )


def two_flights() -> list[Event]:
    """Return two vehicles with a camera each, and an estimator that follows the second's camera.

    The second vehicle flies as the first does, elsewhere, and hits something.
    """
    events: list[Event] = []
    for event in [announced()[0], *truth(10)]:
        assert isinstance(event, VehicleAnnouncement | Odometry)
        moved = tuple(a + b for a, b in zip(event.position, OFFSET, strict=True))
        events += [event, msgspec.structs.replace(event, source="second", position=moved)]
    events += [camera_of("drone"), camera_of("second"), announced()[1]]
    for stamp in FRAMES:
        pixel = np.array([[20, 30]], np.float32)
        events += [
            TrackedFeatures(
                stamp=stamp,
                source="est",
                frame_id="second/eye_optical",
                points=pixel,
                inliers=np.array([True]),
            ),
            estimate(stamp, error=OFFSET),
            PlannedPose(stamp=stamp, source="p", vehicle="second", position=place(stamp), yaw=0.0),
        ]
    for vehicle, count in (("drone", 2), ("second", 1)):
        events += [
            Collision(
                stamp=k + 1,
                source=vehicle,
                other="wall",
                position=(1.0, 2.0, -1.5),
                normal=(1.0, 0.0, 0.0),
                speed=0.5,
            )
            for k in range(count)
        ]
    return events


@pytest.mark.slow
def test_an_estimate_is_held_against_the_vehicle_that_carries_its_camera(tmp_path: Path) -> None:
    scores = run(tmp_path, two_flights())
    assert max(s.value for s in scores if s.metric == "position_error") < 1e-9
    verdict = json.loads((tmp_path / "evaluation" / "verdict.json").read_text())
    figures = verdict["estimators"]["est"]
    assert figures["vehicle"] == "second"
    assert figures["ate_rmse_m"] < 1e-9
    assert figures["collisions"] == 1
    assert figures["plan_rmse_m"] == pytest.approx(math.sqrt(35.0))  # its own, as far as OFFSET
    names = {path.name for path in (tmp_path / "trajectories").iterdir()}
    assert names == {
        "truth.tum", "truth.second.tum", "plan.second.tum", "est.tum", "collisions.csv"
    }  # fmt: skip
    second = read_tum(tmp_path / "trajectories" / "truth.second.tum")
    np.testing.assert_allclose(second.positions[7], np.add(place(35 * MS), OFFSET), atol=1e-9)
    rows = (tmp_path / "trajectories" / "collisions.csv").read_text().splitlines()
    assert rows[1:] == [
        "1,drone,wall,1.000,2.000,-1.500,0.500",
        "2,drone,wall,1.000,2.000,-1.500,0.500",
        "1,second,wall,1.000,2.000,-1.500,0.500",
    ]


def test_a_hole_of_the_truth_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """And no score is made up in it."""
    known = [e for e in truth(6) if not 2 * SECOND < e.stamp < 4 * SECOND]
    poses = [estimate(stamp * 100 * MS) for stamp in range(60)]
    scores = run(tmp_path, [*announced(), *sorted([*known, *poses], key=lambda e: e.stamp)])
    figures = json.loads((tmp_path / "evaluation" / "verdict.json").read_text())["estimators"][
        "est"
    ]
    assert (figures["estimates"], figures["compared"]) == (60, 41)
    assert figures["ate_rmse_m"] < 1e-9
    assert max(s.value for s in scores if s.metric == "position_error") < 1e-9
    assert "est: not compared, of 60 poses: 19 between true poses more than 0.2 s" in caplog.text


def test_the_file_may_say_which_vehicle_is_meant(tmp_path: Path) -> None:
    figures = judged(tmp_path, two_flights(), vehicle="drone")["estimators"]["est"]
    assert figures["vehicle"] == "drone"
    assert figures["ate_rmse_m"] == pytest.approx(math.sqrt(35.0))
    assert figures["collisions"] == 2


@pytest.mark.slow
def test_settings_of_single_estimators_hold_for_those_only(tmp_path: Path) -> None:
    verdict = judged(
        tmp_path,
        two_flights(),
        vehicle="drone",
        thresholds={"ate_percent": 1e9},
        estimators={"est": {"alignment": "se3", "thresholds": {"ate_max_m": 1e9}}},
    )
    figures = verdict["estimators"]["est"]
    assert figures["alignment"] == "se3"
    assert figures["ate_rmse_m"] == pytest.approx(figures["ate_se3_rmse_m"])
    assert (
        verdict["own_thresholds"]["est"] | {"ate_percent": 1e9, "ate_max_m": 1e9}
        == (verdict["own_thresholds"]["est"])
    )
    assert verdict["thresholds"]["ate_max_m"] is None


@pytest.mark.parametrize(
    ("own", "said"),
    [
        (
            {"est": {"thresholds": {"ate_percentt": 1.0}}},
            r"estimators.est.thresholds: expected the name of a figure .* mean .ate_percent",
        ),
        ({"est": {"thresholds": {"collisions": 1.0}}}, "figure of an estimator, found collisions"),
    ],
)
def test_wrong_settings_of_single_estimators_are_refused(
    tmp_path: Path, own: dict[str, Any], said: str
) -> None:
    with pytest.raises((NodeError, ConfigError), match=said):
        judged(tmp_path, two_flights(), estimators=own)


@pytest.mark.slow
def test_settings_of_an_estimator_that_is_not_there_are_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """At once if all who send poses have announced theirs; else at the end."""
    judged(tmp_path, two_flights(), estimators={"estt": {}})
    assert "estimators.estt: expected poses from it, found none" in caplog.text

    class Slam(Node):
        estimates = Output(PoseEstimate)

        def announce(self) -> Iterable[Announcement]:
            yield EstimatorAnnouncement(stamp=0, source=self.name, method="")

    nodes = spec(Slam, "slam"), spec(Evaluation, "judge", {"estimators": {"slamm": {}}})
    said = r"estimators\.slamm: expected one of those that send poses \(slam\).*mean .slam"
    with pytest.raises(NodeError, match=said):
        execute(Config(run=RunConfig(duration=Duration(0.1)), nodes=nodes))


def test_a_vehicle_that_is_not_there_is_refused() -> None:
    with pytest.raises(NodeError, match=r'announced \(drone\), found "drome".*mean .drone'):
        run_node(Evaluation, inputs=announced(), config={"vehicle": "drome"})


def test_an_unknown_threshold_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"thresholds.*unknown key 'ate'"):
        run_node(Evaluation, config={"thresholds": {"ate": 1}})


class Restarted(Evaluation):
    """Fails once in mid-flight."""

    failed = False

    async def on_startup(self) -> None:
        await super().on_startup()
        self.start(self._fail())

    async def _fail(self) -> None:
        await self.clock.sleep(6.0)
        if not self.restarts:
            raise RuntimeError("fails once")


@pytest.mark.slow
def test_an_evaluation_that_was_restarted_fails_and_what_was_written_stays(tmp_path: Path) -> None:
    from runtime.testing import run_nodes, spec

    estimates: list[Event] = [estimate(s) for s in FRAMES]
    limits = {"ate_rmse_m": 1.0}
    node = spec(Restarted, "evaluation", {"thresholds": limits}, on_error="restart")
    script = sorted([*announced(), *truth(10), *estimates], key=lambda e: e.stamp)
    run_nodes([node], inputs=script, duration=11.0, out=tmp_path)
    verdict = json.loads((tmp_path / "evaluation" / "verdict.json").read_text())
    assert verdict["passed"] is False
    assert "restarted" in "".join(verdict["estimators"]["est"]["failed"])
    stamps = read_tum(tmp_path / "trajectories" / "est.tum").stamps
    assert stamps[0] == 0
    assert len(stamps) >= 90


@pytest.mark.parametrize("told", [True, False])
def test_images_count_at_the_time_of_their_exposure(tmp_path: Path, told: bool) -> None:
    """An estimator follows the camera whose late stamps fit its poses, if the offset is known."""
    eye = msgspec.structs.replace(camera_of("drone"), time_offset=0.03 if told else 0.0)
    stamps = range(0, 10 * SECOND, 100 * MS)
    seen = {"down": range(0, 10 * SECOND, 40 * MS), "eye": [stamp + 30 * MS for stamp in stamps]}
    images: list[Event] = [
        Image(
            stamp=stamp,
            source=f"drone/{name}",
            frame_id=f"drone/{name}_optical",
            encoding="mono8",
            data=np.zeros((60, 80), np.uint8),
        )
        for name, times in seen.items()
        for stamp in times
    ]
    poses: list[Event] = [estimate(stamp) for stamp in stamps]
    verdict = judged(tmp_path, [*announced(), eye], truth(10.0), images, poses)
    figures = verdict["estimators"]["est"]
    assert figures["ate_rmse_m"] < 1e-3
    assert (figures["frame_coverage_percent"] > 95.0) == told
