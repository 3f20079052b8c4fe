"""A client of a run's monitor, snapshots in and commands out, and how clients find runs.

Runs listen each at a Unix socket, in a folder that only its user can enter. Each command has a
connection of its own.
"""

from __future__ import annotations

import asyncio
import os
import re
import socket
import threading
from collections.abc import AsyncIterator
from contextlib import closing
from pathlib import Path

from runtime.errors import CommandError, suggest
from runtime.paths import user_folder
from runtime.tools.monitor.protocol import (
    LONGEST_LINE,
    UNREADABLE,
    Answer,
    Command,
    Snapshot,
    Watch,
    decode_answer,
    decode_snapshot,
    encode,
)

ANSWER_TIMEOUT = 10.0
"""Real seconds for a run to answer a command."""


class Client:
    """A client of the run that listens at a path."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._turn = asyncio.Lock()

    async def snapshots(self) -> AsyncIterator[Snapshot]:
        """Yield snapshots until the run is over, or raise `CommandError` if none listens."""
        try:
            reader, writer = await asyncio.open_unix_connection(self._path, limit=LONGEST_LINE)
        except OSError as error:
            raise _not_listening(self._path, error) from None
        with closing(writer):
            writer.write(encode(Watch()) + b"\n")
            try:
                async for line in reader:
                    yield decode_snapshot(line)
            except OSError:
                pass
            except UNREADABLE as error:
                raise CommandError(f"expected a run of this version: {error}") from None

    async def ask(self, command: Command) -> Answer:
        """Send a command to the run after those before it, and return its answer."""
        async with self._turn:
            return await request(self._path, encode(command))


async def request(path: Path, line: bytes) -> Answer:
    """Send an encoded request to a run, and return its answer, or why there is none."""
    try:
        async with asyncio.timeout(ANSWER_TIMEOUT):
            reader, writer = await asyncio.open_unix_connection(path, limit=LONGEST_LINE)
            with closing(writer):
                writer.write(line + b"\n")
                return decode_answer(await reader.readline())
    except TimeoutError:
        return Answer(done=False, text="the run does not answer")
    except (OSError, *UNREADABLE) as error:
        return Answer(done=False, text=str(_not_listening(path, error)))


def ask(path: Path, command: Command) -> str:
    """Send a command to a run, without an event loop, and return the answer.

    Raises:
        CommandError: No run listens there, or it refused.
    """
    answer = asyncio.run(request(path, encode(command)))
    if not answer.done:
        raise CommandError(answer.text)
    return answer.text


def _not_listening(path: Path, error: Exception) -> CommandError:
    reason = getattr(error, "strerror", None) or "it ended"
    return CommandError(f"expected a run that listens at {path}: {reason}")


_LONGEST = 100
"""Bytes of a Unix socket's path at most (108 on Linux, 104 elsewhere)."""


def socket_of(run: str) -> Path:
    """Return the path of the socket for a run of this process, or raise `CommandError`."""
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
        if not _answers(path := Path(run)):
            raise _not_listening(path, ConnectionRefusedError())
        return path
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
