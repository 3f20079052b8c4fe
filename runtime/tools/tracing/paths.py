"""Reads a trace: how long paths from sensor to set-point take, and which nodes load the loop.

Works on any trace that `runtime.tools.tracing.write` wrote, without the run.
"""

from __future__ import annotations

import gzip
import zlib
from pathlib import Path
from typing import Any

import msgspec

from runtime.errors import ConfigError
from runtime.tools.tracing.write import LOOP, MADE_BY


class TraceEvent(msgspec.Struct):
    """One event of a trace; see the format's description for the letters."""

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
    """How long one path from a sensor to a set-point took.

    Attributes:
        path: The events on it.
        run_ms: From exposure to set-point on the run's clock, milliseconds, one a set-point.
        real_ms: The same in real time.
    """

    path: str
    run_ms: list[float]
    real_ms: list[float]


class NodeLoad(msgspec.Struct, frozen=True):
    """How much of the loop's time one node took.

    Attributes:
        node: Its name.
        steps: How often the loop went into it.
        busy_ms: Milliseconds in it, less those in others that it called.
        share: Of the time from the first step to the last.
        longest_ms: The longest step, less what it called.
        longest: What that was.
    """

    node: str
    steps: int
    busy_ms: float
    share: float
    longest_ms: float
    longest: str


def read_trace(path: Path) -> Trace:
    """Read a trace.

    Raises:
        ConfigError: There is none, or it is something else.
    """
    try:
        content = path.read_bytes()
        if content.startswith(b"\x1f\x8b"):
            content = gzip.decompress(content)
        trace = msgspec.json.decode(content, type=Trace)
    except OSError as error:
        found = error.strerror or str(error)
        if path.with_name(path.name + ".part").exists():
            found += ": its run goes on, or was killed and could not write it"
        raise ConfigError(f"{path}: expected a trace, found: {found}") from None
    except (ValueError, EOFError, zlib.error, RecursionError) as error:  # msgspec's is a ValueError
        raise ConfigError(f"{path}: expected a trace, found: {error}") from None
    if trace.about.get("made by") != MADE_BY:
        raise ConfigError(f"{path}: expected a trace of ours, by {MADE_BY}; found another's")
    return trace


def paths(trace: Trace) -> list[PathLatency]:
    """Return the latencies of all paths, the most frequent first."""
    found: dict[str, PathLatency] = {}
    for event in trace.events:
        if "path" in event.args:
            name = event.args["path"]
            path = found.setdefault(name, PathLatency(name, [], []))
            path.run_ms.append(event.args["run_ms"])
            path.real_ms.append(event.args["real_ms"])
    return sorted(found.values(), key=lambda path: -len(path.run_ms))


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
    for each, own in zip(slices, own_times, strict=True):
        by_node.setdefault(names[each.tid], []).append((own, each.name))
    found = []
    for node, steps in by_node.items():
        busy, (longest, what) = sum(own for own, _ in steps), max(steps)
        share = busy / total if total else 0.0
        found.append(NodeLoad(node, len(steps), busy / 1e3, share, longest / 1e3, what))
    return sorted(found, key=lambda each: -each.busy_ms)


def quantile(values: list[float], q: float) -> float:
    """Return the value that a share `q` of all values does not exceed."""
    ordered = sorted(values)
    return ordered[min(int(q * len(ordered)), len(ordered) - 1)]


def _own_times(slices: list[TraceEvent]) -> list[float]:
    """Return how long each slice took (µs) without those within it; sorted by beginning."""
    alone = [each.dur for each in slices]
    open_: list[int] = []
    for index, each in enumerate(slices):
        while open_ and slices[open_[-1]].ts + slices[open_[-1]].dur <= each.ts:
            open_.pop()
        if open_:
            alone[open_[-1]] -= each.dur
        open_.append(index)
    return [max(own, 0.0) for own in alone]
