"""Accuracy against each varied parameter, one PNG a parameter."""

from __future__ import annotations

import re
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from runtime.tools.sweep.plan import Plan
from runtime.tools.sweep.rows import Row
from runtime.tools.sweep.tables import in_order, numbers
from runtime.tools.sweep.values import Parameter, axis

PLOTTED = {
    "ate_percent": "trajectory error (% of the path)",
    "available_rmse_m": "error of the newest pose (m)",
    "lost_seconds": "lost (s)",
}
"""Figure to what it is called on its axis."""

_MOST_LINES = 8


class Line(msgspec.Struct, frozen=True):
    """One line of a plot: a figure at each value of a parameter that has any.

    Attributes:
        label: What tells it from the others; empty if it is the only one.
        texts: The values.
        middle: The median of all runs there.
        low: Lower edge of the band about it: the least, or of many runs together the quartile.
        high: Upper edge.
    """

    label: str
    texts: tuple[str, ...]
    middle: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]


def draw_plots(plan: Plan, rows: Sequence[Row]) -> list[Path]:
    """Draw a plot for each parameter into ``plots/``, if the runs have something to show."""
    own = [row for _, row in in_order(plan, rows)]
    failures = sum(bool(row["error"]) for row in own)
    note = f"{failures} of {len(own)} runs failed and are not shown" if failures else ""
    drawn = []
    for parameter in plan.parameters:
        found = {name: lines(plan, own, parameter, name) for name in PLOTTED}
        found = {name: each for name, each in found.items() if each}
        if found:
            path = plan.out / "plots" / (re.sub(r"[^\w.-]", "_", parameter.path) + ".png")
            path.parent.mkdir(parents=True, exist_ok=True)
            _draw(parameter, found, note, path)
            drawn.append(path)
    return drawn


def lines(plan: Plan, rows: Sequence[Row], parameter: Parameter, figure: str) -> list[Line]:
    """Return what a figure did with a parameter.

    One line for each combination of the other parameters and each estimator, with the range of
    the seeds as its band; if these are more than 8, one for each estimator, with the quartiles.
    """
    points: dict[tuple[str, tuple[str, ...]], dict[str, list[float]]] = {}
    for job, row in in_order(plan, rows):
        settings = dict(job.settings)
        here = settings.pop(parameter.path)
        others = tuple(f"{path}={text}" for path, text in settings.items())
        for estimator, figures in row["estimators"].items():
            for number in numbers([figures.get(figure)]):
                line = points.setdefault((estimator, others), {})
                line.setdefault(here, []).append(number)
    if len(points) <= _MOST_LINES:
        several = len({estimator for estimator, _ in points}) > 1
        return [
            _line(", ".join([estimator] * several + [*others]), line, parameter, _range)
            for (estimator, others), line in points.items()
        ]
    merged: dict[str, dict[str, list[float]]] = {}
    for (estimator, _), line in points.items():
        for text, found in line.items():
            merged.setdefault(estimator, {}).setdefault(text, []).extend(found)
    return [
        _line(f"{estimator}, all others".lstrip(", "), line, parameter, _quartiles)
        for estimator, line in merged.items()
    ]


def _line(label: str, found: dict[str, list[float]], parameter: Parameter, band: Any) -> Line:
    texts = tuple(text for text in parameter.texts if text in found)
    edges = [band(found[text]) for text in texts]
    return Line(
        label=label,
        texts=texts,
        middle=tuple(statistics.median(found[text]) for text in texts),
        low=tuple(low for low, _ in edges),
        high=tuple(high for _, high in edges),
    )


def _range(values: list[float]) -> tuple[float, float]:
    return min(values), max(values)


def _quartiles(values: list[float]) -> tuple[float, float]:
    if len(values) < 2:
        return values[0], values[0]
    first, _, third = statistics.quantiles(values, n=4, method="inclusive")
    return first, third


def _draw(parameter: Parameter, found: dict[str, list[Line]], note: str, path: Path) -> None:
    from matplotlib.figure import Figure

    scale = axis(parameter.texts)
    place = dict(zip(parameter.texts, scale.places, strict=True))
    figure = Figure(figsize=(4.6 * len(found), 4.4), layout="constrained")
    figure.suptitle(note, fontsize=9, color="#b00020")
    labels = list(dict.fromkeys(line.label for own in found.values() for line in own))
    colours = {label: f"C{index}" for index, label in enumerate(labels)}
    handles: dict[str, Any] = {}
    for index, (name, own) in enumerate(found.items(), 1):
        axes: Any = figure.add_subplot(1, len(found), index)
        for line in own:
            places = (place[text] for text in line.texts)
            points = sorted(zip(places, line.middle, line.low, line.high, strict=True))
            x, middle, low, high = zip(*points, strict=True)
            colour = colours[line.label]
            handles[line.label], *_ = axes.plot(x, middle, "o-", color=colour)
            axes.fill_between(x, low, high, color=colour, alpha=0.15, lw=0)
        if scale.words:
            axes.set_xticks(scale.places, parameter.texts)
            axes.set_xlim(-0.5, len(scale.places) - 0.5)
        axes.set(xlabel=parameter.path + f" ({scale.unit})" * bool(scale.unit), title=PLOTTED[name])
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    if any(labels):
        figure.legend(
            list(handles.values()), labels, loc="outside lower center", fontsize=8, ncols=2
        )
    figure.savefig(path, dpi=120)
