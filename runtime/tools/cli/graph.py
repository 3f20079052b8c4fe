"""``graph``: who hears whom, as Mermaid text or as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from runtime.tools.cli.common import ConfigFile, Overrides


def graph(
    config: ConfigFile,
    overrides: Overrides = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Draw it into this PNG, SVG or PDF instead of printing Mermaid."),
    ] = None,
) -> None:
    """Show which node hears which, through which ports."""
    from runtime.config.reading import load
    from runtime.graph import edges

    settings = load(config, overrides or [])
    names = [spec.name for spec in settings.nodes]
    found = edges([(spec.name, spec.node) for spec in settings.nodes])
    if out is None:
        print(mermaid(names, found))
        return
    draw(names, found, out)
    print(out)


def mermaid(names: list[str], edges: list[tuple[str, str, str, str, str]]) -> str:
    """Return the graph in Mermaid's language (mermaid.js.org)."""
    lines = ["flowchart LR", *(f"    {name}" for name in names)]
    for (sender, receiver), events in _by_pair(edges).items():
        lines.append(f"    {sender} -- {', '.join(events)} --> {receiver}")
    return "\n".join(lines)


def draw(names: list[str], edges: list[tuple[str, str, str, str, str]], out: Path) -> None:
    """Draw the nodes on a circle, with an arrow for each pair that talks."""
    import math

    from matplotlib.figure import Figure
    from matplotlib.patches import FancyArrowPatch

    figure = Figure(figsize=(9, 7), layout="constrained")
    axes: Any = figure.add_subplot()
    axes.set_axis_off()
    axes.set_aspect("equal")
    axes.set(xlim=(-1.5, 1.5), ylim=(-1.25, 1.25))
    place = {}
    for index, name in enumerate(names):
        angle = math.pi / 2 - 2 * math.pi * index / len(names)
        place[name] = (math.cos(angle), math.sin(angle))
    for (sender, receiver), events in _by_pair(edges).items():
        (x0, y0), (x1, y1) = place[sender], place[receiver]
        arrow = FancyArrowPatch(
            (x0, y0), (x1, y1), connectionstyle="arc3,rad=0.18", arrowstyle="-|>",
            mutation_scale=14, shrinkA=38, shrinkB=38, color="#5b7083",
        )  # fmt: skip
        axes.add_patch(arrow)
        dx, dy = x1 - x0, y1 - y0
        middle = ((x0 + x1) / 2 + 0.09 * dy, (y0 + y1) / 2 - 0.09 * dx)  # where the arc bulges
        label = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.85}
        text = "\n".join(events)
        axes.text(*middle, text, fontsize=7, ha="center", va="center", bbox=label)
    for name, (x, y) in place.items():
        box = {"boxstyle": "round,pad=0.6", "fc": "#dcebf7", "ec": "#2f6690"}
        axes.text(x, y, name, ha="center", va="center", fontsize=11, weight="bold", bbox=box)
    figure.savefig(out, dpi=150)


def _by_pair(edges: list[tuple[str, str, str, str, str]]) -> dict[tuple[str, str], list[str]]:
    """Return the types of event that pass between each pair of nodes."""
    pairs: dict[tuple[str, str], dict[str, None]] = {}
    for sender, _, event, receiver, _ in edges:
        pairs.setdefault((sender, receiver), {})[event] = None
    return {pair: list(events) for pair, events in pairs.items()}
