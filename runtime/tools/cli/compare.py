"""``compare``: fly two versions over equal flights, and show which is better.

The table of the terminal has a line for each figure; the page has slopes, flight by flight.
"""

from __future__ import annotations

import base64
import io
import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import typer

from runtime.errors import ConfigError
from runtime.figures import FIGURES, figure
from runtime.run.results import write
from runtime.tools.cli.commands import Overrides
from runtime.tools.comparison import ERROR, USUAL, Comparison, Key, compare_rows, read_folder

if TYPE_CHECKING:
    from runtime.tools.sweep import Row


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
    json: Annotated[
        Path | None, typer.Option("--json", help="Write the comparisons as JSON.")
    ] = None,
) -> None:
    """Tell whether B is better than A, over equal flights, with confidence.

    A and B are settings of the same files: `--a odometry.corners=300 --b odometry.corners=500`, or
    two builds of a program: `--a 'slam.command=["./old"]' --b 'slam.command=["./new"]'`. Each
    flight is recorded once, and both get it. Half of the flights are looked at first; if all
    figures are decided then, the others are not flown. Or A and B are two folders of finished
    sweeps.

    Each figure is *better*, *worse*, *no difference* larger than the margin, or *not enough runs*.
    Crashes and lost estimators count as worst. Ends with 0; with 1 if a figure is worse, or with
    --margin also if it may be worse by more than that; with 130 after Ctrl-C.
    """
    for each in name or ():
        if each not in FIGURES:
            raise ConfigError(f"--figure {each}: expected one of {', '.join(FIGURES)}")
    options: dict[str, Any] = {"figures": name or USUAL, "margin": margin}
    if all(path.is_dir() for path in what):
        if len(what) != 2 or a or b:
            raise ConfigError("compare: expected two folders, without --a and --b")
        sides = tuple(map(read_folder, what))
        found = compare_rows(*sides, **options)
    else:
        if not (a or b):
            raise ConfigError("compare: expected --a or --b: in what the two sides differ")
        found = fly(
            what, a or [], b or [], seeds, repeat, overrides or [], out.absolute(), jobs, options
        )
    page = write_page(found, out, a or [str(what[0])], b or [str(what[-1])])
    print_table(found, page)
    if json is not None:
        text = msgspec.json.encode(found)
        write(json, msgspec.json.format(text, indent=2) + b"\n")
    if any(each.verdict == "worse" or (margin and each.inferior(margin)) for each in found):
        raise typer.Exit(1)


def fly(
    files: Sequence[Path],
    a: Sequence[str],
    b: Sequence[str],
    seeds: int,
    repeats: int,
    overrides: Sequence[str],
    out: Path,
    jobs: int | None,
    options: Mapping[str, Any],
) -> list[Comparison]:
    """Fly until all figures are decided: half of the seeds, and then the rest.

    Raises:
        ConfigError: A file or a setting is wrong.
    """
    from runtime.config.reading import load_configuration
    from runtime.tools.cli.sweep import carry_out
    from runtime.tools.sweep import Plan, make_job, sharing
    from runtime.tools.sweep.plan import Parameter

    sides = {"A": a, "B": b}
    first: dict[Path, int] = {}
    planned = []
    for file, (side, changes) in itertools.product(files, sides.items()):
        config = load_configuration(file, [*overrides, *changes])
        first.setdefault(file, config.run.seed)
        settings = (("side", side), ("scenario", file.stem))
        numbers = range(first[file], first[file] + seeds), range(1, repeats + 1)
        for seed, number in itertools.product(*numbers):
            planned.append(make_job(config, settings, seed, file.resolve().parent, out, number))
    begin = {file.stem: seed for file, seed in first.items()}
    looks = sorted({math.ceil(seeds / 2), seeds})
    found: list[Comparison] = []
    for look in looks:
        now = [
            job
            for job in sharing(planned)
            if job.seed < begin[dict(job.settings)["scenario"]] + look
        ]
        parameters = (
            Parameter(path="side", texts=tuple(sides)),
            Parameter(path="scenario", texts=tuple(begin)),
        )
        rows = carry_out(Plan(parameters=parameters, jobs=tuple(now), out=out), jobs=jobs)
        flights: dict[str, dict[Key, list[Row]]] = {side: {} for side in sides}
        for job, row in zip(now, rows, strict=True):
            (_, side), (_, scenario) = job.settings
            flights[side].setdefault((scenario, job.seed), []).append(row)
        found = compare_rows(flights["A"], flights["B"], error=ERROR / len(looks), **options)
        if all(each.verdict != "not enough runs" for each in found):
            break
    return found


WIDTH = 120
"""Of the table where there is no terminal, in letters."""

COLOURS = {
    "better": "#1a7f37",
    "worse": "#b3261e",
    "no difference": "#5c646c",
    "not enough runs": "#9a6700",
}


def words(each: Comparison) -> str:
    """Return the verdict as a reader wants it."""
    if each.verdict == "not enough runs":
        return f"not enough runs: {each.more} more may tell"
    return each.verdict


def change(each: Comparison) -> str:
    """Return the change with its interval: ``+12 % (+4.1 to +21)``."""
    ends = " to ".join(map(_signed, (each.low, each.high)))
    return f"{_signed(each.change)} {each.unit} ({ends})"


def _signed(value: float) -> str:
    if math.isinf(value):
        return "+∞" if value > 0 else "-∞"
    return f"{value:+.3g}"


def _shown(value: float | None, failures: int) -> str:
    text = "–" if value is None else f"{value:.4g}"
    return f"{text} ({failures} failed)" if failures else text


def print_table(found: Sequence[Comparison], page: Path) -> None:
    """Print a line for each figure."""
    from rich.console import Console
    from rich.table import Table

    table = Table("estimator", "figure", "A", "B", "change B - A", "verdict")
    for column in table.columns[2:5]:
        column.justify = "right"
    style = {"better": "green", "worse": "red"}
    for each in found:
        unit = figure(each.figure).unit
        table.add_row(
            each.estimator,
            each.figure,
            _shown(each.a, each.failures[0]) + f" {unit}",
            _shown(each.b, each.failures[1]) + f" {unit}",
            change(each),
            words(each),
            style=style.get(each.verdict, ""),
        )
    console = Console()
    if not console.is_terminal:
        console.width = WIDTH
    console.print(table)
    flights = max((each.pairs for each in found), default=0)
    console.print(f"{flights} flights, medians; the page is {page}", highlight=False)


def write_page(found: Sequence[Comparison], out: Path, a: Sequence[str], b: Sequence[str]) -> Path:
    """Write ``compare.html`` into a folder, made if missing; return its path."""
    out.mkdir(parents=True, exist_ok=True)
    from runtime.tools.sweep.plots import template

    kinds = {"better": "better", "worse": "worse", "not enough runs": "unknown"}
    rows = []
    for each in found:
        row = figure(each.figure)
        a_and_b = (
            f"{_shown(*side)} {row.unit}"
            for side in zip((each.a, each.b), each.failures, strict=True)
        )
        cells = [each.estimator, row.meaning, *a_and_b, change(each), f"{each.p:.2g}"]
        rows.append((cells, kinds.get(each.verdict, ""), words(each)))
    page = template(Path(__file__).with_name("compare.html.jinja")).render(
        sides=[(side, " ".join(said)) for side, said in (("A", a), ("B", b)) if said],
        flights=max((each.pairs for each in found), default=0),
        rows=rows,
        image=base64.b64encode(_slopes(found)).decode(),
    )
    path = out / "compare.html"
    write(path, page.encode())
    return path


def _slopes(found: Sequence[Comparison]) -> bytes:
    """Draw each figure of each flight, from A to B; return the PNG."""
    from matplotlib.figure import Figure

    columns = min(max(len(found), 1), 4)
    height = math.ceil(max(len(found), 1) / columns)
    sheet = Figure(figsize=(2.9 * columns, 3.4 * height), layout="constrained")
    for index, each in enumerate(found, 1):
        axes: Any = sheet.add_subplot(height, columns, index)
        values = [v for pair in each.flights.values() for v in pair if v is not None]
        most = max(values, default=1.0)
        failed = most * 1.6 if figure(each.figure).limit != "least" else 0.0
        scenarios = list(dict.fromkeys(name.rpartition(",")[0] for name in each.flights))
        for name, pair in each.flights.items():
            ends = [failed if value is None else value for value in pair]
            colour = f"C{scenarios.index(name.rpartition(',')[0]) % 10}"
            axes.plot([0, 1], ends, "-", color=colour, alpha=0.6, lw=1.2)
            for place, value in enumerate(pair):
                mark = "x" if value is None else "o"
                axes.plot(place, ends[place], mark, color=colour, ms=6 if mark == "x" else 4)
        if values and min(values) > 0 and most / min(values) > 20:
            axes.set_yscale("log")
        axes.set_xticks([0, 1], ["A", "B"])
        axes.set_xlim(-0.25, 1.25)
        axes.set_title(f"{each.figure}\n{each.verdict}", fontsize=9, color=COLOURS[each.verdict])
        axes.grid(alpha=0.3, axis="y")
    file = io.BytesIO()
    sheet.savefig(file, format="png", dpi=120, metadata={"Software": None})
    return file.getvalue()
