"""Tables for the terminal."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rich.table import Table

from runtime.summary import Summary, Verdict


def run_tables(summary: Summary) -> Iterator[Table]:
    """Return what was sent and dropped, how late ticks were, what workers cost, and more."""
    seconds = max(summary.sim_seconds, 1e-9)
    sent = Table("output", "events", "per second", title="sent")
    for output, count in sorted(summary.outputs.items()):
        sent.add_row(output, f"{count}", f"{count / seconds:.1f}")
    yield _numbers(sent)
    streams = Table("input", "dropped", "fullest", "holds", "unmatched", title="inputs")
    for port, stream in sorted(summary.streams.items()):
        unmatched = f"{sum(stream.missed.values())}" if stream.missed else ""
        dropped = f"{stream.dropped}"
        streams.add_row(port, dropped, f"{stream.peak}", f"{stream.bound}", unmatched)
    if streams.row_count:
        yield _numbers(streams)
    ticks = Table("tick", "Hz", "calls", "late p50 µs", "p99 µs", "max µs", "missed", title="ticks")
    for name, tick in sorted(summary.ticks.items()):
        ticks.add_row(
            name,
            f"{tick.hz:g}",
            f"{tick.calls}",
            f"{tick.late_p50_us:.0f}",
            f"{tick.late_p99_us:.0f}",
            f"{tick.late_max_us:.0f}",
            f"{tick.missed}",
        )
    if ticks.row_count:
        yield _numbers(ticks)
    # The six of its columns for which a terminal has room.
    titles, columns = ("declared", "real", "p95", "CPU", "p95", "MB"), (0, 2, 3, 5, 6, 8)
    title = "calls of workers: milliseconds (median, 95 % below), peak memory"
    workers = Table("worker", *titles, title=title)
    for name, worker in sorted(summary.workers.items()):
        row = worker.row()
        workers.add_row(name, *(row[k] for k in columns))
    if workers.row_count:
        yield _numbers(workers)
    # The columns for which a terminal has room: first what together makes all that was sent.
    title = "systems outside the process: frames"
    names = ("sent", "answered", "empty", "init", "skipped", "no answer", "open", "real ms")
    shown = (0, 2, 3, 4, 5, 6, 7, 15, 16, 17)
    outside = Table("system", *names, "inputs repeat", "answers repeat", title=title)
    for name, system in sorted(summary.outside.items()):
        row = system.row()
        outside.add_row(name, *(row[k] for k in shown))
    if outside.row_count:
        yield _numbers(outside)
    stalls = Table("node", "times", "longest ms", "where", title="the loop stood still")
    for node, count in sorted(summary.stalls.items()):
        worst = summary.longest_stalls[node]
        stalls.add_row(node, f"{count}", f"{worst.seconds * 1e3:.0f}", worst.line)
    if stalls.row_count:
        yield _numbers(stalls)
    if summary.verdict is not None:
        yield verdict_table(summary.verdict)


def verdict_table(verdict: Verdict) -> Table:
    """Return the figures of those that were judged: one column each."""
    table = Table("figure", *verdict.estimators, title="verdict")
    figures = dict.fromkeys(key for each in verdict.estimators.values() for key in each)
    for figure in figures:
        row = [each.get(figure, "") for each in verdict.estimators.values()]
        if not any(isinstance(value, list | tuple | dict) for value in row):
            table.add_row(figure, *(_show(value) for value in row))
    return _numbers(table)


def _show(value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _numbers(table: Table) -> Table:
    """Align all but the first column to the right, unless it is text."""
    table.title_justify = "left"
    names = table.columns[0]
    names.min_width = min(max((len(str(cell)) for cell in names.cells), default=0), 24)
    names.overflow = "fold"
    for column in table.columns[1:]:
        if column.header != "where":
            column.justify = "right"
    return table
