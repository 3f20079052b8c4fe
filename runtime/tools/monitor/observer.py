"""Makes snapshots of a run, its log's last records included, and carries commands out.

All of it happens on the run's loop. While somebody watches, an instrument measures how much of the
loop nodes take, and how old events are; figures are those of the last second or so, which are
steadier than those of one interval.
"""

from __future__ import annotations

import collections
import itertools
import logging
import os
import time
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import msgspec

from events import Event, Image
from runtime.channels.sender import Sender
from runtime.config.model import Config
from runtime.config.parameters import settings
from runtime.errors import CommandError, suggest
from runtime.node import NodeConfig, senders, streams
from runtime.run.instruments import Call, Instrument
from runtime.run.node_runner import NodeRunner
from runtime.run.summarise import count_drops
from runtime.run.supervisor import Supervisor
from runtime.time.clock import Clock
from runtime.time.schedule import SECOND
from runtime.tools.monitor.protocol import (
    ClockState,
    Command,
    LogLine,
    Pause,
    Restart,
    Resume,
    Rows,
    Set,
    Snapshot,
    Speed,
    Step,
    Stop,
)

KEPT = 5
"""How many intervals between snapshots figures cover."""


class Amount(NamedTuple):
    """Sum of durations of a node or output.

    Attributes:
        times: Number of durations.
        total: Their sum, nanoseconds.
        longest: The longest, nanoseconds.
    """

    times: int = 0
    total: int = 0
    longest: int = 0


class Sample(NamedTuple):
    """Counters at a snapshot.

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
        """Real seconds spanned by the samples."""
        return max(self._samples[-1].real - self._samples[0].real, 1e-9)

    @property
    def run(self) -> float:
        """Seconds of the run's clock spanned by the samples."""
        return (self._samples[-1].run - self._samples[0].run) / SECOND

    def rate(self, output: str) -> float:
        """Return how many events an output sent per second of the run's clock."""
        sent = self._samples[-1].sent.get(output, 0) - self._samples[0].sent.get(output, 0)
        return sent / self.run if self.run > 0 else 0.0

    def node(self, name: str) -> Amount:
        """Return how much of the loop's time a node took."""
        return _added(sample.nodes.get(name) for sample in [*self._samples][1:])

    def output(self, name: str) -> Amount:
        """Return the times from the stamps of an output's events to their delivery."""
        return _added(sample.outputs.get(name) for sample in [*self._samples][1:])


def _added(amounts: Iterable[Amount | None]) -> Amount:
    known = [amount for amount in amounts if amount is not None]
    return Amount(
        sum(amount.times for amount in known),
        sum(amount.total for amount in known),
        max((amount.longest for amount in known), default=0),
    )


class DurationSum:
    """Durations since the last snapshot, nanoseconds."""

    __slots__ = ("count", "last", "longest", "total")

    def __init__(self) -> None:
        self.count = 0
        self.total = 0
        self.longest = 0
        self.last = 0
        """End of the last duration, on the run's clock (ns); of outputs only."""

    def take(self) -> Amount:
        """Return the sum, and start again from zero."""
        amount = Amount(self.count, self.total, self.longest)
        self.count = self.total = self.longest = 0
        return amount


class Meter(Instrument):
    """An instrument to add up durations, and to keep the newest images.

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
        """Nanoseconds taken by the steps nested in the running step."""
        self.event_sent = self._tap

    def wrap_call(self, node: str, what: str, call: Call) -> Call:  # noqa: ARG002
        """Return a function to call `call` and add up its durations."""
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


RECORDS = 100


class LastRecords(logging.Handler):
    """A handler to keep the last log records; runs in the log's own thread."""

    def __init__(self) -> None:
        super().__init__()
        self._lines: collections.deque[LogLine] = collections.deque(maxlen=RECORDS)
        self._numbers = itertools.count()

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a record."""
        self._lines.append(
            LogLine(
                number=next(self._numbers),
                seconds=getattr(record, "seconds", 0.0),
                level=record.levelname,
                logger_name=getattr(record, "logger_name", record.name),
                text=record.getMessage(),
            )
        )

    def lines(self) -> list[LogLine]:
        """Return the records, the oldest first."""
        return list(self._lines)


class Observer:
    """Observer and control of a run."""

    def __init__(self, supervisor: Supervisor, config: Config, records: LastRecords) -> None:
        self._supervisor = supervisor
        self._state = supervisor.state
        self._config = config
        self._records = records
        self._meter: Meter | None = None
        self._recent = RecentSamples(self._sample())
        self._settings: dict[str, tuple[NodeConfig, dict[str, str]]] = {}
        """Settings of each node, with their text, cached as they seldom change."""
        self._number = 0

    def begin(self) -> None:
        """Begin to measure: somebody watches."""
        if self._meter is None:
            self._meter = Meter(self._state.clock)
            self._supervisor.instruments.attach(self._meter)
            self._recent = RecentSamples(self._sample())

    def end(self) -> None:
        """Stop measuring: nobody watches."""
        if self._meter is not None:
            self._supervisor.instruments.detach(self._meter)
            self._meter = None
            self._recent = RecentSamples(self._sample())

    # Snapshots.

    def take(self) -> Snapshot:
        """Return a snapshot of now and of the last second or so."""
        state = self._state
        self._number += 1
        sample = self._sample()
        self._recent.add(sample)
        now = sample.run
        return Snapshot(
            run=self._config.run.name,
            pid=os.getpid(),
            number=self._number,
            ended=state.reason,
            clock=ClockState(
                kind=state.clock.kind,
                now=now / SECOND,
                duration=float(self._config.run.duration),
                speed=self._recent.run / self._recent.real,
                target_speed=self._supervisor.stepping.target_speed,
                paused=self._supervisor.stepping.state != "running",
                fixed=self._supervisor.stepping.fixed(),
            ),
            tables=self._tables(sample),
            cameras=sorted(self._meter.images) if self._meter is not None else [],
            log=self._records.lines(),
        )

    def image(self, camera: str) -> Image:
        """Return the newest image of a snapshot's camera.

        Raises:
            CommandError: It has sent no image, or nobody watches.
        """
        images = self._meter.images if self._meter is not None else {}
        if camera not in images:
            raise CommandError(
                f"expected a camera that has sent images, found {camera!r}{suggest(camera, images)}"
            )
        return images[camera]

    def _sample(self) -> Sample:
        """Return the counters, with the durations since the last sample."""
        sent: Counter[str] = Counter()
        for node in self._state.all_nodes:
            for sender in senders(node).values():
                sent[sender.name] += sender.sent().total()
        meter = self._meter
        return Sample(
            time.perf_counter(),
            self._state.clock.now(),
            sent,
            {} if meter is None else {name: sum_.take() for name, sum_ in meter.nodes.items()},
            {} if meter is None else {name: sum_.take() for name, sum_ in meter.outputs.items()},
        )

    def _tables(self, sample: Sample) -> dict[str, Rows]:
        state, runners = self._state, self._state.runners
        return {
            "nodes": [self._node(runner) for runner in runners.values()],
            "outputs": self._outputs(sample),
            "inputs": self._inputs(),
            "links": [
                (link.name, f"{link.lost}", f"{link.thinned}") for link in state.links.values()
            ],
            "ticks": [
                (
                    name,
                    f"{ticker.hz:g}",
                    f"{ticker.calls}",
                    f"{ticker.missed}",
                    f"{ticker.late.quantile(0.99) / 1e3:.0f}",
                    f"{ticker.late.maximum / 1e3:.0f}",
                )
                for name, ticker in state.tickers.items()
            ],
            "settings": [
                (f"{name}.{key}", value)
                for name, runner in runners.items()
                for key, value in self._shown(runner).items()
            ],
        }

    def _node(self, runner: NodeRunner) -> tuple[str, ...]:
        steps, real = self._recent.node(runner.spec.name), self._recent.real
        calls = sum(worker.outstanding() for worker in runner.workers)
        return (
            runner.spec.name,
            self._condition(runner) + (f" ({runner.failures})" if runner.failures else ""),
            f"{steps.total / 1e9 / real:.1%}",
            f"{steps.times / real:.0f}",
            f"{steps.longest / 1e6:.2f}",
            f"{calls}" if calls else "",
        )

    def _shown(self, runner: NodeRunner) -> dict[str, str]:
        config = runner.node.config if runner.node else runner.spec.config
        known = self._settings.get(runner.spec.name)
        if known is None or known[0] is not config:
            known = self._settings[runner.spec.name] = config, settings(config)
        return known[1]

    def _condition(self, runner: NodeRunner) -> str:
        if runner.restarting:
            return "left out" if runner.spec.on_error == "drop" else "restarting"
        if self._state.reason and not runner.started:
            return "over"
        if runner.node is None:
            return "waiting"
        if not runner.started:
            return "starting"
        return "running" if self._state.running else "ready"

    def _outputs(self, sample: Sample) -> Rows:
        events = {
            sender.name: sender.event.__name__
            for node in self._state.all_nodes
            for sender in senders(node).values()
        }
        last = self._meter.outputs if self._meter is not None else {}
        found: Rows = []
        for name, event in events.items():
            flow = self._recent.output(name)
            found.append(
                (
                    name,
                    event,
                    f"{sample.sent[name]}",
                    f"{self._recent.rate(name):.1f}",
                    f"{(sample.run - last[name].last) / SECOND:.2f}" if name in last else "",
                    f"{flow.total / flow.times / 1e6:.2f}" if flow.times else "",
                    f"{flow.longest / 1e6:.2f}" if flow.times else "",
                )
            )
        return found

    def _inputs(self) -> Rows:
        drops = count_drops(self._state)
        found: Rows = []
        for runner in self._state.runners.values():
            for stream in streams(runner.node).values() if runner.node is not None else ():
                of = drops[stream.name]
                held = stream.statistics().buffered
                found.append((stream.name, *map(str, (held, of.peak, of.bound, of.dropped))))
        return found

    # Commands.

    def execute(self, command: Command) -> str:
        """Carry a command out, and return a text about its effect.

        Raises:
            VisnavError: It cannot be carried out; the message says why.
        """
        stepping = self._supervisor.stepping
        match command:
            case Pause():
                stepping.pause()
                return "paused"
            case Resume():
                stepping.resume()
                return "runs"
            case Step(seconds=seconds):
                stepping.step(None if seconds is None else max(round(seconds * SECOND), 1))
                return "one step" if seconds is None else f"runs for {seconds:g} s"
            case Speed(factor=factor):
                stepping.pace(factor)
                return "as fast as it can" if factor is None else f"{factor:g} × real time"
            case Stop():
                self._supervisor.stop("stopped by hand")
                return "ends"
            case Restart(node=node):
                return self._restart(node)
            case Set(text=text):
                values = self._supervisor.parameters.set(text)
                return ", ".join(f"{key} = {value}" for key, value in values.items()) or "as it was"

    def _restart(self, name: str) -> str:
        runners = self._state.runners
        if name not in runners:
            raise CommandError(
                f"expected the name of a node, found {name!r}{suggest(name, runners)}"
            )
        condition = self._condition(runners[name])
        if condition not in {"running", "left out"}:
            raise CommandError(f"expected a node that runs, and {name} is {condition}")
        self._supervisor.restart(name, anyway=True)
        return f"{name} restarts"


def describe(command: Command) -> str:
    """Return a command as text, for the log."""
    words = [str(v) for v in msgspec.structs.astuple(command) if v is not None]
    return " ".join([type(command).__name__.lower(), *words])
