"""A snapshot as rows of text, the same in a terminal and on a page."""

from __future__ import annotations

from collections.abc import Callable

from runtime.tools.monitor.snapshot import ClockState, Snapshot

Rows = list[tuple[str, ...]]

COLUMNS: dict[str, tuple[str, ...]] = {
    "nodes": ("node", "condition", "loop", "steps/s", "longest ms", "calls"),
    "outputs": ("output", "event", "sent", "per s", "age s", "latency ms", "max"),
    "inputs": ("input", "holds", "fullest", "of", "dropped"),
    "links": ("link", "lost", "thinned"),
    "ticks": ("tick", "Hz", "calls", "missed", "late p99 µs", "max µs"),
    "settings": ("setting that can change", "value"),
}
"""Titles of columns, by table."""

LEFT, RIGHT = ("nodes", "ticks", "inputs", "links"), ("outputs", "settings")
"""Tables in the left and in the right column."""

_WORDS = {"condition", "event", "value"}
"""Columns of text; all others but the first hold numbers."""


def is_number(table: str, column: int) -> bool:
    """Tell whether a column holds numbers, which are aligned right."""
    return column > 0 and COLUMNS[table][column] not in _WORDS


def rows(table: str, snapshot: Snapshot) -> Rows:
    """Return the rows of a table; the first column of each is unique."""
    return _TABLES[table](snapshot)


def headline(snapshot: Snapshot) -> str:
    """Return time, speed and condition of the run, as a line."""
    clock = snapshot.clock
    limit = f" of {clock.duration:g}" if clock.duration else ""
    return f"{snapshot.run}   {clock.now:.3f}{limit} s   {pace(clock)}   {condition(snapshot)}"


def condition(snapshot: Snapshot) -> str:
    """Return whether the run goes on, is paused or ends."""
    if snapshot.ended:
        return f"ends: {snapshot.ended}"
    return "paused" if snapshot.clock.paused else "runs"


def pace(clock: ClockState) -> str:
    """Return the speed of time, and the speed that was asked for."""
    speed = f"{clock.speed:.2f} × real time"
    if clock.kind == "real":
        return f"{speed} (real)"
    target = clock.target_speed
    return f"{speed} ({'as fast as it can' if target is None else f'asked: {target:g}'})"


def aim(clock: ClockState) -> float:
    """Return the speed that faster and slower start from: the one asked for, or the present one."""
    return clock.target_speed if clock.target_speed is not None else max(round(clock.speed, 1), 1.0)


def _nodes(snapshot: Snapshot) -> Rows:
    return [
        (
            node.name,
            node.condition + (f" ({node.failures})" if node.failures else ""),
            f"{node.share:.1%}",
            f"{node.steps:.0f}",
            f"{node.longest_ms:.2f}",
            f"{node.calls}" if node.calls else "",
        )
        for node in snapshot.nodes
    ]


def _outputs(snapshot: Snapshot) -> Rows:
    return [
        (
            out.name,
            out.event,
            f"{out.count}",
            f"{out.rate:.1f}",
            _number(out.age, ".2f"),
            _number(out.latency_ms, ".2f"),
            _number(out.latency_max_ms, ".2f"),
        )
        for out in snapshot.outputs
    ]


def _inputs(snapshot: Snapshot) -> Rows:
    return [
        (each.name, f"{each.buffered}", f"{each.peak}", f"{each.bound}", f"{each.dropped}")
        for each in snapshot.inputs
    ]


def _links(snapshot: Snapshot) -> Rows:
    return [(link.name, f"{link.lost}", f"{link.thinned}") for link in snapshot.links]


def _ticks(snapshot: Snapshot) -> Rows:
    return [
        (
            tick.name,
            f"{tick.hz:g}",
            f"{tick.calls}",
            f"{tick.missed}",
            f"{tick.late_p99_us:.0f}",
            f"{tick.late_max_us:.0f}",
        )
        for tick in snapshot.ticks
    ]


def _settings(snapshot: Snapshot) -> Rows:
    return [
        (f"{node.name}.{key}", value)
        for node in snapshot.nodes
        for key, value in node.settings.items()
    ]


def _number(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)


_TABLES: dict[str, Callable[[Snapshot], Rows]] = {
    "nodes": _nodes,
    "outputs": _outputs,
    "inputs": _inputs,
    "links": _links,
    "ticks": _ticks,
    "settings": _settings,
}
