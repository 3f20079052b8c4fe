"""``export``: a run's trajectories, as files for other tools."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer


class Format(Enum):
    """What ``--format`` takes."""

    tum = "tum"
    euroc = "euroc"
    kitti = "kitti"


def export(
    run: Annotated[Path, typer.Argument(help="The folder of a run: runs/<name>.")],
    form: Annotated[Format, typer.Option("--format", "-f", help="Format of the files.")],
    out: Annotated[
        Path | None, typer.Option(help="Folder for the files; RUN/export if not given.")
    ] = None,
    epoch: Annotated[
        str, typer.Option(help="The run's time 0: a date, or nanoseconds of Unix time.")
    ] = "2020-01-01T00:00:00Z",
) -> None:
    """Write the true and the estimated trajectories of a run as evo and other tools read them.

    tum and euroc give one file each for the truth and every estimator; euroc adds the estimates
    in TUM's format, which is what evo_ape euroc compares with, and turns all to a world with z
    up. kitti has no stamps, so it gives a pair of files for every estimator, pose by pose: those
    of the first camera, from identity.
    """
    from nodes.trajectory import export as exports
    from runtime.errors import ConfigError

    try:
        written = exports.export(run, form.value, out, epoch)
    except (ValueError, OSError) as error:
        raise ConfigError(str(error)) from None
    for path in written:
        print(path)
