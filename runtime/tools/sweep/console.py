"""All runs of a plan, on any executor, with their progress and summary in the terminal.

Runs that are finished already are not run again, unless something that they were made from has
changed since: code, programs, files (`runtime.run.made_from`).
"""

from __future__ import annotations

import concurrent.futures
import logging
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import msgspec
from rich import box
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, TextColumn
from rich.table import Table
from rich.text import Text

from runtime.figures import figure
from runtime.run.made_from import Parts, Roots, made_from
from runtime.tools.sweep.plan import Job, Plan
from runtime.tools.sweep.process import Children, run_job
from runtime.tools.sweep.tables import MAIN, Combination, Row, Rows, crashed

_LOG = logging.getLogger("visnav.sweep")


class Watch:
    """Base of a sweep's observers: does nothing."""

    def begin(self, missing: Sequence[Job], finished: int) -> None:
        """Handle the start: the jobs to run, and the number of runs finished earlier."""

    def again(self, changed: Mapping[Job, Sequence[str]]) -> None:
        """Handle finished jobs to run again, with what has changed; called before `begin`."""

    def done(self, job: Job, row: Row) -> None:
        """Handle the end of a run, successful or not."""

    def interrupted(self) -> None:
        """Handle an interruption: the sweep ends after the running jobs, which should end soon."""


def sweep(
    plan: Plan,
    executor: concurrent.futures.Executor,
    *,
    run: Callable[[Job], Row] = run_job,
    watch: Watch | None = None,
    fresh: bool = False,
) -> list[Row]:
    """Run the missing jobs, and those crashed before; called in a single thread.

    So are those made from something else than what is there now. Each row is in ``rows.jsonl``
    before the next one is looked at, so whatever ends a sweep, the next call takes up where it
    ended. A run that fails is a row with an error.

    Args:
        run: Runs one job; must be picklable if the executor needs that.
        fresh: Forget rows of earlier sweeps in the same folder.

    Returns:
        The rows in the order of the plan's jobs.

    Raises:
        ConfigError: Another sweep writes into the same folder.
        BaseException: Whatever interrupts it, such as KeyboardInterrupt, once the running jobs have
            ended; those that ended well are kept. A second one is not waited for.
    """
    watch = watch or Watch()
    parts = parts_of(plan)
    with Rows(plan.out / "rows.jsonl", fresh=fresh) as rows:
        missing, changed = [], {}
        for job in plan.jobs:
            row = rows.get(job)
            if row is None or row["error"]:
                missing.append(job)
            elif reasons := rows.changes(row, parts[job.roots]):
                missing.append(job)
                changed[job] = reasons
        if changed:
            watch.again(changed)
        watch.begin(missing, len(plan.jobs) - len(missing))
        futures: dict[concurrent.futures.Future[Row], Job] = {}  # those without a row
        try:
            for job in missing:
                futures[_submit(executor, run, job)] = job
            for future in concurrent.futures.as_completed([*futures]):
                job = futures[future]
                row = rows.add(_with_parts(_row(future, job), parts[job.roots]))
                watch.done(futures.pop(future), row)
        except BaseException:
            running = [future for future in futures if not future.cancel()]
            watch.interrupted()
            for row in [_row(future, futures[future]) for future in running]:  # waits
                if not row["error"]:
                    job = next(planned for planned in plan.jobs if planned.id == row["id"])
                    rows.add(_with_parts(row, parts[job.roots]))
            raise
        return [row for job in plan.jobs if (row := rows.get(job)) is not None]


def parts_of(plan: Plan) -> dict[Roots, Parts]:
    """Return what a plan's jobs are made from now, by their roots."""
    return {roots: made_from(roots) for roots in {job.roots: None for job in plan.jobs}}


def _with_parts(row: Row, now: Parts) -> Row:
    """Return a row that says what it was made from, which `run_job` notes itself."""
    if "parts" not in row and not row["error"]:
        row["parts"] = now
    return row


def run_here(
    plan: Plan, *, jobs: int | None = None, fresh: bool = False, display: Display | None = None
) -> list[Row]:
    """Run the missing jobs of a plan on this machine; see `sweep`.

    Args:
        jobs: Runs at the same time; if not given, as many as fit on the cores.
        display: Shows them, and has their processes.
    """
    children, watch = (display.children, display) if display else (Children(), Watch())
    if display is None:
        watch.interrupted = children.interrupt  # type: ignore[method-assign]
        watch.again = lambda changed: _LOG.warning("%s", rerun_text(changed))  # type: ignore[method-assign]
    with concurrent.futures.ThreadPoolExecutor(jobs or at_once(plan), "run") as executor:
        return sweep(plan, executor, run=children.run, watch=watch, fresh=fresh)


def at_once(plan: Plan) -> int:
    """Return how many runs fit on the cores: rendering takes one of its own."""
    cores = len(os.sched_getaffinity(0))
    return cores if all(job.record for job in plan.jobs) else max(cores // 2, 1)


def _submit(
    executor: concurrent.futures.Executor, run: Callable[[Job], Row], job: Job
) -> concurrent.futures.Future[Row]:
    try:
        return executor.submit(run, job)
    except concurrent.futures.BrokenExecutor as error:  # by a job before this one
        broken: concurrent.futures.Future[Row] = concurrent.futures.Future()
        broken.set_exception(error)
        return broken


def _row(future: concurrent.futures.Future[Row], job: Job) -> Row:
    try:
        return future.result()
    except Exception as error:
        return crashed(job, f"{type(error).__name__}: {error}")


class Display(Watch):
    """A bar in a terminal, else a line per finished run; a context manager.

    Args:
        finished: Called with each job that has ended, and its row.

    Attributes:
        children: The processes of the runs; whoever interrupts the sweep ends them.
    """

    def __init__(
        self, console: Console, finished: Callable[[Job, Row], None] | None = None
    ) -> None:
        self._finished_callback = finished
        self.children = Children()
        self.crashed = 0
        self.finished = 0
        self._console = console
        self._missing = 0
        self._changed: Mapping[Job, Sequence[str]] = {}
        self._usage, self._looked = (0, 0.0), 0.0
        self._started_at = self._last_end = time.monotonic()
        self._bar = Progress(
            TextColumn("sweep"),
            BarColumn(),
            MofNCompleteColumn(),
            _State(self),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task("sweep", total=None)

    def __enter__(self) -> Display:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def begin(self, missing: Sequence[Job], finished: int) -> None:
        """Show how many runs there are."""
        self._missing = len(missing)
        self._started_at = self._last_end = time.monotonic()
        new = len(missing) - len(self._changed)
        if self._changed:
            to_do = f"{new} to do, " * (new > 0)
            self._print(f"{finished} runs are finished already, {to_do}{rerun_text(self._changed)}")
        elif finished:
            self._print(f"{finished} runs are finished already, {new} to do")
        self._changed = {}  # for another sweep
        self._bar.update(self._task, total=len(missing))

    def again(self, changed: Mapping[Job, Sequence[str]]) -> None:
        """Remember which finished runs are run again, and why; `begin` prints it."""
        self._changed = changed

    def done(self, job: Job, row: Row) -> None:
        """Count a run; print failures, and without a bar every run."""
        if self._finished_callback is not None:
            self._finished_callback(job, row)
        self.finished += 1
        self.crashed += bool(row["error"])
        self._last_end = time.monotonic()
        self._bar.update(self._task, completed=self.finished)
        if row["error"]:
            self._print(f"{self._count()} {job}: crashed: {row['error']}")
        elif not self._console.is_terminal:
            seconds = f"{row['wall_seconds']:.1f} s" if row["wall_seconds"] else "done"
            failed = ", failed" if row["passed"] is False else ""
            self._print(f"{self._count()} {job}: {seconds}{failed}, {self.state()}")
        if edited := row.get("edited"):
            changes = listed([f"{part} while it ran" for part in edited])
            self._print(f"warning: {job}: {changes}: the next call runs it again")

    def interrupted(self) -> None:
        """Print a notice: running jobs are awaited, Ctrl-C ends them at once."""
        self._print("ending the runs that are under way; Ctrl-C ends them at once")

    def state(self) -> str:
        """Return failures, running jobs with processes and memory, and the time left."""
        remaining = "?"
        if self.finished:
            pace = (self._last_end - self._started_at) / self.finished
            until = self._last_end + pace * (self._missing - self.finished)
            remaining = _clock(max(until - time.monotonic(), 0))
        if time.monotonic() - self._looked > 1.0:
            self._usage, self._looked = self.children.usage(), time.monotonic()
        processes, memory = self._usage
        using = f" ({processes} process{'es' * (processes > 1)}, {memory:.1f} GB)" * bool(processes)
        return f"{self.crashed} crashed, {len(self.children)} running{using}, {remaining} left"

    def _count(self) -> str:
        return f"{self.finished}/{self._missing}"

    def _print(self, line: str) -> None:
        self._console.print(line, highlight=False, markup=False, soft_wrap=True)


def rerun_text(changed: Mapping[Job, Sequence[str]]) -> str:
    """Return which finished runs are run again, and why: ``2 are run again: x.py changed``."""
    reasons = [reason for change_reasons in changed.values() for reason in change_reasons]
    are = "is" if len(changed) == 1 else "are"
    return f"{len(changed)} {are} run again: {listed(dict.fromkeys(reasons))}"


def listed(reasons: Iterable[str]) -> str:
    """Return some reasons, and how many more there are."""
    reasons = [*reasons]
    more = len(reasons) - MOST_REASONS
    return ", ".join(reasons[:MOST_REASONS]) + f" and {more} more" * (more > 0)


MOST_REASONS = 4  # in one line


class _State(ProgressColumn):
    def __init__(self, display: Display) -> None:
        super().__init__()
        self._display = display

    def render(self, _: Any) -> Text:
        return Text(self._display.state())


WIDTH = 100  # of a table in a terminal, in letters, at most


class Column(msgspec.Struct, frozen=True):
    """Column of the summary: its heading, a text for each line, and the unit of a figure."""

    heading: str
    texts: tuple[str, ...]
    unit: str | None = None

    def __str__(self) -> str:
        """Return heading, the text that all lines share, and unit."""
        return " ".join(filter(None, (self.heading, self.texts[0], self.unit)))


def print_summary(console: Console, plan: Plan, combinations: Sequence[Combination]) -> None:
    """Print medians with their ends: as many of the main figures as fit without a broken number.

    What is equal in all lines stands above the table in a line of its own; what is left out, and
    the quartiles, are in `write_tables`.
    """
    width = console.width = min(WIDTH, console.width) if console.is_terminal else WIDTH
    shown = [column for column in _columns(plan, combinations) if any(column.texts)]
    if len(combinations) > 1:
        same = [column for column in shown if len(set(column.texts)) == 1]
        shown = [column for column in shown if column not in same]
        console.print("all: " + ", ".join(map(str, same)), markup=False, highlight=False)
    endless = console.options.update(max_width=10_000)
    left_out: list[str] = []
    while figures := [column for column in shown if column.unit is not None]:
        if console.measure(_table(shown), options=endless).maximum <= width:
            break
        shown.remove(figures[-1])
        left_out.insert(0, figures[-1].heading)
    console.print(_table(shown))
    if left_out:
        line = f"also in table.csv and the page: {', '.join(left_out)}"
        console.print(line, highlight=False)
    if len({combination.alignment for combination in combinations}) > 1:
        console.print(
            "Errors after different alignments are different things: compare those of one only.",
            style="yellow",
        )


def _columns(plan: Plan, combinations: Sequence[Combination]) -> Iterator[Column]:
    for index, parameter in enumerate(plan.parameters):
        yield Column(parameter.path, tuple(c.settings[index] for c in combinations))
    passed = ["" if c.passed is None else f"{c.passed} of {c.runs}" for c in combinations]
    for name in ("estimator", "runs", "crashed", "passed", "repeatable", "alignment"):
        cells = passed if name == "passed" else [str(getattr(c, name)) for c in combinations]
        yield Column(name, tuple(cells))
    for name in MAIN:
        texts = tuple(str(c.figures.get(name, "")) for c in combinations)
        yield Column(name, texts, figure(name).unit)


def _table(columns: Sequence[Column]) -> Table:
    table = Table(
        title="median (least–most) of the runs", title_justify="left", box=box.SIMPLE_HEAD
    )
    for column in columns:
        number = column.unit is not None
        heading = column.heading.replace("_", "\n").replace(".", ".\n")
        table.add_column(
            Text(heading), justify="right" if number else "left", no_wrap=number, overflow="fold"
        )
    for texts in zip(*(column.texts for column in columns), strict=True):
        table.add_row(*map(Text, texts))
    return table


def _clock(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}"
