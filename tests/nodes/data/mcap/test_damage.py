"""Files that are damaged anywhere: what is read was written, what is missing is told."""

from __future__ import annotations

import struct
import tracemalloc
from pathlib import Path

import lz4.frame  # type: ignore[import-untyped]
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from nodes.data.mcap import layout
from nodes.data.mcap.layout import RecordingError
from nodes.data.mcap.mcap_file import McapWriter, contents, read
from nodes.data.recorder.recover import recover_file
from nodes.data.replay.node import open_reader
from nodes.data.replay.reader import ReplayConfig, ReplayError
from tests.nodes.data.mcap.test_mcap_file import fill, write

CLOSED = "the end is missing: the file was not closed"


def chunks(path: Path) -> list[tuple[int, int]]:
    """Return where the chunks of a whole file begin and end."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return [
        (index.chunk_start_offset, index.chunk_start_offset + index.chunk_length)
        for index in summary.chunk_indexes
    ]


def without_index(path: Path) -> bytes:
    data = path.read_bytes()
    return data[: data.index(layout.END_WITHOUT_INDEX[:9])]


@pytest.mark.parametrize("index", [True, False])
def test_no_byte_of_a_file_matters_to_the_rest(tmp_path: Path, index: bool) -> None:
    """Whichever is wrong: nothing is made up, nothing fails, and what is lost is told."""
    path = tmp_path / "a.mcap"
    write(path, compression="none")
    whole = [tuple(record) for record in read(path)]
    data = path.read_bytes() if index else without_index(path)
    for place in range(len(layout.MAGIC), len(data), 23):
        damaged = bytearray(data)
        damaged[place] ^= 0xFF
        path.write_bytes(damaged)
        trouble: list[str] = []
        records = [tuple(record) for record in read(path, damaged=trouble.append)]
        rest = iter(whole)
        assert all(record in rest for record in records), place  # in order
        assert len(records) == len(whole) or trouble, place


@pytest.mark.parametrize("index", [True, False])
@pytest.mark.parametrize("after", [0, 9])
def test_a_hole_is_told(tmp_path: Path, index: bool, after: int) -> None:
    """Zeros in the place of a chunk, as a power cut leaves them, are no chunk without messages."""
    path = tmp_path / "a.mcap"
    write(path)
    begin, end = chunks(path)[1]
    data = bytearray(path.read_bytes() if index else without_index(path))
    data[begin + after : end] = bytes(end - begin - after)
    path.write_bytes(data)
    trouble: list[str] = []
    sequences = [record.sequence for record in read(path, damaged=trouble.append)]
    if index or after:  # else nothing tells where the next chunk begins
        assert sequences == [0, 1, 4, 5, 6, 7]
        assert "a damaged chunk is left out" in trouble[0]
    else:
        assert sequences == [0, 1]
        assert trouble == [CLOSED]


def test_a_closed_file_that_goes_wrong_in_the_middle_says_where(tmp_path: Path) -> None:
    """Without an index that is where reading ends, and it is not for want of closing."""
    path = tmp_path / "a.mcap"
    write(path)
    _, place = chunks(path)[1]
    write(path, close=False).abandon()
    data = bytearray(path.read_bytes())
    data[place] = 0
    path.write_bytes(data)
    trouble: list[str] = []
    list(read(path, damaged=trouble.append))
    assert trouble == [f"damaged: nothing can be read from byte {place} of {len(data)} on"]


def test_an_index_that_is_damaged_is_not_trusted(tmp_path: Path) -> None:
    """All is read without it, and mending makes it anew."""
    path = tmp_path / "a.mcap"
    write(path)
    data = bytearray(path.read_bytes())
    data[data.rindex(b"/chatter")] = ord("-")
    path.write_bytes(data)
    assert {record.topic for record in read(path)} == {"/chatter"}
    assert not contents(path).complete
    assert recover_file(path).messages == 8
    assert contents(path).metadata == {"visnav": {"end": "5000000000"}}


def test_what_mending_cannot_help_is_told_and_left_alone(tmp_path: Path) -> None:
    """A file with an index and a damaged chunk: others may make more of it."""
    path = tmp_path / "a.mcap"
    write(path)
    data = bytearray(path.read_bytes())
    data[chunks(path)[1][1] - 5] ^= 0xFF
    path.write_bytes(data)
    report = recover_file(path)
    assert (report.mended, report.messages) == (False, 6)
    assert "a damaged chunk is left out" in report.trouble[0]
    assert path.read_bytes() == data


def test_a_file_of_others_stays_one_when_it_is_mended(tmp_path: Path) -> None:
    """Its header tells who wrote it, and what for."""
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start(profile="theirs", library="another")
        schema = writer.register_schema("x", "jsonschema", b"{}")
        writer.add_message(writer.register_channel("/x", "json", schema), 5, b"{}", 5)
        writer.flush()  # type: ignore[no-untyped-call]
    assert recover_file(path).mended
    assert not contents(path).ours
    with path.open("rb") as file:
        header = make_reader(file).get_header()
    assert (header.profile, header.library) == ("theirs", "another")


def test_a_file_that_is_being_written_is_left_alone(tmp_path: Path) -> None:
    """By mending, which would take its place, and by another recorder."""
    path = tmp_path / "a.mcap"
    writer = McapWriter(path)
    fill(writer)
    before = path.read_bytes()
    with pytest.raises(RecordingError, match="found one being written"):
        recover_file(path)
    with pytest.raises(RecordingError, match="another process is writing it"):
        McapWriter(path)
    assert path.read_bytes() == before
    writer.abandon()
    assert recover_file(path).mended


def claiming(path: Path, compression: str, size: int) -> None:
    """Write a file whose one chunk unpacks, as it or its frame says, to so many bytes."""
    pack = {
        "zstd": zstandard.ZstdCompressor().compress,
        "lz4": lz4.frame.compress,
        "": bytes,
    }[compression]
    data = bytearray(pack(bytes(1000)))
    if compression == "zstd":  # a frame of 1000 bytes has two of them for its size
        assert data[4] >> 6 == 1
        data = data[:4] + bytes([data[4] | 0xC0]) + struct.pack("<Q", size) + data[7:]
    elif compression == "lz4":
        assert data[4] & 8
        data[6:14] = struct.pack("<Q", size)
    name = compression.encode()
    head = struct.pack("<QQQI", 0, 9, 1000 if compression else size, 0)
    chunk = head + struct.pack("<I", len(name)) + name + struct.pack("<Q", len(data)) + data
    header = struct.pack("<BQII", 1, 8, 0, 0)
    path.write_bytes(
        layout.MAGIC + header + struct.pack("<BQ", 6, len(chunk)) + chunk + layout.END_WITHOUT_INDEX
    )


@pytest.mark.parametrize("compression", ["zstd", "lz4", ""])
def test_a_chunk_that_claims_too_much_is_refused_before_it_is_unpacked(
    tmp_path: Path, compression: str
) -> None:
    """By our own reader, and before another one believes it."""
    path = tmp_path / "a.mcap"
    claiming(path, compression, 2 << 30)
    tracemalloc.start()
    trouble: list[str] = []
    assert not list(read(path, damaged=trouble.append))
    with pytest.raises(ReplayError, match=rf"a\.mcap: expected .* found one of {2 << 30}\Z"):
        open_reader(ReplayConfig(file=str(path)), "replay")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert f"found one of {2 << 30}" in trouble[0]
    assert peak < 100 << 20


@settings(deadline=None, max_examples=50)
@given(size=st.integers(0, 70_000), compression=st.sampled_from(["zstd", "lz4"]))
def test_what_a_frame_says_of_its_size_is_read_as_its_library_reads_it(
    size: int, compression: str
) -> None:
    """Of every width that the field has."""
    if compression == "zstd":
        data = zstandard.ZstdCompressor().compress(bytes(size))
    else:
        data = lz4.frame.compress(bytes(size), store_size=True)
    assert layout.frame_size(data) == size


@pytest.mark.slow
@settings(deadline=None, max_examples=100)
@given(data=st.data())
def test_no_file_raises_anything_but_our_own_error(
    data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Cut anywhere, with any bytes changed: one line, for replay and mending alike."""
    path = tmp_path_factory.mktemp("fuzz") / "a.mcap"
    write(path, compression=data.draw(st.sampled_from(["zstd", "lz4", "none"])))
    content = bytearray(path.read_bytes())
    del content[data.draw(st.integers(1, len(content))) :]
    for place in data.draw(st.lists(st.integers(0, len(content) - 1), max_size=4)):
        content[place] = data.draw(st.integers(0, 255))
    path.write_bytes(content)
    errors: list[str] = []
    for call in (
        lambda: list(read(path)),
        lambda: recover_file(path, path.with_name("b.mcap")),
        lambda: open_reader(ReplayConfig(file=str(path)), "replay"),
    ):
        try:
            call()
        except (RecordingError, ReplayError) as error:
            errors.append(str(error))
    assert not any("\n" in message for message in errors)
