"""Whole self-tests: they pass on true rigs, and a simulator that lies fails with a sentence."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from events import Announcement, CameraAnnouncement, ImuAnnouncement
from nodes.calibration.command import Result, prove, subjects, write_page
from nodes.calibration.proofs import Curve, Figure, Points
from runtime.config.reading import load, parse
from runtime.errors import ConfigError
from sims.computer_vision import FreeCamera
from sims.multirotor import Multirotor
from tests.runtime.tools.samples_cli import command

ROOT = Path(__file__).parents[3]
CAMERA: dict[str, Any] = {"name": "camera", "width": 200, "height": 150, "rate": 8}
STEREO = {
    "name": "eye",
    "images": ["grey"],
    "width": 160,
    "height": 120,
    "intrinsics": [85.0, 85.0, 79.0, 60.5],
    "lens": {"model": "equidistant", "coefficients": [0.02, -0.005, 0.001, 0.0]},
    "stereo": {"baseline": 0.12},
    "readout": "15ms",
    "time_offset": "3ms",
    "rate": 8,
}
RADTAN = CAMERA | {
    "intrinsics": [150.0, 149.0, 101.5, 73.0],
    "lens": {"model": "plumb_bob", "coefficients": [-0.28, 0.07, 1e-4, 2e-5]},
    "orientation": [0.0, -20.0, 30.0],
}


class WrongFocal(Multirotor):
    """Announces a focal length that is not the one it draws with."""

    def announce(self) -> Iterable[Announcement]:
        for announcement in super().announce():
            if isinstance(announcement, CameraAnnouncement):
                info = msgspec.structs.replace(announcement.info, fx=1.03 * announcement.info.fx)
                announcement = msgspec.structs.replace(announcement, info=info)
            if isinstance(announcement, ImuAnnouncement):
                noise = 1.5 * announcement.accelerometer_noise_density
                announcement = msgspec.structs.replace(
                    announcement, accelerometer_noise_density=noise
                )
            yield announcement


def proven(node: dict[str, Any], folder: Path, standing: float = 30.0) -> Result:
    """Return what a self-test of one vehicle finds."""
    config = parse({"run": {"seed": 3}, "nodes": [{"name": "drone"} | node]}, "test")
    (spec,) = subjects(config)
    return prove(config, spec, folder, standing)


def missed(result: Result) -> dict[int, list[str]]:
    """Return the sentences of what is not as announced."""
    remarks_of = {
        number: [figure.remark for figure in figures if not figure.passed]
        for number, figures in result.figures.items()
    }
    return {number: remarks for number, remarks in remarks_of.items() if remarks}


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("camera", [STEREO, RADTAN], ids=["stereo kb4 rolling", "radtan"])
def test_a_true_rig_passes(camera: dict[str, Any], tmp_path: Path) -> None:
    result = proven({"type": "Multirotor", "cameras": [camera]}, tmp_path)
    assert missed(result) == {}
    assert all(result.figures.values())
    assert (tmp_path / "calibration" / "kalibr" / "imu.yaml").is_file()


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_errors_of_calibration_are_meant(tmp_path: Path) -> None:
    wrong = {"calibration_error": True}
    sensors = {"imu": wrong, "lidars": [{"name": "lidar"} | wrong], "cameras": [CAMERA | wrong]}
    result = proven({"type": "Multirotor"} | sensors, tmp_path)
    assert missed(result) == {}
    assert any("which are meant, are switched off" in note for note in result.notes)


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_free_camera_passes_without_an_imu(tmp_path: Path) -> None:
    node = {"type": f"{FreeCamera.__module__}:FreeCamera", "cameras": [CAMERA]}
    result = proven(node, tmp_path)
    assert missed(result) == {}
    assert not result.figures[1]
    assert any("no IMU" in note for note in result.notes)


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_carried_rig_passes(tmp_path: Path) -> None:
    """Whatever its own motion is: it is moved along the self-test's."""
    motion = ROOT / "examples" / "motions" / "hall_tour.tum"
    node = {"type": "Carried", "cameras": [CAMERA], "trajectory": str(motion), "speed": 0.5}
    result = proven(node, tmp_path)
    assert missed(result) == {}
    assert all(result.figures.values())


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_simulator_that_lies_fails_with_sentences(tmp_path: Path) -> None:
    result = proven({"type": f"{__name__}:WrongFocal", "cameras": [CAMERA]}, tmp_path)
    said = missed(result)
    assert {2, 3} <= set(said)
    assert "by its Allan deviation, announced 0.003" in said[2][0]
    apparent = re.search(r"as if fx were ([\d.]+) px, not 103 px", said[3][0])
    assert apparent
    assert float(apparent[1]) == pytest.approx(100, abs=0.1)
    assert not result.passed()


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_command_passes_on_the_standard_tour(tmp_path: Path) -> None:
    done = command(
        *("selftest", "config.toml", "--standing", "30s", "--out", str(tmp_path)),
        folder=ROOT,
        limit=500,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "drone: 3. Known points fall on their pixels: passed" in done.stdout
    page = (tmp_path / "selftest.html").read_text(encoding="utf-8")
    assert page.count("<img") == 2


def test_the_page_needs_nothing_beside_it(tmp_path: Path) -> None:
    bad = Figure("drone/camera", "points beside their pixels", 2.0, 0.1, "px", "points fall beside")
    seconds = np.array([0.1, 1.0, 10.0])
    curve = Curve("gyroscope", seconds, seconds**-0.5, seconds**-0.5)
    points = Points(np.ones((3, 2)), np.full((3, 2), 0.1), np.zeros((3, 2)))
    result = Result("drone", {1: [], 3: [bad]}, ["a note"], [curve], {"drone/camera": points})
    write_page(tmp_path / "selftest.html", "tour", [result])
    page = (tmp_path / "selftest.html").read_text(encoding="utf-8")
    for text in ("Self-test of tour", "points fall beside", "nothing to prove", "a note", "--bad"):
        assert text in page
    assert page.count('<img src="data:image/png;base64,') == 2


def test_a_file_without_a_simulator_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "none.toml"
    path.write_text('[[nodes]]\nname = "log"\ntype = "Evaluation"\n')
    with pytest.raises(ConfigError, match="expected a node that simulates a vehicle"):
        subjects(load(path))


def test_the_vehicles_of_the_standard_tour_are_found() -> None:
    assert [spec.name for spec in subjects(load(ROOT / "config.toml"))] == ["drone"]
