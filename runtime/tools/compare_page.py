"""Comparisons as a table of the terminal, and as a page with slopes, flight by flight."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jinja2

from runtime.figures import figure
from runtime.run.results import write
from runtime.tools.compare import Comparison

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
    template = Path(__file__).with_name("compare.html.jinja")
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    page = environment.from_string(template.read_text(encoding="utf-8")).render(
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
