"""The command ``judge``: the figures of a run and of evo, and none of what nobody knows."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from evo.core import metrics as evo
from evo.core.units import Unit

from events import Event, Image
from nodes.data.export import export_trajectories
from nodes.judging.evaluation import Evaluation
from nodes.judging.evaluation.files import FRAMES
from nodes.judging.report.folder import read_run
from nodes.trajectory import Trajectory
from nodes.trajectory_files import read_tum, write_euroc, write_kitti, write_tum
from runtime.commit import commit
from runtime.run.sources import content_hash
from runtime.testing import run_node
from tests.nodes.judging.evaluation import flights
from tests.nodes.judging.judge import bags
from tests.nodes.trajectory.samples import as_evo, moved, noisy, walk
from tests.runtime.tools.samples_cli import command_here

UNKNOWN = {
    "latency_p50_ms", "latency_p99_ms", "newest_pose_rmse_m", "newest_pose_rot_rmse_deg",
    "newest_pose_age_ms", "restarts", "repeated_stamps", "future_stamps", "collisions",
}  # fmt: skip
MS = 1_000_000


def judge(folder: Path, *words: Any, code: int = 0) -> dict[str, Any]:
    """Run the command; return the figures of each estimate."""
    shutil.rmtree(folder / "judged", ignore_errors=True)
    done = said(folder, *words)
    assert done.returncode == code, done.stderr
    verdict = (folder / "judged" / "trajectories" / "evaluation" / "verdict.json").read_text()
    estimators: dict[str, Any] = json.loads(verdict)["estimators"]
    return estimators


def said(folder: Path, *words: Any) -> subprocess.CompletedProcess[str]:
    """Run the command without drawing."""
    with mock.patch("nodes.judging.judged.write_report", lambda out: out / "report.html"):
        return command_here("judge", *words, folder=folder)


def only(figures: dict[str, Any]) -> dict[str, Any]:
    (one,) = figures.values()
    return dict(one)


@pytest.fixture
def pair(tmp_path: Path) -> tuple[Trajectory, Trajectory]:
    """Write ``truth.tum`` and ``vo.tum``, an estimate at stamps of its own in another frame."""
    truth = walk(400)
    stamps = np.arange(0, int(truth.stamps[-1]), 33_333_333)
    estimate = moved(noisy(truth, metres=0.005).at(stamps))
    write_tum(tmp_path / "truth.tum", truth)
    write_tum(tmp_path / "vo.tum", estimate)
    return truth, estimate


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Return the folder of a short run with two estimators, and what its evaluation found."""
    folder = tmp_path_factory.mktemp("run")
    inputs: list[Event] = [*flights.announced(), *flights.announced(source="odo")[1:]]
    inputs += flights.truth(8)
    for k in range(0, 8000, 50):
        stamp, drift = k * MS, k / 1e5
        pixels = np.zeros((2, 2), np.uint8)
        inputs.append(Image(stamp=stamp, source="cam", frame_id="c", encoding="mono8", data=pixels))
        inputs.append(flights.estimate(stamp, error=(drift, 0.0, 0.01 * (k % 3))))
        if not 3000 < k < 4000:
            inputs.append(
                flights.estimate(stamp, error=(0, drift, 1), frame_id="odom", source="odo")
            )
    inputs.sort(key=lambda event: event.stamp)
    run_node(Evaluation, inputs=inputs, duration=8.0, out=folder)
    estimators = json.loads((folder / "evaluation" / "verdict.json").read_text())["estimators"]
    stamps = "".join(f"{k / 1000}\n" for k in range(0, 8000, 50))
    (folder / "times.txt").write_text(stamps)
    return folder, estimators


@pytest.mark.slow
def test_a_runs_own_trajectories_get_its_figures(
    run: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    folder, expected = run
    estimates = [f"--estimate={folder}/trajectories/{name}.tum" for name in expected]
    judged = judge(
        tmp_path, "--truth", folder, *estimates, "--frames", folder / "times.txt", code=1
    )
    assert list(judged) == ["est", "odo"]
    for name, figures in judged.items():
        assert UNKNOWN.isdisjoint(figures)
        same = figures.keys() - {"method", "failed", "compared", "passed"}
        assert {
            "ate_percent",
            "rpe_1m_trans_percent",
            "lost_seconds",
            "initialization_seconds",
        } <= same
        for key in same:
            assert figures[key] == pytest.approx(expected[name][key], abs=1e-7), (name, key)
        assert [reason for reason in expected[name]["failed"] if "coverage" in reason] == figures[
            "failed"
        ]
    assert [judged[name]["alignment"] for name in judged] == ["none", "origin"]
    assert judged["odo"]["failed"] == ["coverage_percent: expected at least 90, found 87.42"]


@pytest.mark.slow
def test_every_exported_format_gives_the_same_figures(
    run: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    folder, expected = run
    for form in ("tum", "euroc", "kitti"):
        export_trajectories(folder, form, tmp_path / form)
    tum = tmp_path / "tum" / "est.tum"
    seconds = [line.split()[0] for line in tum.read_text().splitlines()]
    (tmp_path / "times").write_text("\n".join(line for line in seconds if line[0] != "#"))
    lab = "ts (ns),tx (m),ty (m),tz (m),qx,qy,qz,qw\n"
    for stamp, (x, y, z), (qw, qx, qy, qz) in read_tum(tum).poses():
        lab += f"{stamp},{x},{y},{z},{qx},{qy},{qz},{qw}\n"
    (tmp_path / "lab.csv").write_text(lab)
    direct = only(
        judge(
            tmp_path, "--truth", folder, "--alignment=se3",
            "--estimate", folder / "trajectories" / "est.tum",
        )
    )  # fmt: skip
    for truth, estimate, more in (
        ("tum/truth.tum", "tum/est.tum", ()),
        ("euroc/truth.csv", "euroc/est.csv", ()),
        ("tum/truth.tum", "lab.csv", ()),
        ("kitti/est.truth.kitti.txt", "kitti/est.kitti.txt", ("--times", "times")),
    ):
        figures = only(judge(tmp_path, "--truth", truth, "--estimate", estimate, *more))
        for key in ("ate_rmse_m", "ate_max_m", "rpe_1m_rot_deg_per_m", "rot_rmse_deg"):
            assert figures[key] == pytest.approx(direct[key], abs=2e-6), (estimate, key)
        assert figures["rpe_1m_trans_percent"] == pytest.approx(
            expected["est"]["rpe_1m_trans_percent"], abs=1e-4 if more == () else 0.5
        )


@pytest.mark.slow
@pytest.mark.parametrize("how", ["se3", "sim3"])
def test_errors_are_evos(how: str, tmp_path: Path) -> None:
    truth = walk(400)
    estimate = moved(noisy(truth, metres=0.005), scale=0.5 if how == "sim3" else 1.0)
    write_tum(tmp_path / "truth.tum", truth)
    write_euroc(tmp_path / "vo.csv", estimate)
    words = ["--scale-free"] if how == "sim3" else []
    figures = only(judge(tmp_path, "--truth", "truth.tum", "--estimate", "vo.csv", *words))
    assert figures["alignment"] == how
    reference, other = as_evo(truth), as_evo(estimate)
    other.align(reference, correct_scale=how == "sim3")
    for relation, key in (
        (evo.PoseRelation.translation_part, "ate_rmse_m"),
        (evo.PoseRelation.rotation_angle_deg, "rot_rmse_deg"),
    ):
        metric = evo.APE(relation)
        metric.process_data((reference, other))
        assert figures[key] == pytest.approx(metric.get_all_statistics()["rmse"], abs=1e-7)
    metric = evo.RPE(evo.PoseRelation.translation_part, 1.0, Unit.meters, 0.1, True, True)
    metric.process_data((reference, other))
    expected = 100 * metric.get_all_statistics()["rmse"]
    assert figures["rpe_1m_trans_percent"] == pytest.approx(expected, abs=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("type_", bags.TYPES)
def test_topics_of_bags_are_read_in_our_frames(type_: str, tmp_path: Path) -> None:
    """In `map` nothing has to be aligned: whatever is wrong with the axes would be an error."""
    truth = walk(200, start=10**18)
    write_tum(tmp_path / "truth.tum", truth, FRAMES.format("map (NED)"))
    bags.bag(tmp_path / "bag", type_, truth)
    truths = ["truth.tum", "bag:/slam/poses"]
    for true in truths:
        figures = judge(tmp_path, "--truth", true, "--estimate", "bag:/slam/poses")["slam/poses"]
        assert figures["alignment"] == "none"
        assert (figures["ate_max_m"], figures["rot_rmse_deg"]) == pytest.approx((0, 0), abs=1e-6)
        assert (figures["restarts"], figures["estimates"]) == (0, 200)


WORDS = "--truth", "truth.tum", "--estimate", "slam=bag:/slam/poses"


def judge_changed(
    folder: Path, truth: Trajectory, change: Callable[[int, Any], Any]
) -> dict[str, Any]:
    """Judge a topic whose messages have been changed, and which fails."""
    write_tum(folder / "truth.tum", truth, FRAMES.format("map (NED)"))
    bags.bag(folder / "bag", bags.POSE, truth, frame_id="odom", change=change)
    return only(judge(folder, *WORDS, code=1))


@pytest.mark.parametrize(("changes_at", "left_out"), [(20, 20), (150, 50)])
def test_of_a_topics_frames_the_one_with_most_poses_is_judged(
    tmp_path: Path, changes_at: int, left_out: int
) -> None:
    def change(number: int, message: Any) -> Any:
        message.header.frame_id = "odom" if number <= changes_at else "odom_1"
        message.pose.position.x += 50.0 if number <= changes_at else 0.0  # no frame fits the other
        return message

    figures = judge_changed(tmp_path, walk(200, start=10**18), change)
    assert (figures["restarts"], figures["estimates"]) == (1, 200 - left_out)
    assert figures["ate_rmse_m"] == pytest.approx(0.0, abs=1e-6)
    assert f"left out: {left_out} poses in another frame" in said(tmp_path, *WORDS).stderr


def test_restarts_and_repeated_stamps_of_a_topic_are_counted_and_fail(tmp_path: Path) -> None:
    def change(number: int, message: Any) -> Any:
        message.header.frame_id = "odom" if number < 190 else "odom_1"
        if number == 20:
            message.header.stamp = bags.header(int(truth.stamps[18]), "").stamp
        return message

    truth = walk(200, start=10**18)
    figures = judge_changed(tmp_path, truth, change)
    assert (figures["restarts"], figures["repeated_stamps"], figures["estimates"]) == (1, 1, 188)
    assert [text.partition(":")[0] for text in figures["failed"]] == ["restarts", "repeated_stamps"]
    done = said(tmp_path, "--truth", "bag:/slam/poses", "--estimate", "truth.tum")
    assert "expected a truth in one frame, found that it changes (1 times)" in done.stderr


def camera_poses(truth: Trajectory) -> tuple[np.ndarray, Trajectory]:
    mounted = np.array([[0.0, 0, 1, 0.1], [1, 0, 0, -0.2], [0, 1, 0, 0.3], [0, 0, 0, 1]])
    return mounted, Trajectory.from_matrices(truth.stamps, truth.matrices() @ mounted)


MOUNTED = "0.1 -0.2 0.3 0.5 0.5 0.5 0.5"


@pytest.mark.slow
def test_a_cameras_poses_are_judged_as_the_bodys(tmp_path: Path) -> None:
    """By numbers, by a file, by the name of an announced camera; of a file and of a bag."""
    truth = walk(300)
    _, seen = camera_poses(truth)
    (tmp_path / "run" / "trajectories").mkdir(parents=True)
    write_tum(tmp_path / "run" / "trajectories" / "truth.tum", truth)
    camera = {
        "type": "CameraAnnouncement", "source": "drone/front", "parent_frame_id": "base_link",
        "position": [0.1, -0.2, 0.3], "orientation": [0.5, 0.5, 0.5, 0.5],
    }  # fmt: skip
    (tmp_path / "run" / "summary.json").write_text(json.dumps({"announcements": [camera]}))
    (tmp_path / "mounting.tum").write_text(f"0 {MOUNTED}\n")
    write_tum(tmp_path / "vo.tum", moved(seen))
    bags.bag(tmp_path / "bag", bags.POSE, seen, child="cam_optical")
    bags.bag(tmp_path / "optical", bags.ODOMETRY, seen, child="cam_optical")
    words = ["--truth", "run", "--estimate", "vo.tum", "--alignment", "se3"]
    plain = only(judge(tmp_path, *words, code=1))
    assert plain["rot_rmse_deg"] > 100.0
    assert plain["failed"][0].startswith("rot_rmse_deg: expected at most 15, found 1")
    for given in (MOUNTED, "mounting.tum", "drone/front"):
        figures = only(judge(tmp_path, *words, "--body-from-camera", given))
        assert (figures["ate_max_m"], figures["rot_rmse_deg"]) == pytest.approx((0, 0), abs=1e-6)
    for name in ("bag", "optical"):
        words = ["--truth", "run", "--estimate", f"{name}:/slam/poses"]
        figures = only(judge(tmp_path, *words, "--body-from-camera", MOUNTED))
        assert figures["alignment"] == "none"
        assert (figures["ate_max_m"], figures["rot_rmse_deg"]) == pytest.approx((0, 0), abs=1e-6)


@pytest.mark.parametrize("axes", ["nwu", "enu", "optical"])
def test_axes_are_turned_into_ours(axes: str, tmp_path: Path) -> None:
    truth = walk(200)
    write_tum(tmp_path / "truth.tum", truth)
    optical = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    turns = {
        "nwu": (bags.FLIP, np.eye(4)),
        "enu": (bags.ENU, bags.FLIP),
        "optical": (optical.T, optical),
    }
    world, body = turns[axes]
    poses = Trajectory.from_matrices(truth.stamps, world @ truth.matrices() @ body)
    write_tum(tmp_path / "vo.tum", poses)
    words = ["--truth", "truth.tum", "--estimate", "vo.tum", "--alignment", "none", "--axes", axes]
    figures = only(judge(tmp_path, *words, "--truth-axes", "ned"))
    assert (figures["ate_max_m"], figures["rot_rmse_deg"]) == pytest.approx((0, 0), abs=1e-6)


def test_a_part_of_the_flight_fails_however_good_it_is(tmp_path: Path) -> None:
    truth = walk(400)
    write_tum(tmp_path / "truth.tum", truth)
    write_tum(tmp_path / "part.tum", truth.take(slice(0, 300)))
    figures = judge(tmp_path, "--truth", "truth.tum", "--estimate", "part.tum", code=1)["part"]
    assert figures["ate_rmse_m"] == pytest.approx(0, abs=1e-9)
    assert (figures["passed"], figures["coverage_percent"]) == (False, pytest.approx(74.9, abs=0.1))
    words = ["--threshold", "coverage_percent=70", "--threshold", "ate_percent=1"]
    figures = judge(tmp_path, "--truth", "truth.tum", "--estimate", "part.tum", *words)["part"]
    assert figures["passed"] is True


def test_a_threshold_of_what_nobody_knows_is_missed(
    pair: tuple[Trajectory, Trajectory], tmp_path: Path
) -> None:
    words = ["--truth", "truth.tum", "--estimate", "vo.tum", "--threshold", "latency_p99_ms=50"]
    figures = only(judge(tmp_path, *words, code=1))
    assert figures["failed"] == ["latency_p99_ms: expected at most 50, found none"]
    assert figures["frame_coverage_percent"] is None


def test_what_is_not_compared_is_said(tmp_path: Path) -> None:
    truth = walk(400)
    gap = (truth.stamps < 5_000 * MS) | (truth.stamps > 6_000 * MS)
    write_tum(tmp_path / "truth.tum", truth.take(gap).take(slice(10, None)))
    write_tum(tmp_path / "vo.tum", truth)
    done = said(tmp_path, "--truth", "truth.tum", "--estimate", "vo.tum")
    note = (
        "vo: not compared, of 400 poses: 10 outside the truth's time, 21 between true poses more "
        "than 0.2 s apart (as max_difference says; the longest hole is 1.1 s)"
    )
    assert note in done.stderr
    (shown,) = read_run(tmp_path / "judged" / "trajectories").missing
    assert shown.startswith(note)


@pytest.mark.slow
def test_the_page_has_all_estimates_and_does_not_pretend_to_be_of_a_run(
    pair: tuple[Trajectory, Trajectory], tmp_path: Path
) -> None:
    _, estimate = pair
    write_kitti(tmp_path / "poses.txt", estimate)
    (tmp_path / "times").write_text("".join(f"{s / 1e9:.9f}\n" for s in estimate.stamps))
    words = ["--truth", "truth.tum", "--estimate", "vo.tum", "--estimate", "orb=poses.txt"]
    words += ["--times", "times", "--body-from-camera", "0 0 0 0 0 0 1"]
    done = command_here("judge", *words, "--out", "here", folder=tmp_path)
    assert "here: open report.html" in done.stdout
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "here" / "report.html").read_text()
    for text in ("Trajectories from files, judged without a run", "poses.txt; laid on the truth"):
        assert text in page
    for text in ("latency", "digest", "config.toml", "dropped", "control tick", "No summary"):
        assert text not in page, text
    again = said(tmp_path, *words, "--out", "here")  # the earlier one is kept
    assert again.returncode == 0
    (earlier,) = tmp_path.glob("here.2*")
    assert (earlier / "report.html").is_file()


def test_a_runs_folder_is_not_written_over(
    pair: tuple[Trajectory, Trajectory], tmp_path: Path
) -> None:
    (tmp_path / "tour").mkdir()
    (tmp_path / "tour" / "config.toml").touch()
    (tmp_path / "tour" / ".visnav-run").touch()
    words = ["--truth", "truth.tum", "--estimate", "vo.tum", "--out", "tour"]
    done = said(tmp_path, *words)
    assert done.returncode == 2
    assert done.stderr == "error: tour: expected no run's folder: name another with --out\n"


def test_a_final_trajectory_stands_beside_its_estimate(
    pair: tuple[Trajectory, Trajectory], tmp_path: Path
) -> None:
    truth, _ = pair
    write_tum(tmp_path / "closed.tum", truth)
    words = ("--truth", "truth.tum", "--estimate", "vo.tum")
    figures = only(judge(tmp_path, *words, "--final", "vo=closed.tum"))
    assert figures["ate_rmse_m"] > 1e-3
    assert figures["final_ate_rmse_m"] < 1e-6
    done = said(tmp_path, *words, "--final", "closed.tum")
    assert done.returncode == 2
    assert "expected the name of an estimate (vo), found closed" in done.stderr


def test_the_summary_says_what_was_judged_and_by_which_version(
    pair: tuple[Trajectory, Trajectory], tmp_path: Path
) -> None:
    said(tmp_path, "--truth", "truth.tum", "--estimate", "vo=vo.tum")
    summary = json.loads((tmp_path / "judged" / "trajectories" / "summary.json").read_text())
    assert summary["environment"]["commit"] == commit()
    assert summary["judged"] == {"truth": "truth.tum", "vo": "vo.tum"}
    hashes = {name: content_hash(tmp_path / file) for name, file in summary["judged"].items()}
    assert summary["judged_hashes"] == hashes
