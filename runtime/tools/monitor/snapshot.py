"""What there is to see of a run: plain data, the same for every kind of screen."""

from __future__ import annotations

from typing import Literal

import msgspec

NodeCondition = Literal["waiting", "starting", "ready", "running", "restarting", "left out", "over"]


class _Data(msgspec.Struct, frozen=True, kw_only=True):
    """Base of what a snapshot consists of."""


class ClockState(_Data, frozen=True):
    """The run's clock.

    Attributes:
        kind: ``lockstep`` or ``real``.
        now: Seconds since the first update.
        duration: Seconds at which the run ends; 0 for no limit.
        speed: Seconds of the clock per real second over the last second or so.
        asked: The speed that was asked for; `None`: as fast as it can.
        paused: Whether it stands.
        fixed: Why it can be neither paused nor set; empty if it can.
    """

    kind: str
    now: float
    duration: float
    speed: float
    asked: float | None
    paused: bool
    fixed: str


class NodeState(_Data, frozen=True):
    """One node; times are real, over the last second or so.

    Attributes:
        name: Its name.
        type: ``module:Class``.
        condition: Where it is in its life.
        failures: How often it was restarted.
        share: Of the loop's time that was its own: 1 is all.
        steps: How often the loop went into it, a second.
        longest_ms: Its longest step, less what that called in others.
        calls: Calls of its workers that wait for an answer.
        settings: What can be changed, as ``key`` to TOML.
    """

    name: str
    type: str
    condition: NodeCondition
    failures: int
    share: float
    steps: float
    longest_ms: float
    calls: int
    settings: dict[str, str]


class OutputState(_Data, frozen=True):
    """One output; seconds are the run's clock's, over the last second or so (a real one).

    Attributes:
        name: ``node.port``.
        event: Its type of event.
        count: Events sent since the beginning.
        rate: Events a second.
        age: Seconds since the last; `None` before the first that was seen.
        latency_ms: Mean of what lay between an event's stamp and its delivery; `None` if there
            was none.
        latency_max_ms: The most.
    """

    name: str
    event: str
    count: int
    rate: float
    age: float | None
    latency_ms: float | None
    latency_max_ms: float | None


class InputState(_Data, frozen=True):
    """One input, since the beginning of the run; see `runtime.streams.StreamStatistics`."""

    name: str
    buffered: int
    peak: int
    bound: int
    dropped: int


class LinkState(_Data, frozen=True):
    """What one link lost, and left out to keep to its rate."""

    name: str
    lost: int
    thinned: int


class TickState(_Data, frozen=True):
    """How punctual one ticker was since the beginning; microseconds of the run's clock."""

    name: str
    hz: float
    calls: int
    missed: int
    late_p99_us: float
    late_max_us: float


class LogLine(_Data, frozen=True):
    """One record of the log.

    Attributes:
        number: Counts the records of the run.
        seconds: Of the run's clock.
        level: ``INFO``, ``WARNING``, …
        speaker: The node, or ``runtime``.
        text: What it says.
    """

    number: int
    seconds: float
    level: str
    speaker: str
    text: str


class Snapshot(_Data, frozen=True, tag="snapshot"):
    """A run at one moment.

    Attributes:
        run: Its name.
        pid: Of its process.
        number: Counts snapshots.
        ended: Why the run ends or has ended; empty while it goes on.
        clock: The run's clock.
        nodes: In the order of the file.
        outputs: Of all nodes.
        inputs: Of all nodes.
        links: All there are.
        ticks: Of all nodes.
        cameras: Whose images can be asked for: those that sent one since somebody looks.
        log: The last records.
    """

    run: str
    pid: int
    number: int
    ended: str
    clock: ClockState
    nodes: list[NodeState]
    outputs: list[OutputState]
    inputs: list[InputState]
    links: list[LinkState]
    ticks: list[TickState]
    cameras: list[str]
    log: list[LogLine]
