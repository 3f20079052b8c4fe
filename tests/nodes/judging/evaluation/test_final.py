"""The trajectory after loop closures: judged beside what was said, and not fooled by it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from events import Event, LidarScan, PoseEstimate, TrajectoryEstimate
from nodes.judging.evaluation import Evaluation
from nodes.judging.evaluation.alignment import AlignmentMethod
from nodes.judging.evaluation.judging import Judgement, errors_at_ticks, judge
from nodes.judging.evaluation.record import EstimatorRecord
from nodes.judging.report.folder import read_run
from nodes.trajectory import Trajectory
from runtime.testing import run_nodes, spec
from tests.nodes.judging.evaluation.flights import MS, SECOND, announced, estimate, truth
from tests.nodes.trajectory.samples import moved, noisy, walk

TRUTH = walk(600)


def final(
    poses: Trajectory | None, frame_id: str = "map", stamp: int = 10 * SECOND
) -> TrajectoryEstimate:
    return TrajectoryEstimate(
        stamp=stamp,
        source="est",
        frame_id=frame_id,
        stamps=np.empty(0, np.int64) if poses is None else poses.stamps.copy(),
        positions=np.empty((0, 3)) if poses is None else poses.positions.copy(),
        orientations=np.empty((0, 4)) if poses is None else poses.orientations.copy(),
    )


def judged(
    *finals: TrajectoryEstimate, said: Trajectory | None = None, scale_free: bool = False
) -> Judgement:
    """Judge an estimator that said what is given, or else drifted, and then sent finals."""
    record = EstimatorRecord(scale_free)
    drift = np.arange(len(TRUTH))[:, None] * [0.0, 0.001, 0.0]
    poses = said or Trajectory(TRUTH.stamps, TRUTH.positions + drift, TRUTH.orientations)
    record.longest = EstimatorRecord.of(poses, "map").longest
    for trajectory in finals:
        record.add_final(trajectory)
    return judge(record, TRUTH, cameras={"c": TRUTH.stamps})


def test_both_stand_side_by_side() -> None:
    figures = judged(final(noisy(TRUTH, metres=0.001))).figures
    assert figures["ate_rmse_m"] > 0.3
    assert figures["final_ate_rmse_m"] < 0.02
    assert figures["final_ate_percent"] == pytest.approx(
        100 * figures["final_ate_rmse_m"] / TRUTH.length()
    )
    assert figures["final_flight_ate_rmse_m"] == pytest.approx(figures["final_ate_rmse_m"])
    assert figures["final_poses"] == 600


def test_a_wrong_loop_closure_makes_the_final_one_worse() -> None:
    bent = TRUTH.positions + np.linspace(0.0, 1.0, len(TRUTH))[:, None] ** 2 * [0.0, 5.0, 0.0]
    figures = judged(final(Trajectory(TRUTH.stamps, bent, TRUTH.orientations))).figures
    assert figures["final_ate_percent"] > 4 * figures["ate_percent"]


def test_who_sends_none_or_an_empty_one_has_no_such_figures() -> None:
    for finals in ((), (final(None),)):
        judgement = judged(*finals)
        assert judgement.final is None
        assert not [name for name in judgement.figures if name.startswith("final")]


def test_the_last_one_counts() -> None:
    bad = final(Trajectory(TRUTH.stamps, TRUTH.positions + 3.0, TRUTH.orientations))
    assert judged(bad, final(TRUTH)).figures["final_ate_rmse_m"] < 1e-9
    assert judged(final(TRUTH), bad).figures["final_ate_rmse_m"] == pytest.approx(3 * 3**0.5)


def test_key_frames_alone_are_judged_at_their_stamps_and_over_the_whole_flight() -> None:
    figures = judged(final(TRUTH.take(slice(None, None, 20)))).figures
    assert figures["final_poses"] == 30
    assert figures["final_ate_rmse_m"] < 1e-9
    assert 0.0 < figures["final_flight_ate_rmse_m"] < 0.3  # it cuts the corners between them


@pytest.mark.parametrize("part", [slice(None, 200), slice(400, None), slice(250, 350)])
def test_a_part_of_the_flight_never_looks_good(part: slice) -> None:
    figures = judged(final(TRUTH.take(part))).figures
    assert figures["final_ate_rmse_m"] < 1e-9
    assert figures["final_flight_ate_percent"] > 20.0


def test_two_poses_at_both_ends_do_not_hide_what_is_between() -> None:
    figures = judged(final(TRUTH.take(np.array([0, len(TRUTH) - 1])))).figures
    assert figures["final_ate_rmse_m"] < 1e-9
    assert figures["final_flight_ate_rmse_m"] > 0.5


@pytest.mark.parametrize(
    ("count", "alignment", "scale_free", "least"),
    [(1, "origin", False, 2), (2, "se3", False, 3), (2, "sim3", True, 3)],
)
def test_fewer_poses_than_an_alignment_needs_have_no_error_of_zero(
    count: int, alignment: AlignmentMethod, scale_free: bool, least: int
) -> None:
    record = EstimatorRecord(scale_free)
    for poses, judged_ in ((count, False), (least, True)):
        record.add_final(final(TRUTH.take(slice(None, 100 * poses, 100)), "odom"))
        figures = judge(record, TRUTH, alignment=alignment).figures
        assert ("final_ate_rmse_m" in figures) == judged_
        if not judged_:
            expected = f"expected at least {least} poses to align by {alignment}, found {count}"
            assert figures["why_not_final"] == expected


def test_another_frame_is_aligned_by_its_own_first_pose() -> None:
    elsewhere = moved(TRUTH)
    assert judged(final(elsewhere, "odom")).figures["final_ate_rmse_m"] < 1e-6
    assert judged(final(elsewhere, "map")).figures["final_ate_rmse_m"] > 1.0
    scaled = moved(TRUTH, scale=0.2)
    said = judged(final(scaled, "odom"), said=scaled, scale_free=True).figures
    assert said["final_ate_rmse_m"] < 1e-6


def test_stamps_of_another_clock_are_a_reason_and_the_said_poses_are_judged() -> None:
    late = Trajectory(TRUTH.stamps + 10**18, TRUTH.positions, TRUTH.orientations)
    judgement = judged(final(late))
    assert "Unix time" in judgement.figures["why_not_final"]
    assert judgement.figures["ate_rmse_m"] > 0.3
    assert "final_ate_rmse_m" not in judgement.figures
    assert "why" not in judgement.figures


def test_a_final_trajectory_without_a_single_pose_said_is_judged_alone() -> None:
    record = EstimatorRecord()
    record.add_final(final(TRUTH))
    figures = judge(record, TRUTH).figures
    assert figures["final_ate_rmse_m"] < 1e-9
    assert figures["flight_ate_percent"] > 50.0
    assert figures.get("ate_rmse_m") is None


def flown(out: Path, *more: Event, reads: tuple[str, ...] = ()) -> dict[str, Any]:
    """Run the node on a flight of 10 s with 10 poses a second."""
    out.mkdir(exist_ok=True)
    vehicle, estimator = announced()
    estimator = msgspec.structs.replace(estimator, reads=reads)
    poses = [estimate(k * 100 * MS) for k in range(100)]
    script = sorted([*truth(10), *poses, *more], key=lambda e: e.stamp)
    node = spec(Evaluation, "evaluation", {})
    run_nodes([node], inputs=[vehicle, estimator, *script], duration=11.0, out=out)
    verdict = json.loads((out / "evaluation" / "verdict.json").read_text())
    figures: dict[str, Any] = verdict["estimators"]["est"]
    return figures


@pytest.mark.slow
def test_the_node_judges_it_and_leaves_it_for_the_report(tmp_path: Path) -> None:
    said = [estimate(k * 100 * MS, error=(0.0, 0.0, 0.5)) for k in range(100)]
    poses = Trajectory(
        np.array([e.stamp for e in said]),
        np.array([e.position for e in said]),
        np.array([e.orientation for e in said]),
    )
    figures = flown(tmp_path, final(poses))
    assert figures["ate_rmse_m"] < 1e-9
    assert figures["final_ate_rmse_m"] == pytest.approx(0.5)
    (read,) = read_run(tmp_path).estimators
    assert read.name == "est"
    assert read.final is not None
    np.testing.assert_allclose(read.final.positions, poses.positions, atol=1e-8)


@pytest.mark.parametrize(("scale", "scale_free"), [(1.0, False), (0.2, True)])
def test_a_final_trajectory_of_another_clock_is_told(scale: float, scale_free: bool) -> None:
    late = moved(TRUTH, scale=scale)
    late = Trajectory(late.stamps + 100 * MS, late.positions, late.orientations)
    note = judged(final(late, "odom"), scale_free=scale_free).note
    assert "after loop closures: with -0.1000 s added to its stamps it would fit far" in note


def test_of_an_estimate_of_another_clock_and_unit_the_offset_is_told() -> None:
    scaled = moved(TRUTH, scale=0.2)
    late = Trajectory(scaled.stamps + 10**12, scaled.positions, scaled.orientations)
    why = judge(EstimatorRecord.of(late), TRUTH).figures["why"]
    assert why.endswith("; with -1000.0000 s added to its stamps it would fit")
    backwards = Trajectory(late.stamps, late.positions[::-1].copy(), late.orientations)
    stands = Trajectory(late.stamps, np.ones((len(late), 3)), late.orientations)
    for other in (backwards, stands):
        assert "would fit" not in judge(EstimatorRecord.of(other), TRUTH).figures["why"]


def test_of_a_short_flight_each_tick_is_kept_and_what_is_too_short_is_told() -> None:
    short = walk(11)
    record = EstimatorRecord()
    for stamp, position, orientation in short.poses():
        pose: dict[str, Any] = {"position": (*position,), "orientation": (*orientation,)}
        record.add(PoseEstimate(stamp=stamp, source="est", frame_id="map", **pose), stamp)
    judgement = judge(record, short, rate=100.0)
    assert judgement.tick_errors is not None
    assert len(judgement.tick_errors.stamps) == 1 + round(100 * short.seconds)
    assert judgement.figures["why"].startswith("relative error: expected poses 1 m apart")
    assert judgement.figures["ate_percent"] == 0.0


def scans(period: int) -> list[Event]:
    empty = np.empty(0, np.float32)
    return [
        LidarScan(
            stamp=stamp, source="drone/lidar", frame_id="lidar",
            points=np.empty((0, 3), np.float32), intensities=empty, times=empty,
            rings=np.empty(0, np.uint16),
        )
        for stamp in range(0, 10 * SECOND, period)
    ]  # fmt: skip


def test_who_reads_a_lidar_answers_scans(tmp_path: Path) -> None:
    """Its poses fit the scans; of those that come twice as often, half have none."""
    from tests.nodes.judging.evaluation.test_zoo import images

    both = flown(tmp_path / "a", *images(), *scans(100 * MS), reads=("lidar",))
    assert both["frame_coverage_percent"] == 100.0
    quick = flown(tmp_path / "b", *images(), *scans(50 * MS), reads=("lidar", "imu"))
    assert quick["frame_coverage_percent"] == pytest.approx(50.0, abs=1.0)
    camera = flown(tmp_path / "c", *images(), *scans(100 * MS), reads=("grey",))
    assert camera["frame_coverage_percent"] < 50.0


def test_a_pose_is_the_newest_from_the_tick_of_its_arrival_on() -> None:
    stamps = np.arange(3) * SECOND
    there = Trajectory(stamps, np.eye(3), np.eye(4)[[0, 0, 0]])
    rows, _ = errors_at_ticks(there, there.take(slice(2)), stamps[:2], 1.0, SECOND)
    assert rows is not None
    assert rows.stamps.tolist() == stamps.tolist()
    assert rows.since.tolist() == [0, SECOND, SECOND]
    assert errors_at_ticks(there, there, stamps + 10 * SECOND, 1.0, SECOND) == (None, {})


def test_of_many_ticks_the_figures_are_those_of_all_and_a_few_rows_are_kept() -> None:
    """A pose that is never replaced, of a body that moves along x at 1 m/s for 800 s."""
    ends = np.array([0, 800 * SECOND])
    there = Trajectory(ends, np.array([[0.0, 0, 0], [800.0, 0, 0]]), np.eye(4)[[0, 0]])
    rows, figures = errors_at_ticks(there, there.take(slice(1)), np.array([0]), 400.0, 801 * SECOND)
    assert rows is not None
    assert len(rows.stamps) == 80_001  # every fourth
    assert figures["newest_pose_rmse_m"] == pytest.approx(800 / np.sqrt(3), rel=1e-4)
    assert figures["newest_pose_age_ms"] == pytest.approx(400e3, rel=1e-6)
