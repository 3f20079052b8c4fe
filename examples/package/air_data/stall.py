"""A command: the least airspeed of a recorded flight."""

from pathlib import Path
from typing import Annotated

import typer

from runtime.errors import ConfigError


def stall(
    run: Annotated[Path, typer.Argument(help="The folder of a run with a recording.")],
    least: Annotated[float, typer.Option(help="The speed of stall, m/s.")] = 0.0,
) -> None:
    """Print the least airspeed of a flight; the exit code is 1 if it is too low."""
    from nodes.data.export import export_measurements

    try:
        files = [path for path in export_measurements(run) if ".Airspeed." in path.name]
    except (OSError, ValueError) as error:
        raise ConfigError(str(error)) from None
    if not files:
        raise ConfigError(f"{run}: expected a flight with an airspeed sensor, found none")
    for path in files:
        rows = path.read_text(encoding="utf-8").splitlines()[1:]
        slowest = min(float(row.rpartition(",")[2]) for row in rows)
        print(f"{path.name.partition('.')[0]}: {slowest:.2f} m/s")
        if slowest < least:
            raise typer.Exit(1)
