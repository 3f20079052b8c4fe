"""Topics of bags are chosen by frame and calibration; what cannot be read is left out by name."""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from events import (
    CameraAnnouncement,
    DepthImage,
    Event,
    Image,
    Imu,
    ImuAnnouncement,
    Odometry,
)
from events.frames import OPTICAL_TO_FLU, OPTICAL_TO_FRD
from events.geometry import inverse, pose_matrix
from nodes.calibration.formats import write_files
from nodes.data.dataset.recording import choose
from nodes.data.replay import Replay
from nodes.data.replay.reader import Reader, ReplayError
from runtime.testing import run_node
from tests.nodes.calibration.kalibr_files import CHAIN, IMU
from tests.nodes.data.replay import bags, sets
from tests.nodes.data.replay.bags import COLOUR_K, DEPTH_K, fixed, images, imus, infos, poses

UNIT = (0.0, 0.0, 0.0, 1.0)
COLOUR, DEPTH = "camera_color_optical_frame", "camera_depth_optical_frame"
INFRA = "camera_infra1_optical_frame"


def realsense(space: str = "/camera") -> dict[str, list[Any]]:
    """Return the topics of realsense2_camera with align_depth, colour, depth and both infrareds."""
    topics = {
        f"{space}/color/image_raw": images(COLOUR),
        f"{space}/color/camera_info": infos(COLOUR),
        f"{space}/depth/image_rect_raw": images(DEPTH, "16UC1"),
        f"{space}/depth/camera_info": infos(DEPTH, DEPTH_K),
        f"{space}/aligned_depth_to_color/image_raw": images(COLOUR, "16UC1"),
        f"{space}/aligned_depth_to_color/camera_info": infos(COLOUR),
        f"{space}/imu": imus("camera_imu_optical_frame"),
    }
    for number in (1, 2):
        frame = f"camera_infra{number}_optical_frame"
        topics[f"{space}/infra{number}/image_rect_raw"] = images(frame, "mono8")
        topics[f"{space}/infra{number}/camera_info"] = infos(frame, DEPTH_K)
    return topics


def cameras(reader: Reader) -> dict[str, CameraAnnouncement]:
    announced = reader.announcements()
    return {a.source: a for a in announced if isinstance(a, CameraAnnouncement)}


def events(reader: Reader) -> list[Event]:
    return [record.event for record in reader.events(0, None, lambda *_: True)]


def without(topics: dict[str, list[Any]], *names: str) -> dict[str, list[Any]]:
    return {name: messages for name, messages in topics.items() if name not in names}


@pytest.mark.parametrize("space", ["/camera", "/camera/camera"])
def test_realsenses_colour_gets_the_depth_that_is_aligned_to_it(tmp_path: Path, space: str) -> None:
    """With ROS 1's topics and with ROS 2's. Depth of its own frame is a camera of its own."""
    reader = sets.reader(bags.write(tmp_path, realsense(space)))
    by_source, source = cameras(reader), f"drone{space}"
    assert {name: camera.images for name, camera in by_source.items()} == {
        source: ("rgb", "depth"),
        f"{source}/infra1": ("grey",),
        f"{source}/infra2": ("grey",),
        f"{source}/depth": ("depth",),
    }
    assert [by_source[source].info.fx, by_source[source].info.fy] == [600.0, 601.0]
    assert by_source[f"{source}/depth"].info.fx == by_source[f"{source}/infra1"].info.fx == 420.0
    assert reader.trouble == []
    stamps = [e.stamp for e in events(reader) if isinstance(e, DepthImage) and e.source == source]
    assert len(stamps) == len(set(stamps)) == bags.FRAMES
    reader.close()


def test_each_stream_is_told_in_a_line(tmp_path: Path) -> None:
    reader = sets.reader(bags.write(tmp_path, realsense()))
    told = {note.partition(":")[0]: note for note in reader.notes}
    assert set(told) == {name for name in realsense() if not name.endswith("camera_info")}
    assert told["/camera/color/image_raw"] == (
        "/camera/color/image_raw: image of drone/camera (rgb8), "
        "calibration /camera/color/camera_info"
    )
    assert told["/camera/aligned_depth_to_color/image_raw"] == (
        "/camera/aligned_depth_to_color/image_raw: depth of drone/camera, as "
        "/camera/color/image_raw: one frame, size and K"
    )
    own = told["/camera/depth/image_rect_raw"]
    assert f"/camera/color/image_raw is of the frame '{COLOUR}', not '{DEPTH}'" in own
    reader.close()


def test_a_run_logs_what_it_took_and_warns_of_what_it_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """At the start, before anything is sent."""
    topics = {"/usb/image_raw": images("usb", "yuv422"), "/imu": imus("imu", 2)}
    path = bags.write(tmp_path, topics)
    with caplog.at_level(logging.INFO):
        result = run_node(Replay, config={"file": str(path)}, name="drone", duration=2.0)
    assert len(result.of(Imu)) == 2
    levels = {record.getMessage(): record.levelname for record in caplog.records}
    assert levels[f"{path}: /imu: IMU drone/imu"] == "INFO"
    (warning,) = (text for text, level in levels.items() if level == "WARNING")
    assert warning.startswith(f"{path}: /usb/image_raw: left out: its encoding 'yuv422'")


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        (
            infos(COLOUR, (610.0, *COLOUR_K[1:])),
            "has another K: 600.00 601.00 31.50 23.25, not 610",
        ),
        (infos("other"), "is of the frame 'camera_color_optical_frame', not 'other'"),
        (infos(COLOUR, size=(32, 24)), "has 64 x 48 pixels, not 32 x 24"),
    ],
)
def test_depth_of_another_frame_size_or_matrix_is_not_the_cameras(
    tmp_path: Path, changed: list[Any], why: str
) -> None:
    topics = without(realsense(), "/camera/depth/image_rect_raw")
    topics["/camera/aligned_depth_to_color/camera_info"] = changed
    reader = sets.reader(bags.write(tmp_path, topics))
    assert cameras(reader)["drone/camera"].images == ("rgb",)
    assert cameras(reader)["drone/camera/aligned_depth_to_color"].images == ("depth",)
    assert any(why in note for note in reader.notes)
    reader.close()


def test_depth_of_a_frame_at_the_same_place_is_the_cameras(tmp_path: Path) -> None:
    """As RealSense's depth is the left infrared camera's, which /tf_static says."""
    place, turn = (0.1, 0.02, 0.0), (-0.5, 0.5, -0.5, 0.5)
    topics = realsense() | {
        "/tf_static": fixed(("link", DEPTH, place, turn), ("link", INFRA, place, turn))
    }
    reader = sets.reader(bags.write(tmp_path, topics))
    assert cameras(reader)["drone/camera/infra1"].images == ("grey", "depth")
    assert cameras(reader)["drone/camera/infra2"].images == ("grey",)
    reader.close()


RECTIFIED_K = (500.0, 500.0, 32.0, 24.0)
LENS = (-0.28, 0.07, 1e-4, 2e-5, 0.0)


def pipeline(*names: str) -> dict[str, list[Any]]:
    """Return topics of one camera as image_proc leaves them, beside its calibration."""
    turned = Rotation.from_euler("y", 0.05).as_matrix()
    return {
        **{f"/cam/{name}": images("cam", "mono8" if "mono" in name else "rgb8") for name in names},
        "/cam/camera_info": infos("cam", COLOUR_K, LENS, RECTIFIED_K, turned),
    }


def test_of_raw_and_rectified_images_one_stream_is_taken(tmp_path: Path) -> None:
    """The one as taken, with its lens; it is told how to have the other."""
    names = ("image_raw", "image_mono", "image_rect", "image_rect_color")
    reader = sets.reader(bags.write(tmp_path, pipeline(*names)))
    (camera,) = cameras(reader).values()
    assert (camera.info.distortion, camera.info.fx) == (LENS, COLOUR_K[0])
    stamps = [event.stamp for event in events(reader)]
    assert len(stamps) == len(set(stamps)) == bags.FRAMES
    for name in names[1:]:
        (note,) = (n for n in reader.notes if n.startswith(f"/cam/{name}: "))
        assert "same camera as /cam/image_raw" in note
        assert "name them in topics" in note
    reader.close()


@pytest.mark.parametrize("named", [False, True])
def test_rectified_images_are_those_of_a_pinhole(tmp_path: Path, named: bool) -> None:
    """Of the left of P, and turned by R: nothing rectifies them a second time."""
    topics = pipeline("image_rect_color", *(["image_raw"] if named else []))
    wanted = [
        {"topic": "/cam/image_rect_color", "as": "image"},
        {"topic": "/cam/camera_info", "as": "camera"},
    ]
    reader = sets.reader(bags.write(tmp_path, topics), topics=wanted if named else [])
    (camera,) = cameras(reader).values()
    assert camera.info.is_pinhole
    assert (camera.info.fx, camera.info.cx) == (RECTIFIED_K[0], RECTIFIED_K[2])
    turned = pose_matrix(camera.position, camera.orientation)[:3, :3]
    ahead = pose_matrix((0, 0, 0), OPTICAL_TO_FRD)[:3, :3]
    # A point in the rectified frame is R times that in the camera's.
    np.testing.assert_allclose(
        turned @ Rotation.from_euler("y", 0.05).as_matrix(), ahead, atol=1e-9
    )
    reader.close()


def test_two_named_topics_of_one_source_are_said(tmp_path: Path) -> None:
    """Who names both raw and rectified images gets both."""
    wanted = [{"topic": f"/cam/{name}", "as": "image"} for name in ("image_raw", "image_rect")]
    reader = sets.reader(bags.write(tmp_path, pipeline("image_raw", "image_rect")), topics=wanted)
    assert "expected one stream of images, found /cam/image_raw, /cam/ima" in reader.trouble[0]
    reader.close()


def test_two_cameras_in_one_namespace_stay_two(tmp_path: Path) -> None:
    """As the event cameras of UZH-FPV, /snappy_cam/stereo_l and stereo_r."""
    topics = {f"/snappy_cam/stereo_{side}": images(side, "mono8") for side in "lr"}
    topics |= {f"/snappy_cam/stereo_{side}/camera_info": infos(side) for side in "lr"}
    reader = sets.reader(bags.write(tmp_path, topics))
    assert set(cameras(reader)) == {"drone/snappy_cam/stereo_l", "drone/snappy_cam/stereo_r"}
    reader.close()


def test_zeds_and_oaks_depth_is_that_of_the_camera_in_its_frame(tmp_path: Path) -> None:
    left, oak = "zed_left_camera_optical_frame", "oak_rgb_camera_optical_frame"
    topics = {
        "/zed/zed_node/rgb/image_rect_color": images(left, "rgb8"),
        "/zed/zed_node/rgb/camera_info": infos(left),
        "/zed/zed_node/depth/depth_registered": images(left, "32FC1"),
        "/zed/zed_node/depth/camera_info": infos(left),
        "/oak/rgb/image_raw": images(oak, "bgr8"),
        "/oak/rgb/camera_info": infos(oak, DEPTH_K),
        "/oak/stereo/image_raw": images(oak, "16UC1"),
        "/oak/stereo/camera_info": infos(oak, DEPTH_K),
    }
    reader = sets.reader(bags.write(tmp_path, topics))
    kinds = {name: camera.images for name, camera in cameras(reader).items()}
    assert kinds == {"drone/zed/zed_node": ("rgb", "depth"), "drone/oak": ("rgb", "depth")}
    reader.close()


def test_one_camera_that_cannot_be_read_leaves_the_others(tmp_path: Path) -> None:
    """It is named, with the reason and what to do."""
    topics = realsense() | {
        "/usb/image_raw": images("usb", "yuv422"),
        "/usb/camera_info": infos("usb"),
        "/raw/image_raw": images("raw", "mono8"),
        "/raw/camera_info": infos("raw", (0.0, 0.0, 0.0, 0.0)),
    }
    reader = sets.reader(bags.write(tmp_path, topics))
    by_source = cameras(reader)
    assert "drone/camera" in by_source
    assert not {"drone/usb", "drone/raw"} & set(by_source)
    trouble = "\n".join(reader.trouble)
    assert re.search(r"/usb/image_raw: left out: its encoding 'yuv422' .* convert it to", trouble)
    assert re.search(
        r"/raw/camera_info: left out: expected a calibrated .* the setting calibration", trouble
    )
    sources = {event.source for event in events(reader)}
    assert {"drone/camera", "drone/raw"} <= sources
    assert "drone/usb" not in sources
    reader.close()


def test_a_transform_that_is_none_is_left_out_by_name(tmp_path: Path) -> None:
    ahead = tuple(Rotation.from_euler("z", 90, degrees=True).as_quat())
    topics = {
        "/imu": imus("imu_link"),
        "/tf_static": fixed(
            ("base_link", "cam", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)),
            ("base_link", "imu_link", (0.1, 0.0, 0.0), ahead),
        ),
    }
    reader = sets.reader(bags.write(tmp_path, topics))
    (told,) = reader.trouble
    assert told.startswith("/tf_static: cam is left out: expected a quaternion of length one")
    (imu,) = reader.announcements()
    assert isinstance(imu, ImuAnnouncement)
    assert imu.position == pytest.approx((0.1, 0.0, 0.0))
    reader.close()


def test_of_raw_images_that_cannot_be_read_the_compressed_ones_are(tmp_path: Path) -> None:
    code = np.asarray(cv2.imencode(".png", np.zeros((48, 64), np.uint8))[1], np.uint8).ravel()
    compressed = [
        bags.ROS_2.types["sensor_msgs/msg/CompressedImage"](bags.header("cam", n), "png", code)
        for n in range(bags.FRAMES)
    ]
    topics = {
        "/cam/image_raw": images("cam", "yuv422"),
        "/cam/image_raw/compressed": compressed,
        "/cam/camera_info": infos("cam"),
    }
    reader = sets.reader(bags.write(tmp_path, topics))
    assert cameras(reader)["drone/cam"].images == ("grey",)
    assert len(events(reader)) == bags.FRAMES
    assert any(message.startswith("/cam/image_raw: left out") for message in reader.trouble)
    reader.close()


@pytest.mark.parametrize(
    ("topic", "use", "wrong"),
    [
        (
            "/usb/image_raw",
            "image",
            r"topics: /usb/image_raw: encoding: expected one of .*'yuv422'",
        ),
        ("/raw/camera_info", "camera", "topics: /raw/camera_info: expected a calibrated camera"),
    ],
)
def test_what_the_settings_name_has_to_be_readable(
    tmp_path: Path, topic: str, use: str, wrong: str
) -> None:
    path = bags.write(
        tmp_path,
        {
            "/usb/image_raw": images("usb", "yuv422"),
            "/raw/image_raw": images("raw", "mono8"),
            "/raw/camera_info": infos("raw", (0.0, 0.0, 0.0, 0.0)),
        },
    )
    wanted = [{"topic": topic, "as": use}, {"topic": "/raw/image_raw", "as": "image"}]
    with pytest.raises(ReplayError, match=wrong):
        sets.reader(path, topics=wanted)


def test_a_bag_of_which_nothing_can_be_read_is_an_error_with_the_reasons(tmp_path: Path) -> None:
    path = bags.write(tmp_path, {"/usb/image_raw": images("usb", "yuv422")})
    with pytest.raises(ReplayError, match=r"found: /usb/image_raw .*; /usb/image_raw: left out: "):
        sets.reader(path)


def test_messages_that_lie_of_their_size_leave_nothing(tmp_path: Path) -> None:
    """The calibration that is left is nothing to replay."""
    broken = images("cam", "mono8")
    for message in broken:
        message.data = message.data[:-1]
    path = bags.write(tmp_path, {"/cam/image_raw": broken, "/cam/camera_info": infos("cam")})
    wrong = r"expected a topic to replay; /cam/image_raw: left out: expected height \* step bytes"
    with pytest.raises(ReplayError, match=wrong):
        sets.reader(path)


def test_bayer_and_grey_of_sixteen_bits_are_images(tmp_path: Path) -> None:
    mosaic = np.tile(np.array([[200, 100], [100, 50]], np.uint8), (24, 32))
    grey = np.full((48, 64), 0x4080, np.uint16)
    topics = {
        "/bayer/image_raw": images("bayer", "bayer_rggb8", mosaic),
        "/bayer/camera_info": infos("bayer"),
        "/deep/image_raw": images("deep", "mono16", grey),
        "/deep/camera_info": infos("deep"),
        "/dark/image_raw": images("dark", "mono16", grey >> 4),
        "/dark/camera_info": infos("dark"),
    }
    reader = sets.reader(bags.write(tmp_path, topics))
    kinds = {name: camera.images for name, camera in cameras(reader).items()}
    assert kinds == {"drone/bayer": ("rgb",), "drone/deep": ("grey",), "drone/dark": ("grey",)}
    data = {event.source: event.data for event in events(reader) if isinstance(event, Image)}
    assert (data["drone/bayer"][2:-2, 2:-2] == (200, 100, 50)).all()
    assert (data["drone/deep"] == 0x40).all()
    (told,) = reader.trouble
    assert told.startswith("/dark/image_raw: the first image uses 11 of its 16 bits")
    reader.close()


def test_an_invalid_first_message_is_counted_and_no_end(tmp_path: Path) -> None:
    """The vehicle is where the first valid pose has it."""
    topics = {"/odom": poses((0.0, 0.0, 0.0, 0.0), UNIT, UNIT), "/imu": imus("imu")}
    reader = sets.reader(bags.write(tmp_path, topics))
    vehicle, *_ = reader.announcements()
    assert getattr(vehicle, "position", None) == (0.0, 1.0, 0.0)
    assert sum(isinstance(event, Odometry) for event in events(reader)) == 2
    assert reader.left_out == 1
    reader.close()


def test_halves_of_an_imu_are_left_out_by_name(tmp_path: Path) -> None:
    """RealSense's gyroscope sends no acceleration: as an IMU's it would be a free fall."""
    halves = ("/camera/gyro/sample", "/camera/accel/sample")
    topics = {name: imus("camera_imu_optical_frame") for name in (*halves, "/camera/imu")}
    reader = sets.reader(bags.write(tmp_path, topics))
    assert {event.source for event in events(reader)} == {"drone/camera/imu"}
    for name, text in zip(sorted(halves), sorted(reader.trouble), strict=True):
        assert text.startswith(f"{name}: left out: with /camera/")
    reader.close()


def test_a_second_odometry_is_named(tmp_path: Path) -> None:
    topics = {"/odom": poses(UNIT), "/vins/odom": poses(UNIT)}
    reader = sets.reader(bags.write(tmp_path, topics))
    assert any(note.startswith("/vins/odom: not read, as /odom is") for note in reader.notes)
    reader.close()


@pytest.mark.parametrize("written", ["cam0/image_raw", "/cam0/image_raw"])
@pytest.mark.parametrize("named", ["cam0/image_raw", "/cam0/image_raw"])
def test_topics_are_named_with_or_without_the_slash(
    tmp_path: Path, written: str, named: str
) -> None:
    """Bags of ROS 1 have both."""
    messages = images("cam0", "mono8", store=bags.ROS_1)
    path = bags.write_ros1(tmp_path / "a.bag", {written: messages})
    reader = sets.reader(path, topics=[{"topic": named, "as": "image"}])
    received = events(reader)
    assert [event.source for event in received] == ["drone/cam0"] * bags.FRAMES
    reader.close()


def test_a_folder_with_one_bag_in_it_is_that_bag(tmp_path: Path) -> None:
    """With several, it is said what to do."""
    folder = tmp_path / "flights"
    folder.mkdir()
    messages = {"/cam0/image_raw": images("cam0", "mono8", store=bags.ROS_1)}
    bags.write_ros1(folder / "one.bag", messages)
    reader = sets.reader(folder)
    assert len(events(reader)) == bags.FRAMES
    reader.close()
    bags.write_ros1(folder / "two.bag", messages)
    wrong = r"flights: expected one bag, .*metadata.yaml .*found 2 bags: one.bag, two.bag; name one"
    with pytest.raises(ReplayError, match=wrong):
        sets.reader(folder)


def test_an_imu_is_where_the_fixed_transforms_have_it(tmp_path: Path) -> None:
    """In a body of ours, with the axes of its events."""
    turn = Rotation.from_euler("z", 90, degrees=True)
    topics = {
        "/imu": imus("imu_link"),
        "/tf_static": fixed(("base_link", "imu_link", (0.1, 0.2, 0.3), tuple(turn.as_quat()))),
    }
    reader = sets.reader(bags.write(tmp_path, topics))
    (imu,) = (a for a in reader.announcements() if isinstance(a, ImuAnnouncement))
    assert imu.position == pytest.approx((0.1, -0.2, -0.3))
    (event, *_) = (event for event in events(reader) if isinstance(event, Imu))
    body = pose_matrix((0, 0, 0), imu.orientation)[:3, :3] @ event.linear_acceleration
    in_ros = turn.apply((1.0, 2.0, 3.0))
    assert body == pytest.approx(in_ros * (1.0, -1.0, -1.0))
    reader.close()


def chain_files(folder: Path) -> list[str]:
    """Return a published calibration as files, of images of 64 × 48 pixels."""
    (folder / "camchain.yaml").write_text(CHAIN.replace("[512, 512]", "[64, 48]"))
    (folder / "imu.yaml").write_text(IMU)
    return [str(folder / name) for name in ("camchain.yaml", "imu.yaml")]


@pytest.mark.parametrize("axes", ["imu4", "imu_optical_frame"])
def test_kalibrs_calibration_takes_the_place_of_what_a_bag_says(tmp_path: Path, axes: str) -> None:
    """A point on the IMU's axis is where T_cam_imu has it, whatever axes its events have."""
    topics = {f"/cam{n}/image_raw": images(f"cam{n}", "mono8") for n in (0, 1)}
    topics["/cam0/camera_info"] = infos("cam0", (0.0, 0.0, 0.0, 0.0))
    topics["/imu0"] = imus(axes)
    shifted = "  timeshift_cam_imu: 0.004\n"
    files = chain_files(tmp_path)
    text = Path(files[0]).read_text().replace("cam1:\n", f"{shifted}cam1:\n")
    Path(files[0]).write_text(text)
    reader = sets.reader(bags.write(tmp_path, topics), calibration=files)
    left, right = cameras(reader).values()
    assert reader.trouble == []
    assert any(note.endswith("calibration of the settings") for note in reader.notes)
    assert (left.source, right.source) == ("drone/cam0", "drone/cam1")
    assert left.info.distortion_model == "equidistant"
    assert (left.time_offset, right.time_offset) == (-0.004, 0.0)
    assert right.stereo == left.source
    assert right.baseline == pytest.approx(0.1009, abs=1e-4)
    (imu,) = (a for a in reader.announcements() if isinstance(a, ImuAnnouncement))
    assert (imu.gyroscope_noise_density, imu.rate) == (8e-5, 200.0)
    # A force of the raw (1, 2, 3) is, in the camera, the rotation of T_cam_imu times that.
    event = next(event for event in events(reader) if isinstance(event, Imu))
    in_body = pose_matrix(imu.position, imu.orientation)[:3, :3] @ event.linear_acceleration
    in_camera = inverse(pose_matrix(left.position, left.orientation))[:3, :3] @ in_body
    rotation = np.array(
        [
            [-0.9995378259923383, 0.02917807204183088, -0.008530798463872679],
            [0.007526588843243184, -0.03435493139706542, -0.9993813532126198],
            [-0.029453096117288798, -0.9989836729399656, 0.034119442089241274],
        ]
    )
    assert in_camera == pytest.approx(rotation @ (1.0, 2.0, 3.0))
    reader.close()


@pytest.mark.parametrize("form", ["kalibr", "openvins"])
def test_our_own_calibration_says_of_our_own_bag_what_it_says_itself(
    tmp_path: Path, form: str
) -> None:
    """Exported for the topics of a recording: places, lens and noise come back."""
    path = sets.bag(tmp_path)
    itself = sets.reader(path)
    flown = sets.reader(sets.recording(tmp_path))
    rig = choose(flown.announcements(), None)
    assert rig.imu is not None
    calibrations = []
    for name, text in write_files(rig, form).items():
        if "estimator" not in name:
            calibrations.append(str(tmp_path / name))
            (tmp_path / name).write_text(text)
    reader = sets.reader(path, calibration=calibrations)
    (one,), (other,) = cameras(itself).values(), cameras(reader).values()
    assert other.info == one.info == rig.cameras[0].info
    assert other.position == pytest.approx(one.position, abs=1e-9)
    assert abs(np.dot(other.orientation, one.orientation)) == pytest.approx(1.0, abs=1e-9)
    assert (other.source, other.images) == (one.source, one.images)
    (imu,) = (a for a in reader.announcements() if isinstance(a, ImuAnnouncement))
    assert imu.gyroscope_random_walk == rig.imu.gyroscope_random_walk
    for opened in (itself, flown, reader):
        opened.close()


def test_a_chain_without_an_imu_begins_where_the_first_camera_is(tmp_path: Path) -> None:
    start, end = CHAIN.index("  T_cam_imu"), CHAIN.index("  cam_overlaps")
    second = CHAIN.index("  T_cam_imu", end)
    text = CHAIN[:start] + CHAIN[end:second] + CHAIN[CHAIN.index("  T_cn_cnm1") :]
    path = tmp_path / "camchain.yaml"
    path.write_text(text.replace("[512, 512]", "[64, 48]"))
    w, x, y, z = OPTICAL_TO_FLU
    topics = {f"/cam{n}/image_raw": images(f"cam{n}", "mono8") for n in (0, 1)}
    topics["/tf_static"] = fixed(("base_link", "cam0", (1.0, 0.0, 0.0), (x, y, z, w)))
    reader = sets.reader(bags.write(tmp_path, topics), calibration=[str(path)])
    left, right = cameras(reader).values()
    assert left.position == pytest.approx((1.0, 0.0, 0.0))
    assert left.orientation == pytest.approx(OPTICAL_TO_FRD)
    assert right.position == pytest.approx((1.0014, 0.1009, 0.0020), abs=3e-3)
    reader.close()


def test_a_calibration_of_other_topics_or_sizes_is_refused(tmp_path: Path) -> None:
    files = chain_files(tmp_path)
    path = bags.write(tmp_path, {"/other/image_raw": images("o", "mono8")})
    with pytest.raises(ReplayError, match=r"set rostopic to one of /other/image_raw"):
        sets.reader(path, calibration=files)
    (tmp_path / "second").mkdir()
    path = bags.write(tmp_path / "second", {"/cam0/image_raw": images("o", "mono8", size=(32, 48))})
    with pytest.raises(
        ReplayError, match=r"expected images of 64 x 48 .*cam0 is of, found 32 x 48"
    ):
        sets.reader(path, calibration=files)
    with pytest.raises(ReplayError, match=r"calibration: .*none.yaml: expected Kalibr's YAML"):
        sets.reader(path, calibration=[str(tmp_path / "none.yaml")])
