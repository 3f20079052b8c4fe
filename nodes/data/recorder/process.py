"""The process that records: reads events from its standard input, and writes the file.

Started by `writer_process` as ``python -m nodes.data.recorder.process``. It is a process of its
own because encoding holds Python's lock, and would keep the run's loop from it for milliseconds;
and because it outlives a run that is killed, and closes the file in order.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

import msgspec

from nodes.data.mcap.layout import RecordingError
from nodes.data.mcap.mcap_file import McapWriter
from nodes.data.recorder import pipe
from nodes.data.recorder.event_writer import EventWriter
from nodes.data.recorder.pipe import Reply, WriteRequest
from runtime.errors import MissingDependencyError, WireError

LONGEST = 0.4
"""Seconds, real and of the run's clock, after which a chunk ends."""


class FileWriter:
    """Writes one file.

    Raises:
        RecordingError: The file cannot be made.
        MissingDependencyError: A library is not installed.
    """

    def __init__(self, request: WriteRequest) -> None:
        config = request.config
        self._writer = McapWriter(
            Path(request.path),
            compression=config.compression,
            chunk_size=config.chunk_size,
            fsync=config.fsync,
        )
        attachment = Path(request.attachment)
        if attachment.is_file():
            self._writer.attach(attachment.name, "application/toml", attachment.read_bytes())
        self._events = EventWriter(self._writer, config, self._complain)
        self._metadata = request.metadata
        self._complaints: set[str] = set()
        self._written = 0
        self._in_chunk = 0
        self._chunk_began: tuple[float, int] | None = None
        """Real seconds, and the run's nanoseconds."""

    def run(self, file: int) -> Reply:
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
            if self._metadata:
                try:
                    Path(self._metadata).write_text(self._writer.bag_metadata(), "utf-8")
                except OSError as error:
                    self._complain(f"{self._metadata}: cannot be written: {error.strerror}")
        except RecordingError as error:
            self._written -= self._in_chunk
            self._writer.abandon()
            return self._reply("error", str(error))
        return self._reply("done")

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
        if what not in self._complaints:
            self._complaints.add(what)
            send(Reply("complaint", what))

    def _reply(self, what: str, text: str = "") -> Reply:
        return Reply(what, text, self._written, self._writer.size)


def send(reply: Reply) -> None:
    """Send a reply to the run, if it is still there."""
    line = msgspec.json.encode(reply) + b"\n"
    try:
        while line:
            line = line[os.write(sys.stdout.fileno(), line) :]
    except OSError:
        pass


def main(request: str) -> None:
    """Do what is requested, and reply what came of it."""
    for each in (signal.SIGINT, signal.SIGHUP):  # the terminal is the run's business
        signal.signal(each, signal.SIG_IGN)
    wanted = msgspec.json.decode(request, type=WriteRequest)
    os.nice(wanted.niceness)
    if wanted.cores:
        os.sched_setaffinity(0, wanted.cores)
    try:
        writer = FileWriter(wanted)
    except RecordingError as error:
        send(Reply("error", str(error)))
        return
    except MissingDependencyError as error:
        send(Reply("missing", str(error)))
        return
    send(Reply("ready"))
    send(writer.run(sys.stdin.fileno()))


if __name__ == "__main__":
    main(sys.argv[1])
