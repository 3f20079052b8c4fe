"""``top``: a monitor of a run, in a terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from pathlib import Path

Run = Annotated[str | None, typer.Argument(help="Name of the run; needed if there are several.")]


def top(
    run: Run = None,
    leave: Annotated[bool, typer.Option("--leave", help="Quit when the run ends.")] = False,
) -> None:
    """Monitor a run in a terminal, and control it.

    It shows nodes, channels, clock, settings and log. Keys pause the run, step it, change its
    speed or a setting, restart a node and end the run. Quitting does not affect the run.
    """
    import asyncio

    from runtime.tools.monitor.address import find

    _check_terminal()
    asyncio.run(_show(find(run), leave))


def _check_terminal() -> None:
    """Refuse what cannot show a screen.

    Raises:
        CommandError: It is no terminal, or has not the characters.
    """
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


async def _show(path: Path, leave: bool) -> None:
    from runtime.tools.monitor.client import Client
    from runtime.tools.monitor.screen import Screen

    await Screen(await Client.connect(path), leave).run_async()
