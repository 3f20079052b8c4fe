"""``suite``: every estimator in every scenario, and the page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from runtime.tools.cli.outcomes import Json, JUnit, of_rows, writing


def suite(
    scenario: Annotated[
        list[str] | None, typer.Option(help="Only this scenario; may be repeated.")
    ] = None,
    estimator: Annotated[
        list[str] | None, typer.Option(help="Only this estimator; may be repeated.")
    ] = None,
    file: Annotated[
        Path | None, typer.Option(help="Another suite.toml than the project's own.")
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Flights of each scenario.")] = 1,
    repeat: Annotated[
        int, typer.Option(min=1, help="Runs of each estimator with the first flight of all.")
    ] = 2,
    out: Annotated[Path, typer.Option(help="Folder for the runs.")] = Path("sweeps/suite"),
    page: Annotated[
        Path | None, typer.Option(help="The page, Markdown; SUITE.md in the folder if not given.")
    ] = None,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Runs at the same time, as for `sweep`.")
    ] = None,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Run everything, also what is finished already.")
    ] = False,
    junit: JUnit = None,
    json: Json = None,
) -> None:
    """Judge all installed estimators in scenarios from easy to brutal.

    Each scenario is flown once, and all estimators get the same flight. The result is a page with a
    table of all, their spread, and what the table does not show. A second call runs only missing
    and crashed runs. Exit codes: 2 after a crashed run, 130 after Ctrl-C, else 0, also if
    estimators failed: their failures are what the page is about.
    """
    from bench.estimators.page import write_page
    from bench.estimators.plan import make_plan, read_suite
    from runtime.run.summarise import command_line
    from runtime.tools.cli.sweep import carry_out, end

    with writing("suite", junit, json) as outcomes:
        chosen = (read_suite(file) if file else read_suite()).only(scenario or [], estimator or [])
        plan = make_plan(chosen, out=out.absolute(), seeds=seeds, repeats=repeat)
        rows = carry_out(plan, jobs=jobs, fresh=fresh)
        outcomes += of_rows(map(str, plan.jobs), rows)
    path = page or out / "SUITE.md"
    write_page(chosen, plan, rows, path, command_line())
    typer.echo(f"{len(rows)} runs   the page is {path}")
    end(rows, judged=False)
