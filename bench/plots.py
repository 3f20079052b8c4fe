"""Plots of the benchmarks: how systems scale with N, and how their times spread."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from bench.driver import Row

OURS = "visnav"


def draw(rows: Sequence[Row], out: Path, boxes: Iterable[int]) -> dict[str, list[str]]:
    """Draw the plots of each case into a folder, made if missing; return their names by case.

    Args:
        boxes: Numbers of nodes that get a box plot, where there are rows with so many.
    """
    out.mkdir(parents=True, exist_ok=True)
    drawn: dict[str, list[str]] = {}
    for case in dict.fromkeys(row.case for row in rows):
        own = [row for row in rows if row.case == case]
        names = drawn.setdefault(case, [])
        if len({row.nodes for row in own}) > 1:
            names.append(f"{case}-scaling.png")
            plot_scaling(own, f"{case} message", out / names[-1])
        for n in boxes:
            if boxed := [row for row in own if row.nodes == n]:
                names.append(f"{case}-{n}.png")
                plot_boxes(boxed, f"{case} message, {n} nodes", out / names[-1])
    return drawn


def label(row: Row) -> str:
    """Return what a row is called: the system, and its mode where it has several."""
    return f"{row.system}, {row.mode}"


def _colour(name: str, index: int) -> Any:
    from matplotlib import colormaps

    return "#c1121f" if name.startswith(OURS) else colormaps["tab20"](index % 20)


def plot_scaling(rows: Sequence[Row], title: str, out: Path) -> None:
    """Draw the median against the number of nodes, with the quartiles as a band."""
    figure = Figure(figsize=(10, 6.5), layout="constrained")
    axes: Any = figure.add_subplot()
    last = {label(r): r.median_us for r in sorted(rows, key=lambda r: r.nodes)}
    styles = {"handler": "-", "stream": "--", "routed": ":"}
    for index, name in enumerate(sorted(last, key=lambda n: -last[n])):
        own = sorted((r for r in rows if label(r) == name), key=lambda r: r.nodes)
        colour, n = _colour(name, index), [r.nodes for r in own]
        axes.plot(
            n,
            [r.median_us for r in own],
            styles[own[0].mode],
            marker=".",
            color=colour,
            lw=2.4 if name.startswith(OURS) else 1.2,
            label=name,
        )
        axes.fill_between(
            n, [r.q1_us for r in own], [r.q3_us for r in own], color=colour, alpha=0.12, lw=0
        )
    ticks = sorted({r.nodes for r in rows})
    axes.set(xscale="log", yscale="log", xlabel="nodes", ylabel="round trip (µs)", title=title)
    axes.set_xticks(ticks, [str(t) for t in ticks])
    axes.minorticks_off()
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.savefig(out, dpi=120)


def plot_boxes(rows: Sequence[Row], title: str, out: Path) -> None:
    """Draw a box (quartiles, median) with whiskers to the 99th percentile for each system."""
    own = sorted(rows, key=lambda r: r.median_us, reverse=True)
    figure = Figure(figsize=(9, 0.9 + 0.34 * len(own)), layout="constrained")
    axes: Any = figure.add_subplot()
    boxes = [
        {
            "label": label(r),
            "med": r.median_us,
            "q1": r.q1_us,
            "q3": r.q3_us,
            "whislo": r.q1_us,
            "whishi": r.p99_us,
        }
        for r in own
    ]
    drawn = axes.bxp(boxes, orientation="horizontal", showfliers=False, patch_artist=True)
    for row, box in zip(own, drawn["boxes"], strict=True):
        box.set_facecolor("#f2b5b8" if row.system.startswith(OURS) else "#dcebf7")
    axes.set(xscale="log", xlabel="round trip (µs); whiskers to the 99th percentile", title=title)
    axes.grid(alpha=0.3, axis="x", which="both")
    figure.savefig(out, dpi=120)
