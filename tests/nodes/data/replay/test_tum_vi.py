"""TUM VI: EuRoC's layout, images of 16 bits, truth in mocap0, Kalibr's calibration beside it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from events import CameraAnnouncement, Image, ImuAnnouncement, Odometry
from events.geometry import inverse, pose_matrix
from nodes.data.replay.reader import Reader, ReplayError
from nodes.kalibr import parse_chain
from tests.nodes.calibration.kalibr_files import CHAIN, IMU, IN_IMU
from tests.nodes.data.replay import downloads, sets

FIRST = 1_520_530_308_199_447_626
STEP = 50_000_000
HEAD = (
    "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], "
    "q_RS_z []\n"
)
POSES = ("0.1,0.2,1.3,0.5,0.5,-0.5,0.5", "0.2,0.2,1.3,0.5,0.5,-0.5,0.5")


def rows(*poses: str, every: int = STEP) -> str:
    """Return the rows of a truth, one each STEP."""
    return "".join(f"{FIRST + n * every},{pose}\n" for n, pose in enumerate(poses))


def tum_vi(folder: Path, *poses: str, calibration: Sequence[str] = (CHAIN, IMU)) -> Path:
    """Return a data set as published, of three frames and small images."""
    root = folder / "dataset-room1_512_16"
    for name in ("cam0", "cam1"):
        (root / "mav0" / name / "data").mkdir(parents=True)
        table = "#timestamp [ns],filename\n"
        for number in range(3):
            stamp = FIRST + number * STEP
            table += f"{stamp},{stamp}.png\n"
            image = np.full((512, 512), 0x2040 + number * 0x100, np.uint16)
            cv2.imwrite(str(root / "mav0" / name / "data" / f"{stamp}.png"), image)
        (root / "mav0" / name / "data.csv").write_text(table)
    (root / "mav0" / "imu0").mkdir()
    (root / "mav0" / "imu0" / "data.csv").write_text(
        "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
        "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\n"
        + rows(*("0.1,0.2,0.3,1,2,3",) * 20, every=5_000_000)
    )
    (root / "mav0" / "mocap0").mkdir()
    (root / "mav0" / "mocap0" / "data.csv").write_text(HEAD + rows(*(poses or POSES)))
    (root / "dso").mkdir()
    for name, text in zip(("camchain.yaml", "imu_config.yaml"), calibration, strict=False):
        (root / "dso" / name).write_text(text)
    return root


def cameras(reader: Reader) -> list[CameraAnnouncement]:
    return [a for a in reader.announcements() if isinstance(a, CameraAnnouncement)]


def truth(reader: Reader) -> list[Odometry]:
    events = (record.event for record in reader.events(0, None, lambda kind, _: kind is Odometry))
    return [event for event in events if isinstance(event, Odometry)]


def test_a_sequence_as_published_is_read(tmp_path: Path) -> None:
    reader = sets.reader(tum_vi(tmp_path))
    left, right = cameras(reader)
    chain = parse_chain(CHAIN, "chain")
    assert (left.info, right.info) == (chain.cameras[0].info, chain.cameras[1].info)
    assert left.position == pytest.approx(IN_IMU, abs=1e-8)
    assert (left.rate, left.images) == (20.0, ("grey",))
    assert (right.stereo, right.source) == (left.source, "drone/cam1")
    one, other = (pose_matrix(camera.position, camera.orientation) for camera in (left, right))
    np.testing.assert_allclose(inverse(one) @ other, chain.cameras[1].in_first, atol=1e-8)
    (imu,) = (a for a in reader.announcements() if isinstance(a, ImuAnnouncement))
    assert (imu.rate, imu.accelerometer_noise_density) == (200.0, 0.0014)
    images = [record.event for record in reader.events(0, None, lambda kind, _: kind is Image)]
    assert [event.data[0, 0] for event in images if isinstance(event, Image)][::2] == [32, 33, 34]
    assert any("dso/camchain.yaml" in note for note in reader.notes)
    assert any(note.endswith("mav0/mocap0/data.csv") for note in reader.notes)
    assert reader.trouble == []


@pytest.mark.slow
def test_a_sequence_is_the_same_in_both_layouts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In EuRoC's, with sensor.yaml, 8 bits and 17 columns, and in TUM VI's."""
    monkeypatch.setattr(downloads, "IMAGES", 3)
    one = sets.reader(downloads.euroc(tmp_path / "euroc"))
    other = sets.reader(downloads.tum_vi(tmp_path / "tum_vi"))
    for announced, camera in zip(cameras(one), cameras(other), strict=True):
        assert (camera.info, camera.stereo) == (announced.info, announced.stereo)
        assert camera.position == pytest.approx(announced.position, abs=1e-12)
        assert camera.orientation == pytest.approx(announced.orientation, abs=1e-12)
        assert camera.rate == pytest.approx(announced.rate, rel=1e-3)
    for pose, same in zip(truth(one), truth(other), strict=True):
        assert (same.stamp, same.position) == (pose.stamp, pose.position)
        assert same.orientation == pose.orientation
    both = [
        [record.event for record in reader.events(0, None, lambda kind, _: kind is Image)]
        for reader in (one, other)
    ]
    assert len(both[0]) == 6
    for image, copy in zip(*both, strict=True):
        assert isinstance(image, Image)
        assert isinstance(copy, Image)
        assert (copy.stamp, copy.source) == (image.stamp, image.source)
        assert (copy.data == image.data).all()


def test_its_truth_is_that_of_the_imu_in_a_world_with_z_down(tmp_path: Path) -> None:
    reader = sets.reader(tum_vi(tmp_path))
    first, second = truth(reader)
    assert (first.position, second.position) == ((0.1, -0.2, -1.3), (0.2, -0.2, -1.3))
    world = np.diag([1.0, -1.0, -1.0])
    expected = world @ pose_matrix((0, 0, 0), (0.5, 0.5, -0.5, 0.5))[:3, :3]
    rotation = pose_matrix(first.position, first.orientation)[:3, :3]
    np.testing.assert_allclose(rotation, expected, atol=1e-12)


def test_bad_rows_of_the_truth_are_counted_and_no_end(tmp_path: Path) -> None:
    """A stamp again, a row of NaN, and a quaternion that is none."""
    root = tum_vi(tmp_path)
    path = root / "mav0" / "mocap0" / "data.csv"
    path.write_text(
        HEAD
        + rows(POSES[0], "nan,nan,nan,nan,nan,nan,nan", "0,0,0,0.7,0,0,0", every=STEP // 2)
        + rows("9,9,9,1,0,0,0")
        + f"{FIRST + 2 * STEP},{POSES[1]}\n"
    )
    reader = sets.reader(root)
    assert [event.position[0] for event in truth(reader)] == [0.1, 0.2]
    (told,) = reader.trouble
    assert "3 of 5 true poses are left out: 1 repeat a stamp; 2 are no pose, the first: " in told
    assert "data.csv:3: expected finite numbers" in told


@pytest.mark.parametrize("end", ["", ",0,0,0,0"])
def test_a_truth_of_positions_only_is_read_and_said(tmp_path: Path, end: str) -> None:
    reader = sets.reader(tum_vi(tmp_path, f"1,2,3{end}", f"2,2,3{end}"))
    assert [event.position for event in truth(reader)] == [(1.0, -2.0, -3.0), (2.0, -2.0, -3.0)]
    (told,) = reader.trouble
    assert "mocap0/data.csv: it has positions only: what depends on true orientations" in told


def test_a_truth_without_a_pose_is_an_error_of_its_line(tmp_path: Path) -> None:
    with pytest.raises(ReplayError, match=r"data\.csv:2: expected a quaternion of length 1"):
        sets.reader(tum_vi(tmp_path, "0,0,0,0.9,0,0,0"))


def test_tums_own_repeated_stamps_are_counted(tmp_path: Path) -> None:
    """As in its freiburg2_desk, whose truth has one stamp twice."""
    root = sets.tum_as_published(tmp_path)
    path = root / "groundtruth.txt"
    last = path.read_text().splitlines()[-1]
    path.write_text(f"{path.read_text()}{last}\n1305031102.19 nan nan nan nan nan nan nan\n")
    reader = sets.reader(root)
    (told,) = (text for text in reader.trouble if "true poses" in text)
    assert "2 of 4 true poses are left out: 1 repeat a stamp; 1 are no pose" in told


def test_settings_name_another_calibration(tmp_path: Path) -> None:
    """Also in the place of a sensor.yaml."""
    path = tmp_path / "camchain-imucam.yaml"
    shifted = CHAIN.replace("cam1:\n", "  timeshift_cam_imu: -0.002\ncam1:\n")
    path.write_text(shifted.replace("190.97847715128717", "200.5"))
    left, _ = cameras(sets.reader(tum_vi(tmp_path), calibration=[str(path)]))
    assert (left.info.fx, left.time_offset) == (200.5, 0.002)
    (tmp_path / "second").mkdir()
    path.write_text(shifted.replace("[512, 512]", "[752, 480]"))
    (camera,) = cameras(
        sets.reader(sets.euroc_as_published(tmp_path / "second"), calibration=[str(path)])
    )
    assert camera.info.distortion_model == "equidistant"
    assert camera.position == pytest.approx(IN_IMU, abs=1e-8)


def test_what_a_calibration_lacks_is_said(tmp_path: Path) -> None:
    root = tum_vi(tmp_path, calibration=[CHAIN])
    reader = sets.reader(root)
    assert any("imu0: expected the IMU's noise in a sensor.yaml" in t for t in reader.trouble)
    (root / "dso" / "camchain.yaml").write_text(CHAIN[: CHAIN.index("cam1:")])
    with pytest.raises(ReplayError, match=r"cam1: expected a sensor\.yaml in it, Kalibr's"):
        sets.reader(root)
    (root / "dso" / "camchain.yaml").write_text(CHAIN.replace("[512, 512]", "[1024, 1024]"))
    with pytest.raises(ReplayError, match=r"png: expected images of 1024 x 1024 pixels"):
        sets.reader(root)
    path = tmp_path / "rig.yaml"
    path.write_text(CHAIN.replace("cam1:", "cam8:").replace("cam0:", "cam7:"))
    with pytest.raises(ReplayError, match=r"calibration: expected one of cam0, cam1, found cam7"):
        sets.reader(root, calibration=[str(path)])


def test_a_calibration_beside_what_has_its_own_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "camchain.yaml"
    path.write_text(CHAIN)
    for made in (sets.tum_as_published, sets.recording):
        with pytest.raises(ReplayError, match="calibration: expected a bag of ROS or a data set"):
            sets.reader(made(tmp_path), calibration=[str(path)])
