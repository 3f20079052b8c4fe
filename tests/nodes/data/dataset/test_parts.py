"""The parts of a data set: its world, its images, its rows, its sensors."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from events import Announcement
from nodes.data.dataset.recording import ImageFile, Pixels, RowFile, choose, in_colour, in_grey
from nodes.ros2.messages.images import depth_in_steps
from tests.nodes.data.dataset.samples import camera, image, imu_announcement, png


def test_depth_that_16_bits_cannot_hold_is_none() -> None:
    depth = np.array([[0.0, 1.0, 1.23456, np.inf, np.nan, -1.0, 13.107, 13.1072]], np.float32)
    steps = depth_in_steps(depth, 5000.0)
    assert steps.dtype == np.uint16
    assert steps.tolist() == [[0, 5000, 6173, 0, 0, 0, 65535, 0]]


def test_colours_and_greys() -> None:
    colour, grey = image(1).data, image(1, grey=True).data
    assert (in_colour(colour) == colour[..., ::-1]).all()
    assert in_colour(grey) is in_grey(grey) is grey
    luma = colour @ np.array([0.299, 0.587, 0.114])
    assert abs(in_grey(colour) - luma).max() < 0.6


def test_an_image_is_written_once_however_often_it_is_asked_for(tmp_path: Path) -> None:
    calls = []

    def convert(data: Pixels) -> Pixels:
        calls.append(1)
        return data

    file = ImageFile(tmp_path / "a.png", image(1, grey=True).data, convert)
    with ThreadPoolExecutor(4) as pool:
        for done in [pool.submit(file) for _ in range(8)]:
            done.result()
    assert len(calls) == 1
    assert (png(tmp_path / "a.png") == image(1, grey=True).data).all()


def test_an_image_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    file = ImageFile(tmp_path / "missing" / "a.png", image(1).data, in_colour)
    with pytest.raises(FileNotFoundError, match=r"missing/a\.png"):
        file()


def test_an_image_is_whole_or_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def killed(self: Path, target: Path) -> None:
        assert not target.exists()
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        ImageFile(tmp_path / "a.png", image(1).data, in_colour)()
    assert not (tmp_path / "a.png").exists()


def test_rows_keep_to_the_order_of_time(tmp_path: Path) -> None:
    rows = RowFile(tmp_path / "rows.txt", "# head\n")
    assert [rows.add(stamp, f"{stamp}\n") for stamp in (5, 7, 7, 6, 8)] == [
        True, True, False, False, True,
    ]  # fmt: skip
    rows.close()
    assert (tmp_path / "rows.txt").read_text() == "# head\n5\n7\n8\n"
    assert (rows.count, rows.left_out) == (3, 2)


ANNOUNCED: list[Announcement] = [
    imu_announcement("other"),
    imu_announcement(),
    camera("lidar", ("depth",)),
    camera("front"),
    camera("down", ("grey",)),
    camera("front", body="other"),
]


@pytest.mark.parametrize(
    ("named", "cameras", "imu"),
    [
        (None, ["drone/front", "drone/down"], "drone/imu"),
        ("drone", ["drone/front", "drone/down"], "drone/imu"),
        ("drone/down", ["drone/down"], "drone/imu"),
        ("drone/front/grey", ["drone/front"], "drone/imu"),
        ("other", ["other/front"], "other/imu"),
    ],
)
def test_sensors_are_those_of_one_body(named: str | None, cameras: list[str], imu: str) -> None:
    rig = choose(ANNOUNCED, named)
    assert [c.source for c in rig.cameras] == cameras
    assert rig.body == cameras[0].partition("/")[0]
    assert rig.imu is not None
    assert rig.imu.source == imu


def test_a_body_may_be_without_an_imu() -> None:
    assert choose([camera()], None).imu is None


def test_a_camera_that_is_not_there_is_an_error_that_names_those_that_are() -> None:
    with pytest.raises(ValueError, match=r"called drone/fro, found drone/lidar \(depth\), drone/f"):
        choose(ANNOUNCED, "drone/fro")
    with pytest.raises(ValueError, match=r"rgb or grey images, found drone/lidar \(depth\)"):
        choose(ANNOUNCED[:3], None)
    with pytest.raises(ValueError, match=r"rgb or grey images, found none"):
        choose([], None)
