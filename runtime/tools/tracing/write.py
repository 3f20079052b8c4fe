"""Traces: written from notes, and read for the latency of paths and the load of nodes.

A trace is JSON trace events, which ui.perfetto.dev and chrome://tracing open. Format: "Trace Event
Format", the Chromium project's document of 2016. Its time stamps are microseconds of real time; the
run's clock stands in the arguments. Reading needs no run.
"""

from __future__ import annotations

import bisect
import contextlib
import gzip
import logging
import os
import tempfile
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Any

import msgspec

from runtime.errors import ConfigError
from runtime.run.results import replacing
from runtime.run.supervisor import Supervisor
from runtime.tools.tracing.record import (
    Causes,
    ClockRate,
    EventNote,
    SentEvent,
    Spool,
    TraceInstrument,
)

log = logging.getLogger("visnav.runtime")

MADE_BY = "python -m runtime run --trace"  # mark of a trace made by this project
LOOP, THREADS, WORKERS, SENSORS = 1, 2, 3, 4  # process numbers of the trace's groups of tracks

_TITLES = {
    LOOP: "nodes on the event loop",
    THREADS: "offloaded to threads",
    WORKERS: "worker processes",
    SENSORS: "exposures",
}
_MOMENT = 0.1
"""Microseconds of the slice of an instant, for an arrow to begin there; shorter than a delivery."""


@contextlib.contextmanager
def tracing(supervisor: Supervisor, path: Path, name: str) -> Iterator[None]:
    """Trace a run while the block lasts, then write (``.gz``: compressed); or `ConfigError`."""
    if not path.name or path.is_dir():
        raise ConfigError(f"{path}: expected the name of a file for a trace, found a folder")
    if path.exists() and not (path.is_file() or path.is_char_device()):
        raise ConfigError(f"{path}: expected the name of a file for a trace, found none")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        folder = tempfile.gettempdir() if path.is_char_device() else path.parent
        number, part = tempfile.mkstemp(".part", f"{path.name}.", folder)
        os.close(number)
        spool = Spool(Path(part))
    except OSError as error:
        raise ConfigError(
            f"{path}: expected a place for a trace, found: {error.strerror}"
        ) from None
    recorder = TraceInstrument(supervisor.state.clock, spool)
    supervisor.instruments.attach(recorder)
    try:
        yield
    finally:
        recorder.close()
        spool.close()
        if spool.failed is None:
            _write(spool, path, supervisor, name)
        spool.discard()


def _write(spool: Spool, path: Path, supervisor: Supervisor, name: str) -> None:
    order = [node.name for node in supervisor.state.all_nodes]
    try:
        write_trace(spool, path, name=name, clock=supervisor.state.clock.kind, nodes=order)
    except OSError as error:  # a full disk: the run's other results must not go with the trace
        log.error("%s: the trace could not be written: %s", path, error)


def write_trace(spool: Spool, path: Path, *, name: str, clock: str, nodes: Iterable[str]) -> None:
    """Write the notes of a run as a trace.

    Args:
        path: Of the trace; compressed if it ends with ``.gz``.
        nodes: Names, in the order in which they are to be shown.
    """
    about = {"run": name, "clock": clock, "made by": MADE_BY}
    with replacing(path) as new, _open(new, compress=path.name.endswith(".gz")) as file:
        file.write(b'{"displayTimeUnit":"ms","otherData":' + msgspec.json.encode(about))
        file.write(b',"traceEvents":[\n')
        separator = b""
        for event in _Writer(spool, nodes).events():
            file.write(separator + msgspec.json.encode(event))
            separator = b",\n"
        file.write(b"\n]}\n")


def _open(path: Path, *, compress: bool) -> IO[bytes]:
    if compress:
        return gzip.open(path, "wb", compresslevel=4)  # type: ignore[return-value]
    return path.open("wb")


class _Writer:
    def __init__(self, spool: Spool, nodes: Iterable[str]) -> None:
        self._spool = spool
        self._causes = Causes(spool.kinds, spool.receivers)
        self._moments = _Moments(spool.rate)
        self._tracks: dict[tuple[int, str], int] = {}
        self._answered: dict[str, int] = {}
        self._flows = 0
        self._exposed: set[tuple[str, int]] = set()
        self._nodes = list(nodes)

    def events(self) -> Iterator[dict[str, Any]]:
        """Yield the trace's events."""
        for process, title in _TITLES.items():
            yield _metadata("process_name", process, 0, name=title)
            yield _metadata("process_sort_index", process, 0, sort_index=process)
        for node in self._nodes:
            yield from self._track(LOOP, node)
        for kind, *note in self._spool.read():
            yield from getattr(self, f"_{kind}")(*note)

    def _track(self, process: int, name: str) -> Iterator[dict[str, Any]]:
        if (process, name) not in self._tracks:
            number = self._tracks[process, name] = len(self._tracks) + 1
            yield _metadata("thread_name", process, number, name=name)
            yield _metadata("thread_sort_index", process, number, sort_index=number)

    def _slice(
        self, process: int, track: str, name: str, begin: int, end: float | None, **args: Any
    ) -> Iterator[dict[str, Any]]:
        yield from self._track(process, track)
        yield {
            "ph": "X",
            "pid": process,
            "tid": self._tracks[process, track],
            "name": name,
            "ts": self._us(begin),
            "dur": _MOMENT if end is None else round((end - begin) / 1e3, 3),
            "args": args,
        }

    def _step(
        self, node: str, what: str, begin: int, end: int, run: int, _: int
    ) -> Iterator[dict[str, Any]]:
        run = self._moments.add(begin, run)
        yield from self._slice(LOOP, node, what, begin, end, run_s=run / 1e9)

    def _event(self, *fields: Any) -> Iterator[dict[str, Any]]:
        note = EventNote(*fields)
        time, run = note.time, self._moments.add(note.time, note.run)
        sent = self._causes.add(note._replace(run=run))
        args: dict[str, Any] = {
            "port": note.sender,
            "source": note.source,
            "run_s": run / 1e9,
            "stamp_s": note.stamp / 1e9,
        }
        path: list[SentEvent] = []
        if self._spool.kinds[note.event].setpoint and sent.cause is not None:
            path = sent.path()
            begin = self._exposure(path[0])
            args |= {
                "path": describe(path),
                "run_ms": (run - path[0].stamp) / 1e6,
                "real_ms": round((time - begin) / 1e6, 6),
            }
        yield from self._slice(LOOP, sent.node, f"send {note.event}", time, None, **args)
        if path:
            yield from self._flow(path)

    def _exposure(self, sent: SentEvent) -> int:
        return min(self._moments.of(sent.stamp, sent.time), sent.time)

    def _flow(self, path: list[SentEvent]) -> Iterator[dict[str, Any]]:
        self._flows += 1
        first = path[0]
        begin = self._exposure(first)
        if (first.source, first.stamp) not in self._exposed:
            self._exposed.add((first.source, first.stamp))
            yield from self._slice(
                SENSORS, first.source, f"{first.event} exposed", begin, None,
                run_s=first.stamp / 1e9,
            )  # fmt: skip
        steps = [(SENSORS, first.source, begin), *((LOOP, s.node, s.time) for s in path)]
        for index, (process, track, time) in enumerate(steps):
            yield {
                "ph": "s" if index == 0 else "f" if index == len(steps) - 1 else "t",
                "bp": "e",  # at the slice that encloses this time
                "pid": process,
                "tid": self._tracks[process, track],
                "ts": self._us(time),
                "id": self._flows,
                "cat": "path",
                "name": f"{first.event} to {path[-1].event}",
            }

    def _thread(
        self, thread: str, node: str, function: str, submitted: int, begin: int, end: int
    ) -> Iterator[dict[str, Any]]:
        waited = round((begin - submitted) / 1e6, 6)
        name = f"{node}: {function}"
        yield from self._slice(THREADS, thread, name, begin, end, node=node, waited_ms=waited)

    def _worker(
        self, process: str, method: str, requested: int, answered: int
    ) -> Iterator[dict[str, Any]]:
        # A process answers one call after the other: it begins when the last one is done.
        begin = max(requested, self._answered.get(process, 0))
        self._answered[process] = answered
        waited = round((begin - requested) / 1e6, 6)
        yield from self._slice(WORKERS, process, method, begin, answered, waited_ms=waited)

    def _us(self, time: int) -> float:
        return round((time - self._spool.origin) / 1e3, 3)


class _Moments:
    """Real times at the readings of the run's clock."""

    KEPT = 100_000

    def __init__(self, rate: ClockRate | None) -> None:
        self._rate = rate
        self._runs: list[int] = []
        self._times: list[int] = []

    def add(self, time: int, run: int) -> int:
        """Record the clock's `run` at real time `time`; return the true reading then."""
        if self._rate is not None:
            return self._rate.run(run)
        if not self._runs or run > self._runs[-1]:
            self._runs.append(run)
            self._times.append(time)
            if len(self._runs) > 2 * self.KEPT:
                del self._runs[: self.KEPT], self._times[: self.KEPT]
        return run

    def of(self, stamp: int, latest: int) -> int:
        """Return the real time (ns) of the clock's `stamp`; `latest` if unknown."""
        if self._rate is not None:
            return round(self._rate.origin + stamp / self._rate.speed)
        index = bisect.bisect_left(self._runs, stamp)
        return self._times[index] if index < len(self._times) else latest


def describe(path: list[SentEvent]) -> str:
    """Return a path as text: ``→`` where an event follows, ``⇢`` where this is a guess."""
    arrows = {"begins": "", "follows": " → ", "holds": " ⇢ "}
    return "".join(
        f"{arrows[s.relation]}{s.source if s.relation == 'begins' else s.node} {s.event}"
        for s in path
    )


def _metadata(kind: str, process: int, track: int, **args: Any) -> dict[str, Any]:
    return {"ph": "M", "name": kind, "pid": process, "tid": track, "args": args}


class TraceEvent(msgspec.Struct):
    """An event of a trace; see the format's description for the letters."""

    ph: str
    pid: int
    tid: int
    name: str
    ts: float = 0.0
    dur: float = 0.0
    args: dict[str, Any] = {}


class Trace(msgspec.Struct, rename={"events": "traceEvents", "about": "otherData"}):
    """A trace file."""

    events: list[TraceEvent]
    about: dict[str, str] = {}


class PathLatency(msgspec.Struct, frozen=True):
    """Latency of a path from a sensor to a set-point.

    Attributes:
        run_ms: From exposure to set-point on the run's clock, milliseconds, one a set-point.
        real_ms: The same in real time.
    """

    path: str
    run_ms: list[float]
    real_ms: list[float]


class NodeLoad(msgspec.Struct, frozen=True):
    """Load of a node on the loop.

    Attributes:
        steps: How often the loop went into it.
        busy_ms: Milliseconds in it, less those in others that it called.
        share: Of the time from the first step to the last.
        longest_ms: The longest step, less what it called.
    """

    node: str
    steps: int
    busy_ms: float
    share: float
    longest_ms: float
    longest: str


def read_trace(path: Path) -> Trace:
    """Read a trace, or raise `ConfigError`."""
    try:
        content = path.read_bytes()
        if content.startswith(b"\x1f\x8b"):
            content = gzip.decompress(content)
        trace = msgspec.json.decode(content, type=Trace)
    except OSError as error:
        reason = error.strerror or str(error)
        if path.with_name(path.name + ".part").exists():
            reason += ": its run goes on, or was killed and could not write it"
        raise ConfigError(f"{path}: expected a trace, found: {reason}") from None
    except (ValueError, EOFError, zlib.error, RecursionError) as error:  # msgspec's is a ValueError
        raise ConfigError(f"{path}: expected a trace, found: {error}") from None
    if trace.about.get("made by") != MADE_BY:
        raise ConfigError(f"{path}: expected a trace of ours, by {MADE_BY}; found another's")
    return trace


def paths(trace: Trace) -> list[PathLatency]:
    """Return the latencies of all paths, the most frequent first."""
    latencies: dict[str, PathLatency] = {}
    for event in trace.events:
        if "path" in event.args:
            name = event.args["path"]
            path = latencies.setdefault(name, PathLatency(name, [], []))
            path.run_ms.append(event.args["run_ms"])
            path.real_ms.append(event.args["real_ms"])
    return sorted(latencies.values(), key=lambda path: -len(path.run_ms))


def node_loads(trace: Trace) -> list[NodeLoad]:
    """Return how much of the loop's time each node took, the busiest first."""
    names = {e.tid: e.args["name"] for e in trace.events if e.ph == "M" and e.name == "thread_name"}
    slices = [
        e for e in trace.events if e.ph == "X" and e.pid == LOOP and not e.name.startswith("send ")
    ]
    slices.sort(key=lambda e: (e.ts, -e.dur))
    own_times = _own_times(slices)
    total = max((e.ts + e.dur for e in slices), default=0.0) - (slices[0].ts if slices else 0.0)
    by_node: dict[str, list[tuple[float, str]]] = {}
    for slice_, own_time in zip(slices, own_times, strict=True):
        by_node.setdefault(names[slice_.tid], []).append((own_time, slice_.name))
    loads = []
    for node, steps in by_node.items():
        busy, (longest, step) = sum(own_time for own_time, _ in steps), max(steps)
        share = busy / total if total else 0.0
        loads.append(NodeLoad(node, len(steps), busy / 1e3, share, longest / 1e3, step))
    return sorted(loads, key=lambda load: -load.busy_ms)


def quantile(values: list[float], q: float) -> float:
    """Return the value not exceeded by a share `q` of all values."""
    ordered = sorted(values)
    return ordered[min(int(q * len(ordered)), len(ordered) - 1)]


def _own_times(slices: list[TraceEvent]) -> list[float]:
    """Return each slice's own time (µs), without nested slices; sorted by beginning."""
    times = [slice_.dur for slice_ in slices]
    open_: list[int] = []
    for index, slice_ in enumerate(slices):
        while open_ and slices[open_[-1]].ts + slices[open_[-1]].dur <= slice_.ts:
            open_.pop()
        if open_:
            times[open_[-1]] -= slice_.dur
        open_.append(index)
    return [max(duration, 0.0) for duration in times]
