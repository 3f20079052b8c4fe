"""ORB-SLAM3's settings say what was announced; read back as ORB-SLAM3 does, by OpenCV."""

from __future__ import annotations

import cv2
import msgspec
import numpy as np
import pytest

from extensions.estimators.tests.orb_slam3.scene import CAMERA, IMU, INFO, RIGHT
from visnav_estimators.orb_slam3.settings import Mode, OrbSettings, make_settings

MODES: tuple[Mode, ...] = ("rgbd", "monocular", "rgbd_inertial", "monocular_inertial")
PAIR = (CAMERA, RIGHT)


def read(text: str) -> cv2.FileStorage:
    return cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)


def number(text: str, name: str) -> float:
    stored = read(text)  # which a node does not keep alive
    node = stored.getNode(name)
    assert node.isInt() or node.isReal(), name
    return float(node.real())


def test_the_cameras_intrinsics_and_rate_are_those_announced() -> None:
    made = make_settings("rgbd", [CAMERA])
    # 320 pixels over 70 degrees: 160 / tan 35° = 228.50; pixel centres are whole numbers.
    assert number(made.text, "Camera.fx") == pytest.approx(228.5037, abs=1e-4)
    assert number(made.text, "Camera.fy") == pytest.approx(228.5037, abs=1e-4)
    assert number(made.text, "Camera.cx") == 159.5
    assert number(made.text, "Camera.cy") == 119.5
    assert number(made.text, "Camera.width") == 320
    assert number(made.text, "Camera.height") == 240
    assert number(made.text, "Camera.fps") == 30
    assert (made.mode, made.width, made.height) == ("rgbd", 320, 240)
    assert made.intrinsics == (INFO.fx, INFO.fy, 159.5, 119.5)


@pytest.mark.parametrize("mode", MODES)
def test_numbers_are_of_the_kind_that_orb_slam3_insists_on(mode: Mode) -> None:
    camera = msgspec.structs.replace(
        CAMERA,
        info=msgspec.structs.replace(INFO, fx=256.0, fy=1e-7, cx=0.0),
        rate=29.97,
    )
    text = make_settings(mode, [camera], IMU, OrbSettings(baseline=2.0, close_depth=4.0)).text
    stored = read(text)
    whole = {
        "Camera.width", "Camera.height", "Camera.RGB", "ORBextractor.nFeatures", "loopClosing",
        "ORBextractor.nLevels", "ORBextractor.iniThFAST", "ORBextractor.minThFAST",
    } | ({"IMU.Frequency", "IMU.fastInit"} if "inertial" in mode else set())  # fmt: skip
    names = stored.root().keys()
    assert whole < {*names}
    for name in names:
        node = stored.getNode(name)
        if name in whole:
            assert node.isInt(), name
        elif not node.isString() and name != "Tbc":
            assert node.isReal(), name
    assert number(text, "Camera.fy") == pytest.approx(1e-7)


def test_depth_is_in_metres_and_near_is_counted_in_baselines() -> None:
    text = make_settings("rgbd", [CAMERA], orb=OrbSettings(baseline=0.2, close_depth=5.0)).text
    assert number(text, "DepthMapFactor") == 1.0
    assert number(text, "Camera.bf") == pytest.approx(0.2 * 228.5037, abs=1e-4)
    assert number(text, "ThDepth") == pytest.approx(25.0)
    assert "Depth" not in make_settings("monocular", [CAMERA]).text


def test_the_imu_is_that_announced_and_the_camera_sits_on_it_as_mounted() -> None:
    text = make_settings("rgbd_inertial", [CAMERA], IMU).text
    assert number(text, "IMU.NoiseGyro") == pytest.approx(1.7e-4)
    assert number(text, "IMU.GyroWalk") == pytest.approx(1.9e-5)
    assert number(text, "IMU.NoiseAcc") == pytest.approx(2e-3)
    assert number(text, "IMU.AccWalk") == pytest.approx(3e-3)
    assert number(text, "IMU.Frequency") == 200
    # Optical (right, down, forward) in FRD (forward, right, down), 15 cm ahead, 2 cm up.
    expected = np.array([[0, 0, 1, 0.15], [1, 0, 0, 0], [0, 1, 0, -0.02], [0, 0, 0, 1]])
    stored = read(text)
    transform = stored.getNode("Tbc").mat()
    assert transform.dtype == np.float32
    np.testing.assert_allclose(transform.astype(np.float64), expected, atol=1e-7)


def test_an_ideal_imu_gets_some_noise() -> None:
    ideal = msgspec.structs.replace(
        IMU,
        gyroscope_noise_density=0.0,
        gyroscope_random_walk=0.0,
        accelerometer_noise_density=0.0,
        accelerometer_random_walk=0.0,
    )
    text = make_settings("monocular_inertial", [CAMERA], ideal).text
    for name in ("NoiseGyro", "GyroWalk", "NoiseAcc", "AccWalk"):
        assert number(text, f"IMU.{name}") > 0


@pytest.mark.parametrize(
    "distortion", [(0.0, 0.0, 0.0, 0.0, 0.0), (-0.28, 0.07, 1e-4, -2e-5, 0.01)]
)
def test_distortion_is_that_announced(distortion: tuple[float, ...]) -> None:
    info = msgspec.structs.replace(INFO, distortion=distortion)
    text = make_settings("monocular", [msgspec.structs.replace(CAMERA, info=info)]).text
    coefficients = [number(text, f"Camera.{name}") for name in ("k1", "k2", "p1", "p2", "k3")]
    assert coefficients == pytest.approx(distortion)


def test_distortion_without_its_first_term_is_not_overlooked() -> None:
    info = msgspec.structs.replace(INFO, distortion=(0.0, 0.0, 1e-3, 0.0, 0.0))
    text = make_settings("rgbd", [msgspec.structs.replace(CAMERA, info=info)]).text
    assert 0 < number(text, "Camera.k1") < 1e-9


def test_orb_settings_are_passed_on() -> None:
    orb = OrbSettings(
        features=1500, scale_factor=1.3, levels=6, fast_threshold=10, min_fast_threshold=12,
        loop_closing=False,
    )  # fmt: skip
    text = make_settings("monocular", [CAMERA], orb=orb).text
    assert number(text, "ORBextractor.nFeatures") == 1500
    assert number(text, "ORBextractor.scaleFactor") == pytest.approx(1.3)
    assert number(text, "ORBextractor.nLevels") == 6
    assert number(text, "ORBextractor.iniThFAST") == 10
    assert number(text, "ORBextractor.minThFAST") == 10  # never above the other
    assert number(text, "loopClosing") == 0


def test_an_imu_on_another_body_is_refused() -> None:
    elsewhere = msgspec.structs.replace(IMU, parent_frame_id="gimbal")
    with pytest.raises(ValueError, match=r"expected an IMU on base_link.*drone/imu on gimbal"):
        make_settings("rgbd_inertial", [CAMERA], elsewhere)


def test_an_imu_may_be_anywhere_on_the_body() -> None:
    mounted = msgspec.structs.replace(
        IMU, frame_id="imu", position=(0.0, 0.1, 0.0), orientation=(0.0, 0.0, 0.0, 1.0)
    )
    stored = read(make_settings("rgbd_inertial", [CAMERA], mounted).text)
    # It is turned by half a turn about the vertical: 15 cm ahead of the body is behind it.
    np.testing.assert_allclose(stored.getNode("Tbc").mat()[:3, 3], [-0.15, 0.1, -0.02], atol=1e-6)


def test_a_stereo_pair_is_as_far_apart_as_announced() -> None:
    text = make_settings("stereo", PAIR, orb=OrbSettings(close_depth=5.0)).text
    assert number(text, "Camera.bf") == pytest.approx(0.11 * 228.5037, abs=1e-4)
    assert number(text, "ThDepth") == pytest.approx(5.0 / 0.11)


@pytest.mark.parametrize(
    "wrong", [{"features": 10}, {"scale_factor": 1.0}, {"baseline": 0}, {"ThDepth": 40}]
)
def test_settings_out_of_range_or_unknown_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(wrong, OrbSettings)


def test_a_fisheye_is_kannala_brandts() -> None:
    info = msgspec.structs.replace(
        INFO, distortion_model="equidistant", distortion=(0.02, -0.005, 0.001, -0.0002)
    )
    text = make_settings("monocular", [msgspec.structs.replace(CAMERA, info=info)]).text
    assert read(text).getNode("Camera.type").string() == "KannalaBrandt8"
    coefficients = tuple(number(text, f"Camera.k{k}") for k in (1, 2, 3, 4))
    assert coefficients == pytest.approx(info.distortion)
