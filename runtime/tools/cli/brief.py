"""A run in the terminal: its progress, and its results, as a few lines or in tables."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table

from runtime.errors import ResultsError
from runtime.summary import Summary, Verdict
from runtime.time.clock import SECOND
from runtime.tools.cli.commands import NOBODY, Columns, Csv, Latex, Markdown, chosen_format
from runtime.units import significant

if TYPE_CHECKING:
    from runtime.config.model import RunConfig
    from runtime.run.execute import Watch
    from runtime.run.supervisor import Supervisor
    from runtime.tools.paper.typeset import Format

_WORDS = {
    True: "[green]PASSED[/green]",
    False: "[red]FAILED[/red]",
    None: "[yellow]not judged[/yellow]",
}


def show(
    folder: Annotated[Path, typer.Argument(help="Folder of the run: runs/tour for its latest.")],
    latex: Latex = False,
    markdown: Markdown = False,
    csv: Csv = False,
    figure: Columns = None,
) -> None:
    """Show all figures of a finished run: verdict, channels, ticks, workers, stalls.

    With --latex, --markdown or --csv it prints a table of the estimators instead, for a paper; of a
    judgement's folder, too.
    """
    from runtime.run.results import run_folder
    from runtime.tools.summaries import read_summary

    form = chosen_format(latex=latex, markdown=markdown, csv=csv, figures=figure)
    folder = run_folder(folder)
    if form is not None:
        results = read_summary(folder, _Results)
        print_typeset(results.verdict, form, figure or [], results.error)
        return
    summary = read_summary(folder, Summary)
    print_tables(summary)
    print_lines(summary, folder)


class _Results(msgspec.Struct):
    """Results of a run, or of a judgement."""

    verdict: Verdict | None = None
    error: str | None = None


def print_typeset(
    verdict: Verdict | None, form: Format, figures: Sequence[str], error: str | None = None
) -> None:
    """Print the figures of a single run's estimators as a table for a paper."""
    from runtime.tools.paper.typeset import columns_of, combinations_of, figures_table, typeset

    columns = columns_of(figures, (verdict.estimators if verdict else {}).values())
    rows = combinations_of(verdict, columns, error)
    print(typeset(figures_table(rows, (), columns), form), end="")


def runs(folder: Annotated[Path, typer.Argument(help="Folder of runs.")] = Path("runs")) -> None:
    """List the runs in a folder, the newest last: when, how long, and who passed."""
    from datetime import datetime

    from runtime.run.results import has_run, time_of

    places = [*folder.glob("[!.]*"), *folder.glob("[!.]*/[!.]*")]
    folders = [place for place in places if not place.is_symlink() and has_run(place)]
    if not folders:
        raise ResultsError(f"{folder}: expected folders of runs in it, found none")
    table = Table("run", "time", "s", "seed", "state", "estimators", box=None, pad_edge=False)
    for run in sorted(folders, key=time_of):
        when = datetime.fromtimestamp(time_of(run)).strftime("%Y-%m-%d %H:%M")
        table.add_row(escape(str(run)), when, *_row(run))
    Console().print(table, soft_wrap=True)


def _row(folder: Path) -> tuple[str, str, str, str]:
    from runtime.run.results import has_flown

    try:
        summary = msgspec.json.decode((folder / "summary.json").read_bytes(), type=Summary)
    except FileNotFoundError:
        return "", "", "[yellow]no summary: killed, or not over[/yellow]", ""
    except (OSError, msgspec.MsgspecError):
        return "", "", "[red]unreadable[/red]", ""
    state = _WORDS[summary.verdict.passed if summary.verdict else None]
    if summary.error or not has_flown(folder):
        state = f"[red]{'crashed' if has_flown(folder) else 'did not start'}[/red]"
    judged = summary.verdict.estimators if summary.verdict else {}
    errors = (
        f"{name} {significant(figures['ate_percent'], 2)} %" if figures.get("ate_percent") else name
        for name, figures in judged.items()
    )
    return f"{summary.sim_seconds:.1f}", f"{summary.seed}", state, escape(", ".join(errors))


def print_tables(summary: Summary) -> None:
    """Print the tables of a run, and its digest."""
    console = Console()
    for table in run_tables(summary):
        console.print(table)
    digest = summary.digest or "off"
    if summary.digest and summary.not_deterministic:
        digest += f" (not promised, because of {', '.join(summary.not_deterministic)})"
    console.print(f"digest {digest}", highlight=False)
    console.print(f"digest of the inputs {summary.inputs_digest or 'off'}", highlight=False)


def print_lines(summary: Summary, folder: Path) -> None:
    """Print the results of a run in a few lines, failures first."""
    *words, places = lines(summary, folder)
    print_words(words)
    Console().print(places, highlight=False, soft_wrap=True)  # a path and a command, to be copied


def print_verdict(verdict: Verdict) -> None:
    """Print each verdict, with its main figures, or the reasons for a failure."""
    for name, figures in verdict.estimators.items():
        reasons = "; ".join(str(reason) for reason in figures.get("failed", ()))
        print_words([_heading(name, figures) + (f": {escape(reasons)}" if reasons else "")])
        print_words(f"  {escape(line)}" for line in (*_figures(figures), *_final(figures)))


def print_failures(summary: Summary) -> None:
    """Print a line for each estimator that failed, and nothing else."""
    print_words(_failures(summary))


def print_words(texts: Iterable[str], console: Console | None = None) -> None:
    """Print lines with rich's markup: of a terminal wrapped between words, else as they are."""
    console = console or Console()
    for line in texts:
        console.print(line, highlight=False, soft_wrap=not console.is_terminal)


def lines(summary: Summary, folder: Path) -> Iterator[str]:
    """Return the lines, with rich's markup."""
    yield from _failures(summary)
    pace = ""
    if summary.clock == "lockstep":
        speed = summary.sim_seconds / max(summary.wall_seconds, 1e-9)
        pace = f" in {summary.wall_seconds:.1f} s ({speed:.1f} × real time)"
    yield (
        f"[bold]{escape(summary.name)}[/bold]: {summary.sim_seconds:.1f} s on the {summary.clock} "
        f"clock, seed {summary.seed},{pace or ' in real time'}, ended by: {escape(summary.reason)}"
    )
    if (twice := summary.twice) is not None:
        outcome = (
            "[green]repeats[/green]" if twice.repeats else f"[red]differs[/red]: {twice.first}"
        )
        yield f"run twice, it {outcome}"
    if summary.not_deterministic:
        yield f"repeating it is not promised, because of {', '.join(summary.not_deterministic)}"
    estimators = summary.verdict.estimators if summary.verdict else {}
    for name, figures in estimators.items():
        yield _heading(name, figures)
        yield from (f"  {escape(line)}" for line in (*_figures(figures), *_final(figures)))
        yield from (f"  {escape(line)}" for line in _flow(name, figures, summary))
    for vehicle, figures in (summary.verdict.flights if summary.verdict else {}).items():
        yield from _flight(vehicle, figures)
    judged = {name.partition("/")[0] for name in estimators}
    by_port = {
        k: s.dropped for k, s in summary.streams.items() if k.partition(".")[0] not in judged
    }
    if dropped := [f"{port} {count}" for port, count in by_port.items() if count]:
        yield f"inputs dropped by others: {', '.join(dropped)}"
    program = "visnav" if Path(sys.argv[0]).name == "visnav" else "python -m runtime"
    page = folder / "report.html"
    location = f"report {page}" if page.is_file() else f"results in {folder}"
    yield f"{escape(location)}   all figures: {program} show {escape(str(folder))}"


def _heading(name: str, figures: Mapping[str, Any]) -> str:
    reason = ""
    if figures["passed"] is None:
        reason = f": {escape(str(figures.get('why') or 'no thresholds were given'))}"
    return f"[bold]{escape(name)}[/bold] {_WORDS[figures['passed']]}{reason}"


def _failures(summary: Summary) -> Iterator[str]:
    if summary.verdict is None or summary.verdict.passed is not False:
        return
    flights = {f"flight of {k}": v for k, v in summary.verdict.flights.items()}
    judged = summary.verdict.estimators | flights
    failed = {k: v for k, v in judged.items() if v["passed"] is False}
    for name, figures in failed.items():
        reasons = "; ".join(str(reason) for reason in figures.get("failed", ()))
        yield f"[red]{escape(name)} FAILED[/red]{escape(': ' + reasons if reasons else '')}"
    if not failed:
        yield f"[red]FAILED[/red]: {NOBODY}"


def _flight(vehicle: str, figures: Mapping[str, Any]) -> Iterator[str]:
    parts = []
    if figures.get("collisions"):
        parts.append(f"{figures['collisions']} collisions")
    if figures.get("plan_rmse_m") is not None:
        parts.append(f"{significant(figures['plan_rmse_m'], 3)} m from its plan, RMS")
    if parts or figures["passed"] is not None:
        state = "" if figures["passed"] is None else f" {_WORDS[figures['passed']]}"
        yield f"[bold]flight of {escape(vehicle)}[/bold]{state}   {', '.join(parts)}".rstrip()


def _figures(figures: Mapping[str, Any]) -> Iterator[str]:
    if figures.get("ate_rmse_m") is None:
        return
    parts = [f"ATE {significant(figures['ate_rmse_m'], 3)} m"]
    if figures.get("ate_percent") is not None:
        parts[0] += f" ({significant(figures['ate_percent'], 2)} %)"
    for name, text, digits in (
        ("ate_max_m", "max {} m", 3),
        ("rot_rmse_deg", "rotation {}°", 2),
        ("rpe_1m_trans_percent", "RPE(1 m) {} %", 2),
    ):
        if figures.get(name) is not None:
            parts.append(text.format(significant(figures[name], digits)))
    if figures.get("lost_count") and figures.get("flight_ate_percent") is not None:
        parts.append(f"with lost time {significant(figures['flight_ate_percent'], 2)} %")
    yield f"{', '.join(parts)}   alignment: {figures.get('alignment', 'none')}"


def _final(figures: Mapping[str, Any]) -> Iterator[str]:
    if figures.get("why_not_final") is not None:
        yield f"final trajectory not judged: {figures['why_not_final']}"
    if figures.get("final_ate_rmse_m") is None:
        return
    text = f"final ATE {significant(figures['final_ate_rmse_m'], 3)} m"
    if figures.get("final_ate_percent") is not None:
        text += f" ({significant(figures['final_ate_percent'], 2)} %)"
    yield f"{text} of {figures['final_poses']} poses after all corrections"


def _flow(name: str, figures: Mapping[str, Any], summary: Summary) -> Iterator[str]:
    node = name.partition("/")[0]
    shown = [f"{figures.get('estimates', 0)} poses"]
    if figures.get("frame_coverage_percent") is not None:
        shown[0] += f", for {figures['frame_coverage_percent']:.4g} % of the images"
    if figures.get("compared", figures.get("estimates")) != figures.get("estimates"):
        shown.append(f"compared {figures['compared']} of them")
    lost = figures.get("lost_count")
    if lost is not None:
        times = "never lost" if not lost else f"lost {lost} × ({figures['lost_seconds']:.3g} s)"
        shown.append(times)
    if figures.get("latency_p50_ms") is not None:
        parts = [figures["latency"]] if "latency" in figures else []
        for worker, costs in summary.workers.items():
            if worker.startswith(f"{node}.") and costs.latency_ms:
                parts.append(f"a call takes {costs.wall_p50_ms:.3g} ms here")
        kind = f" ({'; '.join(parts)})" if parts else ""
        shown.append(f"latency {figures['latency_p50_ms']:.3g} ms{kind}")
    dropped = sum(s.dropped for port, s in summary.streams.items() if port.startswith(f"{node}."))
    shown.append(f"{dropped} inputs dropped" if dropped else "nothing dropped")
    yield "   ".join(shown)
    for worker, costs in summary.workers.items():
        if worker.startswith(f"{node}.") and costs.slower:
            yield f"warning: {costs.slower}"


def run_tables(summary: Summary) -> Iterator[Table]:
    """Yield tables of events sent and dropped, tick lateness, worker costs, and more."""
    seconds = max(summary.sim_seconds, 1e-9)
    yield table_of(
        "sent",
        ("output", "events", "per second"),
        [(name, n, f"{n / seconds:.1f}") for name, n in sorted(summary.outputs.items())],
    )
    inputs = table_of(
        "inputs",
        ("input", "dropped", "fullest", "holds", "unmatched"),
        [
            (port, of.dropped, of.peak, of.bound, sum(of.missed.values()) if of.missed else "")
            for port, of in sorted(summary.streams.items())
        ],
    )
    ticks = table_of(
        "ticks",
        ("tick", "Hz", "calls", "late p50 µs", "p99 µs", "max µs", "missed"),
        [
            (
                name,
                f"{tick.hz:g}",
                tick.calls,
                *(f"{us:.0f}" for us in (tick.late_p50_us, tick.late_p99_us, tick.late_max_us)),
                tick.missed,
            )
            for name, tick in sorted(summary.ticks.items())
        ],
    )
    # Of the next two, the columns for which a terminal has room.
    workers = table_of(
        "calls of workers: milliseconds (median, 95 % below), peak memory",
        ("worker", "declared", "real", "p95", "CPU", "p95", "MB"),
        [
            (name, *(worker.row()[k] for k in (0, 2, 3, 5, 6, 8)))
            for name, worker in sorted(summary.workers.items())
        ],
    )
    names = ("sent", "answered", "empty", "init", "skipped", "no answer", "open", "real ms")
    outside = table_of(
        "systems outside the process: frames",  # first what together makes all that was sent
        ("system", *names, "inputs repeat", "answers repeat"),
        [
            (name, *(system.row()[k] for k in (0, 2, 3, 4, 5, 6, 7, 15, 16, 17)))
            for name, system in sorted(summary.outside.items())
        ],
    )
    longest = summary.longest_stalls
    stalls = table_of(
        "the loop stood still",
        ("node", "times", "longest ms", "where"),
        [
            (node, count, f"{longest[node].seconds * 1e3:.0f}", longest[node].line)
            for node, count in sorted(summary.stalls.items())
        ],
    )
    yield from (table for table in (inputs, ticks, workers, outside, stalls) if table.row_count)
    if summary.verdict is not None:
        yield verdict_table(summary.verdict)


def verdict_table(verdict: Verdict) -> Table:
    """Return the figures of the judged estimators, a column each."""
    figures = dict.fromkeys(key for row in verdict.estimators.values() for key in row)
    rows = {
        figure: [row.get(figure, "") for row in verdict.estimators.values()] for figure in figures
    }
    return table_of(
        "verdict",
        ("figure", *verdict.estimators),
        [
            (figure, *map(_show, row))
            for figure, row in rows.items()
            if not any(isinstance(value, list | tuple | dict) for value in row)
        ],
    )


def _show(value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return significant(value) if isinstance(value, float) else str(value)


def table_of(title: str, headings: Sequence[str], rows: Iterable[Sequence[Any]]) -> Table:
    """Return a table, whose columns but the first and those of places are of numbers."""
    table = Table(*headings, title=title, title_justify="left")
    for row in rows:
        table.add_row(*map(str, row))
    names = table.columns[0]
    names.min_width = min(max((len(str(cell)) for cell in names.cells), default=0), 24)
    names.overflow = "fold"
    for column in table.columns[1:]:
        if column.header not in {"where", "in"}:
            column.justify = "right"
    return table


_PERIOD = 0.2
_LINE_PERIOD = 10.0
"""Seconds between two updates: of the bar, and of the lines where there is no terminal."""


def progress(run: RunConfig, console: Console) -> Watch:
    """Return a progress bar on a console as the `watch` of `execute`; log lines appear above it."""

    @contextlib.contextmanager
    def watching(supervisor: Supervisor) -> Iterator[None]:
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

    return watching


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
    from runtime.run.summarise import count_events

    runners = list(supervisor.state.runners.values())
    busy = [f"{runner.spec.name}: {runner.doing}" for runner in runners if runner.doing]
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
