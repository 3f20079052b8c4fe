"""Recordings as they should not be: what can be read is, and the rest is one clear message."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from events import CameraAnnouncement
from nodes.data.mcap.mcap_file import contents
from nodes.data.recorder.recover import recover_file
from nodes.data.replay.bags import Recorded
from nodes.data.replay.reader import MOST_TROUBLE, ReplayError
from nodes.ros2.messages.typestore import Bag
from tests.nodes.data.replay import sets

S = 1_700_000_000_000_000_000
MS = 1_000_000


def imus(folder: Path, *rows: tuple[int, int]) -> Path:
    """Return a bag with messages of an IMU: time of receipt, and stamp (ns)."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types = store.types
    zero = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    path = folder / "bag"
    with Writer(path, version=9) as writer:
        connection = writer.add_connection("/imu", "sensor_msgs/msg/Imu", typestore=store)
        for time, stamp in rows:
            seconds, rest = divmod(stamp, 1_000_000_000)
            at = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest)
            header = types["std_msgs/msg/Header"](stamp=at, frame_id="imu")
            message = types["sensor_msgs/msg/Imu"](
                header, turn, np.zeros(9), zero, np.zeros(9), zero, np.zeros(9)
            )
            data = store.serialize_cdr(message, "sensor_msgs/msg/Imu")
            writer.write(connection, time, data)
    return path


def stamps(path: Path) -> tuple[list[tuple[int, int]], list[str], int]:
    """Return times and stamps of all events, and what could not be read."""
    reader = sets.reader(path)
    times = [
        (record.time, record.event.stamp) for record in reader.events(0, None, lambda *_: True)
    ]
    reader.close()
    return times, reader.trouble, reader.left_out


@pytest.mark.parametrize("first", [0, S])
def test_a_message_without_a_stamp_has_that_of_its_receipt(tmp_path: Path, first: int) -> None:
    """Whether all are so, or some."""
    path = imus(tmp_path, (S, first), (S + 10 * MS, 0), (S + 20 * MS, 0))
    assert stamps(path) == ([(0, 0), (10 * MS, 10 * MS), (20 * MS, 20 * MS)], [], 0)


def test_messages_of_before_the_beginning_are_counted_and_told_once(tmp_path: Path) -> None:
    """However many there are."""
    path = imus(tmp_path, (S, S), *((S + n * MS, S - n * MS) for n in range(1, 50)))
    times, trouble, left_out = stamps(path)
    assert (times, left_out) == ([(0, 0)], 49)
    assert trouble == ["/imu: expected no stamp before the first, found one 0.001 s before it"]


def test_complaints_are_bounded(tmp_path: Path) -> None:
    """A recording of hours must not fill the log."""
    reader = Recorded(sets.recording(tmp_path))
    for number in range(3 * MOST_TROUBLE):
        reader.complain(f"number {number % (2 * MOST_TROUBLE)}")
    assert len(reader.trouble) == MOST_TROUBLE + 1
    assert reader.trouble[-1] == "and more of that kind"


@pytest.mark.parametrize("plugin", list(StoragePlugin))
def test_a_bag_that_is_cut_is_an_error_of_one_line(tmp_path: Path, plugin: StoragePlugin) -> None:
    """Wherever it is cut; it names the file."""
    whole = sets.bag(tmp_path, plugin)
    path = next(file for file in whole.iterdir() if file.suffix in {".db3", ".mcap"})
    data = path.read_bytes()
    torn = tmp_path / f"torn{path.suffix}"
    for length in range(0, len(data) - 4096, 4096):
        torn.write_bytes(data[:length])
        with pytest.raises(ReplayError, match=rf"torn\{path.suffix}: [^\n]+\Z"):
            stamps(torn)


@pytest.mark.parametrize(
    ("name", "content", "cause"),
    [
        ("bag/metadata.yaml", b"rosbag2_bagfile_information: [", "YAML|yaml|parse|metadata"),
        ("bag/metadata.yaml", b"\xff\xfe", "decode|metadata|YAML"),
        ("bag/metadata.yaml", b"other: 1\n", "rosbag2_bagfile_information|key"),
        ("torn.bag", b"#ROSBAG V2.0\n" + bytes(50), "."),
        ("torn.db3", b"SQLite format 3\0" + bytes(4000), "."),
        ("torn.db3", b"", "."),
    ],
)
def test_a_damaged_bag_is_an_error_that_says_what_is_wrong_with_it(
    tmp_path: Path, name: str, content: bytes, cause: str
) -> None:
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content)
    bag = path.parent if path.name == "metadata.yaml" else path
    with pytest.raises(ReplayError, match=rf"{bag}[^\n]*: [^\n]*({cause})[^\n]*\Z") as raised:
        stamps(bag)
    assert "AnyReader is not open" not in str(raised.value)


@pytest.mark.parametrize("wrong", [RuntimeError("malformed\nimage"), MemoryError()])
def test_whatever_a_library_raises_is_an_error_of_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wrong: Exception
) -> None:
    """SQLite and MCAP have errors of their own, which nobody else need know."""
    path = imus(tmp_path, (S, S))

    def messages(*_: object) -> Iterator[None]:
        raise wrong
        yield

    monkeypatch.setattr(Bag, "messages", messages)
    with pytest.raises(ReplayError, match=r"bag: expected a readable bag, found: [^\n]+\Z"):
        sets.reader(path)


def test_images_of_one_moment_have_a_rate(tmp_path: Path) -> None:
    """In TUM's layout it is told by the stamps."""
    path = sets.tum_as_published(tmp_path)
    rows = (path / "rgb.txt").read_text().splitlines()[3:]
    (path / "rgb.txt").write_text("".join(f"1305031102.2 {row.split()[1]}\n" for row in rows))
    (camera,) = (a for a in sets.reader(path).announcements() if isinstance(a, CameraAnnouncement))
    assert camera.rate == 30.0


def test_a_file_without_content_is_no_image(tmp_path: Path) -> None:
    """And the message is ours, not OpenCV's."""
    path = sets.tum_as_published(tmp_path)
    (path / "rgb" / "1305031102.175304.png").write_bytes(b"")
    with pytest.raises(ReplayError, match=r"175304\.png: expected an image, found something else"):
        sets.reader(path)


def test_a_recording_that_was_mended_does_not_know_when_it_ended(tmp_path: Path) -> None:
    """So a replay goes on for a while after its last event."""
    path = sets.torn(tmp_path)
    data = path.read_bytes()
    path.write_bytes(data[: data.index(b"visnav", len(data) - 200)])
    assert recover_file(path).mended
    assert contents(path).complete
    assert Recorded(path).end() is None


@pytest.mark.slow
@pytest.mark.parametrize("plugin", list(StoragePlugin))
@given(data=st.data())
@settings(max_examples=25, deadline=None)
def test_a_bag_with_wrong_bytes_is_read_or_an_error_of_one_line(
    plugin: StoragePlugin, data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Whatever rosbags and the libraries below it make of them."""
    folder = tmp_path_factory.getbasetemp() / f"wrong_{plugin.name}"
    if not folder.exists():
        folder.mkdir()
        sets.bag(folder, plugin)
    files = [
        candidate
        for candidate in folder.rglob("*")
        if candidate.is_file() and "wrong" not in candidate.name
    ]
    whole = next(file for file in files if file.suffix in {".db3", ".mcap"})
    content = bytearray(whole.read_bytes())
    for place in data.draw(st.lists(st.integers(0, len(content) - 1), min_size=1, max_size=8)):
        content[place] = data.draw(st.integers(0, 255))
    path = folder / f"wrong{whole.suffix}"
    path.write_bytes(content)
    wrong = ""
    try:
        stamps(path)
    except ReplayError as error:
        wrong = str(error)
    assert "\n" not in wrong
