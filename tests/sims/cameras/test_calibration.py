"""What is announced of a camera differs from what is drawn, by what the file says and no more."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import visnav
from events import CameraAnnouncement, Image, PoseStamped, TransformStamped
from runtime.testing import run_nodes, spec
from runtime.units import Latency
from sims.cameras import CameraSpec
from sims.cameras.calibration import USUAL, Calibration, CalibrationError, announced
from sims.cameras.optics import Lens
from sims.cameras.spec import DepthSensor, announcement, calibration, eyes
from sims.computer_vision import FreeCamera

CAMERA = CameraSpec(name="c", width=320, height=240, orientation=(3.0, -20.0, 40.0))


def drawn(error: CalibrationError, seed: int, name: str = "c") -> Calibration:
    return announced(calibration(CAMERA), error, np.random.default_rng([seed]), name)


def off(said: Calibration) -> dict[str, np.ndarray]:
    """Return the errors of a calibration of `CAMERA`."""
    true = calibration(CAMERA)
    turn = Rotation.from_quat(true.orientation, scalar_first=True).inv()
    turn *= Rotation.from_quat(said.orientation, scalar_first=True)
    one, other = said.info, true.info
    return {
        "focal": np.array([one.fx - other.fx, one.fy - other.fy]),
        "centre": np.array([one.cx - other.cx, one.cy - other.cy]),
        "distortion": np.subtract(one.distortion, other.distortion),
        "rotation": np.degrees(turn.as_rotvec()),
        "position": np.subtract(said.position, true.position),
        "time": np.array([said.time_offset - true.time_offset]),
    }


def test_errors_have_the_deviations_of_the_settings() -> None:
    errors = [off(drawn(USUAL, seed)) for seed in range(600)]
    for name in ("focal", "centre", "rotation", "position", "time"):
        values = np.array([error[name] for error in errors])
        assert values.std(axis=0) == pytest.approx(float(getattr(USUAL, name)), rel=0.1), name
        assert abs(values.mean(axis=0)).max() < 0.15 * float(getattr(USUAL, name))
    lens = np.array([error["distortion"] for error in errors]).std(axis=0)
    assert lens == pytest.approx(3e-4 * np.array([1.0, 1.0, 0.1, 0.1, 0.0]), rel=0.1)
    first, second = np.array([error["focal"] for error in errors]).T
    assert abs(np.corrcoef(first, second)[0, 1]) < 0.15


def test_k3_errs_where_the_lens_has_one() -> None:
    lens = Lens(model="plumb_bob", coefficients=(-0.28, 0.07, 0.0, 0.0, 0.01))
    for given, errs in ((lens, True), (None, False)):
        camera = CameraSpec(name="c", intrinsics=(160.0, 160.0, 160.0, 120.0), lens=given)
        true = calibration(camera)
        said = announced(true, USUAL, np.random.default_rng([7]), "c")
        assert (said.info.distortion[4] != true.info.distortion[4]) == errs


def test_a_setting_changes_no_others_error_and_zero_changes_nothing() -> None:
    alone, together = drawn(CalibrationError(focal=0.15), 7), drawn(USUAL, 7)
    assert off(alone)["focal"].tolist() == off(together)["focal"].tolist()
    assert alone.orientation == calibration(CAMERA).orientation
    assert drawn(CalibrationError(), 7) == calibration(CAMERA)
    assert drawn(USUAL, 7) == drawn(USUAL, 7)
    assert drawn(USUAL, 7).info != drawn(USUAL, 8).info
    assert drawn(USUAL, 7).info != drawn(USUAL, 7, name="d").info
    assert drawn(USUAL, 7).time_offset == drawn(USUAL, 7, name="d").time_offset


def test_the_draws_of_a_name_and_a_seed_stay_what_they_are() -> None:
    errors = off(drawn(USUAL, 7))
    assert errors["focal"] == pytest.approx([0.07171000241, 0.19338608059])
    assert errors["position"] == pytest.approx(
        [-1.629537e-05, 1.489699e-04, 3.310187e-05], rel=1e-5
    )


def test_an_announcement_holds_nothing_of_the_true_calibration() -> None:
    first = CameraSpec(name="c", images=("rgb", "depth"), depth_sensor=DepthSensor())
    other = msgspec.structs.replace(
        first,
        intrinsics=(200.0, 210.0, 150.0, 130.0),
        position=(1.0, 2.0, 3.0),
        orientation=(4.0, 5.0, 6.0),
        time_offset=Latency(0.007),
    )
    known = announced(calibration(first), USUAL, np.random.default_rng([7]), "c")
    one, two = (
        announcement(spec, source="d/c", prefix="d/", parent_frame_id="base_link", known=known)
        for spec in (first, other)
    )
    assert one == two
    assert one.depth_noise == pytest.approx(0.07 / (known.info.fx * 0.075))


def test_lists_are_the_errors_themselves_the_left_eyes_first() -> None:
    error = CalibrationError(
        focal=(1.0, -2.0), distortion=(0.1, 0.0, 0.0, 0.0, 0.0), rotation=(0.0, 0.0, 0.5)
    )
    errors = off(drawn(error, 1))
    assert errors["focal"] == pytest.approx([1.0, -2.0])
    assert errors["distortion"].tolist() == [0.1, 0.0, 0.0, 0.0, 0.0]
    assert errors["rotation"] == pytest.approx([0.0, 0.0, 0.5])
    both = msgspec.convert(
        {
            "name": "s",
            "stereo": {"baseline": 0.1},
            "calibration_error": {"centre": [1.0, 2.0, 3.0, 4.0], "rotation": 0.1},
        },
        CameraSpec,
    )
    left, right = (eye.wrong for eye in eyes(both))
    assert left is not None
    assert right is not None
    assert (left.centre, right.centre) == ((1.0, 2.0), (3.0, 4.0))
    assert left.rotation == right.rotation == 0.1


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        ({"calibration_error": {"focal": -1.0}}, "focal"),
        (
            {"calibration_error": {"focal": [1.0]}},
            r"calibration_error.focal: expected a standard deviation, or a list of 2 errors, found "
            "a list of 1",
        ),
        (
            {"stereo": {"baseline": 0.1}, "calibration_error": {"position": [0.1, 0.0, 0.0]}},
            "a list of 6 errors, found a list of 3",
        ),
        (
            {
                "lens": {"model": "plumb_bob", "coefficients": [0.1, 0, 0, 0]},
                "undistorted": True,
                "calibration_error": True,
            },
            "undistorted: expected exact intrinsics",
        ),
    ],
)
def test_what_cannot_be_is_refused(camera: dict[str, Any], message: str) -> None:
    with pytest.raises(msgspec.ValidationError, match=message):
        msgspec.convert({"name": "c"} | camera, CameraSpec)


@pytest.fixture
def world(tmp_path: Path) -> Path:
    path = tmp_path / "world.xml"
    path.write_text(WORLD)
    return path


def settings(world: Path, error: Any) -> dict[str, Any]:
    """Return those of a free camera with a small stereo rig."""
    stereo = {"stereo": {"baseline": 0.1}, "images": ["grey"], "width": 32, "height": 24}
    camera = {"name": "s", "calibration_error": error, "rate": 5} | stereo
    return {"world": str(world), "cameras": [camera]}


WORLD = """<mujoco><worldbody>
  <light pos="0 0 4"/><geom type="plane" size="9 9 1"/><geom type="box" size="1 1 1" pos="3 0 0"/>
</worldbody></mujoco>"""


@pytest.mark.slow
def test_the_truth_is_drawn_and_announced_by_nobody(world: Path) -> None:
    flown = {
        name: run_nodes([spec(FreeCamera, "free", settings(world, error))], duration=1.0)
        for name, error in (("exact", False), ("errs", True))
    }
    images = {name: [e.data.tobytes() for e in run.of(Image)] for name, run in flown.items()}
    assert images["exact"]
    assert images["exact"] == images["errs"]
    poses = {name: run.of(PoseStamped) for name, run in flown.items()}
    assert poses["exact"] == poses["errs"]
    said, true = (
        {a.source: a for a in flown[name].of(CameraAnnouncement)} for name in ("errs", "exact")
    )
    mountings = {e.child_frame_id: e for e in flown["errs"].of(TransformStamped)}
    for source, camera in said.items():
        assert camera.info != true[source].info
        mounting = mountings[camera.frame_id]
        assert (mounting.translation, mounting.rotation) == (camera.position, camera.orientation)
    left, right = (said[f"free/s_{eye}"] for eye in ("left", "right"))
    assert left.time_offset == right.time_offset != 0.0
    distance = np.linalg.norm(np.subtract(right.position, left.position))
    assert right.baseline == pytest.approx(distance)
    assert right.baseline != 0.1


@pytest.mark.slow
def test_the_true_calibration_stands_in_the_summary_and_the_report(
    world: Path, tmp_path: Path
) -> None:
    camera = {"name": "free", "type": "FreeCamera"} | settings(
        world, {"focal": [0.5, 0.0, 0.0, 0.0]}
    )
    table = {
        "run": {"name": "n", "duration": 0.5},
        "nodes": [camera, {"name": "r", "type": "Report"}],
    }
    run = visnav.run(table, out=tmp_path / "run", quiet=True)
    truth = run.summary["truth"]["free/s_left"]
    assert truth["announced"]["intrinsics"][0] - truth["true"]["intrinsics"][0] == 0.5
    assert run.report is not None
    page = run.report.read_text(encoding="utf-8")
    assert "free/s_left as announced, less as it is" in page
    assert "intrinsics +0.5 +0 +0 +0" in page
