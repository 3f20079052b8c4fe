"""The recorder in a run: everything is in the file, whatever ends the run."""

from __future__ import annotations

import os
import resource
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import Reader

from events import Event, Image, Odometry
from nodes.data.mcap.layout import RecordingError
from nodes.data.mcap.mcap_file import McapWriter, contents, read
from nodes.data.recorder import McapRecorder, McapRecorderConfig, writer_process
from nodes.data.recorder.process import FileWriter
from nodes.data.recorder.writer_process import Backlog, WriteRequest, WriterProcess
from nodes.data.replay.bags import Recorded
from runtime import Tick, every
from runtime.channels.wire import pack
from runtime.errors import FatalError, NodeError
from runtime.testing import NodeResult, run_node, run_nodes, spec
from tests.nodes.data.recorder.samples import announcements, imu, said, same

SECOND = 1_000_000_000


def record(events: list[Event], out: Path | None, **config: Any) -> NodeResult:
    return run_node(
        McapRecorder, inputs=events, config=config, duration=3.0, name="recorder", out=out
    )


def big(stamp: int) -> Image:
    data = np.random.default_rng(stamp).integers(0, 255, (300, 300, 3), np.uint8)
    return Image(stamp=stamp, source="drone/front", frame_id="f", data=data)


def wait_for_an_event(path: Path) -> None:
    """Wait until another process has written one whole; a part of it may be there before."""
    unfinished: list[str] = []
    while not [*read(path, damaged=unfinished.append)]:
        time.sleep(0.01)


@pytest.mark.slow
def test_a_run_is_recorded_to_its_end(tmp_path: Path) -> None:
    """All that was said is there, when it was said; so is the time at which the run ended."""
    (tmp_path / "config.toml").write_text("[run]\n")
    events = [*announcements(), *said(SECOND), *said(2 * SECOND)]
    result = record(events, tmp_path)
    assert result.drops["recorder.events"].dropped == 0
    path = tmp_path / "recording.mcap"
    reader = Recorded(path)
    records = list(reader.events(0, None, lambda _, __: True))
    assert all(same(*pair) for pair in zip(reader.announcements(), announcements(), strict=True))
    assert all(
        same(a.event, b) for a, b in zip(records, events[len(announcements()) :], strict=True)
    )
    assert [record.time for record in records] == [
        event.stamp for event in events[len(announcements()) :]
    ]
    assert reader.end() == 3 * SECOND
    assert contents(path).metadata["visnav"]["events"] == str(len(events))
    with Reader(tmp_path) as bag:  # the folder is one of ROS 2, for evo among others
        assert (bag.start_time, bag.message_count) == (0, sum(1 for _ in bag.messages()))
        counts = {connection.topic: connection.msgcount for connection in bag.connections}
        assert counts["/drone/odom"] == sum(isinstance(event, Odometry) for event in events)


@pytest.mark.slow
def test_simulated_time_waits_for_a_slow_disk(tmp_path: Path) -> None:
    """With next to no memory nothing is lost: images come no faster than they are written."""
    events: list[Event] = [big(n * 10_000_000) for n in range(12)]
    result = record(events, tmp_path, memory=1 << 19, image_format="png")
    assert result.drops["recorder.events"].dropped == 0
    assert result.seconds == 3.0
    records = Recorded(tmp_path / "recording.mcap").events(0, None, lambda _, __: True)
    assert [record.event.stamp for record in records] == [event.stamp for event in events]


@pytest.mark.slow
def test_a_full_disk_ends_the_run_in_order(tmp_path: Path) -> None:
    """The error names the file; what is not in it is counted."""
    (tmp_path / "recording.mcap").symlink_to("/dev/full")
    with pytest.raises(FatalError, match=r"recording\.mcap cannot be written: No space left"):
        record([imu(0)], tmp_path)


@pytest.mark.slow
def test_a_disk_that_is_full_at_the_very_end_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Though the run itself is over when the last chunk is written."""
    start = WriterProcess.start

    def limited(process: WriterProcess) -> None:
        resource.prlimit(process._child.pid, resource.RLIMIT_FSIZE, (500, 500))
        start(process)

    monkeypatch.setattr(WriterProcess, "start", limited)
    with pytest.raises(NodeError, match=r"recording\.mcap cannot be written: File too large"):
        record([*announcements(), *said(0)], tmp_path, chunk_size=1 << 28)


@pytest.mark.slow
def test_a_disk_that_is_slow_at_the_end_has_its_time_after_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """What the run's end has no time for is written nevertheless."""

    def close(_: WriterProcess, end: int, timeout: float) -> bool:
        assert 0 < timeout < 10
        return False

    monkeypatch.setattr(WriterProcess, "close", close)
    asked = list[tuple[McapRecorder, Callable[[Path], Any]]]()
    monkeypatch.setattr(McapRecorder, "after_run", lambda *of: asked.append(of))
    record([imu(0)], tmp_path)
    assert "are yet to be written" in caplog.text
    path = tmp_path / "recording.mcap"
    assert not contents(path).complete
    monkeypatch.undo()
    ((_, after),) = asked
    after(tmp_path)
    assert contents(path).complete
    assert Recorded(path).end() == 3 * SECOND


def test_what_a_failed_chunk_had_is_not_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor what comes after it: the process stops reading."""
    process = FileWriter(WriteRequest(str(tmp_path / "a.mcap")))

    def fail(_: McapWriter) -> None:
        raise RecordingError("full")

    monkeypatch.setattr(McapWriter, "end_chunk", fail)
    there, here = os.pipe()
    with os.fdopen(here, "wb") as file:
        for stamp in (0, SECOND, 2 * SECOND):
            writer_process.write(file, stamp, writer_process.EVENT, pack(imu(stamp)))
    reply = process.run(there)
    os.close(there)
    assert (reply.kind, reply.text, reply.written) == ("error", "full", 0)


@pytest.mark.slow
def test_a_recorder_that_is_restarted_keeps_what_it_had(tmp_path: Path) -> None:
    """It goes on in a file of its own; both know the announcements."""
    again = spec(Failing, "recorder", on_error="restart")
    events = [*announcements(), imu(0), imu(SECOND), imu(2 * SECOND)]
    run_nodes([again], inputs=events, duration=3.0, out=tmp_path)
    stamps = {}
    for path in sorted(tmp_path.glob("*.mcap")):
        reader = Recorded(path)
        assert len(reader.announcements()) == len(announcements())
        records = reader.events(0, None, lambda _, __: True)
        stamps[path.name] = [record.event.stamp for record in records]
    assert stamps == {"recording-2.mcap": [2 * SECOND], "recording.mcap": [0, SECOND]}


class Failing(McapRecorder):
    """Fails once, at 1.2 s."""

    failed = False

    @every(hz=5)
    def fail(self, tick: Tick) -> None:
        if tick.index == 6 and not type(self).failed:
            type(self).failed = True
            raise ValueError("a test's own")


def test_without_a_folder_nothing_is_recorded() -> None:
    """A run that writes no files needs none of it."""
    assert record([imu(0)], None).reason == "duration"


@pytest.mark.slow
def test_a_process_that_is_killed_leaves_what_it_had_written(tmp_path: Path) -> None:
    """The run hears of it, and simulated time does not wait for what will not come."""
    path, failures = tmp_path / "a.mcap", list[RecordingError]()
    config = McapRecorderConfig(chunk_size=1 << 16)
    request = WriteRequest(str(path), config)
    backlog = Backlog(1 << 18, "wait")
    process = WriterProcess(request, backlog, failures.append, lambda _: None)
    process.start()
    backlog.add(1, big(1))
    wait_for_an_event(path)
    os.kill(process._child.pid, signal.SIGKILL)
    process._child.wait()
    for stamp in range(2, 9):
        backlog.add(stamp, big(stamp))
    backlog.wait_for_room()
    assert process.close(9)
    assert process.unwritten <= 7  # what it had written is not among them
    assert "the process that writes it ended with -9" in str(failures)
    assert process.unwritten >= 6
    trouble: list[str] = []
    assert {record.time for record in read(path, damaged=trouble.append)} == {1}
    assert trouble == ["the end is missing: the file was not closed"]


@pytest.mark.slow
def test_a_run_that_is_killed_leaves_a_whole_file(tmp_path: Path) -> None:
    """To the process that writes, that is the end of its input; it closes the file."""
    path = tmp_path / "a.mcap"
    request = WriteRequest(str(path))
    backlog = Backlog(1 << 18, "wait")
    process = WriterProcess(request, backlog, lambda _: None, lambda _: None)
    process.start()
    for event in said(5):
        backlog.add(5, event)
    while backlog.bytes:
        time.sleep(0.01)  # for the thread that hands over
    assert process._child.stdin is not None
    process._child.stdin.close()  # as the end of this process would
    process._child.wait()
    assert contents(path).complete
    assert len([r for r in read(path) if "kind" in r.metadata]) == len(said(5))
    process.close(5)


@pytest.mark.slow
def test_a_recorder_that_is_stopped_ends_the_run_and_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The run names it instead of waiting without end; then it is told to go on."""
    monkeypatch.setattr("nodes.data.recorder.node.STANDSTILL", 1.0)
    start = WriterProcess.start

    def stopped(process: WriterProcess) -> None:
        start(process)
        os.kill(process._child.pid, signal.SIGSTOP)

    monkeypatch.setattr(WriterProcess, "start", stopped)
    events: list[Event] = [big(20_000_000 * k) for k in range(1, 30)]
    begin = time.monotonic()
    with pytest.raises(NodeError, match=r"recorder: .*recording\.mcap: the process that writes it"):
        record([*announcements(), *events], tmp_path, memory=1 << 19)
    assert time.monotonic() - begin < 30.0
    path = tmp_path / "recording.mcap"
    assert contents(path).complete
    stamps = [e.event.stamp for e in Recorded(path).events(0, None, lambda _, __: True)]
    assert stamps[:3] == [20_000_000, 40_000_000, 60_000_000]


@pytest.mark.slow
def test_a_process_that_cannot_be_woken_is_ended_and_what_it_had_written_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such as one in a frozen group: closing takes no longer than the limit."""
    monkeypatch.setattr("nodes.data.recorder.writer_process.STANDSTILL", 0.3)
    path, failures = tmp_path / "a.mcap", list[RecordingError]()
    config = McapRecorderConfig(chunk_size=1 << 16)
    request = WriteRequest(str(path), config)
    process = WriterProcess(request, Backlog(1 << 30, "wait"), failures.append, lambda _: None)
    process.start()
    process.backlog.add(1, big(1))
    wait_for_an_event(path)
    os.kill(process._child.pid, signal.SIGSTOP)
    send = process._child.send_signal
    deaf = {signal.SIGCONT}
    monkeypatch.setattr(process._child, "send_signal", lambda s: s in deaf or send(s))
    for stamp in range(2, 20):
        process.backlog.add(stamp, big(stamp))
    assert not process.close(20, 0.05)
    assert process.close(20)
    (error,) = failures
    assert error is process.error
    assert str(process._child.pid) in str(error)
    assert "has taken nothing for 0.3 s; what it had taken is kept" in str(error)
    trouble: list[str] = []
    assert {record.time for record in read(path, damaged=trouble.append)} == {1}
