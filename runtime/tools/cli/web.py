"""``web``: a monitor of a run, as a page in a browser."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from runtime.tools.cli.top import Run

if TYPE_CHECKING:
    from pathlib import Path

DEFAULT_PORT = 8420


def web(
    run: Run = None,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="On this machine; 0 for any.")
    ] = DEFAULT_PORT,
    token: Annotated[
        str | None, typer.Option(help="What the address must hold; made up if not given.")
    ] = None,
    leave: Annotated[bool, typer.Option("--leave", help="End with the run.")] = False,
) -> None:
    """Monitor a run on a live page, with the same figures and commands as top.

    The page is served on this machine only, and only to those who have the address that is printed.
    """
    import asyncio

    from runtime.tools.monitor.address import find

    asyncio.run(_serve(find(run), port, token, leave))


async def _serve(path: Path, port: int, token: str | None, leave: bool) -> None:
    from runtime.errors import CommandError
    from runtime.tools.monitor.client import Client
    from runtime.tools.monitor.web import serve

    try:
        await serve(await Client.connect(path), port, token, leave)
    except OSError as error:
        raise CommandError(
            f"--port {port}: expected a port that is free, found: {error.strerror}"
        ) from None
