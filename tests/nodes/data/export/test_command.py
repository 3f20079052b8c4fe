"""The command ``export``, called as the command line calls it."""

from __future__ import annotations

from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from nodes.data.export import Format, export
from nodes.trajectory_files import write_tum
from runtime.errors import ConfigError, ResultsError
from tests.nodes.calibration.samples import IMU, camera
from tests.nodes.calibration.test_formats import summary
from tests.nodes.trajectory.samples import walk

app = typer.Typer()
app.command()(export)


def call(*arguments: str) -> list[str]:
    """Return what the command prints; its errors are raised."""
    done = CliRunner().invoke(app, arguments, catch_exceptions=False)
    if done.exception is not None:
        raise done.exception
    return done.output.splitlines()


@pytest.fixture
def run(tmp_path: Path) -> Path:
    (tmp_path / "trajectories").mkdir()
    write_tum(tmp_path / "trajectories" / "truth.tum", walk(5))
    write_tum(tmp_path / "trajectories" / "vo.tum", walk(5))
    return tmp_path


def test_it_prints_what_it_wrote(run: Path) -> None:
    out = run / "export" / "tum"
    assert call(str(run), "--format", "tum") == [str(out / "truth.tum"), str(out / "vo.tum")]
    other = run / "other" / "place"
    names = ["vo.truth.kitti.txt", "vo.kitti.txt"]
    assert call(str(run), "-f", "kitti", "--out", str(other)) == [str(other / n) for n in names]
    assert sorted(p.name for p in other.iterdir()) == sorted(names)


def test_a_run_without_trajectories_is_one_of_our_errors(tmp_path: Path) -> None:
    with pytest.raises(ResultsError, match=r"expected the folder of a run, .* found nothing in it"):
        call(str(tmp_path), "--format", "euroc")
    (tmp_path / "trajectories").mkdir()
    with pytest.raises(ConfigError, match=r"expected the run's true trajectory"):
        call(str(tmp_path), "--format", "euroc")


def test_a_place_that_cannot_be_written_is_one_of_our_errors(run: Path) -> None:
    (run / "file").touch()
    with pytest.raises(ConfigError, match=r"file"):
        call(str(run), "--format", "tum", "--out", str(run / "file"))


def test_what_a_calibration_does_not_say_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = summary(tmp_path / "run", (camera(readout=0.02), IMU))
    export(run, Format("kalibr"))
    assert capsys.readouterr().err == ""
    export(run, Format("basalt"))
    assert (
        "warning: drone/left: basalt has no word for a rolling shutter" in capsys.readouterr().err
    )


def test_an_unknown_format_is_refused_with_those_there_are(run: Path) -> None:
    done = CliRunner().invoke(app, [str(run), "--format", "bag"])
    assert done.exit_code == 2
    assert all(f"'{name}'" in done.output for name in ("tum", "euroc", "kitti"))
