"""``SUITE.md``: one table of all, one for each scenario, and what they do not show."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Sequence
from pathlib import Path

import jinja2

from bench.estimators.cells import COLUMNS, cells
from bench.estimators.pictures import draw, pictures
from bench.estimators.plan import Suite
from runtime.run.results import write
from runtime.run.summarise import commit, environment
from runtime.tools.sweep.plan import Plan
from runtime.tools.sweep.tables import Row


def write_page(suite: Suite, plan: Plan, rows: Sequence[Row], path: Path, command: str) -> None:
    """Write the page and its pictures.

    Args:
        plan: The runs; their folders are where they were made.
        path: Of the page; its pictures go into a folder ``suite`` beside it.
    """
    folder = path.parent / "suite"
    folder.mkdir(parents=True, exist_ok=True)
    found = cells(suite, plan, rows)
    there = {name for each in found.values() for name in each}
    draw(suite, found, folder / "suite.png")
    text = _template().render(
        command=command,
        runs=len(rows),
        seeds=len({job.seed for job in plan.jobs}),
        repeats=max(job.repeat for job in plan.jobs),
        scenarios=suite.scenarios,
        entrants=[each for each in suite.estimators if each.name in there],
        absent=[each for each in suite.estimators if each.name not in there],
        cells=found,
        columns=COLUMNS,
        thresholds=", ".join(f"{name} {value:g}" for name, value in suite.thresholds.items()),
        pictures=pictures(plan, folder),
        folder=folder.name,
        where={**environment(), "commit": commit(), **_graphics(plan)},
    )
    write(path, (text.rstrip() + "\n").encode())


def _graphics(plan: Plan) -> dict[str, str]:
    """Return what drew the images, and the versions of the estimators, as the first run has it."""
    for job in plan.jobs:
        with contextlib.suppress(OSError, ValueError, KeyError):
            summary = json.loads((Path(job.out) / "summary.json").read_text(encoding="utf-8"))
            if "graphics" in summary["environment"]:
                return {"graphics": summary["environment"]["graphics"]}
    return {}


def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=False,  # noqa: S701  # Markdown is no HTML
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    return environment.get_template("SUITE.md.jinja")
