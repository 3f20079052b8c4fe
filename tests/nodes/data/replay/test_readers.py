"""What every reader keeps to, whatever the format."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from events import Announcement, CameraAnnouncement, DepthImage, Event, Image, Odometry
from nodes.data.replay.reader import Choice, ReplayError, Timed
from runtime.channels.wire import pack
from tests.nodes.data.replay.sets import SETS, reader

ALL = Choice(("Event",))


SLOW = {"mcap", "compressed"}
"""Read as "sqlite" is, but for a part that other tests have too."""


@pytest.fixture(
    scope="module",
    params=[pytest.param(n, marks=[pytest.mark.slow] if n in SLOW else []) for n in SETS],
)
def path(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return SETS[request.param](tmp_path_factory.mktemp("set"))


def read(path: Path, start: int = 0, end: int | None = None, choice: Choice = ALL) -> list[Timed]:
    opened = reader(path)
    try:
        return list(opened.events(start, end, choice))
    finally:
        opened.close()


@pytest.mark.slow
def test_events_come_in_order_of_time(path: Path) -> None:
    """Times begin near 0; stamps are of the same clock, and not ahead."""
    records = read(path)
    times = [record.time for record in records]
    assert times == sorted(times)
    assert 0 <= times[0] < 4_000_000_000
    assert all(0 <= record.event.stamp <= record.time for record in records)
    assert not [record for record in records if isinstance(record.event, Announcement)]


@pytest.mark.slow
def test_reading_again_gives_the_same(path: Path) -> None:
    """To the byte, with a reader of its own or the same one."""
    opened = reader(path)
    twice = [
        [(record.time, pack(record.event).frame()) for record in opened.events(0, None, ALL)]
        for _ in range(2)
    ]
    opened.close()
    assert twice[0] == twice[1]
    assert twice[0] == [(record.time, pack(record.event).frame()) for record in read(path)]


@pytest.mark.slow
def test_a_range_is_that_part_of_the_whole(path: Path) -> None:
    """From its start to before its end."""
    whole = read(path)
    start, end = whole[len(whole) // 3].time, whole[-1].time
    expected = [record for record in whole if start <= record.time < end]
    part = read(path, start, end)
    assert [pack(e.event).frame() for e in part] == [pack(e.event).frame() for e in expected]


@pytest.mark.slow
def test_only_what_is_wanted_is_read(path: Path) -> None:
    """By type and by source."""
    whole = read(path)
    images = [record.event for record in whole if isinstance(record.event, Image)]
    assert images
    chosen = read(path, choice=Choice(("Image",)))
    assert [pack(e.event).frame() for e in chosen] == [pack(e).frame() for e in images]
    assert read(path, choice=Choice(("nobody",))) == []


@pytest.mark.slow
def test_images_are_of_announced_cameras(path: Path) -> None:
    """Of their size, kinds and frame, so that an estimator works unchanged."""
    opened = reader(path)
    cameras = {a.source: a for a in opened.announcements() if isinstance(a, CameraAnnouncement)}
    opened.close()
    kinds: dict[str, set[str]] = {source: set() for source in cameras}
    for record in read(path):
        event: Event = record.event
        if isinstance(event, Image | DepthImage):
            camera = cameras[event.source]
            assert event.data.shape[:2] == (camera.info.height, camera.info.width)
            kind = "depth"
            if isinstance(event, Image):
                kind = "rgb" if event.encoding == "rgb8" else "grey"
            kinds[event.source].add(kind)
    assert kinds == {source: {*camera.images} for source, camera in cameras.items()}
    assert all(np.isclose(np.linalg.norm(c.orientation), 1.0) for c in cameras.values())


@pytest.mark.slow
def test_truth_and_vehicle_agree(path: Path) -> None:
    """The vehicle stands, at first, where the truth has it about the first image."""
    opened = reader(path)
    vehicle, *_ = opened.announcements()
    opened.close()
    truth = [record.event for record in read(path) if isinstance(record.event, Odometry)]
    assert truth
    assert {event.source for event in truth} == {vehicle.source} == {"drone"}
    assert all(np.isclose(np.linalg.norm(event.orientation), 1.0, atol=1e-3) for event in truth)


def test_what_cannot_be_read_is_an_error_that_names_it(tmp_path: Path) -> None:
    """No file, no recording, nothing in the folder."""
    text = tmp_path / "a.mcap"
    text.write_text("text")
    empty = tmp_path / "empty"
    empty.mkdir()
    sqlite = tmp_path / "a.db3"
    sqlite.write_text("text")
    for path in (tmp_path / "missing", text, empty, sqlite):
        with pytest.raises(ReplayError, match=rf"{path.name}\b.*expected"):
            reader(path)
