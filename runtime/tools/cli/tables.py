"""Tables for the terminal.

The progress bar: simulated time, speed, frames. Drawn by a thread; the loop knows nothing.

Arguments that several commands share.
"""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table

from runtime.config.model import RunConfig
from runtime.run.summarise import count_events
from runtime.run.supervisor import Supervisor
from runtime.summary import Summary, Verdict
from runtime.time.schedule import SECOND


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


_PERIOD = 0.2
_LINE_PERIOD = 10.0
"""Seconds between two updates: of the bar, and of the lines where there is no terminal."""


def progress(
    run: RunConfig, console: Console
) -> Callable[[Supervisor], contextlib.AbstractContextManager[None]]:
    """Return what `execute` takes as `watch`.

    Args:
        console: Where to draw. What else is printed there, such as log lines, appears above the
            bar.
    """
    return lambda supervisor: _watching(run, supervisor, console)


@contextlib.contextmanager
def _watching(run: RunConfig, supervisor: Supervisor, console: Console) -> Iterator[None]:
    end = threading.Event()
    show = _draw if console.is_terminal else _print
    thread = threading.Thread(
        target=show, args=(run, supervisor, console, end), name="progress", daemon=True
    )
    thread.start()
    try:
        yield
    finally:
        end.set()
        thread.join()


def _draw(run: RunConfig, supervisor: Supervisor, console: Console, end: threading.Event) -> None:
    columns = TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[text]}")
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(run.name, total=run.duration or None, text="starting")
        while not end.wait(_PERIOD):
            seconds, text = _state(run, supervisor)
            bar.update(task, completed=seconds, text=text)


def _print(run: RunConfig, supervisor: Supervisor, console: Console, end: threading.Event) -> None:
    while not end.wait(_LINE_PERIOD):
        console.print(f"{run.name}: {_state(run, supervisor)[1]}", highlight=False)


def _state(run: RunConfig, supervisor: Supervisor) -> tuple[float, str]:
    if supervisor.state.first_update is None:
        return 0.0, "starting"
    seconds = supervisor.state.clock.now() / SECOND
    speed = seconds / max(time.monotonic() - supervisor.state.first_update, 1e-9)
    limit = f" of {run.duration:g}" if run.duration else ""
    try:
        frames = count_events(supervisor.state)[0]["Image"]
    except RuntimeError:  # a table of counts grew while this thread read it
        frames = 0
    return seconds, f"{seconds:5.1f}{limit} s  {speed:.1f} × real time  {frames} frames"


ConfigFile = Annotated[Path, typer.Argument(help="The file that says what to run.")]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NODE.KEY=VALUE",
        help="Change a setting of a node, or of the run (run.seed=3). May be repeated.",
    ),
]


def warn(warning: str) -> None:
    """Print a warning, as a line of its own."""
    print(f"warning: {warning}", file=sys.stderr)
