"""The command ``vocabulary``: what ORB-SLAM3 recognises places with, made from a file's images."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from runtime.tools.cli.common import ConfigFile, Overrides

_SHUTDOWN_LIMIT = 300.0
"""Seconds; the training is done as the node shuts down."""


def vocabulary(
    config: ConfigFile,
    out: Annotated[
        Path | None,
        typer.Option(help="File to write; where ORB-SLAM3 nodes look by themselves if not given."),
    ] = None,
    overrides: Overrides = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress bar.")] = False,
) -> None:
    """Train ORB-SLAM3's vocabulary from what the cameras of a file see.

    Runs the file without its ORB-SLAM3 nodes and without a folder of results; once done, the
    file's ORB-SLAM3 nodes find the vocabulary by themselves. One made from one world serves in
    others, and best in its own.
    """
    import msgspec
    from rich.console import Console

    from nodes.estimators.orb_slam3.node import OrbSlam3
    from nodes.estimators.orb_slam3.training import VocabularyTrainer, VocabularyTrainerConfig
    from runtime.config.model import Config, NodeSpec
    from runtime.config.reading import load_configuration
    from runtime.errors import ConfigError
    from runtime.logs import terminal_handler
    from runtime.run.execute import execute
    from runtime.tools.cli.progress import progress
    from runtime.tools.cli.run import leave_behind
    from runtime.units import Duration

    if out is not None and out.suffix != ".txt":  # ORB-SLAM3 would read it as binary
        raise ConfigError(f"--out: expected a name that ends with .txt, found {out}")
    settings = load_configuration(config, overrides or [])
    options = VocabularyTrainerConfig(path="" if out is None else str(out.resolve()))
    spec = NodeSpec(
        name="vocabulary_trainer",
        type_name="VocabularyTrainer",
        on_error="stop",
        inputs={},
        links={},
        node=VocabularyTrainer,
        config=options,
    )
    others = (s for s in settings.nodes if not issubclass(s.node, OrbSlam3 | VocabularyTrainer))
    run = msgspec.structs.replace(
        settings.run, shutdown_limit=Duration(_SHUTDOWN_LIMIT), digest=False
    )
    console = Console(stderr=True)
    execute(
        Config(run=run, nodes=(*others, spec)),
        handlers=[terminal_handler(console)],
        watch=None if quiet else progress(run, console),
    )
    print(f"vocabulary: {options.file()}")
    if out is None:
        print("ORB-SLAM3 nodes find it there by themselves")
    else:
        print(f'for an ORB-SLAM3 node to use it: vocabulary = "{options.file()}"')
    leave_behind(0)
