"""Scatter plot of simulated against published errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from runtime.tools.reality.agreement import (
    NEAR,
    Cell,
    Published,
    Simulated,
)

MARKS = "os^Dv*Xp"
FAILED = 3.0  # m, where failures are drawn


def draw(
    simulated: Simulated,
    published: Published,
    labels: Mapping[str, str],
    worlds: Sequence[str],
    failed: Mapping[str, Mapping[Cell, bool]],
    failed_in_reality: Mapping[str, Mapping[str, bool]],
    path: Path,
) -> bool:
    """Draw each system's errors in each cell, as SVG; return whether there was one.

    Args:
        labels: Label of each system, by its name.
        worlds: In the order of the panels.
        failed: Whether each system failed in each cell; it is hollow then.
        failed_in_reality: The same of each sequence.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    shown = [world for world in worlds if _points(simulated, published, world)]
    if not shown:
        return False
    figure = Figure(figsize=(4.2 * len(shown) + 2.6, 4.4), layout="constrained")
    handles: dict[str, Any] = {}
    for number, world in enumerate(shown, 1):
        axes: Any = figure.add_subplot(1, len(shown), number)
        for factor, style in ((1.0, "-"), (NEAR[0], ":"), (NEAR[1], ":")):
            axes.plot([0.005, 5.0], [0.005 * factor, 5.0 * factor], style, color="0.6", lw=1)
        for name, cell, sim, real in _points(simulated, published, world):
            index = [*labels].index(name)
            look: dict[str, Any] = {
                "marker": MARKS[index % len(MARKS)],
                "color": f"C{index}",
                "ls": "",
            }
            at = [min(value, FAILED) for value in (real, sim)]
            hollow = failed[name][cell] or failed_in_reality[name][cell.sequence]
            axes.plot(*at, **look, fillstyle="none" if hollow else "full", clip_on=False)
            axes.annotate(cell.sequence, at, fontsize=5, xytext=(3, 2), textcoords="offset points")
            handles[labels[name]] = axes.plot([], [], **look)[0]
        axes.set(xscale="log", yscale="log", xlim=(0.008, 4.0), ylim=(0.002, 4.0), title=world)
        axes.set_xlabel("published ATE (m)")
        axes.set_ylabel("simulated ATE (m)")
        axes.grid(alpha=0.3)
    figure.legend([*handles.values()], [*handles], loc="outside right upper", fontsize=8)
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "reality"}):
        figure.savefig(path, metadata={"Date": None})
    return True


def _points(
    simulated: Simulated, published: Published, world: str
) -> list[tuple[str, Cell, float, float]]:
    return [
        (name, cell, error, published[name][cell.sequence])
        for name, cells in simulated.items()
        for cell, error in cells.items()
        if cell.world == world and cell.sequence in published.get(name, {})
    ]
