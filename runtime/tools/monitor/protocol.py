"""Snapshots of a run and commands for a run: plain data, a JSON object per line.

The run's observer makes the rows of a snapshot's tables; terminal and page show them as they are.
"""

from __future__ import annotations

from typing import Annotated

import msgspec

SLOWEST, QUICKEST = 1e-3, 1e6
"""Limits of the speed, in simulated seconds per real second."""

Rows = list[tuple[str, ...]]
Points = list[tuple[float, ...]]

COLUMNS: dict[str, tuple[str, ...]] = {
    "estimators": ("estimator", "tracking", "ATE m", "ATE %", "latency ms"),
    "nodes": ("node", "condition", "loop", "steps/s", "longest ms", "calls"),
    "ticks": ("tick", "Hz", "calls", "missed", "late p99 µs", "max µs"),
    "inputs": ("input", "holds", "fullest", "of", "dropped"),
    "links": ("link", "lost", "thinned"),
    "outputs": ("output", "event", "sent", "per s", "age s", "latency ms", "max"),
    "settings": ("setting that can change", "value"),
}
"""Titles of columns, by table; the first column of each row is unique.

Of estimators, the ATE is the last that a node sent as `Score`, and the latency is that of the last
estimate. Of nodes, times are real, over the last second or so: the share of the loop's time that a
node took, how often the loop called it, its longest step without the calls of other nodes in it;
and the calls of its workers that are not answered yet. Of outputs, rate, mean and longest latency
(from an event's stamp to its delivery) are on the run's clock over the last real second or so. All
else is since the run began.
"""

STACKS = (("estimators",), ("nodes", "ticks", "inputs", "links"), ("outputs", "settings"))
"""Tables above, and in the left and in the right column."""

_WORDS = {"tracking", "condition", "event", "value"}
"""Columns of text; all others but the first hold numbers."""


def is_number(table: str, column: int) -> bool:
    """Tell whether a column holds numbers, to be aligned right."""
    return column > 0 and COLUMNS[table][column] not in _WORDS


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
    msgspec.Struct, frozen=True, kw_only=True, tag_field="do", forbid_unknown_fields=True
):
    """Base of all that a run can be asked."""


class Pause(_Request, frozen=True, tag="pause"):
    """Pause simulated time."""


class Resume(_Request, frozen=True, tag="resume"):
    """Resume simulated time."""


class Step(_Request, frozen=True, tag="step"):
    """Run for some seconds and pause; without a number, up to the next due time."""

    seconds: Annotated[float, msgspec.Meta(gt=0, le=1e6)] | None = None


class Speed(_Request, frozen=True, tag="speed"):
    """Set how many simulated seconds pass per real second; without a number, as many as can."""

    factor: Annotated[float, msgspec.Meta(ge=SLOWEST, le=QUICKEST)] | None = None


class Restart(_Request, frozen=True, tag="restart"):
    """Restart a node: shut down, then start again."""

    node: str


class Stop(_Request, frozen=True, tag="stop"):
    """End the run in order."""


class Set(_Request, frozen=True, tag="set"):
    """Change a setting of a node: ``node.key=value``, the value in TOML or a bare word."""

    text: str


class Watch(_Request, frozen=True, tag="watch"):
    """Send snapshots, and no answer, for as long as the connection lasts."""


class Look(_Request, frozen=True, tag="look"):
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

LONGEST_COMMAND = 256 << 10
"""Bytes of a line to a run at most."""

LONGEST_LINE = 16 << 20
"""Bytes of a line from a run at most; a snapshot of a hundred nodes has some tens of thousands."""
