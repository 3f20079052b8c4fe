"""The process that records: reads events from its standard input, and writes the file.

Started by `recording` as ``python -m nodes.mcap_recorder.process``. A process of its own, because
encoding holds Python's lock, and would keep the run's loop from it for milliseconds; and because
it outlives a run that is killed, and closes the file in order.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

import msgspec

from nodes.mcap.disk import RecordingError
from nodes.mcap.mcap_file import McapWriter
from nodes.mcap_recorder import pipe
from nodes.mcap_recorder.event_writer import EventWriter
from nodes.mcap_recorder.order import Answer, Order
from runtime.errors import MissingDependencyError, WireError

LONGEST = 0.4
"""Seconds, real and of the run's clock, after which a chunk ends."""


class Process:
    """Writes one file.

    Args:
        order: What to do.

    Raises:
        RecordingError: The file cannot be made.
        MissingDependencyError: A library is not installed.
    """

    def __init__(self, order: Order) -> None:
        config = order.config
        self._writer = McapWriter(
            Path(order.path),
            compression=config.compression,
            chunk_size=config.chunk_size,
            fsync=config.fsync,
        )
        attachment = Path(order.attachment)
        if attachment.is_file():
            self._writer.attach(attachment.name, "application/toml", attachment.read_bytes())
        self._events = EventWriter(self._writer, config, self._complain)
        self._said: set[str] = set()
        self._written = 0
        self._in_chunk = 0
        self._chunk_began: tuple[float, int] | None = None
        """Real seconds, and the run's nanoseconds."""

    def run(self, file: int) -> Answer:
        """Write what comes from a file descriptor, and close the file."""
        last = 0
        try:
            for piece in pipe.read_all(file, LONGEST / 2, self._while_idle):
                last = piece.time
                if piece.what == pipe.END:
                    break
                self._write(piece)
            self._end_chunk()
            facts = {"end": str(last), "events": str(self._written)}
            self._writer.close({"visnav": facts})
        except RecordingError as error:
            self._written -= self._in_chunk
            self._writer.abandon()
            return self._answer("error", str(error))
        return self._answer("done")

    def _write(self, piece: pipe.Piece) -> None:
        try:
            self._events.write(piece.time, piece.frame, piece.what == pipe.ANNOUNCEMENT)
            self._written += 1
            self._in_chunk += 1
        except WireError as error:
            self._complain(str(error))
        if self._chunk_began is None:
            self._chunk_began = time.monotonic(), piece.time
        real, run = self._chunk_began
        if (
            self._writer.full
            or piece.time - run >= LONGEST * 1e9
            or time.monotonic() - real >= LONGEST
        ):
            self._end_chunk()

    def _while_idle(self) -> None:
        if self._chunk_began and time.monotonic() - self._chunk_began[0] >= LONGEST:
            self._end_chunk()

    def _end_chunk(self) -> None:
        self._chunk_began = None
        self._writer.end_chunk()
        self._in_chunk = 0

    def _complain(self, what: str) -> None:
        if what not in self._said:
            self._said.add(what)
            say(Answer("complaint", what))

    def _answer(self, what: str, text: str = "") -> Answer:
        return Answer(what, text, self._written, self._writer.size)


def say(answer: Answer) -> None:
    """Say something to the run, if it is still there."""
    line = msgspec.json.encode(answer) + b"\n"
    try:
        while line:
            line = line[os.write(sys.stdout.fileno(), line) :]
    except OSError:
        pass


def main(order: str) -> None:
    """Do what is asked, and tell what came of it."""
    for each in (signal.SIGINT, signal.SIGHUP):  # the terminal is the run's business
        signal.signal(each, signal.SIG_IGN)
    wanted = msgspec.json.decode(order, type=Order)
    os.nice(wanted.niceness)
    if wanted.cores:
        os.sched_setaffinity(0, wanted.cores)
    try:
        process = Process(wanted)
    except RecordingError as error:
        say(Answer("error", str(error)))
        return
    except MissingDependencyError as error:
        say(Answer("missing", str(error)))
        return
    say(Answer("ready"))
    say(process.run(sys.stdin.fileno()))


if __name__ == "__main__":
    main(sys.argv[1])
