"""``graph``: which node sends what to which, as Mermaid text or as a drawing."""

from __future__ import annotations

from collections.abc import Iterable
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
    """Show which node sends which events to which."""
    from runtime.config.reading import load_configuration
    from runtime.run.graph import edges

    settings = load_configuration(config, overrides or [])
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
    """Draw the nodes in layers, senders to the left, with an arrow for each pair that talks."""
    from matplotlib.figure import Figure

    pairs = _by_pair(edges)
    columns = layers(names, pairs)
    height = max(len(column) for column in columns)
    figure = Figure(figsize=(1 + 3.4 * len(columns), 1 + 1.3 * height), layout="constrained")
    axes: Any = figure.add_subplot()
    axes.set_axis_off()
    axes.set(xlim=(-0.4, len(columns) - 0.6), ylim=(-height / 2 - 0.2, height / 2 + 0.2))
    boxes = {}
    for x, column in enumerate(columns):
        for row, name in enumerate(column):
            y = (len(column) - 1) / 2 - row + 0.25 * (x % 2)  # so that few arrows cross a box
            boxes[name] = axes.text(
                x, y, name, ha="center", va="center", fontsize=11, weight="bold", zorder=3,
                bbox={"boxstyle": "round,pad=0.6", "fc": "#dcebf7", "ec": "#2f6690"},
            )  # fmt: skip
    for (sender, receiver), events in pairs.items():
        tail, head = boxes[sender], boxes[receiver]
        (x0, y0), (x1, y1) = tail.get_position(), head.get_position()
        bend = 0.12 if x0 < x1 else -0.3  # an arrow back goes below those ahead
        axes.annotate(
            "", xy=(x1, y1), xytext=(x0, y0), zorder=2,
            arrowprops={
                "arrowstyle": "-|>", "color": "#5b7083", "shrinkA": 2, "shrinkB": 2,
                "connectionstyle": f"arc3,rad={bend}", "mutation_scale": 14,
                "patchA": tail.get_bbox_patch(), "patchB": head.get_bbox_patch(),
            },
        )  # fmt: skip
        # The middle of the arc: half of its bend from the middle of the chord, in pixels.
        chord = axes.transData.transform([(x0, y0), (x1, y1)])
        (u0, v0), (u1, v1) = chord
        middle = (u0 + u1) / 2 + bend / 2 * (v1 - v0), (v0 + v1) / 2 - bend / 2 * (u1 - u0)
        x, y = axes.transData.inverted().transform(middle)
        label = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.85}
        text = "\n".join(events)
        axes.text(x, y, text, fontsize=7, ha="center", va="center", bbox=label, zorder=4)
    figure.savefig(out, dpi=150)


def layers(names: list[str], pairs: Iterable[tuple[str, str]]) -> list[list[str]]:
    """Put nodes into layers, so that most arrows go from one layer to a later one.

    A node stands right of all that it listens to; an arrow that would close a circle, looked for
    in the order of the nodes, is left out of account.
    """
    receivers: dict[str, list[str]] = {name: [] for name in names}
    for sender, receiver in pairs:
        receivers[sender].append(receiver)
    finished: list[str] = []
    ahead: dict[str, list[str]] = {}

    def visit(name: str, path: tuple[str, ...]) -> None:
        if name in ahead:
            return
        ahead[name] = []
        for receiver in receivers[name]:
            if receiver not in (*path, name):
                ahead[name].append(receiver)
                visit(receiver, (*path, name))
        finished.append(name)

    for name in names:
        visit(name, ())
    rank = dict.fromkeys(names, 0)
    for name in reversed(finished):
        for receiver in ahead[name]:
            rank[receiver] = max(rank[receiver], rank[name] + 1)
    return [[name for name in names if rank[name] == n] for n in range(max(rank.values()) + 1)]


def _by_pair(edges: list[tuple[str, str, str, str, str]]) -> dict[tuple[str, str], list[str]]:
    """Return the types of event that pass between each pair of nodes."""
    pairs: dict[tuple[str, str], dict[str, None]] = {}
    for sender, _, event, receiver, _ in edges:
        pairs.setdefault((sender, receiver), {})[event] = None
    return {pair: list(events) for pair, events in pairs.items()}
