"""Arguments that several commands share."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

ConfigFile = Annotated[Path, typer.Argument(help="The file that says what to run.")]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NODE.KEY=VALUE",
        help="Change a setting of a node, or of the run (run.seed=3). May be repeated.",
    ),
]


def warn(warning: str) -> None:
    """Print a warning, as a line of its own."""
    print(f"warning: {warning}", file=sys.stderr)
