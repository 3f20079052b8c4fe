"""Snapshots of a run and commands for a run: plain data, a JSON object per line.

The run's observer makes the rows of a snapshot's tables; terminal and page show them as they are.
"""

from __future__ import annotations

from typing import Annotated

import msgspec

SLOWEST, QUICKEST = 1e-3, 1e6
"""Limits of the speed, in simulated seconds per real second."""

Rows = list[tuple[str, ...]]

COLUMNS: dict[str, tuple[str, ...]] = {
    "nodes": ("node", "condition", "loop", "steps/s", "longest ms", "calls"),
    "outputs": ("output", "event", "sent", "per s", "age s", "latency ms", "max"),
    "inputs": ("input", "holds", "fullest", "of", "dropped"),
    "links": ("link", "lost", "thinned"),
    "ticks": ("tick", "Hz", "calls", "missed", "late p99 µs", "max µs"),
    "settings": ("setting that can change", "value"),
}
"""Titles of columns, by table; the first column of each row is unique.

Of nodes, times are real, over the last second or so: the share of the loop's time that a node took,
how often the loop called it, its longest step without the calls of other nodes in it; and the calls
of its workers that are not answered yet. Of outputs, rate, mean and longest latency (from an
event's stamp to its delivery) are on the run's clock over the last real second or so. All else is
since the run began.
"""

LEFT, RIGHT = ("nodes", "ticks", "inputs", "links"), ("outputs", "settings")
"""Tables in the left and in the right column."""

_WORDS = {"condition", "event", "value"}
"""Columns of text; all others but the first hold numbers."""


def is_number(table: str, column: int) -> bool:
    """Tell whether a column holds numbers, to be aligned right."""
    return column > 0 and COLUMNS[table][column] not in _WORDS


class _Data(msgspec.Struct, frozen=True, kw_only=True):
    """Base of the parts of a snapshot."""


class ClockState(_Data, frozen=True):
    """The run's clock.

    Attributes:
        kind: ``lockstep`` or ``real``.
        now: Seconds since the first update.
        duration: Seconds at which the run ends; 0 for no limit.
        speed: Seconds of the clock per real second over the last second or so.
        target_speed: The speed that was asked for; `None`: as fast as it can.
        paused: Whether it is paused.
        fixed: Why it can be neither paused nor set; empty if it can.
    """

    kind: str
    now: float
    duration: float
    speed: float
    target_speed: float | None
    paused: bool
    fixed: str

    @property
    def pace(self) -> str:
        """The actual and the requested speed of time, in words."""
        speed = f"{self.speed:.2f} × real time"
        if self.kind == "real":
            return f"{speed} (real)"
        target = self.target_speed
        return f"{speed} ({'as fast as it can' if target is None else f'asked: {target:g}'})"

    @property
    def aim(self) -> float:
        """Base for faster and slower: the requested speed, or else the present."""
        return (
            self.target_speed if self.target_speed is not None else max(round(self.speed, 1), 1.0)
        )


class LogLine(_Data, frozen=True):
    """A record of the log.

    Attributes:
        number: Counts the run's records, from 0.
        seconds: Of the run's clock.
        level: ``INFO``, ``WARNING``, …
        logger_name: The node, or ``runtime``.
        text: The message.
    """

    number: int
    seconds: float
    level: str
    logger_name: str
    text: str


class Snapshot(_Data, frozen=True, tag="snapshot"):
    """State of a run at a moment.

    Attributes:
        run: Its name.
        pid: Of its process.
        number: Counts snapshots, from 1.
        ended: Why the run ends or has ended; empty while it goes on.
        clock: The run's clock.
        tables: Rows of each of the tables of `COLUMNS`; nodes are in the order of the file.
        cameras: ``node.port: source`` of those that sent an image since somebody watches.
        log: The last records.
    """

    run: str
    pid: int
    number: int
    ended: str
    clock: ClockState
    tables: dict[str, Rows]
    cameras: list[str]
    log: list[LogLine]

    @property
    def headline(self) -> str:
        """Time, speed and condition of the run, as a line."""
        clock = self.clock
        limit = f" of {clock.duration:g}" if clock.duration else ""
        condition = "paused" if clock.paused else "runs"
        if self.ended:
            condition = f"ends: {self.ended}"
        return f"{self.run}   {clock.now:.3f}{limit} s   {clock.pace}   {condition}"


class _Command(
    msgspec.Struct, frozen=True, kw_only=True, tag_field="do", forbid_unknown_fields=True
):
    """Base of the commands."""


class Pause(_Command, frozen=True, tag="pause"):
    """Pause simulated time."""


class Resume(_Command, frozen=True, tag="resume"):
    """Resume simulated time."""


class Step(_Command, frozen=True, tag="step"):
    """Run for some seconds and pause; without a number, up to the next due time."""

    seconds: Annotated[float, msgspec.Meta(gt=0, le=1e6)] | None = None


class Speed(_Command, frozen=True, tag="speed"):
    """Set how many simulated seconds pass per real second; without a number, as many as can."""

    factor: Annotated[float, msgspec.Meta(ge=SLOWEST, le=QUICKEST)] | None = None


class Restart(_Command, frozen=True, tag="restart"):
    """Restart a node: shut down, then start again."""

    node: str


class Stop(_Command, frozen=True, tag="stop"):
    """End the run in order."""


class Set(_Command, frozen=True, tag="set"):
    """Change a setting of a node: ``node.key=value``, the value in TOML or a bare word."""

    text: str


Command = Pause | Resume | Step | Speed | Restart | Stop | Set


class CommandRequest(msgspec.Struct, frozen=True, kw_only=True, tag="ask"):
    """A command to a run; its answer has the same `number`."""

    number: int
    command: Command


class ImageRequest(msgspec.Struct, frozen=True, kw_only=True, tag="image"):
    """Request for a snapshot camera's newest image; answered while somebody watches."""

    number: int
    camera: str


class WatchRequest(msgspec.Struct, frozen=True, tag="watch"):
    """Asks for snapshots for as long as the connection lasts."""


class Answer(msgspec.Struct, frozen=True, kw_only=True, tag="answer"):
    """The answer to a command, or why there is no image.

    Attributes:
        number: Of the request.
        done: Whether it was carried out.
        text: What was done, or why not.
    """

    number: int
    done: bool
    text: str


class EncodedImage(msgspec.Struct, frozen=True, kw_only=True, tag="jpeg"):
    """Answer to an `ImageRequest`.

    Attributes:
        number: Of the request.
        jpeg: The image, made small.
    """

    number: int
    jpeg: bytes


FromClient = CommandRequest | ImageRequest | WatchRequest
FromRun = Snapshot | Answer | EncodedImage

encode = msgspec.json.Encoder().encode
decode_from_client = msgspec.json.Decoder(FromClient).decode
decode_from_run = msgspec.json.Decoder(FromRun).decode
decode_command = msgspec.json.Decoder(Command).decode

UNREADABLE = (msgspec.MsgspecError, ValueError, RecursionError)
"""Exceptions of decoding: invalid JSON or UTF-8, another type, too deep nesting."""

LONGEST_COMMAND = 256 << 10
"""Bytes of a line to a run at most."""

LONGEST_LINE = 16 << 20
"""Bytes of a line from a run at most; a snapshot of a hundred nodes has some tens of thousands."""
