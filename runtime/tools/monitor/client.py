"""A client of a run's monitor, snapshots in and commands out, and how clients find each other.

Runs listen each at a Unix socket, in a folder that only its user can enter. The page listens on
this machine, and needs only a part of HTTP: a request, a response, server-sent events.

Protocols: RFC 9112 (HTTP/1.1); "Server-sent events" in the HTML standard.
"""

from __future__ import annotations

import asyncio
import itertools
import os
import re
import socket
import threading
from collections.abc import AsyncIterator
from http import HTTPStatus
from pathlib import Path
from typing import NamedTuple
from urllib.parse import parse_qs, urlsplit

from runtime.errors import CommandError, suggest
from runtime.paths import user_folder
from runtime.tools.monitor.protocol import (
    LONGEST_LINE,
    UNREADABLE,
    Answer,
    Command,
    CommandRequest,
    EncodedImage,
    ImageRequest,
    Snapshot,
    WatchRequest,
    decode_from_run,
    encode,
)

ANSWER_TIMEOUT = 10.0
"""Real seconds for a run to answer a command."""


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
        """Return the newest image of a snapshot's camera, as JPEG.

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
    """Send a command to a run, without an event loop, and return the answer.

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


_LONGEST = 100
"""Bytes of a Unix socket's path at most (108 on Linux, 104 elsewhere)."""


def socket_of(run: str) -> Path:
    """Return the path of the socket for a run of this process.

    Raises:
        CommandError: The folder cannot be used, or others could enter it.
    """
    place, number = user_folder(), f"{os.getpid()}"
    if threading.current_thread() is not threading.main_thread():  # others may run in others
        number += f".{threading.get_native_id()}"
    end = f"-{number}.sock"
    for other in place.glob("*.sock"):  # what killed runs have left is removed
        _answers(other)
    name = re.sub(r"[^\w.-]", "_", run)
    room = _LONGEST - len(os.fsencode(place)) - 1 - len(end)
    short = os.fsencode(name)[: max(room, 1)].decode(errors="ignore")
    return place / f"{short}{end}"


def runs() -> dict[str, Path]:
    """Return the sockets of listening runs, by name; ``name-process`` for equal names."""
    listening = [path for path in sorted(user_folder().glob("*.sock")) if _answers(path)]
    names = [path.stem.rpartition("-")[0] for path in listening]
    return {
        path.stem if names.count(name) > 1 else name: path
        for name, path in zip(names, listening, strict=True)
    }


def find(run: str | None) -> Path:
    """Return the path of a run's socket.

    Args:
        run: Its name, ``name-process`` if there are two, or the path of its socket; `None` if
            there is only one.

    Raises:
        CommandError: There is no such run, no run at all, or several without a name given.
    """
    if run is not None and run.endswith(".sock"):
        return Path(run)
    found = runs()
    listed = ", ".join(found)
    if not found:
        raise CommandError("expected a run to look at, found none that goes on")
    if run is None and len(found) > 1:
        raise CommandError(f"expected the name of one of several runs: {listed}")
    if run is not None and run not in found:
        raise CommandError(f"expected one of {listed}; found {run!r}{suggest(run, found)}")
    return found[run] if run is not None else next(iter(found.values()))


def _answers(path: Path) -> bool:
    """Tell whether a run listens at a socket; remove the socket of a killed run."""
    with socket.socket(socket.AF_UNIX) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(str(path))
        except (ConnectionRefusedError, FileNotFoundError):
            if path.is_socket():  # of a file, a connection is refused as well
                path.unlink(missing_ok=True)
            return False
        except OSError:
            return False
    return True


LONGEST_HEAD = 16 << 10
LONGEST_BODY = 64 << 10
"""Bytes of a request at most."""


class HttpError(Exception):
    """Refusal of an HTTP request."""

    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        self.status = status
        self.text = text


class Request(NamedTuple):
    """A request; names of headers are in lower case."""

    method: str
    path: str
    query: dict[str, str]
    headers: dict[str, str]
    body: bytes


_ONCE = {"host", "origin", "content-length", "x-token"}
"""Headers to be given only once: with two, the valid origin or target would be unclear."""


def parse_head(head: str) -> tuple[str, str, dict[str, str]]:
    """Return method, target and headers of a request; names of headers are in lower case.

    Raises:
        HttpError: It is no request, or has two of a header of which there may be one.
    """
    first, *lines = head.split("\r\n")
    parts = first.split(" ")
    if len(parts) != 3 or not parts[2].startswith("HTTP/1."):
        raise HttpError(400, "expected a request of HTTP/1.1")
    headers: dict[str, str] = {}
    for line in lines:
        name, colon, value = line.partition(":")
        name = name.strip().lower()
        if colon and name in _ONCE and name in headers:
            raise HttpError(400, f"expected one header {name}, found two")
        if colon:
            headers[name] = value.strip()
    return parts[0], parts[1], headers


def host_of(headers: dict[str, str]) -> str:
    """Return the host named by a request, without its port; empty if none."""
    host = headers.get("host", "")
    if host.startswith("["):
        return host[1:].partition("]")[0]
    return host.partition(":")[0]


async def read_request(reader: asyncio.StreamReader) -> Request:
    """Read a request.

    Raises:
        HttpError: No request, or too long.
        EOFError: The other side went.
    """
    try:
        head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1")
    except asyncio.LimitOverrunError:
        raise HttpError(413, "expected a shorter request") from None
    method, target, headers = parse_head(head)
    try:
        url = urlsplit(target)
    except ValueError as error:
        raise HttpError(400, f"expected an address: {error}") from None
    query = {key: values[0] for key, values in parse_qs(url.query).items()}
    length = headers.get("content-length", "0")
    if not length.isascii() or not length.isdigit():
        raise HttpError(400, "expected a length")
    if len(length) > 9 or int(length) > LONGEST_BODY:
        raise HttpError(413, f"expected at most {LONGEST_BODY} bytes")
    return Request(method, url.path, query, headers, await reader.readexactly(int(length)))


def response(
    status: int, content: bytes, kind: str = "text/plain; charset=utf-8", **headers: str
) -> bytes:
    """Return a response, the last of its connection.

    Args:
        content: Its body.
        headers: Others, with ``_`` for ``-``.
    """
    return _head(status, kind, {"content-length": str(len(content)), **headers}) + content


def event_stream() -> bytes:
    """Return the head of a stream of server-sent events."""
    return _head(200, "text/event-stream", {})


def server_sent(data: bytes) -> bytes:
    """Return an event of a stream; `data` is a single line."""
    return b"data: " + data + b"\n\n"


def _head(status: int, kind: str, headers: dict[str, str]) -> bytes:
    lines = [f"HTTP/1.1 {status} {HTTPStatus(status).phrase}", f"content-type: {kind}"]
    lines += [f"{name.replace('_', '-')}: {value}" for name, value in headers.items()]
    lines += [
        "cache-control: no-store",
        "x-content-type-options: nosniff",
        "referrer-policy: no-referrer",
        "connection: close",
    ]
    return ("\r\n".join(lines) + "\r\n\r\n").encode("latin-1")
