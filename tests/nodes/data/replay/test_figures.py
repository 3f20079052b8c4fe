"""What a recording says comes out in our frames and units, figure by figure."""

from __future__ import annotations

from datetime import date
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from events import (
    CameraAnnouncement,
    DepthImage,
    Event,
    Image,
    Imu,
    ImuAnnouncement,
    Odometry,
    PoseStamped,
    VehicleAnnouncement,
)
from events.frames import rotate
from events.geometry import pose_matrix
from nodes.data.dataset.layouts import Euroc, TumRgbd
from nodes.data.dataset.recording import choose, in_grey
from nodes.data.replay.folders import read_sensor
from nodes.data.replay.node import open_reader
from nodes.data.replay.reader import Choice, Reader, ReplayConfig, ReplayError
from nodes.trajectory_files import epoch_of
from tests.nodes.data.dataset.samples import (
    camera,
    depth,
    image,
    imu,
    imu_announcement,
    odometry,
    pose,
)
from tests.nodes.data.replay import sets

E = TypeVar("E", bound=Event)

ALL = Choice(("Event",))


def of(reader: Reader, kind: type[E]) -> list[E]:
    events = [record.event for record in reader.events(0, None, ALL)]
    return [event for event in events if isinstance(event, kind)]


def announced(reader: Reader, kind: type[E]) -> E:
    (only,) = (a for a in reader.announcements() if isinstance(a, kind))
    return only


@pytest.fixture(scope="module")
def euroc(tmp_path_factory: pytest.TempPathFactory) -> Reader:
    return sets.reader(sets.euroc_as_published(tmp_path_factory.mktemp("euroc")))


@pytest.fixture(scope="module")
def tum(tmp_path_factory: pytest.TempPathFactory) -> Reader:
    return sets.reader(sets.tum_as_published(tmp_path_factory.mktemp("tum")))


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return sets.bag(tmp_path_factory.mktemp("bag"))


def test_eurocs_camera_is_calibrated_and_mounted(euroc: Reader) -> None:
    """Its figures are those of the published sensor.yaml."""
    camera = announced(euroc, CameraAnnouncement)
    assert (camera.source, camera.images, camera.rate) == ("drone/cam0", ("grey",), 20.0)
    info = camera.info
    assert (info.width, info.height, info.fx, info.cy) == (752, 480, 458.654, 248.375)
    assert info.distortion == (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0)
    matrix = pose_matrix(camera.position, camera.orientation)
    assert matrix[:3, 3].tolist() == [-0.0216401454975, -0.064676986768, 0.00981073058949]
    assert matrix[0, :3] == pytest.approx([0.0148655429818, -0.999880929698, 0.00414029679422])


def test_eurocs_imu_has_its_noise_and_figures(euroc: Reader) -> None:
    """Stamps count from the first of all sensors, and keep their nanoseconds."""
    noise = announced(euroc, ImuAnnouncement)
    assert (noise.rate, noise.gyroscope_random_walk) == (200.0, 1.9393e-05)
    first, second = of(euroc, Imu)
    assert (first.stamp, second.stamp) == (0, 5_000_192)
    assert first.angular_velocity[0] == -0.099134701513277898
    assert second.linear_acceleration[1] == -0.40861041666666664
    assert [image.stamp for image in of(euroc, Image)] == [5_000_192, 55_000_192]


def test_eurocs_truth_is_in_ned(euroc: Reader) -> None:
    """What the accelerometer feels in it points up, as it must at rest."""
    (truth,) = of(euroc, Odometry)
    assert truth.position == (4.688319, 1.786938, -0.783338)
    force = of(euroc, Imu)[0].linear_acceleration
    felt = np.array(rotate(truth.orientation, force))
    assert felt[2] / np.linalg.norm(felt) < -0.95
    back = rotate(truth.orientation, truth.linear_velocity)
    assert back == pytest.approx((-0.027876, -0.033207, -0.800006), abs=1e-5)
    assert announced(euroc, VehicleAnnouncement).position == truth.position


def test_tums_depth_has_its_colours_stamp(tum: Reader) -> None:
    """The nearest within 20 ms, as associate.py takes it; one that has none is told."""
    colours, depths = of(tum, Image), of(tum, DepthImage)
    assert [d.stamp for d in depths] == [c.stamp for c in colours[:3]]
    assert colours[1].stamp - colours[0].stamp == 35_910_000
    assert colours[0].data[0, 0].tolist() == [30, 20, 10]
    assert depths[0].data[0, 1] == 1.0
    assert np.isinf(depths[0].data[0, 0])
    assert tum.trouble == ["1 depth images have no colour image near them"]


def test_tums_camera_is_as_said_and_never_guessed(tum: Reader, tmp_path: Path) -> None:
    """An odometry with the wrong focal length is off by as much, and nobody would know."""
    info = announced(tum, CameraAnnouncement).info
    assert (info.width, info.fx, info.cx, info.cy) == (640, 525.0, 319.5, 239.5)
    path = sets.tum_as_published(tmp_path)
    with pytest.raises(ReplayError, match=r"xyz: expected a camera\.yaml .* write camera = \{ fx"):
        open_reader(ReplayConfig(file=str(path)), "replay")
    pinhole = {"fx": 517.3, "fy": 516.5, "cx": 318.6, "cy": 255.3}
    reader = sets.reader(path, camera=pinhole, depth_factor=1000.0)
    assert announced(reader, CameraAnnouncement).info.fx == 517.3
    assert of(reader, DepthImage)[0].data[0, 1] == 5.0


def test_tums_truth_is_in_ned(tum: Reader) -> None:
    """The camera's pose, and that of a body whose x axis is the camera's view."""
    poses, bodies = of(tum, PoseStamped), of(tum, Odometry)
    assert poses[0].position == bodies[0].position == (1.3563, -0.6305, -1.6380)
    raw = Rotation.from_quat([0.6132, 0.5962, -0.3311, -0.3986])
    view = raw.apply([0.0, 0.0, 1.0]) * [1.0, -1.0, -1.0]
    assert rotate(poses[0].orientation, (0.0, 0.0, 1.0)) == pytest.approx(view, abs=1e-3)
    assert rotate(bodies[0].orientation, (1.0, 0.0, 0.0)) == pytest.approx(view, abs=1e-3)
    down = raw.apply([0.0, 1.0, 0.0]) * [1.0, -1.0, -1.0]
    assert rotate(bodies[0].orientation, (0.0, 0.0, 1.0)) == pytest.approx(down, abs=1e-3)


def test_our_own_euroc_comes_back(tmp_path: Path) -> None:
    """Truth to the nanometre, images in grey, depth to its step."""
    reader = sets.reader(sets.euroc(tmp_path))
    stamp = 2 * sets.STEP
    truth, expected = of(reader, Odometry)[2], odometry(stamp)
    assert truth.stamp == stamp
    assert truth.position == pytest.approx(expected.position, abs=1e-9)
    assert truth.orientation == pytest.approx(expected.orientation, abs=1e-9)
    assert truth.linear_velocity == pytest.approx(expected.linear_velocity, abs=1e-8)
    assert of(reader, Imu)[2].linear_acceleration == imu(stamp).linear_acceleration
    assert (of(reader, Image)[2].data == in_grey(image(stamp).data)).all()
    steps = of(reader, DepthImage)[2].data
    far = depth(stamp).data > 13.107
    assert np.isinf(steps[far]).all()
    assert steps[~far] == pytest.approx(depth(stamp).data[~far], abs=1.01e-4)
    mounted = announced(reader, CameraAnnouncement)
    assert mounted.position == camera().position
    assert mounted.orientation == pytest.approx(camera().orientation)


def test_our_own_tum_comes_back(tmp_path: Path) -> None:
    """Colours to the bit, and the camera that took them."""
    reader = sets.reader(sets.tum_rgbd(tmp_path))
    assert (of(reader, Image)[1].data == image(sets.STEP).data).all()
    assert announced(reader, CameraAnnouncement).info == camera().info
    assert of(reader, PoseStamped)[0].position == pytest.approx((1.0, 2.0, -3.0), abs=1e-9)
    assert of(reader, PoseStamped)[0].orientation == pytest.approx((0.5, 0.5, 0.5, 0.5))


def test_a_bag_comes_back(bag: Path) -> None:
    """In NED and FRD, from 0 on; cameras where /tf_static has them."""
    reader = sets.reader(bag)
    stamp = 2 * sets.STEP
    truth, expected = of(reader, Odometry)[2], odometry(stamp)
    assert truth.stamp == stamp
    assert truth.position == pytest.approx(expected.position)
    same = abs(np.dot(truth.orientation, expected.orientation))
    assert same == pytest.approx(1.0)
    assert truth.linear_velocity == pytest.approx(expected.linear_velocity)
    assert of(reader, Imu)[2].linear_acceleration == imu(stamp).linear_acceleration
    assert (of(reader, Image)[2].data == image(stamp).data).all()
    assert (of(reader, DepthImage)[2].data == depth(stamp).data).all()
    mounted = announced(reader, CameraAnnouncement)
    assert mounted.source == "drone/front"
    assert mounted.position == pytest.approx(camera().position)
    turn = abs(np.dot(mounted.orientation, camera().orientation))
    assert turn == pytest.approx(1.0)
    reader.close()


@pytest.mark.slow
def test_compressed_images_of_a_bag_come_back(tmp_path: Path) -> None:
    """PNG to the bit, and depth to the millimetre."""
    reader = sets.reader(sets.compressed_bag(tmp_path))
    assert (of(reader, Image)[2].data == image(2 * sets.STEP).data).all()
    expected = depth(0).data
    there = np.isfinite(expected)
    metres = of(reader, DepthImage)[0].data
    assert np.isinf(metres[~there]).all()
    assert metres[there] == pytest.approx(expected[there], abs=5.1e-4)
    reader.close()


def test_a_bags_topics_can_be_chosen(bag: Path) -> None:
    """By the settings: a pose as the truth, and nothing else."""
    topics = [
        {"topic": "/drone/front/pose", "as": "truth", "source": "rig"},
        {"topic": "/drone/imu", "as": "imu", "source": "rig/imu", "frame_id": "body"},
    ]
    reader = sets.reader(bag, topics=topics)
    events = [record.event for record in reader.events(0, None, ALL)]
    reader.close()
    assert {(type(e), e.source) for e in events} == {(Odometry, "rig"), (Imu, "rig/imu")}
    assert {e.frame_id for e in events if isinstance(e, Imu)} == {"body"}


@pytest.mark.parametrize(
    ("topic", "use", "wrong"),
    [
        ("/drone/od", "odometry", r"found '/drone/od'.*did you mean '/drone/odom'"),
        ("/drone/imu", "image", r"/drone/imu: expected sensor_msgs/msg/Image .* found sensor_msgs"),
    ],
)
def test_a_wrong_choice_of_topics_is_an_error(bag: Path, topic: str, use: str, wrong: str) -> None:
    """It says what there is."""
    with pytest.raises(ReplayError, match=wrong):
        sets.reader(bag, topics=[{"topic": topic, "as": use}])


@pytest.mark.parametrize(
    ("old", "new", "wrong"),
    [
        ("intrinsics: [458.654, ", "intrinsics: [", "intrinsics: expected 4 numbers, found"),
        ("rate_hz: 20", "rate_hz: often", "rate_hz: expected a number, found often"),
        ("radial-tangential", "fov", "expected one of radial-tangential, equidistant, found 'fov'"),
        ("1.0]\n\n# Camera", "x]\n\n# Camera", "data: expected numbers"),
    ],
)
def test_a_damaged_description_is_an_error(tmp_path: Path, old: str, new: str, wrong: str) -> None:
    """It names file and key."""
    folder = sets.euroc_as_published(tmp_path)
    file = folder / "mav0" / "cam0" / "sensor.yaml"
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))
    with pytest.raises(ReplayError, match=rf"cam0/sensor\.yaml.*{wrong}"):
        sets.reader(folder)
    with pytest.raises(ReplayError, match="missing"):
        read_sensor(tmp_path / "missing")


def test_a_damaged_orientation_of_the_truth_is_an_error_of_its_line(tmp_path: Path) -> None:
    folder = sets.euroc_as_published(tmp_path)
    file = folder / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    head, row = file.read_text().splitlines()[:2]
    cells = row.split(",")
    file.write_text("\n".join([head, ",".join([*cells[:4], "0.9", "0", "0", "0", *cells[8:]]), ""]))
    with pytest.raises(ReplayError, match=r"data\.csv:2: expected a quaternion of length 1"):
        sets.reader(folder)


def test_a_missing_image_is_an_error_when_its_turn_comes(tmp_path: Path) -> None:
    """It names the file."""
    folder = sets.euroc_as_published(tmp_path)
    last = sorted((folder / "mav0" / "cam0" / "data").iterdir())[-1]
    last.write_bytes(b"no image")
    reader = sets.reader(folder)
    with pytest.raises(ReplayError, match=rf"{last.name}: expected an image"):
        of(reader, Image)


def cut(path: Path, count: int) -> None:
    """Take the last bytes of a file away."""
    path.write_bytes(path.read_bytes()[:-count])


@pytest.mark.parametrize("count", [1, 8])
@pytest.mark.parametrize(
    ("build", "index", "truth", "images"),
    [
        (sets.euroc, "cam0/data.csv", "state_groundtruth_estimate0/data.csv", "cam0/data"),
        (sets.tum_rgbd, "rgb.txt", "groundtruth.txt", "rgb"),
    ],
)
def test_rows_that_a_killed_run_cut_off_are_left_out_and_told(
    build: Any, index: str, truth: str, images: str, count: int, tmp_path: Path
) -> None:
    """A row without its end may lack digits; an image that is listed may lack its file."""
    folder = build(tmp_path)
    root = folder / "mav0" if (folder / "mav0").is_dir() else folder
    cut(root / index, count)
    cut(root / truth, count)
    sorted((root / images).iterdir())[1].unlink()
    reader = sets.reader(folder)
    assert [image.stamp for image in of(reader, Image)] == [0]
    assert max(pose.stamp for pose in of(reader, Odometry)) < 2 * sets.STEP
    assert {*reader.trouble} >= {
        f"{root / index}: the last line is cut off, and left out",
        f"{root / images}: 1 listed images are missing, and left out",
        f"{root / truth}: the last line is cut off, and left out",
    }


def test_a_last_line_of_others_needs_no_end(tmp_path: Path) -> None:
    folder = sets.euroc_as_published(tmp_path)
    path = folder / "mav0" / "imu0" / "data.csv"
    path.write_text(path.read_text().rstrip())
    reader = sets.reader(folder)
    assert len(of(reader, Imu)) == 2
    assert not reader.trouble


@pytest.mark.slow
@pytest.mark.parametrize("layout", ["euroc", "tum_rgbd"])
@given(
    start=st.integers(0, 10**13),
    gaps=st.lists(st.integers(1, 10**12), min_size=1, max_size=4),
    epoch=st.one_of(st.integers(0, 7 << 60), st.dates(date(1970, 1, 1), date(2200, 1, 1))),
)
@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_every_stamp_of_a_data_set_comes_back(
    tmp_path_factory: pytest.TempPathFactory,
    layout: str,
    start: int,
    gaps: list[int],
    epoch: int | date,
) -> None:
    """To the nanosecond, whatever the epoch, and though the flight did not begin at 0."""
    stamps = [start + sum(gaps[:n]) for n in range(len(gaps) + 1)]
    rig = choose([imu_announcement(), camera()], None)
    folder = tmp_path_factory.mktemp("set")
    zero = epoch_of(epoch if isinstance(epoch, int) else str(epoch))
    recording = (Euroc if layout == "euroc" else TumRgbd)(folder, rig, 5000.0, zero)
    for stamp in stamps:
        for file in (recording.image(image(stamp)), recording.depth(depth(stamp))):
            assert file is not None
            file()
        recording.imu(imu(stamp))
        recording.odometry(odometry(stamp))
        recording.pose(pose(stamp))
    recording.close()
    reader = sets.reader(folder)
    for kind in (Image, DepthImage, Odometry):
        assert [event.stamp for event in of(reader, kind)] == stamps


@pytest.mark.slow
@pytest.mark.parametrize("build", [sets.euroc_as_published, sets.tum_as_published])
def test_truth_beyond_the_sensors_is_no_part_of_a_flight(build: Any, tmp_path: Path) -> None:
    """An estimator could see nothing then, and is not to be charged for that."""
    path = build(tmp_path)
    truth = next(
        path.rglob("*groundtruth*.txt" if path.name.startswith("rgbd") else "*estimate0/*")
    )
    first, *_, pose_row = truth.read_text().splitlines()
    sensors = [event.stamp for event in of(sets.reader(path), Image)]
    origin = 1305031098_665900000 if path.name.startswith("rgbd") else 1403636579758555392
    rows = []
    for stamp in range(-10_000_000_000, 20_000_000_000, 50_000_000):
        at = origin + stamp
        text = f"{at // 10**9}.{at % 10**9:09d}" if path.name.startswith("rgbd") else str(at)
        separator = " " if path.name.startswith("rgbd") else ","
        rows.append(separator.join([text, *pose_row.split(separator)[1:]]))
    truth.write_text("\n".join([first, *rows]) + "\n")
    reader = sets.reader(path)
    images, poses = of(reader, Image), of(reader, Odometry)
    assert len(images) == len(sensors)
    assert poses[0].stamp <= images[0].stamp
    assert images[-1].stamp <= poses[-1].stamp < images[-1].stamp + 50_000_000
    assert min(images[0].stamp, poses[0].stamp) < 60_000_000


@pytest.mark.slow
@pytest.mark.parametrize("build", [sets.euroc, sets.tum_rgbd])
@given(data=st.data())
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_damaged_texts_are_errors_of_one_line(
    build: Any, data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Whichever file is cut or changed, and wherever."""
    path = tmp_path_factory.getbasetemp() / f"fuzzed_{build.__name__}"
    if not path.exists():
        build(path)
    files = sorted(entry for entry in path.rglob("*") if entry.is_file())
    file = data.draw(st.sampled_from(files))
    whole = file.read_bytes()
    content = bytearray(whole)
    del content[data.draw(st.integers(1, len(content))) :]
    for place in data.draw(st.lists(st.integers(0, len(content) - 1), max_size=3)):
        content[place] = data.draw(st.integers(0, 255))
    file.write_bytes(content)
    wrong = ""
    try:
        reader = sets.reader(path / "dataset")
        list(reader.events(0, None, Choice()))
    except ReplayError as error:
        wrong = str(error)
    finally:
        file.write_bytes(whole)
    assert "\n" not in wrong
