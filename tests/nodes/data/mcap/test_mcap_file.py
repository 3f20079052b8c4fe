"""The file: complete, torn, damaged, and on a disk that is full."""

from __future__ import annotations

import errno
import io
from pathlib import Path
from typing import IO, Any

import pytest
from mcap.reader import make_reader

from nodes.data.mcap import native as records
from nodes.data.mcap.layout import RecordingError
from nodes.data.mcap.mcap_file import Compression, McapWriter, contents, read
from nodes.data.recorder.recover import recover_file
from runtime.errors import MissingDependencyError

TYPE, DEFINITION = "std_msgs/msg/String", "string data\n"
CHUNKS = 4


class FullDisk(io.FileIO):
    """A file on a disk that has room for some bytes, and takes half of a write that has none."""

    room = 0

    def write(self, data: Any) -> int:
        free = self.room - self.tell()
        if free <= 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        return super().write(memoryview(data)[:free])


def write(path: Path, *, close: bool = True, compression: Compression = "zstd") -> McapWriter:
    """Write four chunks of two messages, a second apart; the content is all but random."""
    writer = McapWriter(path, compression=compression)
    fill(writer)
    if close:
        writer.close({"visnav": {"end": "5000000000"}})
    return writer


def fill(writer: McapWriter) -> None:
    channel = writer.channel("/chatter", TYPE, lambda _: DEFINITION, {"kind": "test"})
    for number in range(CHUNKS):
        second = number * 1_000_000_000
        writer.write(channel, second, bytes((number * 7 + k * k) % 251 for k in range(500)))
        writer.write(channel, second + 500_000_000, b"half")
        writer.end_chunk()


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_what_is_written_is_read(tmp_path: Path, compression: Compression) -> None:
    """By us and by mcap's own reader, which checks all checksums."""
    path = tmp_path / "a.mcap"
    write(path, compression=compression)
    records = list(read(path))
    assert [(r.time, r.sequence, r.topic, r.type) for r in records[:2]] == [
        (0, 0, "/chatter", TYPE),
        (500_000_000, 1, "/chatter", TYPE),
    ]
    assert records[0].metadata == {"kind": "test"}
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        assert [m.data for _, _, m in reader.iter_messages()] == [r.data for r in records]
    said = contents(path)
    assert said.complete
    assert said.metadata == {"visnav": {"end": "5000000000"}}


def test_a_range_is_read_without_the_rest(tmp_path: Path) -> None:
    """From the first to before the last, with an index or without."""
    for close in (True, False):
        path = tmp_path / f"{close}.mcap"
        write(path, close=close)
        times = [r.time / 1e9 for r in read(path, 1_500_000_000, 3_000_000_000)]
        assert times == [1.5, 2.0, 2.5]


def test_every_beginning_of_a_file_is_read_up_to_its_last_chunk(tmp_path: Path) -> None:
    """Wherever a kill tears it, the chunks before are there; and what is mended is complete."""
    whole = tmp_path / "whole.mcap"
    write(whole)
    data = whole.read_bytes()
    counts = []
    for length in range(60, len(data), 97):
        torn = tmp_path / "torn.mcap"
        torn.write_bytes(data[:length])
        trouble: list[str] = []
        counts.append(len(list(read(torn, damaged=trouble.append))))
        assert trouble == ["the end is missing: the file was not closed"]
        if counts[-1]:
            recover_file(torn)
            assert contents(torn).complete
            assert len(list(read(torn))) == counts[-1]
        else:
            with pytest.raises(RecordingError, match="found none that can be read"):
                recover_file(torn)
    assert counts == sorted(counts)
    assert {0, 2, 4, 6, 8} == {*counts}


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
@pytest.mark.parametrize("place", [70, 110, 300])
def test_a_damaged_chunk_is_passed_over(
    tmp_path: Path, compression: Compression, place: int
) -> None:
    """The others are read, the loss is told, and mending keeps what there is."""
    path = tmp_path / "a.mcap"
    write(path, compression=compression)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    data = bytearray(path.read_bytes())
    data[summary.chunk_indexes[1].chunk_start_offset + place] ^= 0xFF
    path.write_bytes(data)
    trouble: list[str] = []
    assert [r.sequence for r in read(path, damaged=trouble.append)] == [0, 1, 4, 5, 6, 7]
    assert len(trouble) == 1
    assert "1.000 s to 1.500 s: a damaged chunk is left out" in trouble[0]
    mended = recover_file(path, tmp_path / "mended.mcap")
    assert mended.messages == 6
    assert mended.trouble == trouble


def test_a_damaged_first_chunk_takes_its_topics_along(tmp_path: Path) -> None:
    """Without an index nothing else names them; that is said, and the file can be mended."""
    path = tmp_path / "a.mcap"
    writer = write(path, close=False, compression="none")
    other = writer.channel("/other", TYPE, lambda _: DEFINITION)
    writer.write(other, 9_000_000_000, b"there")
    writer.end_chunk()
    data = bytearray(path.read_bytes())
    data[data.index(b"half")] ^= 0xFF
    writer._file.close()  # as a kill does
    path.write_bytes(data)
    trouble: list[str] = []
    assert [r.topic for r in read(path, damaged=trouble.append)] == ["/other"]
    assert "a damaged chunk is left out" in trouble[0]
    assert trouble[1:] == [
        "messages of topics that a damaged chunk named are left out",
        "the end is missing: the file was not closed",
    ]
    assert recover_file(path).messages == 1


def test_a_full_disk_is_told_and_what_was_written_is_valid(tmp_path: Path) -> None:
    """The chunk that has no room is not there by half; what it took is enough for an end."""
    path = tmp_path / "a.mcap"
    full = write(tmp_path / "b.mcap").size

    def open_file(path: Path) -> IO[bytes]:
        file = FullDisk(path, "w")
        file.room = full // 2
        return file

    writer = McapWriter(path, open_file=open_file)
    with pytest.raises(RecordingError, match=r"a\.mcap cannot be written: No space.*MB free"):
        fill(writer)
    writer.abandon()
    with path.open("rb") as stream:
        assert [m.sequence for _, _, m in make_reader(stream).iter_messages()] == [0, 1, 2, 3]


def test_a_disk_with_no_room_for_the_index_leaves_all_messages(tmp_path: Path) -> None:
    """Closing fails, and what is abandoned then is valid nevertheless."""
    path = tmp_path / "a.mcap"
    unclosed = write(tmp_path / "b.mcap", close=False).size

    def open_file(path: Path) -> IO[bytes]:
        file = FullDisk(path, "w")
        file.room = unclosed + 100
        return file

    writer = McapWriter(path, open_file=open_file)
    fill(writer)
    with pytest.raises(RecordingError, match=r"a\.mcap cannot be written: No space"):
        writer.close()
    writer.abandon()
    trouble: list[str] = []
    assert len(list(read(path, damaged=trouble.append))) == 2 * CHUNKS
    assert trouble == []


def test_an_abandoned_file_is_valid_without_an_index(tmp_path: Path) -> None:
    """mcap's own reader reads it to its end; mending gives it the index."""
    path = tmp_path / "a.mcap"
    write(path, close=False).abandon()
    with path.open("rb") as file:
        assert len(list(make_reader(file).iter_messages())) == 2 * CHUNKS
    trouble: list[str] = []
    assert len(list(read(path, damaged=trouble.append))) == 2 * CHUNKS
    assert trouble == []
    assert not contents(path).complete
    assert recover_file(path).mended
    assert contents(path).complete


def test_what_is_whole_is_left_alone(tmp_path: Path) -> None:
    """Mending changes nothing there, and never writes over another file."""
    path = tmp_path / "a.mcap"
    write(path)
    before = path.read_bytes()
    assert not recover_file(path).mended
    assert path.read_bytes() == before
    other = tmp_path / "other.mcap"
    other.write_text("mine")
    with pytest.raises(RecordingError, match="expected the name of a new file"):
        recover_file(path, other)
    assert other.read_text() == "mine"


@pytest.mark.parametrize("content", [None, b"", b"text", b"\x89MCAP0\r\n", b"\x89MCAP0\r\n" * 9])
def test_what_is_no_recording_is_an_error(tmp_path: Path, content: bytes | None) -> None:
    """It names the file; nothing is left lying about."""
    path = tmp_path / "a.mcap"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"a\.mcap: expected"):
        recover_file(path)
    assert [file.name for file in tmp_path.iterdir()] == ([] if content is None else ["a.mcap"])


def test_a_file_that_cannot_be_made_is_an_error(tmp_path: Path) -> None:
    """It names the file, and says why."""
    with pytest.raises(RecordingError, match="cannot be written: No such file or directory"):
        McapWriter(tmp_path / "missing" / "a.mcap")


def test_without_mcap_the_error_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For writing as for reading."""
    monkeypatch.setattr(records, "_MISSING", ImportError("mcap"))
    for ask in (McapWriter, contents, recover_file):
        with pytest.raises(MissingDependencyError, match=r"pip install -e '\.\[record\]'"):
            ask(tmp_path / "a.mcap")
