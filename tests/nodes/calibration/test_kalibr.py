"""Kalibr's calibrations are read: intrinsics, noise, time shift, and which way transforms go."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from events.frames import from_rpy
from events.geometry import inverse, pose_matrix
from nodes.calibration.formats import camera_in_imu, imu_axes, write_files
from nodes.data.dataset.recording import Rig
from nodes.kalibr import mounting_of_kalibr, parse_chain, read_chain, transform
from runtime.errors import MissingDependencyError
from tests.nodes.calibration.kalibr_files import CHAIN, IMU, IN_IMU
from tests.nodes.calibration.samples import IMU as ANNOUNCED
from tests.nodes.calibration.samples import LENSES, camera, stereo


def write(folder: Path, text: str, name: str = "camchain.yaml") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_a_published_chain_is_read(tmp_path: Path) -> None:
    """TUM VI's; the place of its first camera on the IMU by hand."""
    chain = read_chain([write(tmp_path, CHAIN), write(tmp_path, IMU, "imu.yaml")])
    first, second = chain.cameras
    assert (first.name, first.topic, second.topic) == ("cam0", "/cam0/image_raw", "/cam1/image_raw")
    assert (first.info.width, first.info.height) == (512, 512)
    assert (first.info.fx, first.info.cy) == (190.97847715128717, 256.8974428996504)
    assert first.info.distortion_model == "equidistant"
    assert first.info.distortion[3] == 0.00020293673591811182
    assert first.in_imu is not None
    assert second.in_imu is not None
    assert first.in_imu[:3, 3] == pytest.approx(IN_IMU, abs=1e-8)
    assert second.in_first[:3, 3] == pytest.approx((0.1009, 0.0020, 0.0014), abs=1e-4)
    imu = chain.imu
    assert imu is not None
    assert (imu.rate, imu.topic) == (200.0, "/imu0")
    assert imu.gyroscope_noise_density == 8e-5
    assert imu.accelerometer_random_walk == 8.6e-5


def test_the_library_of_yaml_is_named_if_it_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "yaml", None)
    expected = r"chain: Kalibr's YAML needs pyyaml: pip install -e '\.\[kalibr\]'"
    with pytest.raises(MissingDependencyError, match=expected):
        parse_chain(CHAIN, "chain")


@pytest.mark.parametrize("lens", sorted(set(LENSES) - {"rational", "radtan5"}))
def test_what_we_export_is_read_back(lens: str) -> None:
    rig = stereo(lens, time_offset=0.005)
    chain = parse_chain("\n".join(write_files(rig, "kalibr").values()), "kalibr")
    for announced, read in zip(rig.cameras, chain.cameras, strict=True):
        assert read.info == announced.info
        assert read.time_offset == 0.005
        assert read.in_imu is not None
        expected = imu_axes(rig, ros=True) @ camera_in_imu(rig, announced)
        np.testing.assert_allclose(read.in_imu, expected, atol=1e-12)
    assert chain.imu is not None
    assert chain.imu.gyroscope_noise_density == ANNOUNCED.gyroscope_noise_density
    assert chain.imu.rate == ANNOUNCED.rate


def test_openvins_files_are_read(tmp_path: Path) -> None:
    """With the inverse transform, OpenCV's header, and the IMU in a table of its own."""
    imu = msgspec.structs.replace(ANNOUNCED, orientation=from_rpy(0.2, 0.1, 1.5))
    rig = Rig("drone", (camera(),), imu)
    files = write_files(rig, "openvins")
    names = ("kalibr_imucam_chain.yaml", "kalibr_imu_chain.yaml")
    chain = read_chain([write(tmp_path, files[name], name) for name in names])
    expected = imu_axes(rig, ros=True) @ camera_in_imu(rig, rig.cameras[0])
    assert chain.cameras[0].in_imu == pytest.approx(expected, abs=1e-12)
    assert chain.imu is not None
    assert chain.imu.accelerometer_noise_density == ANNOUNCED.accelerometer_noise_density


@settings(max_examples=10)
@given(angles=st.tuples(*[st.floats(-3, 3)] * 3), place=st.tuples(*[st.floats(-2, 2)] * 3))
def test_a_chain_without_all_transforms_is_closed_from_camera_to_camera(
    angles: tuple[float, float, float], place: tuple[float, float, float]
) -> None:
    """Of T_cn_cnm1 alone, or with T_cam_imu of the first camera."""
    step = pose_matrix(place, from_rpy(*angles))
    on_imu = pose_matrix((0.1, -0.2, 0.3), from_rpy(1.0, -0.5, 2.0))
    common = "camera_model: pinhole, intrinsics: [1, 1, 0, 0], resolution: [2, 2]"
    rows = f"T_cn_cnm1: {inverse(step).tolist()}"
    first = f"cam0: {{{common}, T_cam_imu: {inverse(on_imu).tolist()}}}"
    rest = f"cam1: {{{common}, {rows}}}\ncam2: {{{common}, {rows}}}"
    third = parse_chain(f"{first}\n{rest}", "chain").cameras[2]
    np.testing.assert_allclose(third.in_first, step @ step, atol=1e-9)
    assert third.in_imu is not None
    np.testing.assert_allclose(third.in_imu, on_imu @ step @ step, atol=1e-9)
    back = on_imu @ inverse(step)
    last = f"cam1: {{{common}, {rows}, T_cam_imu: {inverse(on_imu).tolist()}}}"
    in_imu = parse_chain(f"cam0: {{{common}}}\n{last}", "chain").cameras[0].in_imu
    assert in_imu is not None
    np.testing.assert_allclose(in_imu, back, atol=1e-9)
    third = parse_chain(f"cam0: {{{common}}}\n{rest}", "chain").cameras[2]
    assert third.in_imu is None
    np.testing.assert_allclose(third.in_first, step @ step, atol=1e-9)


@pytest.mark.parametrize(
    ("angle", "shift", "same"),
    [(0.009, 0.009, True), (0.011, 0.0, False), (0.0, 0.011, False), (math.pi, 0.0, False)],
)
def test_a_chain_that_contradicts_itself_is_refused(angle: float, shift: float, same: bool) -> None:
    """T_cn_cnm1 beside T_cam_imu of both cameras, from which it is off."""
    first = pose_matrix((0.1, -0.2, 0.3), from_rpy(1.0, -0.5, 2.0))
    step = pose_matrix((0.1, 0.0, 0.0), from_rpy(0.02, 0.01, -0.01))
    odd = pose_matrix((0.0, shift, 0.0), from_rpy(0.0, 0.0, angle))
    common = "camera_model: pinhole, intrinsics: [1, 1, 0, 0], resolution: [2, 2]"
    given = inverse(step)
    given[:3, :3] = odd[:3, :3] @ given[:3, :3]
    given[:3, 3] += odd[:3, 3]
    text = (
        f"cam0: {{{common}, T_cam_imu: {inverse(first).tolist()}}}\n"
        f"cam1: {{{common}, T_cam_imu: {inverse(first @ step).tolist()}, "
        f"T_cn_cnm1: {given.tolist()}}}"
    )
    if same:
        assert len(parse_chain(text, "chain").cameras) == 2
    else:
        with pytest.raises(ValueError, match="chain: cam1: T_cn_cnm1: expected what T_cam_imu of"):
            parse_chain(text, "chain")


T_BS = (
    [
        [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975],
        [0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768],
        [-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949],
        [0.0, 0.0, 0.0, 1.0],
    ],
    [
        [0.0125552670891, -0.999755099723, 0.0182237714554, -0.0198435579556],
        [0.999598781151, 0.0130119051815, 0.0251588363115, 0.0453689425024],
        [-0.0253898008918, 0.0179005838253, 0.999517347078, 0.00786212447038],
        [0.0, 0.0, 0.0, 1.0],
    ],
)
"""Of EuRoC's two cameras, as published in their sensor.yaml."""


def test_the_inverse_given_for_t_cam_imu_is_named() -> None:
    first, second = map(np.array, T_BS)
    common = "camera_model: pinhole, intrinsics: [1, 1, 0, 0], resolution: [2, 2]"
    step = f"T_cn_cnm1: {(inverse(second) @ first).tolist()}"
    text = (
        f"cam0: {{{common}, T_imu_cam: {T_BS[0]}}}\n"
        f"cam1: {{{common}, T_imu_cam: {T_BS[1]}, {step}}}"
    )
    assert len(parse_chain(text, "chain").cameras) == 2
    with pytest.raises(ValueError, match=r"T_imu_cam \(as EuRoC's T_BS\) may have been given"):
        parse_chain(text.replace("T_imu_cam", "T_cam_imu"), "chain")


def test_numbers_that_yaml_takes_for_texts_are_numbers() -> None:
    """YAML 1.1 wants a point in them; who writes by hand does not."""
    imu = parse_chain(IMU.replace("8.0e-5", "8e-5"), "imu.yaml").imu
    assert imu is not None
    assert imu.gyroscope_noise_density == 8e-5


@pytest.mark.parametrize(
    ("old", "new", "wrong"),
    [
        ("camera_model: pinhole", "camera_model: omni", r"cam0: camera_model: expected pinhole"),
        ("distortion_model: equidistant", "distortion_model: fov", "expected one of radtan, equid"),
        ("intrinsics: [190.97847715128717, ", "intrinsics: [", "cam0: intrinsics: expected 4 numb"),
        ("resolution: [512, 512]", "resolution: [512, 0]", "cam0: resolution: expected a width"),
        ("resolution: [512, 512]", "", "cam0: resolution: expected 2 numbers, found nothing"),
        ("[-0.9995378259923383,", "[0.9995378259923383,", "cam0: T_cam_imu: expected a rotation"),
        ("[-0.9995378259923383,", "[.nan,", "cam0: T_cam_imu: expected a rotation"),
        (", 0.047094247958417004]", "]", r"cam0: T_cam_imu: expected a transform of 4 × 4 numbers"),
        ("cam0:", "cam0: [", "expected YAML, found: while parsing"),
        ("cam0:", "cam0: 3\nother:", "cam0: expected a table, found 3"),
    ],
)
def test_a_damaged_chain_is_an_error_of_one_line(old: str, new: str, wrong: str) -> None:
    assert old in CHAIN
    with pytest.raises(ValueError, match=rf"camchain\.yaml.*{wrong}") as raised:
        parse_chain(CHAIN.replace(old, new, 1), "camchain.yaml")
    assert "\n" not in str(raised.value)


@pytest.mark.slow
@given(
    place=st.floats(0, 1),
    length=st.integers(0, 12),
    text=st.one_of(
        st.text(max_size=8),
        st.sampled_from(
            ["1" * 400, "2001-99-99", "[" * 2000, "&a [*a]", "{}", "null", "? []", "-"]
        ),
    ),
)
def test_a_chain_with_anything_in_it_is_read_or_an_error_of_one_line(
    place: float, length: int, text: str
) -> None:
    whole = CHAIN + IMU
    at = int(place * len(whole))
    wrong = "chain"
    try:
        parse_chain(whole[:at] + text + whole[at + length :], "chain")
    except ValueError as error:
        wrong = str(error)
    assert wrong.startswith("chain")
    assert "\n" not in wrong


def test_what_is_no_calibration_is_refused(tmp_path: Path) -> None:
    for text, wrong in (
        ("a: 1", r"expected Kalibr's calibration of cameras .*, found a"),
        ("- 1", "expected Kalibr's YAML, found"),
        ("", "expected Kalibr's YAML, found None"),
        (IMU.replace("0.0014", "much"), "accelerometer_noise_density: expected a number, found"),
        (IMU.replace("0.0014", "-1"), "accelerometer_noise_density: expected a density"),
    ):
        with pytest.raises(ValueError, match=wrong):
            read_chain([write(tmp_path, text)])
    with pytest.raises(ValueError, match=r"missing\.yaml: expected Kalibr's YAML, found"):
        read_chain([tmp_path / "missing.yaml"])


def test_the_mounting_is_from_the_optical_frame_to_the_imu(tmp_path: Path) -> None:
    """Of the first camera, of another one, or of EuRoC's sensor.yaml."""
    path = write(tmp_path, CHAIN)
    first = mounting_of_kalibr(str(path))
    assert first is not None
    assert first[:3, 3] == pytest.approx(IN_IMU, abs=1e-8)
    second = mounting_of_kalibr(f"{path}:cam1")
    assert second is not None
    assert (inverse(first) @ second)[0, 3] == pytest.approx(0.1009, abs=1e-4)
    sensor = f"T_BS:\n  rows: 4\n  cols: 4\n  data: {second.ravel().tolist()}\n"
    np.testing.assert_array_equal(
        mounting_of_kalibr(str(write(tmp_path, sensor, "sensor.yaml"))), second
    )
    for text in ("1 2 3 0 0 0 1", "drone/camera", str(tmp_path / "none.yaml"), str(tmp_path)):
        assert mounting_of_kalibr(text) is None
    with pytest.raises(ValueError, match="expected a camera cam7, found cam0, cam1"):
        mounting_of_kalibr(f"{path}:cam7")
    start, end = CHAIN.index("  T_cam_imu"), CHAIN.index("  cam_overlaps")
    alone = CHAIN[:start] + CHAIN[end : CHAIN.index("cam1:")]
    with pytest.raises(ValueError, match="cam0: expected T_cam_imu, which says where it is"):
        mounting_of_kalibr(str(write(tmp_path, alone)))


@pytest.mark.parametrize(
    "given",
    [
        np.eye(4).tolist(),
        np.eye(4).ravel().tolist(),
        {"rows": 4, "cols": 4, "data": np.eye(4).ravel().tolist()},
    ],
)
def test_a_transform_is_given_by_rows_or_by_sixteen_numbers(given: Any) -> None:
    np.testing.assert_array_equal(transform(given, "T"), np.eye(4))


@pytest.mark.parametrize("given", [None, {}, "x", np.eye(3).tolist(), np.zeros((4, 4)).tolist()])
def test_another_transform_is_refused(given: Any) -> None:
    with pytest.raises(ValueError, match="T: expected a"):
        transform(given, "T")
    wrong = np.eye(4)
    wrong[3, 0] = math.nan
    with pytest.raises(ValueError, match="last row 0 0 0 1"):
        transform(wrong.tolist(), "T")
