"""Commands for a live run, or for its trace: top, web, set and trace."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.table import Table
    from rich.text import Text

    from runtime.tools.tracing.write import Trace

DEFAULT_PORT = 8420
Run = Annotated[str | None, typer.Argument(help="Name of the run; needed if there are several.")]


def top(
    run: Run = None,
    leave: Annotated[bool, typer.Option("--leave", help="Quit when the run ends.")] = False,
) -> None:
    """Monitor and control a run in a terminal.

    It shows estimators with their errors so far, their paths from above, nodes, channels, clock,
    settings and log. Keys pause the run, step it, change its speed or a setting, restart a node
    and end the run. Quitting does not affect the run.
    """
    from runtime.tools.monitor.protocol import Client, find
    from runtime.tools.monitor.screen import Screen

    _check_terminal()
    Screen(Client(find(run)), leave).run()


def _check_terminal() -> None:
    import codecs
    import sys

    from runtime.errors import CommandError

    drawn_on = sys.__stderr__  # by Textual
    if drawn_on is None or not (sys.stdin.isatty() and drawn_on.isatty()):
        raise CommandError('expected a terminal, found none; "python -m runtime web" needs none')
    if codecs.lookup(drawn_on.encoding).name != "utf-8":
        raise CommandError(
            f"expected a terminal in UTF-8, found {drawn_on.encoding}: set LC_ALL=C.UTF-8 if it is"
        )


def web(
    run: Run = None,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="On this machine; 0 for any.")
    ] = DEFAULT_PORT,
    token: Annotated[
        str | None, typer.Option(help="What the address must hold; made up if not given.")
    ] = None,
) -> None:
    """Monitor a run on a live page, with the same figures and commands as top, and its images.

    The page is served on this machine only, only to those who have the address that is printed,
    and until the run ends.
    """
    from runtime.errors import CommandError
    from runtime.tools.monitor.protocol import find
    from runtime.tools.monitor.web import PageServer, serve

    path = find(run)
    try:
        server = PageServer(port, path, token)
    except OSError as error:
        raise CommandError(
            f"--port {port}: expected a port that is free, found: {error.strerror}"
        ) from None
    serve(server)


def set_(
    change: Annotated[str, typer.Argument(metavar="NODE.KEY=VALUE", help="As for run --set.")],
    run: Annotated[
        str | None, typer.Option(help="Name of the run; needed if there are several.")
    ] = None,
) -> None:
    """Change a setting of a node while its run goes on.

    The value is checked as in the file. The change is an event of the run, so that its log, its
    digest and its recordings have it. "python -m runtime nodes" says which settings can change.
    """
    from runtime.tools.monitor.protocol import Set, ask, find

    found = find(run)
    print(f"run {found.stem.rpartition('-')[0]}: {ask(found, Set(text=change))}")


def trace(file: Annotated[Path, typer.Argument(help="A trace that run --trace wrote.")]) -> None:
    """Show the latency from sensors to set-points, and how much of the loop each node had.

    A path is the events from an exposure to a set-point: → where one follows from another (it
    bears its stamp, or was sent on hearing it), ⇢ where a node goes at a rate of its own, and it
    was the newest that it had heard. Latencies begin at the exposure.
    """
    from rich.console import Console

    from runtime.tools.tracing.write import read_trace

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
    from rich.text import Text

    from runtime.tools.cli.brief import table_of
    from runtime.tools.tracing.write import node_loads, paths, quantile

    def shown(ms: list[float]) -> list[str]:
        return [f"{each:.2f}" for each in (quantile(ms, 0.5), quantile(ms, 0.99), max(ms))]

    routes = paths(found)
    for number, route in enumerate(routes, 1):
        yield Text(f"path {number}: {_for(encoding, route.path)}")
    if routes:
        yield table_of(
            "from sensor to set-point",
            ("path", "times", "run p50 ms", "p99", "max", "real p50 ms", "p99", "max"),
            [
                (number, len(route.run_ms), *shown(route.run_ms), *shown(route.real_ms))
                for number, route in enumerate(routes, 1)
            ],
        )
    else:
        yield Text("no set-point was sent that a sensor led to")
    loads = [
        (
            _for(encoding, each.node),
            each.steps,
            f"{each.busy_ms:.1f}",
            f"{each.share:.1%}",
            f"{each.longest_ms:.3f}",
            _for(encoding, each.longest),
        )
        for each in node_loads(found)
    ]
    yield table_of("on the loop", ("node", "steps", "loop ms", "share", "longest ms", "in"), loads)


def _for(encoding: str, text: str) -> str:
    """Return a text with all characters foreign to an encoding replaced."""
    try:
        text.encode(encoding)
    except UnicodeEncodeError:
        text = text.replace("→", "->").replace("⇢", "~>")
        return text.encode(encoding, "replace").decode(encoding)
    return text
