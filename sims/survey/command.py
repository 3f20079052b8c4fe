"""``python -m runtime world``: what a mesh file gives as a world, and what flying in it costs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from runtime.errors import CommandError


def world(
    file: Annotated[Path, typer.Argument(help="A mesh file.", metavar="FILE")],
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change a setting of `mesh` (unit=cm)."),
    ] = None,
    image: Annotated[
        Path | None,
        typer.Option("--image", metavar="PNG", help="Draw it here; by default <name>-world.png."),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option("--config", metavar="TOML", help="Write a file here that flies the tour."),
    ] = None,
) -> None:
    """Say what a mesh file gives as a world: size, what is left out, cost, a start and a tour.

    The first time the file is read and prepared, which is kept for all later runs. Times are of one
    core of this machine, of images and lidar turns along the tour. Four views and a plan from above
    are drawn.
    """
    from runtime.config.overrides import override
    from runtime.config.reading import parse
    from sims.survey.survey import Survey
    from sims.world import WorldConfig

    table = {"nodes": [{"name": "scan", "type": "World", "world": str(file.absolute())}]}
    for change in settings or []:
        override(table, f"scan.mesh.{change}")
    (node,) = parse(table, "command line").nodes
    assert isinstance(node.config, WorldConfig)
    if config is not None and config.exists():
        raise CommandError(f"--config: {config}: expected no such file, found one")
    survey = Survey(file, node.config.mesh)
    for line in survey.lines():
        print(line, flush=True)
    path = image or Path(f"{file.stem}-world.png")
    survey.draw(path)
    print(f"images: {path}")
    if config is not None:
        config.write_text(survey.configuration(config.parent.absolute()), "utf-8")
        print(f"fly: python -m runtime run {config}")
