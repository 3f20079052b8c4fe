"""What is noted of answers: files of latencies that are read back, and the digest of inputs."""

from __future__ import annotations

from pathlib import Path

import pytest

from runtime.channels.answers import Answers, read_latencies
from runtime.errors import ConfigError


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "columns stamp_ns,outcome,latency_ms"),
        ("stamp_ns,outcome,latency_ms\n1,answered,-4\n", "line 2: expected a latency ≥ 0"),
        ("stamp_ns,outcome,latency_ms\n1,answered,nan\n", "line 2: expected a latency ≥ 0"),
        ("stamp_ns,outcome,latency_ms\n1,lost,\n", "at least one answered frame"),
        ("stamp_ns,outcome,latency_ms\n1,2\n", "line 2"),
    ],
)
def test_a_wrong_file_is_refused(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "slam.csv"
    file.write_text(text)
    with pytest.raises(ConfigError, match=message):
        read_latencies(file)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="No such file"):
        read_latencies(tmp_path / "slam.csv")


def test_the_digest_of_inputs_is_that_of_their_bytes_by_stream() -> None:
    first, second = Answers(), Answers()
    first.record_input("image", b"abc")
    first.record_input("imu", bytearray(b"d"))
    second.record_input("imu", memoryview(b"d"))
    second.record_input("image", b"abc")
    assert first.inputs() == second.inputs()
    second.record_input("image", b"")
    assert first.inputs() != second.inputs()
    assert Answers().inputs() is None
