"""Snapshots of a run and commands for a run: plain data, a JSON object per line.

The run's observer makes the rows of a snapshot's tables; terminal and page show them as they are.
Runs listen each at a Unix socket, in a folder that only its user can enter. Each command has a
connection of its own.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
import socket
import threading
from collections.abc import AsyncIterator, Iterable
from pathlib import Path
from typing import Annotated

import msgspec

from runtime.errors import CommandError, suggest
from runtime.user_folder import user_folder

SLOWEST, QUICKEST = 1e-3, 1e6  # limits of the speed, in simulated seconds per real second

Rows = list[tuple[str, ...]]
Points = list[tuple[float, ...]]

COLUMNS: dict[str, dict[str, str]] = {
    "estimators": {
        "estimator": "", "tracking": "", "ATE m": ".3f", "ATE %": ".2f", "latency ms": ".1f",
    },
    "nodes": {
        "node": "", "condition": "", "loop": ".1%", "steps/s": ".0f", "longest ms": ".2f",
        "calls": "d",
    },
    "ticks": {
        "tick": "", "Hz": "g", "calls": "d", "missed": "d", "late p99 µs": ".0f", "max µs": ".0f",
    },
    "inputs": {"input": "", "holds": "d", "fullest": "d", "of": "d", "dropped": "d"},
    "links": {"link": "", "lost": "d", "thinned": "d"},
    "outputs": {
        "output": "", "event": "", "sent": "d", "per s": ".1f", "age s": ".2f",
        "latency ms": ".2f", "max": ".2f",
    },
    "settings": {"setting that can change": "", "value": ""},
}  # fmt: skip
"""Titles of columns with the formats of their numbers (none: text), by table.

The first column of each row is unique. Of estimators, the ATE is the last that a node sent as
`Score`, and the latency is that of the last estimate. Of nodes, times are real, over the last
second or so: the share of the loop's time that a node took, how often the loop called it, its
longest step without the calls of other nodes in it; and the calls of its workers that are not
answered yet. Of outputs, rate, mean and longest latency (from an event's stamp to its delivery) are
on the run's clock over the last real second or so. All else is since the run began.
"""

STACKS = (("estimators",), ("nodes", "ticks", "inputs", "links"), ("outputs", "settings"))
"""Tables above, and in the left and in the right column."""


def formatted(table: str, values: Iterable[tuple[object, ...]]) -> Rows:
    """Return values as the rows of a table; `None` leaves a cell empty."""
    forms = COLUMNS[table].values()
    return [
        tuple(
            "" if value is None else format(value, form)
            for value, form in zip(row, forms, strict=True)
        )
        for row in values
    ]


class LogLine(msgspec.Struct, frozen=True, kw_only=True):
    """A record of the log.

    Attributes:
        number: Counts the run's records, from 0.
        text: Seconds of the run's clock, level, node (or ``runtime``) and message.
    """

    number: int
    level: str
    text: str


class Snapshot(msgspec.Struct, frozen=True, kw_only=True):
    """State of a run at a moment.

    Attributes:
        now: Seconds since the first update.
        ended: Why the run ends or has ended; empty while it goes on.
        fixed: Why it can be neither paused nor set; empty if it can.
        speed: Base for faster and slower: the requested speed, or else the present one.
        tables: Rows of each of the tables of `COLUMNS`; nodes are in the order of the file.
        paths: Places passed since somebody watches, seen from above (metres east, metres north):
            first the vehicles' true paths (``drone: truth``), then the estimators'.
        cameras: ``node.port: source`` of those that sent an image since somebody watches.
    """

    headline: str
    now: float
    ended: str
    paused: bool
    fixed: str
    speed: float
    tables: dict[str, Rows]
    paths: dict[str, Points]
    cameras: list[str]
    log: list[LogLine]


class _Request(
    msgspec.Struct,
    frozen=True,
    kw_only=True,
    tag_field="do",
    tag=str.lower,
    forbid_unknown_fields=True,
):
    """Base of all that a run can be asked."""


class Pause(_Request, frozen=True):
    """Pause simulated time."""


class Resume(_Request, frozen=True):
    """Resume simulated time."""


class Step(_Request, frozen=True):
    """Run for some seconds and pause; without a number, up to the next due time."""

    seconds: Annotated[float, msgspec.Meta(gt=0, le=1e6)] | None = None


class Speed(_Request, frozen=True):
    """Set how many simulated seconds pass per real second; without a number, as many as can."""

    factor: Annotated[float, msgspec.Meta(ge=SLOWEST, le=QUICKEST)] | None = None


class Restart(_Request, frozen=True):
    """Restart a node: shut down, then start again."""

    node: str


class Stop(_Request, frozen=True):
    """End the run in order."""


class Set(_Request, frozen=True):
    """Change a setting of a node: ``node.key=value``, the value in TOML or a bare word."""

    text: str


class Watch(_Request, frozen=True):
    """Send snapshots, and no answer, for as long as the connection lasts."""


class Look(_Request, frozen=True):
    """Answer with the newest image of a snapshot's camera, while somebody watches."""

    camera: str


Command = Pause | Resume | Step | Speed | Restart | Stop | Set
Request = Command | Watch | Look


class Answer(msgspec.Struct, frozen=True, kw_only=True):
    """The answer to a request.

    Attributes:
        text: What was done, or why not.
        jpeg: The image asked for, made small, its features drawn.
    """

    done: bool
    text: str
    jpeg: bytes = b""


encode = msgspec.json.Encoder().encode
decode_request = msgspec.json.Decoder(Request).decode
decode_answer = msgspec.json.Decoder(Answer).decode
decode_snapshot = msgspec.json.Decoder(Snapshot).decode

UNREADABLE = (msgspec.MsgspecError, ValueError, RecursionError)
"""Exceptions of decoding: invalid JSON or UTF-8, another type, too deep nesting."""

LONGEST_COMMAND = 256 << 10  # bytes of a line to a run at most

LONGEST_LINE = 16 << 20
"""Bytes of a line from a run at most; a snapshot of a hundred nodes has some tens of thousands."""


ANSWER_TIMEOUT = 10.0  # real seconds for a run to answer a command


class Client:
    """A client of the run that listens at a path."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._turn = asyncio.Lock()

    @contextlib.asynccontextmanager
    async def lines(self, request: Request | bytes) -> AsyncIterator[asyncio.StreamReader]:
        """Send a request, encoded or not, on a connection of its own, and hold what comes back.

        Raises:
            CommandError: No run listens.
        """
        try:
            reader, writer = await asyncio.open_unix_connection(self._path, limit=LONGEST_LINE)
        except OSError as error:
            raise _not_listening(self._path, error) from None
        with contextlib.closing(writer):
            line = request if isinstance(request, bytes) else encode(request)
            writer.write(line + b"\n")
            yield reader

    async def snapshots(self) -> AsyncIterator[Snapshot]:
        """Yield snapshots until the run is over, or raise `CommandError` if none listens."""
        async with self.lines(Watch()) as lines:
            try:
                async for line in lines:
                    yield decode_snapshot(line)
            except OSError:
                pass
            except UNREADABLE as error:
                raise CommandError(f"expected a run of this version: {error}") from None

    async def ask(self, request: Request | bytes) -> Answer:
        """Send a request to the run after those before it; return its answer, or why none came."""
        try:
            async with self._turn, asyncio.timeout(ANSWER_TIMEOUT), self.lines(request) as lines:
                return decode_answer(await lines.readline())
        except TimeoutError:
            return Answer(done=False, text="the run does not answer")
        except CommandError as error:
            return Answer(done=False, text=str(error))
        except (OSError, *UNREADABLE) as error:
            return Answer(done=False, text=str(_not_listening(self._path, error)))


def ask(path: Path, command: Command) -> str:
    """Send a command to a run, without a loop, and return the answer; `CommandError` if refused."""
    answer = asyncio.run(Client(path).ask(command))
    if not answer.done:
        raise CommandError(answer.text)
    return answer.text


def _not_listening(path: Path, error: Exception) -> CommandError:
    reason = getattr(error, "strerror", None) or "it ended"
    return CommandError(f"expected a run that listens at {path}: {reason}")


_LONGEST = 100  # bytes of a Unix socket's path at most (108 on Linux, 104 elsewhere)


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
    sockets = runs()
    listed = ", ".join(sockets)
    if not sockets:
        raise CommandError("expected a run to look at, found none that goes on")
    if run is None and len(sockets) > 1:
        raise CommandError(f"expected the name of one of several runs: {listed}")
    if run is not None and run not in sockets:
        raise CommandError(f"expected one of {listed}; found {run!r}{suggest(run, sockets)}")
    return sockets[run] if run is not None else next(iter(sockets.values()))


def _answers(path: Path) -> bool:
    """Return whether a run listens at a socket; remove the socket of a killed run."""
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
