"""Plots of accuracy against each varied parameter, a PNG per parameter.

A sweep as a page: ``index.html`` beside its tables, with links to each run's own report.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jinja2
import msgspec
import numpy as np

from runtime.figures import FIGURES
from runtime.run.results import write
from runtime.tools.sweep.plan import Parameter, Plan, axis
from runtime.tools.sweep.tables import MAIN, Row, Spread, in_order, numbers, summarise

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PLOTTED = {figure.name: figure.plot for figure in FIGURES.values() if figure.plot}
"""Axis label of each plotted figure."""

_SHARES = "failures (% of the runs)"
_MOST_LINES = 8
_MARKS = "os^Dv*Xp"
_ACROSS = 2  # panels side by side: as many as a page has room for at full size
_LETTERS = 70  # letters of a legend below one panel


class Line(msgspec.Struct, frozen=True):
    """A line of a plot: a figure at each value of a parameter with results.

    Attributes:
        label: Its name among others; empty for a single line.
    """

    label: str
    texts: tuple[str, ...]
    spreads: tuple[Spread, ...]


def draw_plots(plan: Plan, rows: Sequence[Row]) -> list[Path]:
    """Draw a plot for each parameter into ``plots/``, if the runs have something to show.

    A line is the median, with the quartiles as its band, and bars from the least to the most; the
    last panel has the share of the runs crashed, and of those failed. A figure that is 0
    throughout has no panel, and a parameter with a single value no plot.
    """
    drawn = []
    for name, figure in figures_of(plan, rows):
        path = plan.out / "plots" / f"{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=120)
        drawn.append(path)
    return drawn


def figures_of(plan: Plan, rows: Sequence[Row]) -> Iterator[tuple[str, Figure]]:
    """Yield a name for files and the plot of each parameter, as `draw_plots` draws it."""
    job_rows = [row for _, row in in_order(plan, rows)]
    for parameter in plan.parameters:
        by_figure = {name: lines(plan, job_rows, parameter, name) for name in PLOTTED}
        by_figure = {name: curves for name, curves in by_figure.items() if any(map(_seen, curves))}
        if by_figure and len(parameter.texts) > 1:
            name = re.sub(r"[^\w.-]", "_", parameter.path)
            yield name, _draw(parameter, by_figure, _shares(parameter, job_rows))


def lines(plan: Plan, rows: Sequence[Row], parameter: Parameter, figure: str) -> list[Line]:
    """Return the lines of a figure over a parameter.

    One line for each combination of the other parameters and each estimator; if these are more
    than 8, one for each estimator. Errors after different alignments are never in one line.
    """
    verdicts = [verdict for row in rows for verdict in row["estimators"].values()]
    aligned = len({verdict.get("alignment") for verdict in verdicts}) > 1
    short = _short([other.path for other in plan.parameters])
    samples: list[tuple[str, str, str, float]] = []
    for job, row in in_order(plan, rows):
        settings = dict(job.settings)
        value = settings.pop(parameter.path)
        label_rest = ", ".join(f"{short[path]}={text}" for path, text in settings.items())
        for estimator, figures in row["estimators"].items():
            name = f"{estimator} ({figures.get('alignment', 'none')})" if aligned else estimator
            samples += [
                (name, label_rest, value, number) for number in numbers([figures.get(figure)])
            ]
    several = len({name for name, *_ in samples}) > 1
    if len({(name, label_rest) for name, label_rest, *_ in samples}) > _MOST_LINES:
        several, samples = True, [(name, "all others", value, n) for name, _, value, n in samples]
    points: dict[str, dict[str, list[float]]] = {}
    for name, label_rest, value, number in samples:
        label = ", ".join(filter(None, (name * several, label_rest)))
        points.setdefault(label, {}).setdefault(value, []).append(number)
    return [_line(label, line, parameter) for label, line in points.items()]


def _short(paths: Sequence[str]) -> dict[str, str]:
    """Return the last word of each path, or the path where another ends the same."""
    ends = Counter(path.rpartition(".")[2] for path in paths)
    return {path: end if ends[end := path.rpartition(".")[2]] == 1 else path for path in paths}


def _seen(line: Line) -> bool:
    return any(spread.most != 0 or spread.least != 0 for spread in line.spreads)


def _line(label: str, values: dict[str, list[float]], parameter: Parameter) -> Line:
    texts = tuple(text for text in parameter.texts if text in values)
    return Line(label, texts, tuple(Spread.of(values[text]) for text in texts))


def _shares(parameter: Parameter, rows: Sequence[Row]) -> dict[str, list[float]]:
    groups = [[r for r in rows if r["parameters"][parameter.path] == t] for t in parameter.texts]
    shares = {
        "crashed": [_percent(bool(row["error"]) for row in group) for group in groups],
        "failed": [_percent(row["passed"] is False for row in group) for group in groups],
    }
    return shares if any(map(any, shares.values())) else {}


def _percent(outcomes: Iterable[bool]) -> float:
    flags = [*outcomes]
    return 100.0 * sum(flags) / max(len(flags), 1)


def _draw(
    parameter: Parameter, lines: dict[str, list[Line]], shares: dict[str, list[float]]
) -> Figure:
    from matplotlib.figure import Figure

    scale = axis(parameter.texts)
    place = dict(zip(parameter.texts, scale.places, strict=True))
    panels = len(lines) + bool(shares)
    columns, rows = min(panels, _ACROSS), math.ceil(panels / _ACROSS)
    figure = Figure(figsize=(4.6 * columns, 3.4 * rows), layout="constrained")
    labels = list(dict.fromkeys(line.label for group in lines.values() for line in group))
    colours = {label: f"C{index}" for index, label in enumerate(labels)}
    handles: dict[str, Any] = {}
    for index, (name, group) in enumerate([*lines.items(), *[("", [])] * bool(shares)], 1):
        axes: Any = figure.add_subplot(rows, columns, index)
        for line in group:
            points = sorted(
                (place[text], (s.median, s.first, s.third, s.least, s.most))
                for text, s in zip(line.texts, line.spreads, strict=True)
            )
            middle, first, third, least, most = np.array([spread for _, spread in points]).T
            x = np.array([at for at, _ in points])
            colour, mark = colours[line.label], _MARKS[labels.index(line.label) % len(_MARKS)]
            handles[line.label], *_ = axes.plot(x, middle, f"{mark}-", color=colour)
            axes.fill_between(x, first, third, color=colour, alpha=0.2, lw=0)
            axes.errorbar(
                x, middle, (middle - least, most - middle), fmt="none", ecolor=colour, capsize=3
            )
        highest = max((s.most for line in group for s in line.spreads), default=100.0)
        if not group:
            for style, (label, percent) in zip(("s-", "^--"), shares.items(), strict=True):
                x, y = np.array(sorted(zip(scale.places, percent, strict=True))).T
                axes.plot(x, y, style, color="#b00020", label=label)
            axes.set_ylim(-4, 125)  # with room for the legend
            axes.set_yticks(range(0, 101, 20))
            axes.legend(fontsize=8, loc="upper left", ncols=2)
        elif decades([v for line in group for s in line.spreads for v in (s.least, s.most)]):
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter("{x:g}")
        else:
            axes.set_ylim(-0.03 * highest, 1.06 * highest)
        if scale.words:
            axes.set_xticks(scale.places, parameter.texts)
            axes.set_xlim(-0.5, len(scale.places) - 0.5)
        elif decades(scale.places):
            axes.set_xscale("log")
            axes.set_xticks(scale.places, [f"{at:g}" for at in scale.places])
            axes.minorticks_off()
        axes.set_xlabel(parameter.path + f" ({scale.unit})" * bool(scale.unit))
        axes.set_title(PLOTTED.get(name, _SHARES), fontsize=10)
        axes.grid(alpha=0.3)
    if any(labels):
        across = max(int(_LETTERS * columns / (max(map(len, labels)) + 6)), 1)
        figure.legend(
            list(handles.values()), labels, loc="outside lower center", fontsize=8, ncols=across
        )
    return figure


def decades(values: Sequence[float]) -> bool:
    """Return whether values span more than a decade, all of them above 0."""
    return min(values) > 0 and max(values) > 10 * min(values)


def write_page(plan: Plan, rows: Sequence[Row]) -> Path:
    """Write the page of a sweep into its folder, beside its tables and plots, and return it."""
    combinations = summarise(plan, rows)
    aligned = Counter(c.alignment for c in combinations if c.alignment)
    page = template(Path(__file__).with_name("page.html.jinja")).render(
        name=plan.out.name,
        parameters=[parameter.path for parameter in plan.parameters],
        figures=[n for n in MAIN if any(n in c.figures for c in combinations)],
        alignments=[name for name, _ in aligned.most_common()],
        summary=combinations,
        repeated=any(job.repeat > 1 for job in plan.jobs),
        runs=in_order(plan, rows),
        reports={job.id for job in plan.jobs if (Path(job.out) / "report.html").is_file()},
        states={True: "passed", False: "failed", None: "not judged"},
        plots=[f"plots/{path.name}" for path in sorted((plan.out / "plots").glob("*.png"))],
    )
    path = plan.out / "index.html"
    write(path, page.encode())
    return path


def template(path: Path) -> jinja2.Template:
    """Return the template of a page; it may extend ``base.html.jinja``, here.

    Values are escaped in HTML, and in nothing else.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader([path.parent, Path(__file__).parent]),
        autoescape=jinja2.select_autoescape(["html.jinja"]),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(path.name)
