"""Command ``bundle``: a run as one archive; `run --from` repeats it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from runtime.tools.cli.commands import warn


def bundle(
    run: Annotated[Path, typer.Argument(help="Folder of the run: runs/tour for its latest.")],
    out: Annotated[
        Path | None, typer.Option(help="Archive to write; NAME.zip of the run if not given.")
    ] = None,
    with_inputs: Annotated[
        bool,
        typer.Option(
            "--with-inputs", help="Put in the files that the settings name, and nodes' own code."
        ),
    ] = False,
) -> None:
    """Write a run as one archive, for a paper's readers: what it was made from, and what came out.

    It has the settings, seed, digests, versions and commits of the tool and the estimators, hashes
    of all inputs and programs, figures, plots, trajectories, and the command that repeats it: run
    --from ARCHIVE. Inputs are in it with --with-inputs alone, programs and recordings never; what
    is not in it stands there by size and hash, and is printed. Equal folders give equal archives.
    """
    from runtime.errors import CommandError
    from runtime.run.results import run_folder
    from runtime.summary import Summary
    from runtime.tools.paper.bundle import size_of, write_bundle
    from runtime.tools.summaries import read_summary

    folder = run_folder(run)
    path = out or Path(f"{read_summary(folder, Summary).name}.zip")
    if path.suffix != ".zip":
        raise CommandError(f"--out {path}: expected a file .zip, found {path.suffix!r}")
    if not path.absolute().parent.is_dir():
        raise CommandError(f"--out {path}: expected a folder {path.parent}, found none")
    manifest = write_bundle(folder, path, with_inputs=with_inputs)
    for note in manifest.notes:
        warn(note)
    print(f"{path}: {len(manifest.files) + 1} files, {size_of(path.stat().st_size)}")
    print(f"repeat it with: {manifest.repeat}")
