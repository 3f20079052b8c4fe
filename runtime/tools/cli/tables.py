"""Output of commands in the terminal: tables, and the progress bar.

The bar shows simulated time, speed and frames; a thread draws it, and the loop knows nothing.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table

from runtime.config.model import RunConfig
from runtime.run.summarise import count_events
from runtime.run.supervisor import Supervisor
from runtime.summary import Summary, Verdict
from runtime.time.schedule import SECOND


def run_tables(summary: Summary) -> Iterator[Table]:
    """Yield tables of events sent and dropped, tick lateness, worker costs, and more."""
    seconds = max(summary.sim_seconds, 1e-9)
    yield _table(
        "sent",
        ("output", "events", "per second"),
        [(name, f"{n}", f"{n / seconds:.1f}") for name, n in sorted(summary.outputs.items())],
    )
    inputs = _table(
        "inputs",
        ("input", "dropped", "fullest", "holds", "unmatched"),
        [
            (port, *map(str, (stream.dropped, stream.peak, stream.bound)), _sum(stream.missed))
            for port, stream in sorted(summary.streams.items())
        ],
    )
    ticks = _table(
        "ticks",
        ("tick", "Hz", "calls", "late p50 µs", "p99 µs", "max µs", "missed"),
        [
            (
                name,
                f"{tick.hz:g}",
                f"{tick.calls}",
                *(f"{us:.0f}" for us in (tick.late_p50_us, tick.late_p99_us, tick.late_max_us)),
                f"{tick.missed}",
            )
            for name, tick in sorted(summary.ticks.items())
        ],
    )
    # Of the next two, the columns for which a terminal has room.
    workers = _table(
        "calls of workers: milliseconds (median, 95 % below), peak memory",
        ("worker", "declared", "real", "p95", "CPU", "p95", "MB"),
        [
            (name, *(worker.row()[k] for k in (0, 2, 3, 5, 6, 8)))
            for name, worker in sorted(summary.workers.items())
        ],
    )
    names = ("sent", "answered", "empty", "init", "skipped", "no answer", "open", "real ms")
    outside = _table(
        "systems outside the process: frames",  # first what together makes all that was sent
        ("system", *names, "inputs repeat", "answers repeat"),
        [
            (name, *(system.row()[k] for k in (0, 2, 3, 4, 5, 6, 7, 15, 16, 17)))
            for name, system in sorted(summary.outside.items())
        ],
    )
    longest = summary.longest_stalls
    stalls = _table(
        "the loop stood still",
        ("node", "times", "longest ms", "where"),
        [
            (node, f"{count}", f"{longest[node].seconds * 1e3:.0f}", longest[node].line)
            for node, count in sorted(summary.stalls.items())
        ],
    )
    yield from (table for table in (inputs, ticks, workers, outside, stalls) if table.row_count)
    if summary.verdict is not None:
        yield verdict_table(summary.verdict)


def verdict_table(verdict: Verdict) -> Table:
    """Return the figures of the judged estimators, a column each."""
    figures = dict.fromkeys(key for each in verdict.estimators.values() for key in each)
    rows = {
        figure: [each.get(figure, "") for each in verdict.estimators.values()] for figure in figures
    }
    return _table(
        "verdict",
        ("figure", *verdict.estimators),
        [
            (figure, *map(_show, row))
            for figure, row in rows.items()
            if not any(isinstance(value, list | tuple | dict) for value in row)
        ],
    )


def _sum(missed: Mapping[str, int]) -> str:
    return f"{sum(missed.values())}" if missed else ""


def _show(value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _table(title: str, headings: Sequence[str], rows: Iterable[Sequence[str]]) -> Table:
    table = Table(*headings, title=title, title_justify="left")
    for row in rows:
        table.add_row(*row)
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
    """Return a progress bar on a console as the `watch` of `execute`; log lines appear above it."""
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
    runners = list(supervisor.state.runners.values())
    busy = [f"{each.spec.name}: {each.doing}" for each in runners if each.doing]
    if supervisor.state.first_update is None:
        return 0.0, " ".join(["starting", *busy[:1]])
    seconds = supervisor.state.clock.now() / SECOND
    speed = seconds / max(time.monotonic() - supervisor.state.first_update, 1e-9)
    limit = f" of {run.duration:g}" if run.duration else ""
    try:
        frames = count_events(supervisor.state)[0]["Image"]
    except RuntimeError:  # a table of counts grew while this thread read it
        frames = 0
    text = f"{seconds:5.1f}{limit} s  {speed:.1f} × real time  {frames} frames"
    return seconds, "  ".join([text, *busy[:1]])
