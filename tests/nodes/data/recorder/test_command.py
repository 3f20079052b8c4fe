"""What ``recover`` says of a file: torn, whole, damaged, or none."""

from __future__ import annotations

from pathlib import Path

import pytest

from nodes.data.mcap import layout
from nodes.data.mcap.mcap_file import read
from nodes.data.recorder.recover import recover
from runtime.errors import VisnavError
from tests.nodes.data.mcap.test_mcap_file import write


def test_a_torn_file_is_mended_and_a_whole_one_is_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Both are told in a line."""
    path = tmp_path / "a.mcap"
    write(path)
    data = path.read_bytes()
    path.write_bytes(data[: data.index(layout.END_WITHOUT_INDEX[:9])])
    recover(path)
    assert capsys.readouterr().out.splitlines() == [
        f"{path}: the end is missing: the file was not closed",
        f"{path}: 8 messages, now with an index",
    ]
    recover(path)
    assert capsys.readouterr().out == f"{path}: 8 messages, complete, nothing to mend\n"


def test_a_damaged_file_with_an_index_is_left_as_it_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is not called complete."""
    path = tmp_path / "a.mcap"
    write(path, compression="none")
    data = bytearray(path.read_bytes())
    data[data.index(b"half")] ^= 0xFF
    path.write_bytes(data)
    recover(path)
    first, last = capsys.readouterr().out.splitlines()
    assert "0.000 s to 0.500 s: a damaged chunk is left out" in first
    assert last == (
        f"{path}: 6 messages, has its index, left as it is; what is named above is missing"
    )


@pytest.mark.parametrize("what", ["nothing", "a folder", "a text"])
def test_what_is_no_recording_is_an_error_of_one_line(tmp_path: Path, what: str) -> None:
    """With the file's name in it."""
    path = tmp_path / "a.mcap"
    if what == "a folder":
        path.mkdir()
    elif what == "a text":
        path.write_text("hello")
    with pytest.raises(VisnavError, match=r"a\.mcap: expected [^\n]+\Z"):
        recover(path)


def test_what_a_damaged_chunk_took_stays_missing_however_often_it_is_mended(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A new index does not make such a file complete, and its numbers have a gap."""
    path = tmp_path / "a.mcap"
    write(path, compression="none")
    data = bytearray(path.read_bytes())
    data[data.index(b"half")] ^= 0xFF
    path.write_bytes(data)
    out = tmp_path / "b.mcap"
    recover(path, out)
    first, last = capsys.readouterr().out.splitlines()
    assert last == f"{out}: 6 messages, now with an index; what is named above is missing"
    recover(out)
    again, last = capsys.readouterr().out.splitlines()
    assert again.partition(": ")[2] == first.partition(": ")[2]
    assert last.endswith("has its index, left as it is; what is named above is missing")
    assert [record.sequence for record in read(out)] == [2, 3, 4, 5, 6, 7]
