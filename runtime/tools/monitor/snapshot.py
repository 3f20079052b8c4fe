"""Snapshots of a run: plain data, the same for terminal and page."""

from __future__ import annotations

from typing import Literal

import msgspec

NodeCondition = Literal["waiting", "starting", "ready", "running", "restarting", "left out", "over"]


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


class NodeState(_Data, frozen=True):
    """One node; times are real, over the last second or so.

    Attributes:
        name: Its name.
        type: As in the file.
        condition: Of starting, running and ending.
        failures: How often it was restarted.
        share: Share of the loop's time that it took, 0 to 1.
        steps: How often the loop called it, per second.
        longest_ms: Its longest step, without the calls of other nodes in it.
        calls: Calls of its workers that are not answered yet.
        settings: Those that can change: ``key`` to value in TOML.
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
    """One output; rate and latency are on the run's clock, over the last real second or so.

    Attributes:
        name: ``node.port``.
        event: Its type of event.
        count: Events sent since the run began.
        rate: Events per second.
        age: Seconds since the last event; `None` before the first that was seen.
        latency_ms: Mean time from an event's stamp to its delivery; `None` without events.
        latency_max_ms: The longest.
    """

    name: str
    event: str
    count: int
    rate: float
    age: float | None
    latency_ms: float | None
    latency_max_ms: float | None


class InputState(_Data, frozen=True):
    """One input, since the beginning of the run; see `StreamStatistics`."""

    name: str
    buffered: int
    peak: int
    bound: int
    dropped: int


class LinkState(_Data, frozen=True):
    """How many events one link lost, and left out to keep to its rate."""

    name: str
    lost: int
    thinned: int


class TickState(_Data, frozen=True):
    """How late one ticker was since the run began; microseconds of the run's clock."""

    name: str
    hz: float
    calls: int
    missed: int
    late_p99_us: float
    late_max_us: float


class LogLine(_Data, frozen=True):
    """One record of the log.

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
    """A run at one moment.

    Attributes:
        run: Its name.
        pid: Of its process.
        number: Counts snapshots, from 1.
        ended: Why the run ends or has ended; empty while it goes on.
        clock: The run's clock.
        nodes: In the order of the file.
        outputs: Of all nodes.
        inputs: Of all nodes.
        links: All there are.
        ticks: Of all nodes.
        cameras: ``node.port: source`` of those that sent an image since somebody watches.
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
