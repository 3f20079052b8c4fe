"""Folders with parts missing or broken still give a page that says so; others are refused."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from events import TrackingLost, TrackingRegained
from nodes.judging.evaluation.record import EstimatorRecord
from nodes.judging.evaluation.thresholds import Thresholds
from nodes.judging.report.folder import read_run
from nodes.judging.report.page import write_report
from nodes.judging.report.tables import Floats
from nodes.trajectory import Trajectory
from nodes.trajectory_files import tum_row, write_tum
from runtime.errors import ResultsError
from tests.nodes.judging.report.folders import SECOND, evaluated, ply, recorded, summary, walk
from tests.nodes.judging.report.test_report import Page

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def evaluated_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with an evaluation of one estimator in a flight of 8 s."""
    out, truth = tmp_path_factory.mktemp("evaluated"), walk(8)
    evaluated(out, truth, {"vo": recorded(truth)}, Thresholds())
    return out


@pytest.fixture
def one_estimator(evaluated_once: Path, tmp_path: Path) -> Path:
    """Return a copy of it."""
    shutil.copytree(evaluated_once, tmp_path, dirs_exist_ok=True)
    return tmp_path


def test_a_killed_run_gives_a_page_of_what_it_left(tmp_path: Path) -> None:
    """Trajectories grow as the run goes on; their last lines may be cut off."""
    truth = walk(4)
    folder = tmp_path / "trajectories"
    folder.mkdir()
    for name, trajectory in (("truth", truth), ("vo", recorded(truth).longest.rows.trajectory())):
        rows = zip(
            trajectory.stamps.tolist(),
            trajectory.positions.tolist(),
            trajectory.orientations.tolist(),
            strict=True,
        )
        text = "".join(tum_row(*row) for row in rows)
        (folder / f"{name}.tum").write_text(text[:-30])
    (tmp_path / "config.toml").write_text("[run]\n")
    page = Page(write_report(tmp_path, ("png",)))
    for text in (
        "No summary: the run did not end in an orderly way",
        "summary.json is not there",
        "evaluation/verdict.json is not there: nothing was evaluated to the end",
        "log.txt is not there",
        "vo: the run left no evaluation of it; its first pose was laid on the true one",
        "not judged",
        "Errors over time",
        tmp_path.name,
    ):
        assert text in page.text
    names = {p.name for p in (tmp_path / "plots").iterdir()}
    assert {"trajectories.png", "errors.png", "distributions.png"} <= names
    assert "latency.png" not in names


def test_a_run_of_which_only_the_log_is_left(tmp_path: Path) -> None:
    (tmp_path / "log.txt").write_text("    0.000000 ERROR    drone: broken\n")
    page = Page(write_report(tmp_path, ("png",)))
    assert "nobody was judged" in page.text
    assert "no estimator has sent anything" in page.text
    assert "trajectories/truth.tum is not there" in page.text
    assert "drone: broken" in page.text
    assert list((tmp_path / "plots").iterdir()) == []


def test_broken_files_are_named_and_the_rest_is_shown(one_estimator: Path) -> None:
    (one_estimator / "summary.json").write_text('{"name": 3')
    (one_estimator / "evaluation" / "verdict.json").write_text("[]")
    (one_estimator / "evaluation" / "vo.csv").write_text("stamp_ns\n")
    (one_estimator / "evaluation" / "vo.ticks.csv").write_text("stamp_ns\n1,2,a,b\n")
    (one_estimator / "trajectories" / "plan.tum").write_text("1 2 3\n")
    (one_estimator / "clouds").mkdir()
    (one_estimator / "clouds" / "vo.ply").write_text("none")
    ply(one_estimator / "clouds" / "empty.ply", walk(1).positions[:0])
    (one_estimator / "frames").mkdir()
    (one_estimator / "frames" / "vo_000.jpg").write_text("none")
    (one_estimator / "frames" / "vo_001.jpg").touch()
    (one_estimator / "frames" / "vo_002.jpg").mkdir()
    page = Page(write_report(one_estimator, ("png",)))
    for name in (
        "summary.json cannot be read",
        "evaluation/verdict.json cannot be read",
        "evaluation/vo.csv cannot be read: expected rows of errors",
        "evaluation/vo.ticks.csv cannot be read",
        "trajectories/plan.tum cannot be read: line 1: expected 8 fields",
        "clouds/vo.ply cannot be read: expected a PLY file",
        "clouds/empty.ply cannot be drawn: it has no points",
        "frames/vo_000.jpg cannot be read: expected a JPEG",
        "frames/vo_001.jpg cannot be read: expected a JPEG",
        "frames/vo_002.jpg cannot be read: [Errno 21]",
    ):
        assert name in page.text
    names = {p.name for p in (one_estimator / "plots").iterdir()}
    assert names == {"trajectories.png", "relative.png", "axes.png"}


def test_the_verdict_of_an_earlier_run_does_not_pass_for_this_one_s(one_estimator: Path) -> None:
    """A run that ends at once leaves in its folder what the one before had left there."""
    assert read_run(one_estimator).verdict is not None
    summary(one_estimator, None)
    run = read_run(one_estimator)
    assert run.verdict is None
    assert any("verdict.json is of an earlier run" in text for text in run.missing)


def test_an_estimate_that_has_burst_is_named(one_estimator: Path) -> None:
    (one_estimator / "evaluation" / "vo.aligned.tum").write_text("0.1 1e300 0 0 0 0 0 1\n")
    (one_estimator / "evaluation" / "vo.csv").write_text("stamp_ns\n100,200,inf,0\n")
    missing = read_run(one_estimator).missing
    burst = "expected positions within 1e+12 m, found 1e+300 m"
    assert f"evaluation/vo.aligned.tum cannot be read: {burst}" in missing
    assert "evaluation/vo.csv cannot be read: expected finite errors, found others" in missing


def test_lost_intervals_of_a_file_win_over_gaps(one_estimator: Path) -> None:
    assert read_run(one_estimator).estimators[0].lost == []
    path = one_estimator / "evaluation" / "vo.lost.csv"
    path.write_text(f"start_ns,end_ns\n{2 * SECOND},{3 * SECOND}\n")
    assert read_run(one_estimator).estimators[0].lost == [(2 * SECOND, 3 * SECOND)]


def test_lost_time_that_the_gaps_do_not_tell_of_is_said(tmp_path: Path) -> None:
    """An estimator may say that it is lost and go on saying poses."""
    truth = walk(8)
    record = recorded(truth)
    record.add_tracking(TrackingLost(stamp=2 * SECOND, source="vo", reason="dark"), 2 * SECOND)
    record.add_tracking(TrackingRegained(stamp=5 * SECOND, source="vo"), 5 * SECOND)
    evaluated(tmp_path, truth, {"vo": record}, Thresholds())
    (tmp_path / "evaluation" / "vo.lost.csv").unlink()
    missing = read_run(tmp_path).missing
    assert any("vo: lost for 3.0 s by the figures" in text for text in missing)


def test_estimators_that_said_nothing_are_named(tmp_path: Path) -> None:
    truth = walk(3)
    records = {"vo": recorded(truth), "mute": EstimatorRecord()}
    summary(tmp_path, evaluated(tmp_path, truth, records, Thresholds()))
    run = read_run(tmp_path)
    assert [estimator.name for estimator in run.estimators] == ["vo", "mute"]
    assert "mute: no curves: it left no poses" in run.missing


@pytest.mark.parametrize("kind", ["hover", pytest.param("diverged", marks=pytest.mark.slow)])
def test_odd_flights_are_drawn(tmp_path: Path, kind: str) -> None:
    """Warnings, such as those of matplotlib about empty axes, are errors here."""
    truth = walk(2)
    positions = truth.positions * np.array({"hover": (0, 0, 0)}.get(kind, (1, 0, 0)))
    truth = Trajectory(truth.stamps, positions, truth.orientations)
    records = {"vo": recorded(truth), "other": recorded(truth, source="other")}
    if kind == "diverged":
        records["other"] = recorded(truth, noise=50.0, source="other")
    evaluated(tmp_path, truth, records, Thresholds())
    if kind == "hover":
        write_tum(tmp_path / "evaluation" / "vo.aligned.tum", truth.take(slice(0, 1)))
    page = Page(write_report(tmp_path, ("png",)))
    assert "Trajectories" in page.text


@pytest.mark.slow
@pytest.mark.parametrize("points", [np.zeros((1, 3)), np.linspace((0, 0, 0), (0, 0, -9), 50)])
def test_clouds_without_breadth_are_drawn(tmp_path: Path, points: Floats) -> None:
    """One point, and a pole."""
    (tmp_path / "log.txt").touch()
    (tmp_path / "clouds").mkdir()
    ply(tmp_path / "clouds" / "vo.ply", points)
    page = Page(write_report(tmp_path, ("png",)))
    assert "cannot be" not in page.text
    assert (tmp_path / "plots" / "clouds_1.png").exists()


def test_a_folder_that_is_no_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ResultsError, match=r"none: expected the folder of a run, .*found none"):
        write_report(tmp_path / "none")
    (tmp_path / "letter.txt").touch()
    with pytest.raises(ResultsError, match=r"summary\.json.*found letter\.txt"):
        write_report(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["letter.txt"]
