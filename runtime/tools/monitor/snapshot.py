"""Snapshots of a run: plain data, the same for terminal and page.

Measures how much of the loop nodes take, and how old events are, while somebody watches.

Figures are those of the last second or so, which are steadier than those of one interval.
"""

from __future__ import annotations

import collections
import time
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import msgspec

from events import Event, Image
from runtime.channels.sender import Sender
from runtime.run.instruments import Call, Instrument
from runtime.time.clock import Clock
from runtime.time.schedule import SECOND

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


KEPT = 5
"""How many intervals between snapshots figures cover."""


class Amount(NamedTuple):
    """Durations of one node or output, added up.

    Attributes:
        times: How many they are.
        total: Their sum, nanoseconds.
        longest: The longest, nanoseconds.
    """

    times: int = 0
    total: int = 0
    longest: int = 0

    def plus(self, other: Amount) -> Amount:
        """Return both, added up."""
        return Amount(
            self.times + other.times,
            self.total + other.total,
            max(self.longest, other.longest),
        )


class Sample(NamedTuple):
    """Counters at one snapshot.

    Attributes:
        real: Seconds of `time.perf_counter`.
        run: Nanoseconds of the run's clock.
        sent: Events sent since the run began, by output.
        nodes: Time that each node took of the loop since the sample before.
        outputs: Times from stamp to delivery since then.
    """

    real: float
    run: int
    sent: Mapping[str, int]
    nodes: Mapping[str, Amount]
    outputs: Mapping[str, Amount]


class RecentSamples:
    """The last samples.

    Args:
        first: Only its times and its count of sent events are used.
    """

    def __init__(self, first: Sample) -> None:
        self._samples = collections.deque([first], maxlen=KEPT + 1)

    def add(self, sample: Sample) -> None:
        """Add a sample and forget the oldest."""
        self._samples.append(sample)

    @property
    def real(self) -> float:
        """Real seconds that the samples span."""
        return max(self._samples[-1].real - self._samples[0].real, 1e-9)

    @property
    def run(self) -> float:
        """Seconds of the run's clock that the samples span."""
        return (self._samples[-1].run - self._samples[0].run) / SECOND

    def rate(self, output: str) -> float:
        """Return how many events an output sent per second of the run's clock."""
        sent = self._samples[-1].sent.get(output, 0) - self._samples[0].sent.get(output, 0)
        return sent / self.run if self.run > 0 else 0.0

    def node(self, name: str) -> Amount:
        """Return how much of the loop's time a node took."""
        return self._sum([sample.nodes.get(name, Amount()) for sample in self._later()])

    def output(self, name: str) -> Amount:
        """Return the times from the stamps of an output's events to their delivery."""
        return self._sum([sample.outputs.get(name, Amount()) for sample in self._later()])

    def _later(self) -> list[Sample]:
        return list(self._samples)[1:]

    @staticmethod
    def _sum(amounts: list[Amount]) -> Amount:
        found = Amount()
        for amount in amounts:
            found = found.plus(amount)
        return found


class DurationSum:
    """Durations since the last snapshot, nanoseconds."""

    __slots__ = ("count", "last", "longest", "total")

    def __init__(self) -> None:
        self.count = 0
        self.total = 0
        self.longest = 0
        self.last = 0
        """When the last one ended, on the run's clock (ns); of outputs only."""

    def take(self) -> Amount:
        """Return the sum, and start again from zero."""
        amount = Amount(self.count, self.total, self.longest)
        self.count = self.total = self.longest = 0
        return amount


class Meter(Instrument):
    """An instrument that adds up durations, and keeps the newest images.

    Attributes:
        nodes: Time each node took of the loop, by name, without the calls of other nodes in it.
        outputs: Times from stamp to delivery of each output's events, by ``node.port``.
        images: The newest image of each camera, by ``node.port: source``.
    """

    def __init__(self, clock: Clock) -> None:
        self.nodes: dict[str, DurationSum] = {}
        self.outputs: dict[str, DurationSum] = {}
        self.images: dict[str, Image] = {}
        self._clock = clock
        self._inner = [0]
        """Nanoseconds that the steps within the one that runs have taken."""
        self.event_sent = self._tap

    def wrap_call(self, node: str, what: str, call: Call) -> Call:  # noqa: ARG002
        """Return a function that calls `call` and adds up how long it takes."""
        inner, time_ns = self._inner, time.perf_counter_ns
        steps = self.nodes.setdefault(node, DurationSum())

        def metering(argument: Any) -> Any:
            outer = inner[0]
            inner[0] = 0
            begin = time_ns()
            try:
                return call(argument)
            finally:
                took = time_ns() - begin
                own = took - inner[0]
                inner[0] = outer + took
                steps.total += own
                steps.count += 1
                if own > steps.longest:
                    steps.longest = own

        return metering

    def _tap(self, sender: Sender[Any] | None, event: Event) -> None:
        name = "run.announced" if sender is None else sender.name
        flow = self.outputs.get(name)
        if flow is None:
            flow = self.outputs[name] = DurationSum()
        now = self._clock.now()
        latency = now - event.stamp
        flow.count += 1
        flow.total += latency
        flow.last = now
        if latency > flow.longest:
            flow.longest = latency
        if isinstance(event, Image):
            self.images[f"{name}: {event.source}"] = event
