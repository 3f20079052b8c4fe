"""``set``: change a setting of a node while the run goes on."""

from __future__ import annotations

from typing import Annotated

import typer


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
    from runtime.tools.monitor.address import find
    from runtime.tools.monitor.client import ask
    from runtime.tools.monitor.command import Set

    found = find(run)
    print(f"run {found.stem.rpartition('-')[0]}: {ask(found, Set(text=change))}")
