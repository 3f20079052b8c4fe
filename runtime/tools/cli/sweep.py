"""Commands for many runs: ``sweep``, ``flights`` (those recorded) and ``compare``.

``compare``'s table in the terminal has a line for each figure; the page has slopes, flight by
flight.
"""

from __future__ import annotations

import contextlib
import functools
import signal
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
import typer

from runtime.run.results import write
from runtime.tools.cli.commands import (
    Columns,
    ConfigFile,
    Csv,
    Json,
    JUnit,
    Latex,
    Markdown,
    Outcome,
    Overrides,
    State,
    chosen_format,
    of_rows,
    warn,
    writing,
)

if TYPE_CHECKING:
    from runtime.tools.comparison import Compared, Comparison
    from runtime.tools.sweep import Children, Job, Plan, Row


def sweep(
    config: ConfigFile,
    vary: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PATH=V1,V2,…",
            help="Values of a setting to run with (paths as for --set). May be repeated: then "
            "every combination is run.",
        ),
    ] = None,
    seeds: Annotated[
        int, typer.Option(min=1, help="Run each combination with so many seeds, from the file's.")
    ] = 1,
    repeat: Annotated[
        int, typer.Option(min=1, help="Run it with each seed so often: is it the same each time?")
    ] = 1,
    overrides: Overrides = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for results; sweeps/<name> if not given.")
    ] = None,
    jobs: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Runs at the same time; if not given, as many as there are cores if they share "
            "their flights, else half of that.",
        ),
    ] = None,
    fly: Annotated[
        bool, typer.Option("--fly", help="Fly each run anew, also what was recorded.")
    ] = False,
    timeout: Annotated[
        str | None,
        typer.Option(
            metavar="DURATION",
            help='Real time after which a run is ended as failed, such as "20min"; if not given, '
            "10 min and 30 times the run's duration.",
        ),
    ] = None,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Run everything, also what is finished already.")
    ] = False,
    junit: JUnit = None,
    json: Json = None,
    latex: Latex = False,
    markdown: Markdown = False,
    csv: Csv = False,
    figure: Columns = None,
) -> None:
    """Run a file with every combination of some settings, and compare the results.

    Each run is a process of its own; one that fails is a row of the table. Runs that differ only in
    what comes after the sensors fly once: that flight is recorded, and kept for later sweeps (see
    the command flights). Results go to sweeps/<name>: index.html shows all of them; table.csv,
    summary.csv, plots/, each run's folder in runs/, and, since they depend on the machine,
    timing.csv and what workers cost in costs.csv. Called again, only what is missing, has crashed,
    or was made from something that has changed (code, programs, files) is run. Ends with 0 if every
    run came to its end and met its thresholds; with 1 if a threshold was missed; with 2 if a run
    crashed; with 130 after Ctrl-C.
    """
    from rich.console import Console

    from runtime.config.reading import load_configuration
    from runtime.tools import sweep as sweeping
    from runtime.tools.cli.run import check_before_run
    from runtime.tools.paper.typeset import columns_of, figures_table, typeset
    from runtime.tools.sweep.console import print_summary
    from runtime.tools.sweep.tables import summarise

    form = chosen_format(latex=latex, markdown=markdown, csv=csv, figures=figure)
    with writing(config.stem, junit, json) as outcomes:
        plan = sweeping.make_plan(
            config,
            vary or [],
            overrides=overrides or [],
            seeds=seeds,
            repeats=repeat,
            out=out,
            fly=fly,
            limit=_seconds(timeout),
        )
        changes = [f"{path}={text}" for path, text in plan.jobs[0].settings]
        check_before_run(load_configuration(config, [*(overrides or []), *changes]))
        rows = carry_out(plan, jobs=jobs, fresh=fresh)
        outcomes += of_rows(map(str, plan.jobs), rows)
    sweeping.write_tables(plan, rows)
    sweeping.draw_plots(plan, rows)
    page = sweeping.write_page(plan, rows)
    if form is not None:
        judged = (figures for row in rows for figures in row["estimators"].values())
        columns = columns_of(figure or [], judged)
        paths = [parameter.path for parameter in plan.parameters]
        table = figures_table(summarise(plan, rows, columns), paths, columns)
        print(typeset(table, form), end="")
        end(rows)
        return
    console = Console()
    print_summary(console, plan, sweeping.summarise(plan, rows))
    console.print(
        f"{len(rows)} runs   results in [bold]{plan.out}[/bold]: open {page.name}",
        highlight=False,
        soft_wrap=True,
    )
    end(rows)


def end(rows: Sequence[Row], *, judged: bool = True) -> None:
    """Print how many runs crashed or failed.

    Raises:
        typer.Exit: With 2 if a run crashed, with 1 if a threshold was missed and runs are `judged`.
    """
    if again := sum("crashes" in row for row in rows):
        typer.echo(f"{again} of {len(rows)} runs crashed before, and were tried again", err=True)
    if crashed := sum(bool(row["error"]) for row in rows):
        typer.echo(f"error: {crashed} of {len(rows)} runs crashed", err=True)
        raise typer.Exit(2)
    if judged and (failed := sum(row["passed"] is False for row in rows)):
        typer.echo(f"{failed} of {len(rows)} runs failed: thresholds were missed", err=True)
        raise typer.Exit(1)


def carry_out(
    plan: Plan,
    *,
    jobs: int | None = None,
    fresh: bool = False,
    finished: Callable[[Job, Row], None] | None = None,
) -> list[Row]:
    """Run the missing jobs of a plan on this machine, and show the progress.

    Args:
        finished: Called with each job that ends, and its row; not after an interruption.

    Raises:
        typer.Exit: With 130, after Ctrl-C or another signal that ends it.
    """
    from rich.console import Console

    from runtime.tools.sweep.console import Display, run_here

    display = Display(Console(stderr=True), finished)
    try:
        with _signals_interrupt(display.children), display:
            return run_here(plan, jobs=jobs, fresh=fresh, display=display)
    except KeyboardInterrupt:
        typer.echo(f"interrupted; the same command runs what is missing in {plan.out}", err=True)
        raise typer.Exit(130) from None


@contextlib.contextmanager
def _signals_interrupt(children: Children) -> Iterator[None]:
    """Make Ctrl-C, SIGTERM and a closed terminal end the runs, and the sweep; unless ignored."""

    def stop(*_: object) -> None:
        first = not children.ending
        children.interrupt()
        if first:  # what follows it is not to be interrupted itself
            raise KeyboardInterrupt

    with contextlib.ExitStack() as before:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if (handler := signal.getsignal(number)) is not signal.SIG_IGN:
                before.callback(signal.signal, number, handler)
                signal.signal(number, stop)
        yield


def _seconds(duration: str | None) -> float | None:
    from runtime.errors import ConfigError
    from runtime.units import Duration

    try:
        return None if duration is None else float(Duration.parse(duration))
    except ValueError as error:
        raise ConfigError(f"--timeout {duration}: {error}") from None


def flights(
    keep: Annotated[
        float | None,
        typer.Option(min=0, metavar="GB", help="Remove those not used for longest beyond this."),
    ] = None,
    clear: Annotated[bool, typer.Option("--clear", help="Remove all of them.")] = False,
) -> None:
    """Show the flights recorded by sweeps, or remove some.

    A sweep flies once what several of its runs have in common, and keeps it for later ones: up to
    20 GB, or as many as VISNAV_FLIGHTS_GB says. What a flight depends on is a part of its name, so
    one that no longer fits is not used, and goes when it was not used for longest.
    """
    from runtime.tools.flights import home, remove_beyond, stored

    if clear or keep is not None:
        removed = remove_beyond(0.0 if clear or keep is None else keep)
        gigabytes = sum(flight.size for flight in removed) / 1e9
        print(f"{len(removed)} flights removed, {gigabytes:.2f} GB")
    cached = stored()
    for flight in cached:
        used = datetime.fromtimestamp(flight.used).strftime("%Y-%m-%d %H:%M")
        print(f"{flight.path.stem}  {flight.size / 1e9:7.2f} GB  used {used}")
    print(f"{len(cached)} flights, {sum(f.size for f in cached) / 1e9:.2f} GB in {home()}")


def compare(
    what: Annotated[
        list[Path],
        typer.Argument(help="Files to fly, one a scenario; or two folders of finished sweeps."),
    ],
    a: Annotated[
        list[str] | None,
        typer.Option("--a", metavar="NODE.KEY=VALUE", help="Setting of A. May be repeated."),
    ] = None,
    b: Annotated[
        list[str] | None,
        typer.Option("--b", metavar="NODE.KEY=VALUE", help="Setting of B. May be repeated."),
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Flights of each file, at most.")] = 12,
    repeat: Annotated[int, typer.Option(min=1, help="Runs with each flight, averaged.")] = 1,
    name: Annotated[
        list[str] | None, typer.Option("--figure", help="Figure to compare. May be repeated.")
    ] = None,
    margin: Annotated[
        float,
        typer.Option(min=0, help="Change that does not matter, in percent (or the figure's unit)."),
    ] = 0.0,
    overrides: Overrides = None,
    out: Annotated[Path, typer.Option(help="Folder for runs and page.")] = Path("compared"),
    jobs: Annotated[int | None, typer.Option(min=1, help="Runs at the same time.")] = None,
    junit: JUnit = None,
    json: Annotated[
        Path | None, typer.Option("--json", help="Write the comparisons as JSON.")
    ] = None,
    latex: Latex = False,
    markdown: Markdown = False,
    csv: Csv = False,
) -> None:
    """Return whether B is better than A, over equal flights, with confidence.

    A and B are settings of the same files: `--a odometry.corners=300 --b odometry.corners=500`, or
    two builds of a program: `--a 'slam.command=["./old"]' --b 'slam.command=["./new"]'`. Each
    flight is recorded once, and both get it. Half of the flights are looked at first; if all
    figures are decided then, the others are not flown. Or A and B are two folders of finished
    sweeps or runs, and it is said if their flights differ. Each figure is *better*, *worse*, *no
    difference* larger than the margin, *identical*, *not enough runs*, or *not comparable*, an
    error after different alignments. Crashes and lost estimators count as worst. Ends with 0; with
    1 if a figure is worse, or with --margin also if it may be worse by more than that; with 130
    after Ctrl-C.
    """
    from runtime.tools.comparison import compare as compare_all
    from runtime.tools.paper.typeset import comparison_table, typeset

    form = chosen_format(latex=latex, markdown=markdown, csv=csv)
    with writing("compare", junit, None) as outcomes:
        compared = compare_all(
            what,
            a or [],
            b or [],
            seeds=seeds,
            repeats=repeat,
            figures=name or [],
            margin=margin,
            overrides=overrides or [],
            out=out,
            fly=functools.partial(carry_out, jobs=jobs),
        )
        for row in compared.rows:
            outcomes += of_comparison(row, margin)
    if form is None:
        print_table(compared)
    else:
        print(typeset(comparison_table(compared.rows), form), end="")
    for note in compared.notes:
        warn(note)
    if json is not None:
        text = msgspec.json.encode(compared.rows)
        write(json, msgspec.json.format(text, indent=2) + b"\n")
    if compared.worse:
        raise typer.Exit(1)


def of_comparison(row: Comparison, margin: float) -> list[Outcome]:
    """Return an outcome for each scenario of a figure.

    If a figure fails, so do the scenarios in most of whose flights B is worse; all, if it is so in
    none.
    """
    counts = row.by_scenario()
    guilty = [name for name, (worse, better, _) in counts.items() if worse > better]
    outcomes = []
    for name, (worse, _, flights) in counts.items():
        state: State = "passed"
        if row.fails(margin):
            state = "failed" if name in guilty or not guilty else "passed"
        elif row.verdict in {"not enough runs", "not comparable"} or row.more:
            state = "not judged"
        reason = f"{row.words}: {row.interval} in all; worse in {worse} of {flights} flights here"
        reasons = [] if state == "passed" else [reason]
        label = f"{row.estimator} {row.figure}"
        outcomes.append(Outcome(run=name, estimator=label, state=state, reasons=reasons))
    return outcomes


WIDTH = 120  # of the table where there is no terminal, in letters


def print_table(compared: Compared) -> None:
    """Print a line for each figure."""
    from rich import box
    from rich.console import Console
    from rich.table import Column, Table

    names = [Column(heading, no_wrap=True) for heading in ("figure", "A", "B", "change B - A")]
    for number in names[1:]:
        number.justify = "right"
    table = Table("estimator", *names, "verdict", box=box.SIMPLE_HEAD)
    style = {"better": "green", "worse": "red"}
    for row in compared.rows:
        cells = row.estimator, row.figure, *row.medians, row.interval, row.words
        table.add_row(*cells, style=style.get(row.verdict, ""))
    console = Console()
    if not console.is_terminal:
        console.width = WIDTH
    console.print(table)
    flights = max((row.pairs for row in compared.rows), default=0)
    console.print(
        f"{flights} flights, medians; the page is {compared.page}", highlight=False, soft_wrap=True
    )
