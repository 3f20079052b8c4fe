"""What a run's trajectories become, and that evo reads the files as they are."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from nodes.data.export import export_trajectories, load
from nodes.judging.evaluation.alignment import align
from nodes.judging.evaluation.metrics import absolute_errors, path_errors
from nodes.trajectory import Trajectory, associate
from nodes.trajectory_files import read_euroc, read_kitti, read_tum, write_tum
from tests.nodes.trajectory.samples import moved, noisy, walk

ROOT = Path(__file__).parents[4]


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Return a run of two estimators: one in `map`, and one in a frame and at times of its own."""
    folder = tmp_path / "run" / "trajectories"
    folder.mkdir(parents=True)
    truth = walk(400)
    estimate = noisy(truth, metres=0.005)
    stamps = np.arange(210_000_000, 19_900_000_000, 33_333_333)
    write_tum(folder / "truth.tum", truth)
    write_tum(folder / "plan.tum", truth)
    write_tum(folder / "vo.tum", estimate.take(slice(20, 380)))
    write_tum(folder / "slam.tum", moved(estimate.at(stamps)))
    return tmp_path / "run"


def evo(folder: Path, *arguments: str) -> dict[str, float]:
    """Run one of evo's commands as a user would, and return the statistics it prints."""
    tool, *rest = arguments
    code = f"import sys; from evo.cli.entry_points import {tool}; sys.exit({tool}())"
    command = [sys.executable, "-c", code, *rest]
    done = subprocess.run(
        command, cwd=folder, env={"HOME": str(folder)}, capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, ""), done.stdout + done.stderr
    return {name: float(value) for name, value in re.findall(r"(\w+)\t(\d\S*)", done.stdout)}


def test_every_format_has_its_files(run: Path, tmp_path: Path) -> None:
    written = {
        form: export_trajectories(run, form, tmp_path / form) for form in ("tum", "euroc", "kitti")
    }
    assert {form: [p.name for p in paths] for form, paths in written.items()} == {
        "tum": ["truth.tum", "slam.tum", "vo.tum"],
        "euroc": ["truth.csv", "slam.csv", "slam.tum", "vo.csv", "vo.tum"],
        "kitti": [
            "slam.truth.kitti.txt",
            "slam.kitti.txt",
            "vo.truth.kitti.txt",
            "vo.kitti.txt",
        ],
    }
    assert all(path.is_file() for paths in written.values() for path in paths)
    for form in written:
        paths = export_trajectories(run, form)
        assert {path.parent for path in paths} == {run / "export" / form}


def rmse(truth: Trajectory, estimate: Trajectory) -> float:
    true, said = associate(truth, estimate)
    return absolute_errors(true, align(said, true, "se3").trajectory)["ate_rmse_m"]


def test_one_formats_estimate_is_not_replaced_by_anothers(run: Path) -> None:
    """Both turn the world another way, so that an estimate is only right beside its own truth."""
    truths, estimates = load(run)
    expected = rmse(truths["truth"], estimates["vo"])
    for form in ("tum", "euroc"):
        export_trajectories(run, form)
    tum, euroc = run / "export" / "tum", run / "export" / "euroc"
    true, said = read_tum(tum / "truth.tum"), read_tum(tum / "vo.tum")
    assert rmse(true, said) == pytest.approx(expected, abs=1e-8)
    true, said = read_euroc(euroc / "truth.csv"), read_tum(euroc / "vo.tum")
    assert rmse(true, said) == pytest.approx(expected, abs=1e-8)


def test_a_file_of_another_format_is_never_overwritten(run: Path, tmp_path: Path) -> None:
    """An export in the same format is."""
    out = tmp_path / "mine"
    for _ in range(2):
        export_trajectories(run, "tum", out)
    before = (out / "vo.tum").read_bytes()
    with pytest.raises(ValueError, match=r"slam\.tum: expected no file, .*\(--out\)"):
        export_trajectories(run, "euroc", out)
    assert (out / "vo.tum").read_bytes() == before
    assert not list(out.glob("*.csv"))


NWU = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("epoch", "zero"),
    [
        ("2020-01-01T00:00:00Z", 1_577_836_800 * 10**9),
        ("2026-07-14T12:00:00.25+02:00", 1_784_023_200 * 10**9 + 250_000_000),
        (7, 7),
    ],
)
def test_poses_stay_where_they_were_and_stamps_are_of_the_epoch(
    run: Path, epoch: int | str, zero: int
) -> None:
    truths, estimates = load(run)
    truth = truths["truth"]
    assert list(estimates) == ["slam", "vo"]
    out = run / "export"
    for form, world in (("tum", np.eye(4)), ("euroc", NWU)):
        export_trajectories(run, form, epoch=epoch)
        for name, expected in ({"truth": truth} | estimates).items():
            files = {f"{name}.csv": read_euroc} if form == "euroc" else {}
            if form == "tum" or name != "truth":
                files[f"{name}.tum"] = read_tum
            for file, read in files.items():
                trajectory = read(out / form / file)
                assert (trajectory.stamps == expected.stamps + zero).all()
                assert abs(trajectory.matrices() - world @ expected.matrices()).max() < 1e-9
                assert f"time 0 is {zero} ns" in (out / form / file).read_text()


@pytest.mark.parametrize("epoch", ["yesterday", "1969-12-31", "2263-01-01", -1, 1 << 63, "１２x"])
def test_an_epoch_that_is_none_is_refused(run: Path, epoch: int | str) -> None:
    with pytest.raises(ValueError, match=r"epoch: expected nanoseconds of Unix time or a date as"):
        export_trajectories(run, "tum", epoch=epoch)
    assert not (run / "export").exists()


def test_kittis_poses_are_the_left_cameras_from_identity_line_by_line(run: Path) -> None:
    """As that benchmark's: z forward and x right in the frame of the first pose."""
    truths, estimates = load(run)
    truth = truths["truth"]
    for announced, mounted in (
        ([], OPTICAL),
        ([{"type": "CameraAnnouncement", "parent_frame_id": "map"}], OPTICAL),
        ([{"type": "ImuAnnouncement"}, CAMERA, {**CAMERA, "position": [9, 9, 9]}], LEVER @ OPTICAL),
    ):
        (run / "summary.json").write_text(json.dumps({"announcements": announced}))
        export_trajectories(run, "kitti")
        true = read_kitti(run / "export" / "kitti" / "slam.truth.kitti.txt")
        said = read_kitti(run / "export" / "kitti" / "slam.kitti.txt")
        for kitti, body in ((true, truth.at(estimates["slam"].stamps)), (said, estimates["slam"])):
            poses = body.matrices() @ mounted
            assert abs(kitti[0] - np.eye(4)).max() < 1e-9
            assert abs(poses[0] @ kitti - poses).max() < 1e-9
    (run / "summary.json").write_text("{")
    with pytest.raises(ValueError, match=r"summary\.json: expected the run's summary, found: "):
        export_trajectories(run, "kitti")


OPTICAL = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
LEVER = np.array([[1.0, 0, 0, 0.1], [0, 1, 0, -0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]])
CAMERA = {
    "type": "CameraAnnouncement",
    "parent_frame_id": "base_link",
    "position": [0.1, -0.2, 0.3],
    "orientation": [0.5, 0.5, 0.5, 0.5],
    "rate": 30.0,
}


def test_poses_without_a_truth_are_left_out_of_kittis_pairs() -> None:
    truth = walk(10)
    early = Trajectory(truth.stamps - 75_000_000, truth.positions, truth.orientations)
    true, said = associate(truth, early)
    assert true.stamps.tolist() == said.stamps.tolist() == early.stamps[2:].tolist()


def test_a_run_without_trajectories_is_an_error_that_says_what_leaves_them(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"truth\.tum: expected .* found no trajectories: .*Eval"):
        export_trajectories(tmp_path, "tum")
    (tmp_path / "trajectories").mkdir()
    write_tum(tmp_path / "trajectories" / "vo.tum", walk(3))
    with pytest.raises(ValueError, match=r"truth\.tum: expected .* found vo\.tum"):
        export_trajectories(tmp_path, "tum")


def test_a_kitti_export_needs_an_estimate_of_the_truths_time(tmp_path: Path) -> None:
    folder = tmp_path / "trajectories"
    folder.mkdir()
    write_tum(folder / "truth.tum", walk(3))
    with pytest.raises(ValueError, match=r"expected an estimate .*, found truth\.tum only"):
        export_trajectories(tmp_path, "kitti")
    write_tum(folder / "vo.tum", walk(3, start=10**12))
    with pytest.raises(ValueError, match=r"vo\.tum: expected estimates within the truth's time"):
        export_trajectories(tmp_path, "kitti")
    assert not (tmp_path / "export").exists()


def test_a_broken_trajectory_is_named(run: Path) -> None:
    (run / "trajectories" / "vo.tum").write_text("1 2 3\n")
    with pytest.raises(ValueError, match=r"vo\.tum:1: expected 8 fields"):
        export_trajectories(run, "tum")
    with pytest.raises(ValueError, match="expected one of tum, euroc, kitti, found 'bag'"):
        export_trajectories(run, "bag")


@pytest.mark.slow
def test_evos_commands_take_the_files_as_they_are_and_find_our_figures(run: Path) -> None:
    """`evo_ape` and `evo_rpe` of each format, in processes of their own."""
    for form in ("tum", "euroc", "kitti"):
        export_trajectories(run, form)
    truths, estimates = load(run)
    truth = truths["truth"]
    # Only those at stamps of the truth: where evo would pair poses of different times.
    true, said = associate(truth, estimates["vo"])
    aligned = align(said, true, "se3").trajectory
    ape, rpe = absolute_errors(true, aligned), path_errors(true, said)
    files = {
        "tum": ["truth.tum", "vo.tum"],
        "euroc": ["truth.csv", "vo.tum"],
        "kitti": ["vo.truth.kitti.txt", "vo.kitti.txt"],
    }
    pairs = ["--delta", "1", "--delta_unit", "m", "--all_pairs", "--pairs_from_reference"]
    for form, names in files.items():
        stats = evo(run / "export" / form, "ape", form, *names, "--align")
        assert stats["rmse"] == pytest.approx(ape["ate_rmse_m"], abs=2e-6)  # it prints six decimals
        assert stats["max"] == pytest.approx(ape["ate_max_m"], abs=2e-6)
        stats = evo(run / "export" / form, "rpe", form, *names, *pairs)
        assert stats["rmse"] * 100 == pytest.approx(rpe["rpe_1m_trans_percent"], abs=2e-4)


@pytest.mark.slow
def test_of_several_vehicles_each_estimate_goes_with_its_own(run: Path) -> None:
    truths, estimates = load(run)
    moved = truths["truth"].positions + np.array([1.0, 0.0, 0.0])
    second = Trajectory(truths["truth"].stamps, moved[::-1], truths["truth"].orientations)
    write_tum(run / "trajectories" / "truth.second.tum", second)
    write_tum(run / "trajectories" / "plan.second.tum", second)
    (run / "evaluation").mkdir()
    verdict = {"passed": None, "estimators": {"vo": {"vehicle": "second"}, "slam": {}}}
    (run / "evaluation" / "verdict.json").write_text(json.dumps(verdict))
    assert {path.name for path in export_trajectories(run, "tum")} == {
        "truth.tum", "truth.second.tum", "slam.tum", "vo.tum"
    }  # fmt: skip
    export_trajectories(run, "kitti")
    for name, true in (("vo", second), ("slam", truths["truth"])):
        there = true.at(estimates[name].stamps).matrices() @ OPTICAL
        poses = read_kitti(run / "export" / "kitti" / f"{name}.truth.kitti.txt")
        assert abs(there[0] @ poses - there).max() < 1e-9


@pytest.mark.slow
def test_evo_reads_an_estimate_in_a_frame_of_its_own(run: Path) -> None:
    export_trajectories(run, "kitti")
    truths, estimates = load(run)
    truth = truths["truth"]
    true, said = associate(truth, estimates["slam"])
    files = ["slam.truth.kitti.txt", "slam.kitti.txt"]
    stats = evo(run / "export" / "kitti", "ape", "kitti", *files, "--align")
    ours = absolute_errors(true, align(said, true, "se3").trajectory)
    assert stats["rmse"] == pytest.approx(ours["ate_rmse_m"], abs=2e-6)
