"""Calibrations of a rig and of a finished run, read back as their documentation says."""

from __future__ import annotations

import copy
import csv
import importlib
import json
import re
import tomllib
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from events import Announcement, CameraInfo
from events.frames import convert_vector, from_rpy
from events.geometry import pose_matrix
from nodes.calibration.formats import FORMATS, export_calibration, left_out, write_files
from nodes.calibration.room import READERS, ReadCamera, read
from nodes.data.dataset.recording import Rig
from runtime.config.reading import parse
from runtime.json_values import plain
from runtime.run.execute import execute
from sims.sensors import calibration
from tests.nodes.calibration.samples import IMU, LENSES, camera, stereo

SAYS = {
    "kalibr": {"pinhole", "radtan4", "kb4"},
    "openvins": {"pinhole", "radtan4", "kb4"},
    "vins": {"pinhole", "radtan4", "kb4"},
    "basalt": set(LENSES),
    "orbslam3": {"pinhole", "radtan4", "radtan5", "kb4"},
    "vslamlab": {"pinhole", "radtan4", "radtan5", "kb4"},
}


def exported(rig: Rig, form: str, folder: Path) -> list[ReadCamera]:
    """Write a rig's calibration, and read it."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in write_files(rig, form).items():
        (folder / name).write_text(text, encoding="utf-8")
    return read(form, folder)


def imu_axes(form: str, points: Any) -> Any:
    """Return points as the IMU has them whose measurements a format is for."""
    on_topics = form in {"kalibr", "openvins", "vins"}
    return np.array([convert_vector("body", tuple(p)) for p in points]) if on_topics else points


def difference(rig: Rig, form: str, cameras: list[ReadCamera]) -> float:
    """Return by how many pixels the same points of the IMU's frame fall elsewhere, at most."""
    points = np.random.default_rng(1).uniform(-0.7, 0.7, (300, 3)) + np.array([0, 0, 2])
    worst = 0.0
    for announced, other in zip(rig.cameras, cameras, strict=True):
        pose = pose_matrix(announced.position, announced.orientation)
        pixels = announced.info.project(points)
        assert np.isfinite(pixels).all()
        off = other.project(imu_axes(form, points @ pose[:3, :3].T + pose[:3, 3])) - pixels
        worst = max(worst, float(np.abs(off).max()))
    return worst


def test_every_format_is_written_and_read() -> None:
    assert set(FORMATS) == set(READERS) == set(SAYS)


@pytest.mark.slow
@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("form", FORMATS)
def test_a_stereo_pair_projects_the_same_or_is_refused(
    form: str, lens: str, tmp_path: Path
) -> None:
    rig = stereo(lens, time_offset=0.005)
    if lens not in SAYS[form]:
        with pytest.raises(ValueError, match=f"{form} has no word for its lens.*basalt has one"):
            write_files(rig, form)
        return
    cameras = exported(rig, form, tmp_path)
    assert difference(rig, form, cameras) < 1e-6
    assert {camera.time_offset for camera in cameras} <= {-0.005, None}


@pytest.mark.slow
@settings(max_examples=25)
@given(
    k=st.tuples(*[st.floats(-0.2, 0.2)] * 2),
    focal=st.tuples(*[st.floats(200, 900)] * 2),
    place=st.tuples(*[st.floats(-2, 2)] * 3),
    form=st.sampled_from(sorted(FORMATS)),
)
def test_any_radtan_camera_projects_the_same(
    k: tuple[float, float],
    focal: tuple[float, float],
    place: tuple[float, float, float],
    form: str,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    info = CameraInfo(
        width=640,
        height=480,
        fx=focal[0],
        fy=focal[1],
        cx=300.5,
        cy=251.25,
        distortion=(*k, 1e-3, -1e-3, 0.0),
    )
    rig = Rig("drone", (msgspec.structs.replace(camera(), info=info, position=place),), IMU)
    cameras = exported(rig, form, tmp_path_factory.mktemp(form))
    rays = np.random.default_rng(2).uniform(-0.25, 0.25, (100, 3)) + np.array([0, 0, 2])
    pose = pose_matrix(place, rig.cameras[0].orientation)
    moved = rays @ pose[:3, :3].T + pose[:3, 3]
    np.testing.assert_allclose(
        cameras[0].project(imu_axes(form, moved)), info.project(rays), atol=1e-6
    )


def test_a_transposed_transform_is_found(tmp_path: Path) -> None:
    rig = Rig("drone", (camera(),), IMU)
    assert difference(rig, "basalt", exported(rig, "basalt", tmp_path)) < 1e-6
    path = tmp_path / "calibration.json"
    text = path.read_text()
    turned = re.sub(r'"q([xyz])": (-?)', lambda m: f'"q{m[1]}": {"" if m[2] else "-"}', text)
    path.write_text(turned)
    assert difference(rig, "basalt", read("basalt", tmp_path)) > 100.0


def test_the_noise_is_in_each_programs_unit(tmp_path: Path) -> None:
    rig = stereo()
    kalibr = write_files(rig, "kalibr")["imu.yaml"]
    assert "gyroscope_noise_density: 0.00015\n" in kalibr
    assert "update_rate: 200.0" in kalibr
    vins = write_files(rig, "vins")["vins.yaml"]
    acc_n = re.search(r"^acc_n: (.*)$", vins, re.M)
    assert acc_n is not None
    assert float(acc_n[1]) == pytest.approx(2e-3 * 200**0.5)
    orb = write_files(rig, "orbslam3")["orbslam3.yaml"]
    assert "IMU.NoiseAcc: 0.002\n" in orb


def test_kalibrs_files_are_plain_yaml_and_the_chain_closes() -> None:
    yaml: Any = importlib.import_module("yaml")
    files = write_files(stereo("kb4"), "kalibr")
    chain = yaml.safe_load(files["camchain-imucam.yaml"])
    first, second = (np.array(chain[name]["T_cam_imu"]) for name in ("cam0", "cam1"))
    np.testing.assert_allclose(np.array(chain["cam1"]["T_cn_cnm1"]) @ first, second, atol=1e-12)
    assert chain["cam0"]["cam_overlaps"] == [1]
    assert yaml.safe_load(files["imu.yaml"])["rostopic"] == "/drone/imu"
    lab = yaml.safe_load(write_files(stereo("kb4"), "vslamlab")["calibration.yaml"])
    assert lab["cameras"][1]["distortion_type"] == "equid4"
    assert lab["imus"][0]["sigma_g_c"] == 1.5e-4


def test_opencv_reads_every_file_that_is_meant_for_it() -> None:
    for form in ("openvins", "vins", "orbslam3"):
        for text in write_files(stereo(), form).values():
            flags = cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY
            assert cv2.FileStorage(text, flags).root().keys()


def test_without_an_imu_the_body_stands_in_its_place(tmp_path: Path) -> None:
    rig = Rig("cv", (camera(),), None)
    for form in sorted(set(FORMATS) - {"openvins"}):
        files = write_files(rig, form)
        assert "imu.yaml" not in files
        if form != "orbslam3":  # which has no transform without an IMU
            assert difference(rig, form, exported(rig, form, tmp_path / form)) < 1e-6
    with pytest.raises(ValueError, match="openvins: expected an IMU on cv, found none"):
        write_files(rig, "openvins")


def test_what_has_no_word_is_a_comment_or_refused() -> None:
    rolling = Rig("drone", (camera(readout=0.02, time_offset=0.01),), IMU)
    for form in ("kalibr", "openvins", "vslamlab", "orbslam3"):
        assert any(
            "rolling shutter: 0.02 s" in text for text in write_files(rolling, form).values()
        )
        assert not left_out(rolling, form)
    (said,) = left_out(rolling, "basalt")
    assert "drone/left: basalt has no word for a rolling shutter (0.02 s)" in said
    assert "rolling_shutter_tr: 0.02" in write_files(rolling, "vins")["vins.yaml"]
    assert "0.01 s late" in write_files(rolling, "orbslam3")["orbslam3.yaml"]
    two = Rig("drone", (camera(time_offset=0.01), camera("other")), IMU)
    with pytest.raises(ValueError, match="basalt has one time_offset for all cameras"):
        write_files(two, "basalt")


def test_an_imu_that_is_turned_and_moved_is_what_transforms_speak_of(tmp_path: Path) -> None:
    imu = msgspec.structs.replace(
        IMU, position=(0.03, -0.02, 0.01), orientation=from_rpy(0.2, 0.1, 1.5)
    )
    rig = Rig("drone", (camera(),), imu)
    pose, points = pose_matrix(imu.position, imu.orientation), np.array([[0.3, 0.2, 2.0]])
    seen = pose_matrix(rig.cameras[0].position, rig.cameras[0].orientation)
    in_body = points @ seen[:3, :3].T + seen[:3, 3]
    in_imu = (in_body - pose[:3, 3]) @ pose[:3, :3]
    for form in FORMATS:
        pixels = exported(rig, form, tmp_path / form)[0].project(imu_axes(form, in_imu))
        np.testing.assert_allclose(pixels, rig.cameras[0].info.project(points), atol=1e-6)


@given(
    gyroscope=st.lists(st.floats(-0.2, 0.2), min_size=9, max_size=9),
    accelerometer=st.lists(st.floats(-0.2, 0.2), min_size=9, max_size=9),
    feigned=st.sampled_from([0.0, 2e-3]),
    ros=st.booleans(),
)
def test_what_a_calibration_says_of_an_imu_undoes_its_errors(
    gyroscope: list[float], accelerometer: list[float], feigned: float, ros: bool
) -> None:
    """By the equations of OpenVINS (``Propagator.cpp``) and Basalt (``calib_bias.hpp``)."""
    yaml: Any = importlib.import_module("yaml")  # without types
    m_g, m_a = (np.eye(3) + np.reshape(matrix, (3, 3)) for matrix in (gyroscope, accelerometer))
    rates, force = np.array([0.3, -0.2, 0.7]), np.array([1.0, 2.0, -9.0])
    seen_rates, seen_force = m_g @ rates + feigned * force, m_a @ force

    def rig_with(accelerometer: npt.NDArray[np.float64]) -> Rig:
        matrices = (tuple(m.ravel().tolist()) for m in (m_g, accelerometer))
        names = ("gyroscope_matrix", "accelerometer_matrix")
        errors: dict[str, Any] = dict(zip(names, matrices, strict=True))
        return msgspec.structs.replace(
            stereo(), imu=msgspec.structs.replace(IMU, g_sensitivity=feigned, **errors)
        )

    flip = np.diag([1.0, -1.0, -1.0]) if ros else np.eye(3)
    files = write_files(rig_with(m_a), "openvins", topics=ros)
    says = yaml.safe_load(files["kalibr_imu_chain.yaml"].partition("---")[2])["imu0"]
    says = {name: np.array(value) for name, value in says.items() if isinstance(value, list)}
    for name in ("Tw", "Ta"):
        np.testing.assert_allclose(says[name], np.tril(says[name]))
    back = says["R_IMUtoACC"].T @ np.linalg.inv(says["Ta"]) @ flip @ seen_force
    np.testing.assert_allclose(back, flip @ force, atol=1e-9)
    left = np.linalg.inv(says["Tw"]) @ (flip @ seen_rates - says["Tg"] @ back)
    np.testing.assert_allclose(says["R_IMUtoGYRO"].T @ left, flip @ rates, atol=1e-9)

    lower = np.tril(m_a)
    if feigned:
        with pytest.raises(ValueError, match="basalt has no word for all of the IMU's errors"):
            write_files(rig_with(lower), "basalt")
        return
    bias = json.loads(write_files(rig_with(lower), "basalt")["calibration.json"])["value0"]
    s = bias["calib_gyro_bias"]
    assert s[:3] == bias["calib_accel_bias"][:3] == [0.0, 0.0, 0.0]
    undone = (np.eye(3) + np.reshape(s[3:], (3, 3)).T) @ m_g
    np.testing.assert_allclose(undone, np.eye(3), atol=1e-9)
    s1, s2, s3, s4, s5, s6 = bias["calib_accel_bias"][3:]
    undone = (np.eye(3) + np.array([[s1, 0, 0], [s2, s4, 0], [s3, s5, s6]])) @ lower
    np.testing.assert_allclose(undone, np.eye(3), atol=1e-9)


@pytest.mark.parametrize("name", [*FORMATS])
def test_every_format_holds_the_announced_imu_of_a_usual_error(name: str) -> None:
    """In words of its own, or in a remark."""
    said = calibration.announced(IMU, calibration.USUAL_IMU, np.random.default_rng([1]), "imu")
    exact, errs = (msgspec.structs.replace(stereo(), imu=imu) for imu in (IMU, said))
    assert write_files(exact, name) != write_files(errs, name)


def test_errors_of_an_imu_without_a_word_are_a_comment_or_refused() -> None:
    errors: dict[str, Any] = {"accelerometer_matrix": (1.0, 0.1, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)}
    rig = msgspec.structs.replace(stereo(), imu=msgspec.structs.replace(IMU, **errors))
    for form in ("kalibr", "vins", "orbslam3", "vslamlab"):
        text = "".join(write_files(rig, form).values())
        assert (
            "# accelerometer_matrix, which readers of this file know nothing of: (1.0, 0.1" in text
        )
        assert "gyroscope_matrix" not in text
    with pytest.raises(ValueError, match=r"without numbers above its diagonal, found 0 and \(1"):
        write_files(rig, "basalt")
    dead: dict[str, Any] = {"gyroscope_matrix": (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0)}
    rig = msgspec.structs.replace(stereo(), imu=msgspec.structs.replace(IMU, **dead))
    with pytest.raises(ValueError, match="openvins: expected an IMU of three axes"):
        write_files(rig, "openvins")


def test_a_library_that_gets_our_measurements_gets_files_for_them() -> None:
    ours = write_files(stereo(), "openvins", topics=False)
    assert 'rostopic: ""' in ours["kalibr_imu_chain.yaml"]
    assert "z down" in ours["kalibr_imucam_chain.yaml"]
    turned = write_files(stereo(), "openvins")
    assert 'rostopic: "/drone/imu"' in turned["kalibr_imu_chain.yaml"]
    assert "z up, as on ROS's topics" in turned["kalibr_imucam_chain.yaml"]


@pytest.mark.parametrize("example", ["stereo_inertial", "figure_eight"])
def test_openvins_initializes_at_the_rest_of_our_examples(example: str) -> None:
    settings = write_files(stereo(), "openvins")["estimator_config.yaml"]
    says = dict(re.findall(r"^(\w+): (\S+)$", settings, re.M))
    assert says["try_zupt"] == says["zupt_only_at_beginning"] == "true"
    at_rest = 3**0.5 * IMU.accelerometer_noise_density * IMU.rate**0.5
    assert 3 * at_rest < float(says["init_imu_thresh"]) < 0.62  # of a gentle take-off
    path = Path(__file__).parents[3] / "examples" / f"{example}.toml"
    nodes = {node["name"]: node for node in tomllib.loads(path.read_text())["nodes"]}
    rests = float(nodes["pilot"]["start_delay"].removesuffix("s"))
    assert rests >= float(says["init_window_time"]) + 0.5
    assert nodes["drone"]["imu"]["vibration"]["amplitude"] > 1.0


def test_an_imu_on_another_body_is_refused() -> None:
    elsewhere = msgspec.structs.replace(IMU, parent_frame_id="other")
    with pytest.raises(ValueError, match="drone/left: expected a camera mounted on other"):
        write_files(Rig("drone", (camera(),), elsewhere), "kalibr")


RECORDED = {
    "run": {"duration": "1s"},
    "nodes": [
        {"name": "recorder", "type": "McapRecorder"},
        {
            "name": "drone",
            "type": "Multirotor",
            "cameras": [{"name": "camera", "width": 32, "height": 24, "rate": 10}],
        },
    ],
}


def summary(run: Path, announced: tuple[Announcement, ...]) -> Path:
    """Write what an export needs of a run."""
    run.mkdir()
    rows = [
        {"type": type(announcement).__name__, **plain(announcement, "test")}
        for announcement in announced
    ]
    (run / "summary.json").write_bytes(msgspec.json.encode({"announcements": rows}))
    return run


def test_files_come_from_the_summary_of_a_run(tmp_path: Path) -> None:
    rig = stereo()
    assert rig.imu is not None
    run = summary(tmp_path / "run", (*rig.cameras, rig.imu))
    written = export_calibration(run, "kalibr")
    assert [path.relative_to(run).as_posix() for path in written] == [
        "export/kalibr/camchain-imucam.yaml",
        "export/kalibr/imu.yaml",
    ]
    one = export_calibration(run, "vslamlab", tmp_path / "one", camera="drone/right")
    assert "rgb_1" not in one[0].read_text()
    with pytest.raises(ValueError, match="called drone/frnt, found drone/left"):
        export_calibration(run, "kalibr", camera="drone/frnt")


def test_a_run_without_a_summary_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"summary.json: expected the summary of a finished run"):
        export_calibration(tmp_path, "kalibr")
    (tmp_path / "summary.json").write_text(json.dumps({"announcements": [{"type": "CameraInfo"}]}))
    with pytest.raises(ValueError, match="expected a camera with rgb or grey images, found none"):
        export_calibration(tmp_path, "kalibr")


@pytest.mark.slow
def test_a_recorded_run_gives_vslam_lab_its_data(tmp_path: Path) -> None:
    recorded: Any = copy.deepcopy(RECORDED)
    recorded["nodes"][1]["imu"] = {"position": [0.3, 0.0, -0.1], "orientation": [0, 0, 90]}
    execute(parse(recorded, "test"), tmp_path)
    names = [path.name for path in export_calibration(tmp_path, "vslamlab", epoch=10**18)]
    assert names == ["calibration.yaml", "imu_0.csv", "groundtruth.csv", "rgb.csv"]
    folder = tmp_path / "export" / "vslamlab"
    rows = list(csv.DictReader((folder / "rgb.csv").read_text().splitlines()))
    assert list(rows[0]) == ["ts_rgb_0 (ns)", "path_rgb_0", "ts_depth_0 (ns)", "path_depth_0"]
    stamps = np.diff([int(row["ts_rgb_0 (ns)"]) for row in rows])
    assert len(rows) >= 8
    assert set(stamps.tolist()) == {100_000_000}
    assert int(rows[0]["ts_rgb_0 (ns)"]) >= 10**18
    colour: Any = cv2.imread(str(folder / rows[0]["path_rgb_0"]))
    assert colour.shape == (24, 32, 3)
    depth: Any = cv2.imread(str(folder / rows[0]["path_depth_0"]), cv2.IMREAD_UNCHANGED)
    assert depth.dtype == np.uint16
    imu = list(csv.reader((folder / "imu_0.csv").read_text().splitlines()))
    assert imu[0][:2] == ["ts (ns)", "wx (rad s^-1)"]
    assert float(imu[50][6]) == pytest.approx(-9.81, abs=0.2)
    truth = list(csv.reader((folder / "groundtruth.csv").read_text().splitlines()))
    assert len(truth) > 150
    assert float(truth[-1][3]) > 0.0  # up
    # The body is the IMU, before the vehicle and turned to its right (north, west, up).
    assert [float(value) for value in truth[1][1:3]] == pytest.approx([0.3, 0.0], abs=0.01)
    turned = [abs(float(value)) for value in truth[1][4:8]]
    assert turned == pytest.approx([0.5**0.5, 0.5**0.5, 0.0, 0.0], abs=0.01)
    export_calibration(tmp_path, "vslamlab")  # again, over what is there
