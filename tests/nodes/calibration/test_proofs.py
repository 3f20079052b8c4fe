"""Each proof passes on what is true, and names what is not."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from events import CameraAnnouncement, CameraInfo
from events.camera_info import DistortionModel
from events.frames import OPTICAL_TO_FRD, from_rpy, multiply
from nodes.calibration import proofs
from nodes.calibration.proofs import noise, trials, variances
from nodes.calibration.room import HIGH, LOW, Motion, _Collector, hits, mjcf, spheres
from nodes.data.dataset.recording import Rig
from tests.nodes.calibration.samples import ANGLE, IMU, camera, flown, true_motion, twist

pytestmark = pytest.mark.slow

LENSES: dict[str, tuple[DistortionModel, tuple[float, ...]]] = {
    "pinhole": ("plumb_bob", (0.0, 0.0, 0.0, 0.0, 0.0)),
    "radtan": ("plumb_bob", (-0.2, 0.04, 1e-3, -1e-3, 0.0)),
    "kb4": ("equidistant", (0.02, -0.005, 0.001, 0.0)),
}


def seen(lens: str = "pinhole", **more: object) -> CameraAnnouncement:
    """Return a camera whose discs are large enough for few pixels."""
    model, k = LENSES[lens]
    focal = 90.0 if lens == "kb4" else 120.0
    info = CameraInfo(
        width=180,
        height=140,
        fx=focal,
        fy=focal * 1.02,
        cx=91.0,
        cy=68.5,
        distortion_model=model,
        distortion=k,
    )
    looks = multiply(from_rpy(0.1, 0.2, -0.3), OPTICAL_TO_FRD)
    return msgspec.structs.replace(camera(), info=info, orientation=looks, **more)


def lying(kept: _Collector, **more: object) -> CameraAnnouncement:
    """Have the camera of a flight announce something else than it sends."""
    (source,) = kept.cameras
    info = {k: v for k, v in more.items() if k in CameraInfo.__struct_fields__}
    rest = {k: v for k, v in more.items() if k not in info}
    now = msgspec.structs.replace(
        kept.cameras[source],
        info=msgspec.structs.replace(kept.cameras[source].info, **info),
        **rest,
    )
    kept.cameras[source] = now
    return now


@pytest.fixture(scope="module")
def plain() -> _Collector:
    return flown(seen())


@pytest.fixture(scope="module")
def rolling() -> _Collector:
    return flown(seen(readout=0.02))


@pytest.fixture
def kept(plain: _Collector) -> _Collector:
    """Return a flight that may be changed."""
    copy = _Collector()
    vars(copy).update({k: v.copy() if isinstance(v, dict) else v for k, v in vars(plain).items()})
    return copy


def judged(kept: _Collector, announced: CameraAnnouncement) -> dict[int, list[proofs.Figure]]:
    motion = Motion(kept.odometry)
    points = proofs.discs(announced, kept, motion, ANGLE)
    return {
        1: [proofs.integration(IMU, kept.imu, motion, 0)],
        3: [proofs.projection(announced, points)],
        4: [proofs.depth(announced, kept, motion, ANGLE)],
        6: [
            *proofs.stamps(announced, kept, motion, points),
            proofs.lateness(IMU, kept, motion),
        ],
    }


def remarks(kept: _Collector, announced: CameraAnnouncement, number: int) -> str:
    """Return what a proof says is wrong."""
    figures = judged(kept, announced)[number]
    assert not all(figure.passed for figure in figures), figures
    return "; ".join(figure.remark for figure in figures if not figure.passed)


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("readout", [0.0, 0.02])
def test_a_true_camera_passes(lens: str, readout: float) -> None:
    announced = seen(lens, readout=readout, time_offset=0.004)
    judgement = judged(flown(announced), announced)
    assert [f for figures in judgement.values() for f in figures if not f.passed] == []
    assert judgement[3][0].value < 0.06
    assert judgement[4][0].value < 1e-6
    assert int(judgement[3][0].name.split()[2]) > 8


def test_a_wrong_focal_length_is_named(kept: _Collector) -> None:
    said = remarks(kept, lying(kept, fx=120.0 * 1.05), 3)
    assert "drone/left: points fall up to" in said
    assert "as if fx were 12" in said


def test_a_wrong_principal_point_is_named(kept: _Collector) -> None:
    assert "as if cy were 68.5 px, not 69.5 px" in remarks(kept, lying(kept, cy=69.5), 3)


def test_a_wrong_readout_is_named(rolling: _Collector) -> None:
    wrong = msgspec.structs.replace(rolling.cameras["drone/left"], readout=0.01)
    said = remarks(rolling, wrong, 3)
    assert re.search(r"as if readout were (19|2[01])[. ]", said)
    assert "not 10 ms" in said
    assert "poses of rows are missing, or bear other stamps" in remarks(rolling, wrong, 6)


def test_a_shifted_stamp_is_named_with_its_time(kept: _Collector) -> None:
    announced = kept.cameras["drone/left"]
    late = 5_000_000  # as if stamps were those of the delivery
    stores: tuple[dict[str, Any], ...] = (kept.images, kept.depths, kept.vehicle_pixels, kept.poses)
    for store in stores:
        for source, rows in list(store.items()):
            store[source] = {s + late: image for s, image in rows.items()}
    said = remarks(kept, announced, 6)
    assert "drone/left: images show what was 5." in said or "what was 4.9" in said
    assert "ms before the time that their stamps say" in said
    assert "camera poses beside odometry and mounting by" in said


def test_one_image_without_its_depth_is_named(kept: _Collector) -> None:
    kept.depths.update({"drone/left": dict(list(kept.depths["drone/left"].items())[1:])})
    said = remarks(kept, kept.cameras["drone/left"], 6)
    assert said == "drone/left: 1 exposures have no depth image of their stamp"


def test_scaled_depth_is_named(kept: _Collector) -> None:
    scaled = {s: rows * [1.0, 1.0, 1.01] for s, rows in kept.depths["drone/left"].items()}
    kept.depths.update({"drone/left": scaled})
    said = remarks(kept, kept.cameras["drone/left"], 4)
    assert "its median is 1.0100 times the truth" in said


def test_images_of_nothing_prove_nothing(kept: _Collector) -> None:
    black = {s: np.zeros_like(image) for s, image in kept.images["drone/left"].items()}
    kept.images.update({"drone/left": black})
    figure = judged(kept, kept.cameras["drone/left"])[3][0]
    assert not figure.passed
    assert "are missing" in figure.remark
    kept.images.update({"drone/left": {}})
    figure = judged(kept, kept.cameras["drone/left"])[3][0]
    assert not figure.passed
    assert "nothing is proven" in figure.remark


def test_an_imu_that_lies_does_not_integrate(kept: _Collector) -> None:
    kept.imu = [
        msgspec.structs.replace(
            s, linear_acceleration=tuple(1.01 * a for a in s.linear_acceleration)
        )
        for s in kept.imu
    ]
    said = remarks(kept, kept.cameras["drone/left"], 1)
    assert "drone/imu" not in said  # the sentence is about the sensor, the figure names it
    assert "the ideal IMU, integrated over 5.00 s, ends" in said


def test_imu_samples_with_late_stamps_are_named(kept: _Collector) -> None:
    kept.imu = [msgspec.structs.replace(s, stamp=s.stamp + 3_000_000) for s in kept.imu[:-1]]
    said = remarks(kept, kept.cameras["drone/left"], 6)
    assert "drone/imu: IMU samples show what was 3.0" in said


def test_a_transposed_rotation_in_a_file_is_named(tmp_path: Path) -> None:
    rig = Rig("drone", (camera(),), IMU)
    assert all(figure.passed for figure in proofs.exported(rig, tmp_path))
    path = tmp_path / "kalibr" / "camchain-imucam.yaml"
    lines = path.read_text().splitlines()
    at = lines.index("  T_cam_imu:") + 1
    rows = [[float(x) for x in line.strip("- []").split(",")] for line in lines[at : at + 3]]
    turned = np.array(rows)
    turned[:, :3] = turned[:, :3].T
    lines[at : at + 3] = [f"    - {row}" for row in turned.tolist()]
    path.write_text("\n".join(lines) + "\n")
    figure = proofs.read_back(rig, "kalibr", path.parent, np.random.default_rng(5))
    assert not figure.passed
    assert "the files for kalibr project up to" in figure.remark


def standing(white: float, walk: float, seconds: float, seed: int = 4) -> np.ndarray[Any, Any]:
    generator = np.random.default_rng(seed)
    count = round(seconds * IMU.rate)
    bias = np.cumsum(generator.standard_normal((count, 3)) * walk / IMU.rate**0.5, axis=0)
    rows: np.ndarray[Any, Any] = (
        bias + generator.standard_normal((count, 3)) * white * IMU.rate**0.5
    )
    return rows


def test_true_noise_is_shown_and_wrong_noise_named() -> None:
    samples = {
        "gyroscope": standing(1.5e-4, 2e-5, 200.0),
        "accelerometer": standing(2.5e-3, 3e-3, 200.0),  # announced: 2e-3
    }
    (_, gyroscope), (curve, accelerometer) = noise(IMU, samples)
    assert all(figure.passed for figure in gyroscope)
    assert "show gyroscope_random_walk to ±" in gyroscope[1].remark  # 200 s are too short for it
    assert not accelerometer[0].passed
    assert "accelerometer_noise_density is 0.0025 by its Allan" in accelerometer[0].remark
    assert accelerometer[0].remark.endswith("announced 0.002")
    assert curve.measured[0] > 1.2 * curve.announced[0]


def test_noise_where_none_is_announced_is_named() -> None:
    quiet = msgspec.structs.replace(IMU, gyroscope_noise_density=0.0, gyroscope_random_walk=0.0)
    for rows, passed in ((np.zeros((6000, 3)), True), (standing(1e-4, 0.0, 30.0), False)):
        (_, figures), *_ = noise(quiet, {"gyroscope": rows})
        assert all(figure.passed for figure in figures) == passed


def test_the_fit_finds_what_was_put_in() -> None:
    fit = np.median(trials(2e-3, 3e-3, 0.0, 200.0, 40_000), axis=0)
    assert fit == pytest.approx([2e-3, 3e-3], rel=0.1)
    seconds, values = variances(standing(2e-3, 0.0, 100.0), 200.0)
    assert np.sqrt(values[0] * seconds[0]) == pytest.approx(2e-3, rel=0.02)


def test_rays_meet_what_the_world_file_says() -> None:
    centres, radii = spheres(ANGLE)
    assert (centres - radii[:, None] > LOW).all()
    assert (centres + radii[:, None] < HIGH).all()
    assert mjcf(ANGLE).count('type="sphere"') == len(radii)
    origin = np.array([[0.1, -0.2, -1.4]] * len(radii))
    rays = centres - origin
    distance = np.linalg.norm(rays, axis=1)
    distances, what = hits(ANGLE, origin, rays / distance[:, None])
    assert what.tolist() == list(range(len(radii)))
    np.testing.assert_allclose(distances, distance - radii, atol=1e-9)
    down, wall = hits(ANGLE, np.array([[0.0, 0.0, -1.0]]), np.array([[0.002, 0.001, 1.0]]))
    assert wall[0] == -6
    assert down[0] == pytest.approx(1.0)


def test_motion_between_rows_is_that_of_the_formula() -> None:
    motion = Motion(flown(length=2.0).odometry)
    stamps = np.arange(100_000_000, 1_900_000_000, 1_370_000)
    places, turns = motion.at(stamps)
    true, turned = true_motion(stamps / 1e9)
    assert np.abs(places - true).max() < 1e-7
    assert (turns.inv() * turned).magnitude().max() < 1e-6
    assert np.abs(twist(stamps / 1e9)[0]).max() > 0.5
    assert isinstance(turned, Rotation)
