"""Makes snapshots of a run, its log's last records included, and carries commands out.

All of it happens on the run's loop. While somebody watches, an instrument measures how much of the
loop nodes take, and how old events are; figures are those of the last second or so, which are
steadier than those of one interval.
"""

from __future__ import annotations

import collections
import itertools
import logging
import time
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import msgspec

from events import Event, Image, TrackedFeatures
from runtime.channels.sender import Sender
from runtime.config.model import Config
from runtime.config.parameters import settings
from runtime.errors import CommandError, expect_known
from runtime.node import NodeConfig, senders, streams
from runtime.run.instruments import Call, Instrument
from runtime.run.node_runner import NodeRunner
from runtime.run.summarise import count_drops, count_events, tick_summaries
from runtime.run.supervisor import Supervisor
from runtime.time.clock import SECOND, Clock
from runtime.tools.monitor import protocol
from runtime.tools.monitor.estimators import Measured

KEPT = 5  # how many intervals between snapshots figures cover


class Amount(msgspec.Struct):
    """Durations of a node's steps or of an output's events: number, sum and longest (ns)."""

    times: int = 0
    total: int = 0
    longest: int = 0

    def add(self, total: int, longest: int, times: int = 1) -> None:
        """Add durations."""
        self.times += times
        self.total += total
        if longest > self.longest:
            self.longest = longest


class Sample(NamedTuple):
    """Counters at a snapshot.

    Attributes:
        real: Seconds of `time.perf_counter`.
        run: Nanoseconds of the run's clock.
        amounts: What a `Meter` added up since the sample before.
    """

    real: float
    run: int
    sent: Mapping[str, int]
    amounts: Mapping[str, Amount]


class RecentSamples:
    """The last samples; of the first, only its times and its count of sent events are used."""

    def __init__(self, first: Sample) -> None:
        self._samples = collections.deque([first], maxlen=KEPT + 1)
        self.add = self._samples.append

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

    def amount(self, name: str) -> Amount:
        """Return the durations of a node or an output."""
        amount = Amount()
        for sample in itertools.islice(self._samples, 1, None):
            if (measured := sample.amounts.get(name)) is not None:
                amount.add(measured.total, measured.longest, measured.times)
        return amount


class Meter(Instrument):
    """An instrument to add up durations."""

    def __init__(self, clock: Clock, measured: Measured) -> None:
        self.last: dict[str, int] = {}
        self._amounts: dict[str, Amount] = collections.defaultdict(Amount)
        self._follow = measured.follow
        self._clock = clock
        self._inner = 0  # nanoseconds taken by the steps nested in the running step
        self.event_sent = self._tap

    def pop_amounts(self) -> Mapping[str, Amount]:
        """Return the sums, and start again from zero.

        They are the time of the loop of each node, without nested calls of others, and the times
        from stamp to delivery of each output's events, by ``node.port``.
        """
        amounts, self._amounts = self._amounts, collections.defaultdict(Amount)
        return amounts

    def wrap_call(self, node: str, what: str, call: Call) -> Call:  # noqa: ARG002
        """Return a function to call `call` and add up its durations."""
        time_ns = time.perf_counter_ns

        def metering(argument: Any) -> Any:
            outer, self._inner = self._inner, 0
            start = time_ns()
            try:
                return call(argument)
            finally:
                duration = time_ns() - start
                own_time = duration - self._inner
                self._inner = outer + duration
                self._amounts[node].add(own_time, own_time)

        return metering

    def _tap(self, sender: Sender[Any] | None, event: Event) -> None:
        name = "run.announced" if sender is None else sender.name
        self.last[name] = now = self._clock.now()
        latency = now - event.stamp
        self._amounts[name].add(latency, latency)
        follow = self._follow.get(type(event))
        if follow is not None:
            follow(name, event)


RECORDS = 100


class LastRecords(logging.Handler):
    """A handler to keep the last log records; runs in the log's own thread."""

    def __init__(self) -> None:
        super().__init__()
        self._lines: collections.deque[protocol.LogLine] = collections.deque(maxlen=RECORDS)
        self._numbers = itertools.count()

    def emit(self, record: logging.LogRecord) -> None:
        """Store a record."""
        seconds = getattr(record, "seconds", 0.0)
        name = getattr(record, "logger_name", record.name)
        self._lines.append(
            protocol.LogLine(
                number=next(self._numbers),
                level=record.levelname,
                text=f"{seconds:10.3f} {record.levelname:8} {name}: {record.getMessage()}",
            )
        )

    def lines(self) -> list[protocol.LogLine]:
        """Return the records, the oldest first."""
        return list(self._lines)


class Observer:
    """Observer and control of a run."""

    def __init__(self, supervisor: Supervisor, config: Config, records: LastRecords) -> None:
        self._supervisor = supervisor
        self._state = supervisor.state
        self._config = config
        self._records = records
        self._settings: dict[str, tuple[NodeConfig, dict[str, str]]] = {}
        """Settings of each node, with their text, cached as they seldom change."""
        self._forget()

    def _forget(self) -> None:
        self._measured = Measured(self._state)
        self._meter = Meter(self._state.clock, self._measured)
        self._recent = RecentSamples(self._sample())

    def begin(self) -> None:
        """Start measuring, for the first client."""
        if self._meter not in self._supervisor.instruments.attached:
            self._forget()
            self._supervisor.instruments.attach(self._meter)

    def end(self) -> None:
        """Stop measuring, after the last client."""
        if self._meter in self._supervisor.instruments.attached:
            self._supervisor.instruments.detach(self._meter)
            self._forget()

    # Snapshots.

    def snapshot(self) -> protocol.Snapshot:
        """Return a snapshot of now and of the last second or so."""
        sample = self._sample()
        self._recent.add(sample)
        stepping, clock = self._supervisor.stepping, self._state.clock
        now, target = sample.run / SECOND, stepping.target_speed
        present = self._recent.run / self._recent.real
        speed_text = "as fast as it can" if target is None else f"asked: {target:g}"
        duration = float(self._config.run.duration)
        ended, paused = self._state.reason, stepping.state != "running"
        headline = (
            self._config.run.name,
            f"{now:.3f}{f' of {duration:g}' if duration else ''} s",
            f"{present:.2f} × real time ({'real' if clock.kind == 'real' else speed_text})",
            f"ends: {ended}" if ended else "paused" if paused else "runs",
        )
        return protocol.Snapshot(
            headline="   ".join(headline), now=now, ended=ended, paused=paused,
            fixed=stepping.fixed(), speed=max(round(present, 1), 1.0) if target is None else target,
            tables=self._tables(sample), paths=self._measured.paths(),
            cameras=self._measured.cameras(), log=self._records.lines(),
        )  # fmt: skip

    def image(self, camera: str) -> tuple[Image, list[TrackedFeatures]]:
        """Return a camera's newest image with its features, or raise `CommandError`."""
        return self._measured.image(camera)

    def _sample(self) -> Sample:
        _, sent = count_events(self._state)
        return Sample(time.perf_counter(), self._state.clock.now(), sent, self._meter.pop_amounts())

    def _tables(self, sample: Sample) -> dict[str, protocol.Rows]:
        state, runners = self._state, self._state.runners
        values: dict[str, Iterable[tuple[object, ...]]] = {
            "estimators": self._measured.rows(),
            "nodes": map(self._node, runners.values()),
            "ticks": (
                (name, tick.hz, tick.calls, tick.missed, tick.late_p99_us, tick.late_max_us)
                for name, tick in tick_summaries(state).items()
            ),
            "inputs": self._inputs(),
            "links": ((link.name, link.lost, link.thinned) for link in state.links.values()),
            "outputs": self._outputs(sample),
            "settings": (
                (f"{name}.{key}", value)
                for name, runner in runners.items()
                for key, value in self._settings_text(runner).items()
            ),
        }
        return {name: protocol.formatted(name, rows) for name, rows in values.items()}

    def _node(self, runner: NodeRunner) -> tuple[object, ...]:
        steps, real = self._recent.amount(runner.spec.name), self._recent.real
        return (
            runner.spec.name,
            self._condition(runner) + (f" ({runner.failures})" if runner.failures else ""),
            steps.total / 1e9 / real,
            steps.times / real,
            steps.longest / 1e6,
            sum(worker.outstanding() for worker in runner.workers) or None,
        )

    def _settings_text(self, runner: NodeRunner) -> dict[str, str]:
        config = runner.node.config if runner.node else runner.spec.config
        cached = self._settings.get(runner.spec.name)
        if cached is None or cached[0] is not config:
            cached = self._settings[runner.spec.name] = config, settings(config)
        return cached[1]

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

    def _outputs(self, sample: Sample) -> Iterator[tuple[object, ...]]:
        events = {
            sender.name: sender.event.__name__
            for node in self._state.all_nodes
            for sender in senders(node).values()
        }
        for name, event in events.items():
            flow, last = self._recent.amount(name), self._meter.last.get(name)
            yield (
                name,
                event,
                sample.sent[name],
                self._recent.rate(name),
                None if last is None else (sample.run - last) / SECOND,
                flow.total / flow.times / 1e6 if flow.times else None,
                flow.longest / 1e6 if flow.times else None,
            )

    def _inputs(self) -> Iterator[tuple[object, ...]]:
        drops = count_drops(self._state)
        for runner in self._state.runners.values():
            for stream in streams(runner.node).values() if runner.node is not None else ():
                drop = drops[stream.name]
                yield stream.name, stream.statistics().buffered, drop.peak, drop.bound, drop.dropped

    # Commands.

    def execute(self, command: protocol.Command) -> str:
        """Carry a command out, and return a text about its effect; or raise `VisnavError`."""
        stepping = self._supervisor.stepping
        match command:
            case protocol.Pause():
                stepping.pause()
                return "paused"
            case protocol.Resume():
                stepping.resume()
                return "runs"
            case protocol.Step(seconds=seconds):
                stepping.step(None if seconds is None else max(round(seconds * SECOND), 1))
                return "one step" if seconds is None else f"runs for {seconds:g} s"
            case protocol.Speed(factor=factor):
                stepping.pace(factor)
                return "as fast as it can" if factor is None else f"{factor:g} × real time"
            case protocol.Stop():
                self._supervisor.stop("stopped by hand")
                return "ends"
            case protocol.Restart(node=node):
                return self._restart(node)
            case protocol.Set(text=text):
                values = self._supervisor.parameters.set(text)
                return ", ".join(f"{key} = {value}" for key, value in values.items()) or "as it was"

    def _restart(self, name: str) -> str:
        runners = self._state.runners
        message = f"expected the name of a node, found {name!r}"
        expect_known(name, runners, message, CommandError)
        condition = self._condition(runners[name])
        if condition not in {"running", "left out"}:
            raise CommandError(f"expected a node that runs, and {name} is {condition}")
        self._supervisor.restart(name, anyway=True)
        return f"{name} restarts"


def describe(command: protocol.Command) -> str:
    """Return a command as text, for the log."""
    texts = [str(v) for v in msgspec.structs.astuple(command) if v is not None]
    return " ".join([type(command).__name__.lower(), *texts])
