"""``compare``: fly two versions over equal flights, and show which is better.

The table of the terminal has a line for each figure; the page has slopes, flight by flight.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
import typer

from runtime.run.results import write
from runtime.tools.cli.commands import Overrides
from runtime.tools.cli.outcomes import JUnit, Outcome, State, writing

if TYPE_CHECKING:
    from runtime.tools.comparison import Compared, Comparison


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
) -> None:
    """Tell whether B is better than A, over equal flights, with confidence.

    A and B are settings of the same files: `--a odometry.corners=300 --b odometry.corners=500`, or
    two builds of a program: `--a 'slam.command=["./old"]' --b 'slam.command=["./new"]'`. Each
    flight is recorded once, and both get it. Half of the flights are looked at first; if all
    figures are decided then, the others are not flown. Or A and B are two folders of finished
    sweeps. Each figure is *better*, *worse*, *no difference* larger than the margin, *not enough
    runs*, or *not comparable*, an error after different alignments. Crashes and lost estimators
    count as worst. Ends with 0; with 1 if a figure is worse, or with --margin also if it may be
    worse by more than that; with 130 after Ctrl-C.
    """
    from runtime.tools.cli.sweep import carry_out
    from runtime.tools.comparison import compare as compare_all

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
        for each in compared.rows:
            outcomes += of_comparison(each, margin)
    print_table(compared)
    if json is not None:
        text = msgspec.json.encode(compared.rows)
        write(json, msgspec.json.format(text, indent=2) + b"\n")
    if compared.worse:
        raise typer.Exit(1)


def of_comparison(each: Comparison, margin: float) -> list[Outcome]:
    """Return an outcome for each scenario of a figure.

    If a figure fails, so do the scenarios in most of whose flights B is worse; all, if it is so in
    none.
    """
    counts = each.by_scenario()
    guilty = [name for name, (worse, better, _) in counts.items() if worse > better]
    found = []
    for name, (worse, _, flights) in counts.items():
        state: State = "passed"
        if each.fails(margin):
            state = "failed" if name in guilty or not guilty else "passed"
        elif each.verdict in {"not enough runs", "not comparable"}:
            state = "not judged"
        reason = f"{each.words}: {each.interval} in all; worse in {worse} of {flights} flights here"
        reasons = [] if state == "passed" else [reason]
        label = f"{each.estimator} {each.figure}"
        found.append(Outcome(run=name, estimator=label, state=state, reasons=reasons))
    return found


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
    for each in compared.rows:
        cells = each.estimator, each.figure, *each.medians, each.interval, each.words
        table.add_row(*cells, style=style.get(each.verdict, ""))
    console = Console()
    if not console.is_terminal:
        console.width = WIDTH
    console.print(table)
    flights = max((each.pairs for each in compared.rows), default=0)
    console.print(
        f"{flights} flights, medians; the page is {compared.page}", highlight=False, soft_wrap=True
    )
