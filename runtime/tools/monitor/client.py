"""A client of a run's monitor: snapshots in, commands out."""

from __future__ import annotations

import asyncio
import itertools
import socket
from collections.abc import AsyncIterator
from pathlib import Path

from runtime.errors import CommandError
from runtime.tools.monitor.command import (
    LONGEST_LINE,
    UNREADABLE,
    Answer,
    Command,
    CommandRequest,
    EncodedImage,
    ImageRequest,
    WatchRequest,
    decode_from_run,
    encode,
)
from runtime.tools.monitor.snapshot import Snapshot

ANSWER_TIMEOUT = 10.0
"""Real seconds within which a run must answer a command."""


class Client:
    """A connection to a run."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader = reader
        self._writer = writer
        self._numbers = itertools.count()
        self._waiting: dict[int, asyncio.Future[Answer | EncodedImage]] = {}
        self._over = False

    @classmethod
    async def connect(cls, path: Path) -> Client:
        """Connect to a run.

        Raises:
            CommandError: No run listens there.
        """
        try:
            reader, writer = await asyncio.open_unix_connection(path, limit=LONGEST_LINE)
        except OSError as error:
            raise _not_listening(path, error) from None
        return cls(reader, writer)

    async def snapshots(self) -> AsyncIterator[Snapshot]:
        """Yield snapshots until the run is over; answers are received only meanwhile.

        Raises:
            CommandError: The run is of another version.
        """
        self._writer.write(encode(WatchRequest()) + b"\n")
        try:
            async for line in self._reader:
                message = decode_from_run(line)
                if isinstance(message, Snapshot):
                    yield message
                else:
                    self._settle(message)
        except OSError:
            pass
        except UNREADABLE as error:
            raise CommandError(f"expected a run of this version: {error}") from None
        finally:
            self._over = True
            for number in list(self._waiting):
                self._settle(_run_over(number))
            self.close()

    def _settle(self, answer: Answer | EncodedImage) -> None:
        waiting = self._waiting.pop(answer.number, None)
        if waiting is not None and not waiting.done():  # else it came too late
            waiting.set_result(answer)

    async def ask(self, command: Command) -> Answer:
        """Send a command to the run, and return its answer."""
        answer = await self._request(CommandRequest(number=next(self._numbers), command=command))
        assert isinstance(answer, Answer)
        return answer

    async def image(self, camera: str) -> bytes:
        """Return the newest image of one of a snapshot's cameras, as JPEG.

        Raises:
            CommandError: There is none, or the run does not answer.
        """
        answer = await self._request(ImageRequest(number=next(self._numbers), camera=camera))
        if isinstance(answer, Answer):
            raise CommandError(answer.text)
        return answer.jpeg

    async def _request(self, request: CommandRequest | ImageRequest) -> Answer | EncodedImage:
        number = request.number
        if self._over:
            return _run_over(number)
        waiting: asyncio.Future[Answer | EncodedImage] = asyncio.get_running_loop().create_future()
        self._waiting[number] = waiting
        self._writer.write(encode(request) + b"\n")
        try:
            async with asyncio.timeout(ANSWER_TIMEOUT):
                return await waiting
        except TimeoutError:
            self._waiting.pop(number, None)
            return Answer(number=number, done=False, text="the run does not answer")

    def close(self) -> None:
        """Close the connection."""
        self._writer.close()


def ask(path: Path, command: Command) -> str:
    """Send a command to a run, without an event loop, and return what was done.

    Raises:
        CommandError: No run listens there, or it refused.
    """
    with socket.socket(socket.AF_UNIX) as connection:
        connection.settimeout(ANSWER_TIMEOUT)
        try:
            connection.connect(str(path))
            connection.sendall(encode(CommandRequest(number=0, command=command)) + b"\n")
            line = connection.makefile("rb").readline(LONGEST_LINE)
            answer = decode_from_run(line)
        except TimeoutError:
            raise CommandError("the run does not answer") from None
        except (OSError, *UNREADABLE) as error:
            raise _not_listening(path, error) from None
    assert isinstance(answer, Answer)
    if not answer.done:
        raise CommandError(answer.text)
    return answer.text


def _run_over(number: int) -> Answer:
    return Answer(number=number, done=False, text="the run is over")


def _not_listening(path: Path, error: Exception) -> CommandError:
    reason = getattr(error, "strerror", None) or "it ended"
    return CommandError(f"expected a run that listens at {path}: {reason}")
