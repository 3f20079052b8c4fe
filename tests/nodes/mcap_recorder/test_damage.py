"""Files that are damaged anywhere: what is read was written, what is missing is told."""

from __future__ import annotations

from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from nodes.mcap_recorder import layout
from nodes.mcap_recorder.disk import RecordingError
from nodes.mcap_recorder.mcap_file import McapWriter, contents, read
from nodes.mcap_recorder.recover import recover_file
from tests.nodes.mcap_recorder.test_mcap_file import fill, write

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
        found = [tuple(record) for record in read(path, damaged=trouble.append)]
        rest = iter(whole)
        assert all(record in rest for record in found), place  # in order
        assert len(found) == len(whole) or trouble, place


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
    found = [record.sequence for record in read(path, damaged=trouble.append)]
    if index or after:  # else nothing tells where the next chunk begins
        assert found == [0, 0, 2, 2, 3, 3]
        assert "a damaged chunk is left out" in trouble[0]
    else:
        assert found == [0, 0]
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
    found = recover_file(path)
    assert (found.mended, found.messages) == (False, 6)
    assert "a damaged chunk is left out" in found.trouble[0]
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
