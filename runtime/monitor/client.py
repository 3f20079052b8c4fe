"""The end of the monitor that is not in the run: snapshots in, commands out."""

from __future__ import annotations

import asyncio
import itertools
import socket
from collections.abc import AsyncIterator
from pathlib import Path

from runtime.errors import CommandError
from runtime.monitor.command import (
    LONGEST_LINE,
    UNREADABLE,
    Answer,
    Asked,
    Command,
    Watch,
    decode_from_run,
    encode,
)
from runtime.monitor.snapshot import Snapshot

PATIENCE = 10.0
"""Real seconds that a run gets to answer a command."""


class Client:
    """A connection to a run."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader = reader
        self._writer = writer
        self._numbers = itertools.count()
        self._waiting: dict[int, asyncio.Future[Answer]] = {}

    @classmethod
    async def connect(cls, path: Path) -> Client:
        """Connect to a run.

        Raises:
            CommandError: Nobody listens there.
        """
        try:
            reader, writer = await asyncio.open_unix_connection(path, limit=LONGEST_LINE)
        except OSError as error:
            raise _nobody(path, error) from None
        return cls(reader, writer)

    async def snapshots(self) -> AsyncIterator[Snapshot]:
        """Yield snapshots until the run is over; answers come only while somebody iterates."""
        self._writer.write(encode(Watch()) + b"\n")
        try:
            async for line in self._reader:
                message = decode_from_run(line)
                if isinstance(message, Snapshot):
                    yield message
                elif message.number in self._waiting:
                    self._waiting.pop(message.number).set_result(message)
        except OSError:
            pass
        finally:
            for number, waiting in self._waiting.items():
                waiting.set_result(Answer(number=number, done=False, text="the run is over"))
            self._waiting.clear()
            self.close()

    async def ask(self, command: Command) -> Answer:
        """Ask the run to do something, and return what came of it."""
        number = next(self._numbers)
        waiting: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()
        self._waiting[number] = waiting
        self._writer.write(encode(Asked(number=number, command=command)) + b"\n")
        try:
            async with asyncio.timeout(PATIENCE):
                return await waiting
        except TimeoutError:
            return Answer(number=number, done=False, text="the run does not answer")

    def close(self) -> None:
        """Hang up."""
        self._writer.close()


def ask(path: Path, command: Command) -> str:
    """Ask a run to do something, from outside any loop, and return what was done.

    Raises:
        CommandError: Nobody listens there, or it was not done.
    """
    with socket.socket(socket.AF_UNIX) as connection:
        connection.settimeout(PATIENCE)
        try:
            connection.connect(str(path))
            connection.sendall(encode(Asked(number=0, command=command)) + b"\n")
            line = connection.makefile("rb").readline(LONGEST_LINE)
            answer = decode_from_run(line)
        except TimeoutError:
            raise CommandError("the run does not answer") from None
        except (OSError, *UNREADABLE) as error:
            raise _nobody(path, error) from None
    assert isinstance(answer, Answer)
    if not answer.done:
        raise CommandError(answer.text)
    return answer.text


def _nobody(path: Path, error: Exception) -> CommandError:
    reason = getattr(error, "strerror", None) or "it ended"
    return CommandError(f"expected a run that listens at {path}: {reason}")
