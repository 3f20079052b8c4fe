"""``suite``: every estimator in every scenario, and the page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


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
        int, typer.Option(min=1, help="Runs of each estimator with each flight.")
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
) -> None:
    """Judge all estimators that are installed in scenarios from easy to brutal.

    Each scenario is flown once, and all estimators get that flight. The result is a page with one
    table of all, their spread, and what the table does not show. Called again, only what is missing
    or has failed is run. Ends as `sweep` does: a run that fails makes exit code 2, Ctrl-C 130.
    """
    from bench.estimators.page import write_page
    from bench.estimators.plan import make_plan, read_suite
    from runtime.run.summarise import command_line
    from runtime.tools.cli.sweep import carry_out

    chosen = (read_suite(file) if file else read_suite()).only(scenario or [], estimator or [])
    plan = make_plan(chosen, out=out.absolute(), seeds=seeds, repeats=repeat)
    rows = carry_out(plan, jobs=jobs, fresh=fresh)
    path = page or out / "SUITE.md"
    write_page(chosen, plan, rows, path, command_line())
    typer.echo(f"{len(rows)} runs   the page is {path}")
    if failed := sum(bool(row["error"]) for row in rows):
        typer.echo(f"error: {failed} of {len(rows)} runs failed", err=True)
        raise typer.Exit(2)
