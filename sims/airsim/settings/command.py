"""``import``: AirSim's settings.json as a TOML file of ours."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer


def import_(
    settings: Annotated[Path, typer.Argument(help="AirSim's settings.json.")],
    world: Annotated[
        str, typer.Option(help="World to fly in: its name, or an MJCF file.")
    ] = "hall",
) -> None:
    """Print AirSim's settings.json as a TOML file that runs the same.

    What is not honoured is a warning on standard error, and a comment at the top of the file.
    """
    import tomli_w

    from runtime.config.reading import text_of
    from sims.airsim.settings import read

    warnings: list[str] = []
    table = read(text_of(settings), settings.name, warnings.append, world)
    for line in warnings:
        print(f"warning: {line}", file=sys.stderr)
    print(f"# Made from AirSim's {settings.name} by `python -m runtime import`.")
    print("".join(f"# {line}\n" for line in warnings))
    print(tomli_w.dumps(table, multiline_strings=True), end="")
