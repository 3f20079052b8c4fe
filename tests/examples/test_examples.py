"""Every example runs as its first lines say, a little shorter."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from runtime.config.reading import load
from runtime.tools.cli.inspect import example_files
from sims.worlds import load_world
from tests.nodes.data.replay import downloads

ROOT = Path(__file__).parents[2]
EXAMPLES = [*example_files().values()]


def run(example: str, out: Path, *changes: str, code: int = 0) -> dict[str, Any]:
    """Run an example in a process of its own and return its summary."""
    settings = [word for change in changes for word in ("--set", change)]
    command = [sys.executable, "-m", "runtime", "run", str(example_files()[example]), "--quiet"]
    done = subprocess.run(
        [*command, "--out", str(out), *settings], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == code, done.stderr
    summary: dict[str, Any] = json.loads((out / "summary.json").read_text())
    return summary


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda p: p.stem)
def test_is_a_right_file(path: Path) -> None:
    """Its nodes exist and its settings are valid."""
    assert load(path).nodes


@pytest.mark.parametrize("scene", ["plain_room", "plain_field"])
def test_a_plain_scene_is_one_to_fly_in(scene: str) -> None:
    """MuJoCo reads it, and what is in it has a name that a collision can tell."""
    model = load_world(ROOT / "examples" / f"{scene}.xml").compile()
    assert model.ngeom >= 18
    assert all(model.geom(number).name for number in range(model.ngeom))


@pytest.mark.slow
def test_a_node_of_ones_own_scores_each_image(tmp_path: Path) -> None:
    """`brightness` scores what its camera sees, at the rate of the camera."""
    summary = run("brightness", tmp_path, "run.duration=1s", "drone.camera_processes=1")
    assert summary["events"]["Image"] == 10
    assert summary["events"]["Score"] == 10


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_an_estimator_of_ones_own_is_judged_beside_ours(tmp_path: Path) -> None:
    """`own_estimator` passes its thresholds; so does the reference, which is better."""
    summary = run("own_estimator", tmp_path, "report.figures=[]")
    figures = summary["verdict"]["estimators"]
    assert figures["reference"]["ate_percent"] < figures["own"]["ate_percent"] < 2.0
    assert figures["own"]["coverage_percent"] == 100.0


@pytest.mark.slow
def test_two_cameras_have_rates_of_their_own(tmp_path: Path) -> None:
    """`two_cameras` gives 15 coloured pairs and 70 grey images a second."""
    summary = run("two_cameras", tmp_path, "run.duration=2s")
    assert summary["events"]["DepthImage"] == 30
    assert summary["events"]["Image"] == pytest.approx(30 + 140, abs=2)
    assert {path.name[:11] for path in (tmp_path / "frames").iterdir()} == {
        "drone+front", "drone+down_"
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_rig_is_carried_along_a_recorded_motion(tmp_path: Path) -> None:
    """`carried` ends with its motion, as planned, and its estimator passes."""
    summary = run("carried", tmp_path, "report.figures=[]")
    assert summary["verdict"]["estimators"]["odometry"]["passed"]
    assert summary["reason"] == "trajectory ended"


@pytest.mark.slow
def test_computer_vision_follows_the_trajectory(tmp_path: Path) -> None:
    """`computer_vision` ends with its trajectory, having given one set of images per update."""
    summary = run("computer_vision", tmp_path, "camera.rate=5")
    assert summary["reason"] == "trajectory ended"
    assert summary["events"]["Image"] == summary["events"]["SegmentationImage"] == 61
    assert summary["events"]["Odometry"] == 61


@pytest.mark.slow
@pytest.mark.timeout(500)
def test_the_closed_loop_flies_its_path_on_estimates(tmp_path: Path) -> None:
    """`closed_loop` lands without a collision, and was where the truth says it should be."""
    summary = run("closed_loop", tmp_path, "report.figures=[]")
    assert summary["reason"] == "pilot: flight completed"
    assert summary["outputs"]["drone.vehicle_events"] == 4
    figures = summary["verdict"]["estimators"]["odometry"]
    assert figures["lost_seconds"] == 0.0
    assert figures["ate_percent"] < 0.3


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_scan_is_flown_in_as_the_world_that_it_shows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`scan` lands without a collision, as well followed as in the hall it was exported from."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    less = "camera.width=256", "camera.height=256", "camera.rate=15"
    figures = []
    for name, *world in (("scan",), ("hall", "drone.world=hall", "drone.mesh={}")):
        summary = run("scan", tmp_path / name, *less, *world, "report.figures=[]")
        assert summary["reason"] == "pilot: flight completed"
        figures.append(summary["verdict"]["estimators"]["odometry"])
    scan, hall = figures
    assert scan["collisions"] == 0
    assert scan["ate_percent"] < 2.0 * hall["ate_percent"]


@pytest.mark.slow
@pytest.mark.timeout(500)
def test_the_figure_eight_is_flown_and_followed(tmp_path: Path) -> None:
    """`figure_eight` excites the vehicle, flies at 3 m/s, and lands without a collision."""
    summary = run("figure_eight", tmp_path, "report.figures=[]")
    assert summary["reason"] == "pilot: flight completed"
    figures = summary["verdict"]["estimators"]["odometry"]
    assert figures["collisions"] == 0
    assert figures["ate_percent"] < 0.1


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_rig_of_euroc_is_followed_by_both_eyes_and_its_imu(tmp_path: Path) -> None:
    """`euroc_rig` passes its thresholds, with lenses, mounting and bias of a real rig."""
    summary = run("euroc_rig", tmp_path, "report.figures=[]")
    figures = summary["verdict"]["estimators"]["odometry"]
    assert figures["passed"]
    assert figures["coverage_percent"] == 100.0


@pytest.mark.slow
@pytest.mark.timeout(500)
def test_a_single_camera_keeps_within_two_percent(tmp_path: Path) -> None:
    """`monocular` at 30 instead of 70 images a second, for the sake of time."""
    summary = run("monocular", tmp_path, "camera.rate=30", "report.figures=[]")
    figures = summary["verdict"]["estimators"]["odometry"]
    assert figures["alignment"] == "sim3"
    assert figures["ate_percent"] < 2.0


@pytest.mark.slow
def test_poor_images_over_a_poor_link_are_late_and_some_are_missing(tmp_path: Path) -> None:
    """`imperfect` loses one image in twenty; the estimates are as late as it asks for."""
    summary = run("imperfect", tmp_path, "run.duration=8s", "report.figures=[]")
    figures = summary["verdict"]["estimators"]["odometry"]
    link = summary["links"]["odometry.frames"]
    assert link["lost"] + figures["estimates"] == pytest.approx(summary["events"]["Image"], abs=4)
    assert 2 <= link["lost"] <= 20
    assert figures["latency_p50_ms"] > 40 + 80 + 15


@pytest.mark.slow
def test_two_clouds_of_which_one_smears(tmp_path: Path) -> None:
    """`mapping` writes both clouds, and the smeared one fills more cells."""
    run("mapping", tmp_path, "run.duration=8s", "report.figures=[]")
    sizes = {p.stem: p.stat().st_size for p in (tmp_path / "clouds").glob("*.ply")}
    assert sizes["latest"] > 1.2 * sizes["matched"] > 100_000


@pytest.mark.slow
def test_the_data_sets_hold_equal_stamps(tmp_path: Path) -> None:
    """`dataset` writes both layouts with the same images."""
    run("dataset", tmp_path, "run.duration=2s")
    euroc = {int(p.stem) for p in (tmp_path / "euroc/mav0/cam0/data").glob("*.png")}
    tum = {int(p.stem.replace(".", "")) for p in (tmp_path / "tum_rgbd/rgb").glob("*.png")}
    assert euroc == tum
    assert len(euroc) == 40


@pytest.mark.slow
def test_a_recording_takes_the_simulators_place(tmp_path: Path) -> None:
    """`replay` gives the estimates that `record` gave in flight, to the byte."""
    run("record", tmp_path / "live", "run.duration=4s", "report.figures=[]")
    file = f"replay.file={tmp_path / 'live' / 'recording.mcap'}"
    summary = run("replay", tmp_path / "again", file, "report.figures=[]")
    assert summary["reason"] == "the recording ended"
    name = "trajectories/odometry.tum"
    assert (tmp_path / "live" / name).read_bytes() == (tmp_path / "again" / name).read_bytes()


@pytest.mark.slow
def test_an_odometry_takes_the_undistorted_images_of_a_fisheye(tmp_path: Path) -> None:
    """`fisheye` keeps its way; each exposure gives two images."""
    summary = run("fisheye", tmp_path, "run.duration=6s", "report.figures=[]")
    figures = summary["verdict"]["estimators"]["odometry"]
    assert figures["lost_seconds"] == 0.0
    assert figures["ate_rmse_m"] < 0.02
    assert summary["events"]["Image"] == 2 * summary["events"]["PoseEstimate"]


@pytest.mark.slow
def test_a_rolling_shutter_makes_an_odometry_worse(tmp_path: Path) -> None:
    """`rolling_shutter` has the same flight seen twice."""
    summary = run("rolling_shutter", tmp_path, "run.duration=7s", "report.figures=[]")
    figures = summary["verdict"]["estimators"]
    assert figures["of_rolling"]["rot_rmse_deg"] > 2.0 * figures["of_global"]["rot_rmse_deg"]


@pytest.mark.slow
def test_a_stereo_rig_becomes_a_data_set_of_two_cameras(tmp_path: Path) -> None:
    """`stereo_inertial` writes pairs with equal stamps, which are 3 ms later than the IMU's."""
    run("stereo_inertial", tmp_path, "run.duration=3s")
    folders = [tmp_path / "euroc" / "mav0" / camera for camera in ("cam0", "cam1")]
    left, right = ({int(p.stem) for p in (f / "data").glob("*.png")} for f in folders)
    assert left == right
    assert len(left) >= 58
    rows = (tmp_path / "euroc/mav0/imu0/data.csv").read_text().splitlines()[1:]
    assert {stamp - 3_000_000 for stamp in left} <= {int(row.partition(",")[0]) for row in rows}


@pytest.mark.slow
@pytest.mark.timeout(500)
def test_two_drones_fly_in_one_world_each_by_its_own_pilot(tmp_path: Path) -> None:
    summary = run("two_drones", tmp_path, "report.figures=[]", "alpha.camera_processes=1")
    assert summary["reason"] == "alpha_pilot: flight completed"
    assert summary["outputs"]["alpha.vehicle_events"] == 4  # no collision among them
    assert summary["outputs"]["beta.vehicle_events"] == 4
    assert summary["verdict"]["estimators"]["odometry"]["ate_percent"] < 0.3


@pytest.mark.slow
@pytest.mark.timeout(500)
@pytest.mark.parametrize("example", ["windy", "moving"])
def test_a_flight_in_wind_or_among_things_that_move(example: str, tmp_path: Path) -> None:
    summary = run(example, tmp_path, "report.figures=[]", "camera.rate=10")
    assert summary["reason"] == "pilot: flight completed"
    sent = summary["outputs"]
    assert sent["world.wind" if example == "windy" else "world.body_poses"] > 200
    assert sent["drone.vehicle_events"] == 4
    assert summary["verdict"]["estimators"]["odometry"]["ate_percent"] < 0.5


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_data_sets_in_the_layouts_that_people_download(tmp_path: Path) -> None:
    """`euroc`, `tum` and `kitti` on small folders: lenses are rectified, eyes become a pair."""
    lens = downloads.KINECT
    camera = {name: getattr(lens, name) for name in ("fx", "fy", "cx", "cy")}
    camera["distortion"] = list(lens.distortion)
    table = ", ".join(f"{name} = {value}" for name, value in camera.items())
    tum = (f"replay.camera={{ {table} }}",)
    for name, folder, more in (
        ("euroc", downloads.euroc(tmp_path / "MH_01"), ()),
        ("euroc", downloads.tum_vi(tmp_path / "room1"), ()),
        ("tum", downloads.tum(tmp_path / "fr1"), tum),
        ("kitti", downloads.kitti(tmp_path / "kitti"), ()),
    ):
        file = f"replay.file={folder}"
        out = tmp_path / f"{folder.name}_out"
        summary = run(name, out, file, *more, "report.figures=[]")
        figures = summary["verdict"]["estimators"]
        judged = figures["odometry" if name == "tum" else "stereo"]
        assert judged["estimates"] == downloads.IMAGES
        assert judged["ate_rmse_m"] < 0.005
        assert judged["lost_seconds"] == 0.0
