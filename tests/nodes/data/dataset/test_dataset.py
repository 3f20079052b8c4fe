"""What a recorded run leaves: every file of the two layouts, with nothing lost."""

from __future__ import annotations

import logging
import math
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from evo.tools import file_interface
from scipy.spatial.transform import Rotation

from events import Announcement, CameraAnnouncement, Event, ImuAnnouncement, Odometry, Shutdown
from events.frames import from_rpy, rotate
from nodes.data.dataset import DatasetWriter
from nodes.data.dataset.recording import ImageFile, RowFile
from nodes.data.replay.node import open_reader
from nodes.data.replay.reader import ReplayConfig
from nodes.trajectory_files import read_euroc, read_tum
from runtime.errors import ConfigError, FatalError, NodeError
from runtime.testing import NodeResult, run_node, run_nodes, spec
from tests.nodes.data.dataset.samples import (
    camera,
    depth,
    flight,
    image,
    imu,
    imu_announcement,
    odometry,
    png,
    pose,
    table,
    yaml,
)

TURNED = from_rpy(0.1, -0.2, 0.3)
STAMPS = ["1577836800000000000", "1577836800030000000", "1577836800060000000"]
SECONDS = ["1577836800.000000000", "1577836800.030000000", "1577836800.060000000"]


def record(out: Path, events: list[Event], form: str, **config: Any) -> Path:
    run_node(DatasetWriter, inputs=events, out=out, config={"format": form, **config})
    return out / str(config.get("folder", "dataset"))


def narrowed(out: Path, events: list[Event], form: str, source: str) -> NodeResult:
    node = spec(DatasetWriter, "data", {"format": form}, inputs={"images": source})
    return run_nodes([node], inputs=events, out=out)


def names(folder: Path) -> set[str]:
    return {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}


def test_tum_rgbd_has_its_files(tmp_path: Path) -> None:
    data = record(tmp_path, flight(), "tum_rgbd")
    images = {f"{kind}/{s}.png" for kind in ("rgb", "depth") for s in SECONDS}
    texts = {"rgb", "depth", "associations", "groundtruth", "accelerometer"}
    assert names(data) == {*images, *(f"{name}.txt" for name in texts), "camera.yaml"}
    assert table(data / "rgb.txt") == [[s, f"rgb/{s}.png"] for s in SECONDS]
    assert table(data / "depth.txt") == [[s, f"depth/{s}.png"] for s in SECONDS]
    pairs = [[s, f"rgb/{s}.png", s, f"depth/{s}.png"] for s in SECONDS]
    assert table(data / "associations.txt") == pairs
    assert [row[0] for row in table(data / "accelerometer.txt")] == SECONDS


def test_tum_rgbd_has_what_the_events_said(tmp_path: Path) -> None:
    data = record(tmp_path, flight(), "tum_rgbd")
    for text, stamp in zip(SECONDS, (0, 30_000_000, 60_000_000), strict=True):
        assert (png(data / "rgb" / f"{text}.png") == image(stamp).data).all()
        deep = png(data / "depth" / f"{text}.png")
        assert deep.dtype == np.uint16
        assert (deep[0, :3].tolist(), deep[2, 3]) == ([0, 65500, 0], 7500)
    truth = read_tum(data / "groundtruth.txt")
    assert truth.positions[0].tolist() == [1.0, -2.0, 3.0]
    # The optical axis points north, the images' right east: minus west.
    assert truth.matrices()[0, :3, :3] == pytest.approx(
        np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    )
    assert table(data / "accelerometer.txt")[0][1:] == [
        "0.000000000",
        "0.000000000",
        "-9.810000000",
    ]
    lens = yaml(data / "camera.yaml")
    assert (lens["width"], lens["height"], lens["depth_factor"]) == (4, 3, 5000.0)
    assert [lens[key] for key in ("fx", "fy", "cx", "cy")] == [5.0, 5.5, 1.5, 1.0]


def test_heads_of_tum_files_are_three_lines_and_name_the_world(tmp_path: Path) -> None:
    data = record(tmp_path, flight(), "tum_rgbd")
    for name in ("rgb", "depth", "groundtruth", "accelerometer"):
        lines = (data / f"{name}.txt").read_text().splitlines()
        assert [line.startswith("# ") for line in lines[:4]] == [True, True, True, False], name
    assert "z up" in (data / "groundtruth.txt").read_text()
    evos = file_interface.read_tum_trajectory_file(str(data / "groundtruth.txt"))
    assert evos.check()[0]


def test_images_and_depth_without_a_partner_are_in_no_pair(tmp_path: Path) -> None:
    events = [e for e in flight(4) if not (e.stamp == 30_000_000 and type(e).__name__ == "Image")]
    events = [
        e for e in events if not (e.stamp and e.stamp < 90_000_000 and "pth" in repr(type(e)))
    ]
    data = record(tmp_path, events, "tum_rgbd")
    stamps = [row[0] for row in table(data / "associations.txt")]
    assert stamps == [SECONDS[0], "1577836800.090000000"]


def test_euroc_has_its_files(tmp_path: Path) -> None:
    data = record(tmp_path, flight(), "euroc")
    cameras = {
        f"mav0/{name}/{file}"
        for name in ("cam0", "depth0")
        for file in (*(f"data/{s}.png" for s in STAMPS), "data.csv", "sensor.yaml")
    }
    others = {
        f"mav0/{name}/{file}"
        for name in ("imu0", "state_groundtruth_estimate0")
        for file in ("data.csv", "sensor.yaml")
    }
    assert names(data) == cameras | others | {"mav0/body.yaml"}
    for name in ("cam0", "depth0"):
        assert table(data / "mav0" / name / "data.csv") == [[s, f"{s}.png"] for s in STAMPS]
    for name in ("imu0", "state_groundtruth_estimate0"):
        assert [row[0] for row in table(data / "mav0" / name / "data.csv")] == STAMPS


def test_euroc_has_what_the_events_said(tmp_path: Path) -> None:
    mav = record(tmp_path, flight(), "euroc") / "mav0"
    grey = png(mav / "cam0" / "data" / f"{STAMPS[1]}.png")
    assert (grey == cv2.cvtColor(image(30_000_000).data, cv2.COLOR_RGB2GRAY)).all()
    assert png(mav / "depth0" / "data" / f"{STAMPS[0]}.png")[0, :3].tolist() == [0, 65500, 0]
    row = [float(v) for v in table(mav / "imu0" / "data.csv")[1][1:]]
    assert row == [0.1, 0.2, 0.3, 0.0, 0.0, -9.81]
    truth = [float(v) for v in table(mav / "state_groundtruth_estimate0" / "data.csv")[0]]
    assert truth[1:4] == [1.0, -2.0, 3.0]
    # It looks east, which is minus west, and rises.
    assert truth[8:] == pytest.approx([0.0, -0.5, 1.0, *[0.0] * 6], abs=1e-9)
    body = Rotation.from_quat(truth[4:8], scalar_first=True)
    assert body.apply([1.0, 0.0, 0.0]) == pytest.approx([0.0, -1.0, 0.0])
    assert body.apply([0.0, 0.0, 1.0]) == pytest.approx([0.0, 0.0, -1.0])


def test_eurocs_settings_are_yaml(tmp_path: Path) -> None:
    mav = record(tmp_path, flight(), "euroc") / "mav0"
    cam = yaml(mav / "cam0" / "sensor.yaml")
    assert (cam["sensor_type"], cam["camera_model"], cam["rate_hz"]) == ("camera", "pinhole", 30.0)
    assert (cam["resolution"], cam["intrinsics"]) == ([4, 3], [5.0, 5.5, 1.5, 1.0])
    assert len(cam["distortion_coefficients"]) == 4
    pose_on_body = np.reshape(cam["T_BS"]["data"], (4, 4))
    assert pose_on_body @ [0, 0, 1, 1] == pytest.approx([1.15, 0.0, 0.05, 1.0])
    inertial = yaml(mav / "imu0" / "sensor.yaml")
    assert inertial["T_BS"]["data"] == np.eye(4).ravel().tolist()
    assert inertial["rate_hz"] == 200.0
    assert inertial["gyroscope_noise_density"] == 1.7e-4
    assert inertial["gyroscope_random_walk"] == 2e-5
    assert inertial["accelerometer_random_walk"] == 3e-3
    assert "drone" in yaml(mav / "body.yaml")["comment"]
    assert yaml(mav / "depth0" / "sensor.yaml")["depth_factor"] == 5000.0
    assert "z up" in yaml(mav / "state_groundtruth_estimate0" / "sensor.yaml")["comment"]


def test_evo_reads_eurocs_truth(tmp_path: Path) -> None:
    path = record(tmp_path, flight(), "euroc") / "mav0/state_groundtruth_estimate0/data.csv"
    assert file_interface.read_euroc_csv_trajectory(str(path)).check()[0]
    assert len(read_euroc(path)) == 3


def test_several_cameras_have_folders_of_their_own(tmp_path: Path) -> None:
    events: list[Event] = [
        camera("front", ("rgb", "grey", "depth")),
        camera("down", ("grey",)),
        image(0),
        image(0, "drone/front/grey", grey=True),
        image(5, "drone/down", grey=True),
        image(7, "drone/other"),
        depth(0),
        depth(7, "drone/other"),
    ]
    mav = record(tmp_path, events, "euroc") / "mav0"
    assert {p.name for p in mav.iterdir() if p.is_dir()} == {
        "cam0", "cam1", "depth0", "state_groundtruth_estimate0",
    }  # fmt: skip
    # The camera's own grey, where it gives any.
    assert (png(mav / f"cam0/data/{STAMPS[0]}.png") == image(0, grey=True).data).all()
    assert (png(mav / "cam1/data/1577836800000000005.png") == image(5, grey=True).data).all()
    assert table(mav / "depth0/data.csv") == [[STAMPS[0], f"{STAMPS[0]}.png"]]


def test_the_file_can_name_the_camera(tmp_path: Path) -> None:
    events: list[Event] = [
        camera("front"),
        camera("down", ("grey",)),
        image(0),
        image(5, "drone/down", grey=True),
        pose(0),
        pose(5, name="down"),
    ]
    narrowed(tmp_path / "a", events, "tum_rgbd", "drone/down")
    data = tmp_path / "a" / "dataset"
    assert table(data / "rgb.txt") == [["1577836800.000000005", "rgb/1577836800.000000005.png"]]
    assert len(table(data / "groundtruth.txt")) == 1
    assert not (data / "depth.txt").exists()
    narrowed(tmp_path / "b", events, "euroc", "drone/down")
    assert table(tmp_path / "b/dataset/mav0/cam0/data.csv") == [
        ["1577836800000000005", "1577836800000000005.png"]
    ]


def test_without_a_camera_the_run_ends_with_a_reason(tmp_path: Path) -> None:
    with pytest.raises(FatalError, match="expected a camera with rgb or grey images, found none"):
        record(tmp_path, [imu_announcement(), imu(0)], "euroc")
    with pytest.raises(FatalError, match=r"called drone/frnt, found drone/front \(rgb, depth\)"):
        narrowed(tmp_path, flight(), "euroc", "drone/frnt")


LENSES: dict[str, dict[str, Any]] = {
    "radtan": {"distortion": (-0.28, 0.07, 2e-4, -1e-4, 0.0)},
    "radtan with k3": {"distortion": (-0.28, 0.07, 2e-4, -1e-4, 0.01)},
    "fisheye": {"distortion_model": "equidistant", "distortion": (-0.01, 0.012, -0.008, 0.001)},
    "ideal fisheye": {"distortion_model": "equidistant", "distortion": (0.0,) * 4},
}


@pytest.mark.parametrize("form", ["euroc", "tum_rgbd"])
@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_a_replay_announces_the_lens_and_the_mounting_that_were_recorded(
    tmp_path: Path, form: str, lens: dict[str, Any]
) -> None:
    info = msgspec.structs.replace(camera().info, **lens)
    errors: dict[str, Any] = {
        "gyroscope_matrix": (1.1, 0.01, 0.0, 0.0, 0.9, 0.0, 0.0, 0.02, 1.0),
        "g_sensitivity": 1e-3,
        "vibration": 1.5,
        "averaged": True,
    }
    sensors: list[Event] = [
        msgspec.structs.replace(
            camera(), info=info, time_offset=0.06, readout=0.02, noise=2.0, vignette=(-0.5, 0.1)
        ),
        msgspec.structs.replace(
            imu_announcement(frame="drone/imu"),
            position=(0.1, 0.0, -0.02),
            orientation=TURNED,
            **errors,
        ),
    ]
    twin = msgspec.structs.replace(
        camera(), source="drone/front/undistorted", undistorted="drone/front"
    )
    events = [e for e in flight() if not isinstance(e, Announcement)]
    data = record(tmp_path, [*sensors, twin, *events], form)
    announced = {
        type(announcement): announcement
        for announcement in open_reader(
            ReplayConfig(file=str(data / "mav0" if form == "euroc" else data)), "drone"
        ).announcements()
    }
    seen = announced[CameraAnnouncement]
    assert isinstance(seen, CameraAnnouncement)
    assert seen.info == info
    # The true poses of TUM's are those of the images' stamps.
    assert (seen.time_offset, seen.readout) == (0.06 if form == "euroc" else 0.0, 0.02)
    assert (seen.noise, seen.vignette, seen.exposure) == (2.0, (-0.5, 0.1), 0.0)
    if form == "euroc":
        inertial = announced[ImuAnnouncement]
        assert isinstance(inertial, ImuAnnouncement)
        assert inertial.position == pytest.approx((0.1, 0.0, -0.02))
        assert inertial.orientation == pytest.approx(TURNED)
        assert {name: getattr(inertial, name) for name in errors} == errors
        assert not (data / "mav0" / "cam1").exists()  # the twin is no camera of its own
    else:
        force = (data / "accelerometer.txt").read_text().splitlines()[3].split()[1:]
        assert [float(f) for f in force] == pytest.approx(rotate(TURNED, (0.0, 0.0, -9.81)))


def test_a_lens_that_euroc_has_no_word_for_is_refused(tmp_path: Path) -> None:
    rational = {"distortion_model": "rational_polynomial", "distortion": (0.1,) * 8}
    info = msgspec.structs.replace(camera().info, **rational)
    with pytest.raises(FatalError, match="drone/front: expected plumb_bob or equidistant"):
        record(tmp_path, [msgspec.structs.replace(camera(), info=info)], "euroc")


@pytest.mark.parametrize(
    "announced",
    [
        [camera(parent="map")],
        [camera(), camera("arm", parent="gripper")],
        [
            msgspec.structs.replace(imu_announcement(), parent_frame_id="gimbal"),
            camera(),
        ],
    ],
)
def test_sensors_off_the_body_are_refused_for_euroc(announced: Any, tmp_path: Path) -> None:
    with pytest.raises(FatalError, match=r"expected a sensor on the body of drone/front, found it"):
        record(tmp_path, announced, "euroc")


def test_what_is_not_written_when_the_run_ends_is_written_then(tmp_path: Path) -> None:
    """A burst at one moment, and the end at the same: some wait in the stream, some to begin."""
    moment = 10**8
    burst = [image(moment - 40 + k) for k in range(40)]
    deep = [depth(moment - 40 + k) for k in range(40)]
    end = Shutdown(stamp=moment, source="script")
    events: list[Event] = [camera(), imu(moment), *burst, *deep, end]
    result = run_node(DatasetWriter, inputs=events, out=tmp_path, duration=1.0)
    assert result.seconds == 0.1
    for name in ("cam0", "depth0"):
        data = tmp_path / "dataset" / "mav0" / name
        listed = [row[1] for row in table(data / "data.csv")]
        assert len(listed) == 40
        assert {p.name for p in (data / "data").iterdir()} == {*listed}
        assert all(png(data / "data" / listed_name).shape == (3, 4) for listed_name in listed)


def test_of_a_killed_run_the_rows_are_there_but_those_of_the_last_moment(tmp_path: Path) -> None:
    rows = RowFile(tmp_path / "rows.txt", "# header\n")
    for stamp in range(0, 1_000 * 10**6, 7 * 10**6):
        rows.add(stamp, f"{stamp}\n")
        seen = (tmp_path / "rows.txt").read_text().splitlines()[1:]
        assert seen == [str(nanoseconds) for nanoseconds in range(0, int(seen[-1]) + 1, 7 * 10**6)]
        assert stamp - int(seen[-1]) < 100 * 10**6
    rows.close()


@pytest.mark.parametrize("front", [False, True])
def test_a_stereo_rig_is_found_among_other_cameras(tmp_path: Path, front: bool) -> None:
    pair = [
        msgspec.structs.replace(camera(name, images=("grey",)), position=(0.15, y, 0.05))
        for name, y in (("left", 0.0), ("right", 0.1), ("more", 0.2))
    ]
    others = [camera(images=("rgb",))] if front else []
    seen = [
        image(0, announcement.source, grey="grey" in announcement.images)
        for announcement in (*others, *pair)
    ]
    data = record(tmp_path, [*others, *pair, *seen, odometry(0)], "euroc")
    announced = open_reader(ReplayConfig(file=str(data)), "drone").announcements()
    stereo = [a.stereo for a in announced if isinstance(a, CameraAnnouncement)]
    assert stereo == (["", "", "drone/cam1", ""] if front else ["", "drone/cam0", ""])


def test_a_few_images_are_written_at_once_and_none_is_lost(tmp_path: Path) -> None:
    """A burst at one moment, and 200 images a nanosecond apart: simulated time waits."""
    at_once: list[int] = [0, 0]  # now, most

    class Watched(DatasetWriter):
        async def offload(self, fn: Any, /, *args: Any, **kwargs: Any) -> Any:
            at_once[0] += 1
            at_once[1] = max(at_once)
            try:
                return await super().offload(fn, *args, **kwargs)
            finally:
                at_once[0] -= 1

    burst = [imu(100), *(image(k) for k in range(60))]
    events = [camera(images=("rgb",)), *burst, *(image(k) for k in range(200, 400))]
    result = run_node(Watched, inputs=events, out=tmp_path, duration=0.1)
    assert len(table(tmp_path / "dataset/mav0/cam0/data.csv")) == 260
    assert len(names(tmp_path / "dataset/mav0/cam0/data")) == 260
    assert result.drops["node.images"].dropped == 0
    assert at_once[1] == 4


def test_events_out_of_order_are_left_out_and_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    events = [*flight(2), imu(5), image(5), odometry(30_000_000)]
    with caplog.at_level(logging.WARNING):
        data = record(tmp_path, events, "euroc")
    assert "3 events came out of order and are left out" in caplog.text
    assert not (data / "mav0/cam0/data/5.png").exists()
    assert [row[0] for row in table(data / "mav0/imu0/data.csv")] == STAMPS[:2]


def test_files_that_stay_empty_are_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        record(tmp_path, [camera(), image(0), depth(0)], "tum_rgbd")
    assert "nothing came for groundtruth.txt" in caplog.text


def test_an_earlier_data_set_makes_room_and_other_files_do_not(tmp_path: Path) -> None:
    record(tmp_path, flight(5), "tum_rgbd")
    data = record(tmp_path, flight(2), "euroc")
    assert {p.name for p in data.iterdir()} == {"mav0"}
    data = record(tmp_path, flight(2), "tum_rgbd")
    assert len(names(data / "rgb")) == 2
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "mine.txt").touch()
    with pytest.raises(NodeError, match=r"expected the name of a new folder, .* found .*notes"):
        record(tmp_path, flight(2), "euroc", folder="notes")
    assert names(tmp_path / "notes") == {"mine.txt"}


@pytest.mark.parametrize("folder", ["", ".", "..", "a/b", "/tmp"])
def test_the_folder_is_one_of_the_run(folder: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="folder"):
        record(tmp_path, flight(), "euroc", folder=folder)


def test_without_a_folder_for_the_run_it_writes_nothing() -> None:
    before = set(Path.cwd().iterdir())
    run_node(DatasetWriter, inputs=flight())
    assert set(Path.cwd().iterdir()) == before


def test_a_disk_that_takes_no_more_ends_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(self: ImageFile) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(ImageFile, "__call__", full)
    with pytest.raises(NodeError, match="No space left on device"):
        record(tmp_path, flight(), "euroc")


def test_a_depth_factor_is_what_it_is_written_with(tmp_path: Path) -> None:
    data = record(tmp_path, flight(1), "tum_rgbd", depth_factor=1000)
    assert png(data / f"depth/{SECONDS[0]}.png")[2, 3] == 1500
    assert math.isclose(yaml(data / "camera.yaml")["depth_factor"], 1000.0)


@pytest.mark.parametrize("form", ["euroc", "tum_rgbd"])
def test_names_sort_in_the_order_of_time_and_are_unix_time(form: str, tmp_path: Path) -> None:
    """Kalibr takes a name's last nine digits for nanoseconds, and what is before for seconds."""
    stamps = [0, 7, 999_999_999, 1_000_000_000, 10_000_000_000, 100_000_000_000]
    events: list[Event] = [imu_announcement(), camera(), *map(image, stamps)]
    run_node(DatasetWriter, inputs=events, out=tmp_path, config={"format": form}, duration=101.0)
    data = tmp_path / "dataset"
    folder = data / ("mav0/cam0/data" if form == "euroc" else "rgb")
    names = sorted(path.stem for path in folder.iterdir())
    digits = [name.replace(".", "") for name in names]
    assert [int(name[-9:]) for name in digits] == [stamp % 10**9 for stamp in stamps]
    assert [int(name[:-9]) for name in digits] == [
        1_577_836_800 + stamp // 10**9 for stamp in stamps
    ]
    noted = yaml(data / ("mav0/body.yaml" if form == "euroc" else "camera.yaml"))
    assert noted["epoch_ns"] == 1_577_836_800_000_000_000


def test_an_epoch_is_checked_with_the_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"epoch: expected nanoseconds .* found 'soon'"):
        record(tmp_path, flight(), "euroc", epoch="soon")


def test_a_velocity_that_nobody_says_is_not_called_true(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Zeros while the body moves are no velocity."""
    said = tmp_path / "said"
    unsaid = tmp_path / "unsaid"
    path = "mav0/state_groundtruth_estimate0/sensor.yaml"
    assert "as the vehicle sent" in yaml(record(said, flight(), "euroc") / path)["comment"]
    still = (0.0, 0.0, 0.0)
    events = [
        msgspec.structs.replace(
            event, linear_velocity=still, position=(event.stamp / 1e9, 0.0, 0.0)
        )
        if isinstance(event, Odometry)
        else event
        for event in flight()
    ]
    assert "velocities unknown" in yaml(record(unsaid, events, "euroc") / path)["comment"]
    assert "sent no velocity: those of the ground truth are zeros" in caplog.text


class Restarted(DatasetWriter):
    """Fails once, after the first frame."""

    async def run(self) -> None:
        if not self.restarts:
            self.start(self._fail())
        await super().run()

    async def _fail(self) -> None:
        await self.clock.sleep(0.02)
        raise RuntimeError("now")


@pytest.mark.parametrize("form", ["euroc", "tum_rgbd"])
def test_a_restart_keeps_what_was_recorded_before(form: str, tmp_path: Path) -> None:
    """What comes then is in a folder of its own, on the same clock."""
    node = spec(Restarted, "data", {"format": form}, on_error="restart")
    run_nodes([node], inputs=flight(60), out=tmp_path, duration=1.8)
    first, second = (list((tmp_path / name).rglob("*.png")) for name in ("dataset", "dataset-2"))
    index = "mav0/imu0/data.csv" if form == "euroc" else "rgb.txt"
    stamps = [
        row[0].replace(".", "")
        for name in ("dataset", "dataset-2")
        for row in table(tmp_path / name / index)
    ]
    assert first
    assert second
    assert stamps[0] == STAMPS[0]
    assert stamps == sorted(set(stamps))
    assert len(stamps) > 20
