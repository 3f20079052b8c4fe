"""Page of a comparison: a table, and each flight as a line from A to B."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from runtime.figures import figure
from runtime.run.results import write
from runtime.tools.comparison.statistics import Comparison
from runtime.tools.sweep.plots import template

COLOURS = {
    "better": "#1a7f37",
    "worse": "#b3261e",
    "no difference": "#5c646c",
    "not enough runs": "#9a6700",
    "not comparable": "#9a6700",
}


def change(each: Comparison) -> str:
    """Return the change with its interval: ``+12 % (+4.1 to +21)``."""
    ends = " to ".join(map(_signed, (each.low, each.high)))
    return f"{_signed(each.change)} {each.unit} ({ends})"


def _signed(value: float) -> str:
    if math.isinf(value):
        return "+∞" if value > 0 else "-∞"
    return f"{value:+.3g}"


def shown(value: float | None, unit: str, failures: int) -> str:
    """Return a median with the number of flights without the figure: ``0.31 m (2 failed)``."""
    text = "–" if value is None else f"{value:.4g} {unit}"
    return f"{text} ({failures} failed)" if failures else text


def write_page(found: Sequence[Comparison], out: Path, a: Sequence[str], b: Sequence[str]) -> Path:
    """Write ``compare.html`` into a folder, made if missing; return its path."""
    out.mkdir(parents=True, exist_ok=True)
    kinds = {"better": "good", "worse": "bad", "no difference": ""}
    rows = []
    for each in found:
        row = figure(each.figure)
        medians = zip((each.a, each.b), each.failures, strict=True)
        a_and_b = (shown(median, row.unit, failures) for median, failures in medians)
        cells = [each.estimator, row.meaning, *a_and_b, change(each), f"{each.p:.2g}"]
        rows.append((cells, kinds.get(each.verdict, "doubt"), each.words))
    page = template(Path(__file__).with_name("page.html.jinja")).render(
        sides=[(side, " ".join(said)) for side, said in (("A", a), ("B", b)) if said],
        flights=max((each.pairs for each in found), default=0),
        rows=rows,
        image=base64.b64encode(_slopes(found)).decode(),
    )
    path = out / "compare.html"
    write(path, page.encode())
    return path


def _slopes(found: Sequence[Comparison]) -> bytes:
    from matplotlib.figure import Figure

    columns = min(max(len(found), 1), 4)
    height = math.ceil(max(len(found), 1) / columns)
    sheet = Figure(figsize=(2.9 * columns, 3.4 * height), layout="constrained")
    handles: dict[str, Any] = {}
    several = len({each.estimator for each in found}) > 1
    for index, each in enumerate(found, 1):
        axes: Any = sheet.add_subplot(height, columns, index)
        values = [v for pair in each.flights.values() for v in pair if v is not None]
        most = max(values, default=1.0)
        failed = most * 1.6 if figure(each.figure).limit != "least" else 0.0
        scenarios = list(dict.fromkeys(name.rpartition(",")[0] for name in each.flights))
        for name, pair in each.flights.items():
            ends = [failed if value is None else value for value in pair]
            scenario = name.rpartition(",")[0]
            colour = f"C{scenarios.index(scenario) % 10}"
            handles[scenario], *_ = axes.plot([0, 1], ends, "-", color=colour, alpha=0.6, lw=1.2)
            for place, value in enumerate(pair):
                mark = "x" if value is None else "o"
                axes.plot(place, ends[place], mark, color=colour, ms=6 if mark == "x" else 4)
        if values and failed > 0 and min(values) > 0 and most > 10 * min(values):
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter("{x:g}")
        axes.set_xticks([0, 1], ["A", "B"])
        axes.set_xlim(-0.25, 1.25)
        title = f"{each.estimator}\n" * several + f"{each.figure}\n{each.verdict}"
        axes.set_title(title, fontsize=9, color=COLOURS[each.verdict])
        axes.grid(alpha=0.3, axis="y")
    if len(handles) > 1:
        sheet.legend(handles.values(), handles, loc="outside lower center", fontsize=8, ncols=4)
    file = io.BytesIO()
    sheet.savefig(file, format="png", dpi=120, metadata={"Software": None})
    return file.getvalue()
