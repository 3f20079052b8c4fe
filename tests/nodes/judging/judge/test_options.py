"""Options of the command and arguments of `visnav.judge`; what is said where one may be meant."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import visnav
from nodes.judging.commands import judge as command
from nodes.judging.judgement import JudgeConfig, judge_all, offset_of
from nodes.judging.readers import Source
from nodes.trajectory import Trajectory
from nodes.trajectory_files import write_kitti, write_tum
from runtime.errors import ConfigError
from tests.nodes.judging.judge.test_judge import said
from tests.nodes.trajectory.samples import moved, walk

SECOND = 10**9
START = 1_700_000_000 * SECOND


def source(poses: Trajectory, name: str = "vo") -> Source:
    return Source(name=name, file=f"{name}.tum", poses=poses)


def at(poses: Trajectory, stamps: Any) -> Trajectory:
    return Trajectory(np.asarray(stamps, np.int64), poses.positions, poses.orientations)


def judged(
    truth: Trajectory, estimate: Trajectory, frames: Any = None, **config: Any
) -> tuple[dict[str, Any], list[str]]:
    """Return the figures, and notes."""
    given = JudgeConfig(**config)
    _, _, verdict, notes = judge_all(source(truth), [source(estimate)], frames, given)
    return verdict.estimators["vo"], notes


def test_the_command_and_python_take_the_same() -> None:
    ours = {*inspect.signature(visnav.judge).parameters}
    theirs = {*inspect.signature(command).parameters}
    renamed = {"estimate": "estimates", "threshold": "thresholds"}
    printed = {"latex", "markdown", "csv", "figure"}
    own = {renamed.get(name, name) for name in theirs} - ours
    assert own == {"name", "junit", "json"} | printed
    assert ours - {renamed.get(name, name) for name in theirs} == set()


@pytest.mark.parametrize(
    ("given", "offset"),
    [(0, 0), (0.3, 3 * 10**8), (-18, -18 * SECOND), ("30ms", 30_000_000), ("-30 ms", -30_000_000),
     ("+1.5", 15 * 10**8), ("-2e-3", -2_000_000)],
)  # fmt: skip
def test_an_offset_is_seconds_or_a_text(given: float | str, offset: int) -> None:
    assert offset_of(given) == offset


def test_an_offset_is_added_to_the_estimates_stamps() -> None:
    truth = walk(200)
    late = at(truth, truth.stamps + 300_000_000)
    assert judged(truth, late)[0]["ate_rmse_m"] > 0.05
    figures, _ = judged(truth, late, time_offset="-300ms")
    assert figures["ate_rmse_m"] == pytest.approx(0, abs=1e-9)
    assert figures["coverage_percent"] == 100.0


@pytest.mark.parametrize("given", ["soon", "1 fortnight", float("nan")])
def test_an_offset_that_is_none_is_refused(given: Any) -> None:
    with pytest.raises(ValueError, match="time_offset: "):
        JudgeConfig(time_offset=given)


@pytest.mark.parametrize("first", [40, "2s", "1999 ms"])
def test_the_beginning_alone_is_aligned(first: int | str) -> None:
    """An estimate that goes wrong after two seconds is right until then."""
    truth = walk(200)
    positions = moved(truth).positions.copy()
    positions[40:] += np.linspace(0.0, 3.0, 160)[:, None]
    wrong = Trajectory(truth.stamps, positions, moved(truth).orientations)
    whole, _ = judged(truth, wrong)
    begun, _ = judged(truth, wrong, align_first=first)
    assert begun["ate_max_m"] == pytest.approx(3.0 * np.sqrt(3.0), abs=1e-6)
    assert whole["ate_max_m"] < 4.0


@pytest.mark.parametrize("words", [["--align-first", "40"], ["--align-first", "2s"]])
def test_the_command_takes_a_beginning(words: list[str], tmp_path: Path) -> None:
    write_tum(tmp_path / "t.tum", walk(200))
    done = said(tmp_path, "--truth", "t.tum", "--estimate", "t.tum", *words)
    assert done.returncode == 0, done.stderr
    for wrong in ("0", "-3", "soon"):
        done = said(tmp_path, "--truth", "t.tum", "--estimate", "t.tum", "--align-first", wrong)
        assert done.returncode == 2
        assert "align_first: expected" in done.stderr


def test_heading_and_position_are_aligned_alone() -> None:
    """A tilt stays an error, a turn about the vertical axis is none."""
    truth = walk(200)
    for axis, expected in (((0, 0, 1), 0.0), ((1, 0, 0), 10.0)):
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_rotvec(np.radians(10.0) * np.array(axis)).as_matrix()
        turned = Trajectory.from_matrices(truth.stamps, turn @ truth.matrices())
        figures, _ = judged(truth, turned, alignment="posyaw")
        assert figures["rot_rmse_deg"] == pytest.approx(expected, abs=1.5)


def test_a_turned_body_and_a_late_clock_name_their_options() -> None:
    truth = walk(400)
    camera = truth.matrices() @ np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    _, notes = judged(truth, Trajectory.from_matrices(truth.stamps, camera))
    assert any("by --axes and --truth-axes, or say where" in note for note in notes)
    _, notes = judged(truth, at(truth, truth.stamps + 300_000_000))
    assert any(note.endswith("shift it by --time-offset") for note in notes)
    assert judged(truth, truth)[1] == []


FRAMES = np.arange(0, 400) * 50_000_000 + START


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        (FRAMES / 1e9, r"frames: expected stamps in whole nanoseconds, .* found float64"),
        (FRAMES[::-1], r"frames: row 1: expected a stamp above \d+ ns, found"),
        (np.repeat(FRAMES, 2), r"frames: row 1: expected a stamp above \d+ ns, found"),
        (np.arange(20) + START // SECOND, r"frames: expected nanoseconds, found stamps of another"),
        (
            FRAMES // 1000,
            r"frames: expected nanoseconds, found stamps of another unit, 50000 apart",
        ),
        (FRAMES - 10**13, r"frames: expected images within the truth's time"),
        (
            FRAMES[None],
            r"frames: expected stamps in whole nanoseconds, shape \(n,\), found int64 of",
        ),
        (FRAMES[:0], r"frames: expected stamps in whole nanoseconds, shape \(n,\)"),
    ],
)
def test_stamps_of_images_are_checked_as_files_are(frames: Any, message: str) -> None:
    truth = walk(400, start=START)
    with pytest.raises(ValueError, match=message):
        visnav.judge(truth, truth, frames=frames)


def test_poses_for_few_of_the_images_fail() -> None:
    """Every ninth image: never silent for half a second, so that all the time is covered."""
    truth = walk(400, start=START)
    few = truth.take(slice(0, None, 9))
    figures, _ = judged(truth, few, FRAMES)
    assert figures["coverage_percent"] == 100.0
    assert figures["passed"] is False
    (failed,) = figures["failed"]
    assert failed.startswith("frame_coverage_percent: expected at least 30, found 11.25 (of key f")
    assert judged(truth, few, FRAMES, gap=2.0)[0]["passed"] is None  # key frames
    half = truth.take(slice(0, None, 2))
    assert judged(truth, half, FRAMES)[0]["passed"] is None
    limits = JudgeConfig().thresholds
    asked = type(limits)(frame_coverage_percent=10.0)
    assert judged(truth, few, FRAMES, thresholds=asked)[0]["passed"] is True


def test_coverage_that_is_missed_names_the_images() -> None:
    """As of TUM's sets, whose truth is longer than the images."""
    truth = walk(400, start=START)
    part = truth.take(slice(20, 370))
    (failed,) = judged(truth, part)[0]["failed"]
    assert failed.startswith("coverage_percent: expected at least 90, found 87.")
    assert "name their stamps with --frames" in failed
    assert judged(truth, part, truth.stamps[20:370])[0]["failed"] == []


def test_a_truth_as_sparse_as_the_estimate_names_the_option() -> None:
    """A sparse truth of a dense estimate is compared at its own stamps."""
    truth = walk(400, start=START)
    late = at(truth, truth.stamps + 310_000_000)
    sparse = truth.take(slice(0, None, 20))
    with pytest.raises(
        ValueError, match=r"1 s apart \(median\).*; --max-difference 0.6s lets them"
    ):
        judged(sparse, late.take(slice(0, 380, 20)))
    figures, _ = judged(sparse, late.take(slice(0, 380, 20)), max_difference=0.6)
    assert figures["compared"] == 19
    assert judged(sparse, truth)[0]["compared"] == 20


CLOCK = walk(50).stamps + SECOND  # of a run, from its beginning
UNIX = CLOCK + START


@pytest.mark.parametrize(
    ("truth", "estimate", "why"),
    [
        (UNIX, CLOCK, "one is Unix time, the other counts from a beginning"),
        (CLOCK, CLOCK * 10**3, "are the stamps of the estimate in milliseconds, and read as sec"),
        (CLOCK, CLOCK * 10**6, "are the stamps of the estimate in microseconds, and read as sec"),
        (CLOCK * 10**6, CLOCK, "are the stamps of the truth in microseconds, and read as seconds?"),
        (
            UNIX,
            UNIX + 10**13,
            "found 1700010001.000 to 1700010003.450 s; with -10000.0000 s added to its st",
        ),
        (UNIX, [0], "expected stamps, found that all are zero: the sender sets none"),
    ],
)
def test_no_time_in_common_says_what_differs(truth: Any, estimate: Any, why: str) -> None:
    poses = walk(50)
    figures, _ = judged(at(poses, truth), at(poses.take(slice(len(estimate))), estimate))
    assert why in figures["why"]
    assert why in figures["failed"][0]


def test_everything_the_command_has_is_had_in_python(tmp_path: Path) -> None:
    truth = walk(201, start=START)
    mounted = np.array([[0.0, 0, 1, 0.1], [1, 0, 0, -0.2], [0, 1, 0, 0.3], [0, 0, 0, 1]])
    camera = Trajectory.from_matrices(truth.stamps, moved(truth).matrices() @ mounted)
    write_kitti(tmp_path / "k.txt", camera)
    (tmp_path / "times").write_text("".join(f"{s / 1e9:.9f}\n" for s in truth.stamps))
    write_tum(tmp_path / "truth.tum", truth.take(slice(0, None, 4)))
    given: dict[str, Any] = {
        "times": tmp_path / "times",
        "time_offset": "0ms",
        "max_difference": "300ms",
        "gap": "1s",
        "thresholds": {"ate_percent": 1},
        "final": tmp_path / "k.txt",
    }
    for mounting in (mounted, "0.1 -0.2 0.3 0.5 0.5 0.5 0.5"):
        run = visnav.judge(
            tmp_path / "truth.tum", tmp_path / "k.txt", body_from_camera=mounting, **given
        )
        figures = run.figures["k"]
        assert figures["rot_rmse_deg"] < 5.0  # between true poses 0.2 s apart
        assert figures["final_ate_rmse_m"] == pytest.approx(figures["ate_rmse_m"])
        assert figures["passed"] is True
    with pytest.raises(
        ValueError, match=r"body_from_camera: expected a transform of shape \(4, 4\)"
    ):
        visnav.judge(truth, truth, body_from_camera=2 * np.eye(4))
    with pytest.raises(ValueError, match="expected the name of an estimate"):
        visnav.judge(truth, {"a": truth, "b": truth}, final=truth)
    with pytest.raises(ConfigError, match=r"judge\.axes"):
        visnav.judge(truth, truth, axes="flu")
    with pytest.raises(ValueError, match=r"expected stamps in seconds, as TUM's, found 1\.7e"):
        visnav.judge(np.c_[truth.stamps, np.zeros((201, 6)), np.ones(201)], truth)


def test_rows_in_memory_are_read_as_a_file_of_them() -> None:
    """Bad ones are left out and counted; without a quaternion they are positions only."""
    truth = walk(100)
    seconds = truth.stamps[:, None] / 1e9
    rows = np.hstack([seconds, truth.positions, truth.orientations[:, [1, 2, 3, 0]]])
    rows[7, 2], rows[9, 0], rows[20, 0] = np.nan, np.nan, rows[19, 0]
    with pytest.warns(UserWarning, match="left out: 2 poses with NaN, 1 repeated stamp"):
        figures = visnav.judge(truth, rows).figures["estimate"]
    assert figures["estimates"] == 97
    assert figures["repeated_stamps"] == 1
    assert figures["ate_rmse_m"] == pytest.approx(0, abs=1e-9)
    rows[30, 7] = 3.0
    with pytest.raises(ValueError, match="estimate: row 30: expected a quaternion of length 1"):
        visnav.judge(truth, rows)
    with pytest.warns(UserWarning, match="estimate: it has no orientations"):
        figures = visnav.judge(truth, rows[40:, :4]).figures["estimate"]
    assert figures["ate_rmse_m"] == pytest.approx(0, abs=1e-9)


def test_a_run_with_one_estimator_is_an_estimate(tmp_path: Path) -> None:
    folder = tmp_path / "run" / "trajectories"
    folder.mkdir(parents=True)
    truth = walk(100)
    write_tum(folder / "truth.tum", truth)
    write_tum(folder / "vo.tum", moved(truth), "base_link (FRD) in odom, as it was sent")
    (tmp_path / "run" / "summary.json").write_text("{}")
    run = visnav.judge(tmp_path / "run", tmp_path / "run")
    assert run.figures["vo"]["alignment"] == "origin"
    assert run.figures["vo"]["ate_rmse_m"] == pytest.approx(0, abs=1e-8)
    write_tum(folder / "orb.tum", truth)
    with pytest.raises(
        ValueError, match=r"expected one estimate, found orb\.tum, vo\.tum: name its"
    ):
        visnav.judge(tmp_path / "run", tmp_path / "run")


def test_axes_that_change_nothing_are_said() -> None:
    truth = walk(50)
    with pytest.warns(
        UserWarning, match=r"truth: declares no axes, so .* \(--axes enu\) are taken"
    ):
        visnav.judge(truth, truth, axes="enu")
    with pytest.warns(UserWarning, match=r"estimate: declares no axes, so .*--truth-axes\s?ned"):
        visnav.judge(truth, truth, truth_axes="ned")
    visnav.judge(truth, truth, truth_axes="ned", axes="ned")


@pytest.mark.slow
def test_figures_are_plain_numbers(tmp_path: Path) -> None:
    truth = walk(200)
    write_tum(tmp_path / "t.tum", truth)
    turned = Trajectory.from_matrices(truth.stamps, truth.matrices() @ np.diag([-1.0, -1, 1, 1]))
    write_tum(tmp_path / "turned.tum", turned)
    for name, rotation in (("t", "rotation 0°"), ("turned", "rotation 180°")):
        done = said(tmp_path, "--truth", "t.tum", "--estimate", f"{name}.tum")
        assert rotation in done.stdout
        assert "e-" not in done.stdout.replace("estimate-", "")
        assert "e+" not in done.stdout
