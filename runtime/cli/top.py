"""``top``: a run in a terminal, while it goes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from pathlib import Path

Run = Annotated[str | None, typer.Argument(help="Name of the run; needed if there are several.")]


def top(
    run: Run = None,
    leave: Annotated[bool, typer.Option("--leave", help="Go when the run is over.")] = False,
) -> None:
    """Watch a run in a terminal, and have a say in it.

    Its nodes, channels, clock and log; keys pause it, step it, change its speed, restart a node,
    set a parameter, end the run. Quitting leaves the run alone.
    """
    import asyncio

    from runtime.monitor.address import find

    asyncio.run(_show(find(run), leave))


async def _show(path: Path, leave: bool) -> None:
    from runtime.monitor.client import Client
    from runtime.monitor.screen import Screen

    await Screen(await Client.connect(path), leave).run_async()
