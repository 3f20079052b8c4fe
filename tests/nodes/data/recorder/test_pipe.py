"""Events through a pipe: what goes in comes out, whole or not at all."""

from __future__ import annotations

import io
import os
import threading

import pytest

from events import Event
from nodes.data.recorder import writer_process
from runtime.channels.wire import pack, unpack
from tests.nodes.data.recorder.samples import announcements, image, imu, said, same


def through(data: list[Event], cut: int = 0) -> list[writer_process.Piece]:
    """Send events through a pipe, without the last `cut` bytes."""
    there, here = os.pipe()
    sent = io.BytesIO()
    for event in data:
        writer_process.write(sent, event.stamp + 1, writer_process.EVENT, pack(event))

    def send() -> None:
        with os.fdopen(here, "wb") as file:
            file.write(sent.getvalue()[: -cut or None])

    sender = threading.Thread(target=send)
    sender.start()
    records = list(writer_process.read_all(there, 10.0, lambda: None))
    sender.join()
    os.close(there)
    return records


def test_events_come_out_as_they_went_in() -> None:
    """All kinds, with their times, at alignments of their arrays."""
    events = [*announcements(), *said(3)]
    records = through(events)
    assert [record.time for record in records] == [event.stamp + 1 for event in events]
    assert all(
        same(unpack(record.frame), event) for record, event in zip(records, events, strict=True)
    )


@pytest.mark.parametrize("cut", [1, 40, 200])
def test_half_an_event_at_the_end_is_left_out(cut: int) -> None:
    """The other side was killed: what came whole counts."""
    records = through([imu(1), image(2)], cut)
    assert [record.time for record in records] == [2]


def test_silence_is_noticed() -> None:
    """While nothing comes there is time to end a chunk."""
    there, here = os.pipe()
    calls: list[int] = []

    def while_idle() -> None:
        calls.append(1)
        if len(calls) == 2:
            with os.fdopen(here, "wb") as file:
                writer_process.write(file, 9, writer_process.END)

    assert [record.kind for record in writer_process.read_all(there, 0.001, while_idle)] == [
        writer_process.END
    ]
    assert len(calls) == 2
    os.close(there)


def test_nobody_reading_is_an_error() -> None:
    """It must not be taken for success."""
    there, here = os.pipe()
    os.close(there)
    with pytest.raises(BrokenPipeError), os.fdopen(here, "wb") as file:
        writer_process.write(file, 9, writer_process.END)
