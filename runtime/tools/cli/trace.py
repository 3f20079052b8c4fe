"""``trace``: latencies and loads of a trace, as tables."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rich.table import Table
    from rich.text import Text

    from runtime.tools.tracing.paths import Trace


def trace(
    file: Annotated[Path, typer.Argument(help="A trace that run --trace wrote.")],
) -> None:
    """Show the latency from sensors to set-points, and how much of the loop each node had.

    A path is the events from an exposure to a set-point: → where one follows from another (it
    bears its stamp, or was sent on hearing it), ⇢ where a node goes at a rate of its own, and it
    was the newest that it had heard. Latencies begin at the exposure.
    """
    from rich.console import Console

    from runtime.tools.tracing.paths import read_trace

    found = read_trace(file)
    console = Console()
    for table in tables(found, console.encoding):
        console.print(table)
    clock = found.about.get("clock", "?")
    console.print(
        f"run {found.about.get('run', '?')!r} on the {clock} clock; ui.perfetto.dev shows the rest",
        highlight=False,
    )


def tables(found: Trace, encoding: str = "utf-8") -> Iterator[Table | Text]:
    """Return the paths of a trace, and its nodes, as a terminal of this encoding can show them."""
    from rich.table import Table
    from rich.text import Text

    from runtime.tools.tracing.paths import node_loads, paths, quantile

    routes = paths(found)
    for number, route in enumerate(routes, 1):
        yield Text(f"path {number}: {_for(encoding, route.path)}")
    table = Table(
        "path", "times", "run p50 ms", "p99", "max", "real p50 ms", "p99", "max",
        title="from sensor to set-point", title_justify="left",
    )  # fmt: skip
    for number, route in enumerate(routes, 1):
        figures = [
            f"{figure:.2f}"
            for each in (route.run_ms, route.real_ms)
            for figure in (quantile(each, 0.5), quantile(each, 0.99), max(each))
        ]
        table.add_row(f"{number}", f"{len(route.run_ms)}", *figures)
    if not table.row_count:
        yield Text("no set-point was sent that a sensor led to")
    else:
        yield _right(table)
    table = Table(
        "node", "steps", "loop ms", "share", "longest ms", "in",
        title="on the loop", title_justify="left",
    )  # fmt: skip
    for share in node_loads(found):
        table.add_row(
            _for(encoding, share.node),
            f"{share.steps}",
            f"{share.busy_ms:.1f}",
            f"{share.share:.1%}",
            f"{share.longest_ms:.3f}",
            _for(encoding, share.longest),
        )
    yield _right(table)


def _for(encoding: str, text: str) -> str:
    """Return a text in characters that an encoding has."""
    try:
        text.encode(encoding)
    except UnicodeEncodeError:
        text = text.replace("→", "->").replace("⇢", "~>")
        return text.encode(encoding, "replace").decode(encoding)
    return text


def _right(table: Table) -> Table:
    for column in table.columns[1:]:
        if column.header != "in":
            column.justify = "right"
    return table
