"""``python -m runtime bench …``: one command a benchmark."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Measure latency and throughput on this machine.",
)

Json = Annotated[Path | None, typer.Option("--json", help="Write the figures to this file, too.")]


@app.callback()
def bench() -> None:
    """Measure latency and throughput on this machine."""


@app.command()
def stall(
    json: Json = None,
    seconds: Annotated[float, typer.Option(min=0.5, help="Length of each run.")] = 6.0,
    repeats: Annotated[int, typer.Option(min=1, help="Runs of each mode, interleaved.")] = 4,
    rate: Annotated[float, typer.Option(min=0.1, help="Hertz of the camera.")] = 10.0,
    size: Annotated[int, typer.Option(min=16, help="Width and height of its pictures.")] = 512,
) -> None:
    """Lateness of a 400 Hz tick with no camera, and with one inline, in a thread, in a worker."""
    from rich.console import Console

    from bench.results import write_json
    from bench.stall import measure
    from bench.tables import stall_table

    console = Console()
    with console.status("stall") as status:
        rows = measure(
            seconds=seconds, repeats=repeats, rate=rate, size=size, progress=status.update
        )
    console.print(stall_table(rows))
    if json is not None:
        write_json(json, rows, seconds=seconds, repeats=repeats, rate=rate, size=size)
