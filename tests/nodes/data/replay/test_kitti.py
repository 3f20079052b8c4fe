"""KITTI's layout, pairs of cameras, and what is said of a folder in which something is missing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from events import CameraAnnouncement, Image, Odometry, VehicleAnnouncement
from events.frames import OPTICAL_TO_FRD
from events.geometry import pose_matrix
from nodes.data.replay.folders import as_pair
from nodes.data.replay.reader import Choice, Reader, ReplayError
from nodes.estimators.rectification import misalignment
from tests.nodes.data.replay import downloads, sets
from tests.nodes.estimators.test_rectification import EUROC, seen

ALL = Choice(("Event",))


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(downloads, "IMAGES", 3)
        return downloads.kitti(tmp_path_factory.mktemp("kitti"))


def cameras(reader: Reader) -> list[CameraAnnouncement]:
    return [a for a in reader.announcements() if isinstance(a, CameraAnnouncement)]


def test_the_cameras_stand_where_the_projections_say(sequence: Path) -> None:
    left, right = cameras(sets.reader(sequence))
    assert (left.source, right.source) == ("drone/image_0", "drone/image_1")
    assert left.images == ("grey",)
    assert left.rate == pytest.approx(20.0)
    assert (left.info, left.info.is_pinhole) == (downloads.CAR, True)
    assert left.position == (0.0, 0.0, 0.0)
    np.testing.assert_allclose(right.position, (0.0, 0.12, 0.0), atol=1e-9)
    assert right.stereo == left.source
    assert right.baseline == pytest.approx(0.12)
    assert misalignment(left, right) < 1e-6


def test_images_and_truth_come_at_their_times(sequence: Path) -> None:
    reader = sets.reader(sequence)
    events = [record.event for record in reader.events(0, None, ALL)]
    stamps = [event.stamp for event in events if isinstance(event, Image)]
    assert stamps == [0, 0, 50_000_000, 50_000_000, 100_000_000, 100_000_000]
    truth = [event for event in events if isinstance(event, Odometry)]
    assert [pose.stamp for pose in truth] == stamps[::2]
    vehicle = next(a for a in reader.announcements() if isinstance(a, VehicleAnnouncement))
    assert vehicle.position == truth[0].position == (0.0, 0.0, 0.0)
    axes = pose_matrix((0.0, 0.0, 0.0), OPTICAL_TO_FRD)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(downloads, "IMAGES", 3)
        last = axes @ downloads.way()[2] @ axes.T
    np.testing.assert_allclose(
        pose_matrix(truth[2].position, truth[2].orientation), last, atol=1e-9
    )
    assert last[1, 3] > 0, "to the right is east"


@pytest.mark.parametrize(
    ("name", "text", "wrong"),
    [
        (
            "times.txt",
            "0.0\n0.05\n",
            r"image_0: expected 2 images, as many as times.txt .* found 3",
        ),
        ("times.txt", "0.0\nsoon\n", "times.txt:2: expected a stamp in seconds"),
        ("calib.txt", "P0: 1 2 3\n", r"calib.txt:1: expected 13 fields"),
        ("calib.txt", f"P3: {'1 ' * 12}\n", "calib.txt: expected P0, found none"),
    ],
)
def test_what_is_not_as_published_is_said(
    sequence: Path, tmp_path: Path, name: str, text: str, wrong: str
) -> None:
    copy = tmp_path / "sequences" / "07"
    copy.mkdir(parents=True)
    for path in sequence.iterdir():
        (copy / path.name).symlink_to(path)
    (copy / name).unlink()
    (copy / name).write_text(text)
    with pytest.raises(ReplayError, match=wrong):
        sets.reader(copy)


def test_without_true_poses_there_are_images(sequence: Path, tmp_path: Path) -> None:
    copy = tmp_path / "sequences" / "11"
    copy.mkdir(parents=True)
    for path in sequence.iterdir():
        (copy / path.name).symlink_to(path)
    reader = sets.reader(copy)
    assert len(cameras(reader)) == 2
    (trouble,) = reader.trouble
    assert trouble.startswith("expected true poses in")


def test_a_missing_download_is_told_where_to_find(tmp_path: Path) -> None:
    with pytest.raises(ReplayError, match=r"found nothing there; docs/how-to/datasets.md says"):
        sets.reader(tmp_path / "MH_01_easy")


@pytest.mark.parametrize(
    ("change", "is_pair"),
    [
        ({"position": (0.0, 0.11, 0.02)}, True),
        ({"position": (0.0, -0.11, 0.0)}, False),
        ({"position": (0.2, 0.0, 0.0)}, False),
        ({"position": (0.0, 0.0, 0.0)}, False),
        ({"position": (0.0, 0.11, 0.0), "rate": 5.0}, False),
        ({"position": (0.0, 0.11, 0.0), "orientation": (0.5, -0.5, -0.5, 0.5)}, False),
    ],
)
def test_cameras_side_by_side_are_a_pair(change: dict[str, Any], is_pair: bool) -> None:
    left = seen(EUROC, "drone/cam0")
    right = as_pair(left, seen(EUROC, "drone/cam1", **change))
    assert (right.stereo == left.source) == is_pair
    assert (right.baseline > 0.1) == is_pair
