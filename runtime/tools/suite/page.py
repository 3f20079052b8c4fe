"""Command ``suite`` and its page ``SUITE.md``: every estimator in every scenario."""

from __future__ import annotations

import contextlib
import json
import statistics
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import cv2
import msgspec
import numpy as np
import typer

from runtime.channels.wire import combined
from runtime.errors import ConfigError
from runtime.run.results import write
from runtime.tools.cli.commands import (
    Columns,
    Csv,
    Json,
    JUnit,
    Latex,
    Markdown,
    chosen_format,
    of_rows,
    writing,
)
from runtime.tools.paper.typeset import Table, columns_of, figures_table, typeset
from runtime.tools.suite.plan import EXACT, FOLDER, Suite
from runtime.tools.sweep.plan import Job, Plan
from runtime.tools.sweep.plots import template
from runtime.tools.sweep.tables import Combination, Row, combine, crashed, in_order, summarise


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
    latex: Latex = False,
    markdown: Markdown = False,
    csv: Csv = False,
    figure: Columns = None,
) -> None:
    """Judge all installed estimators in scenarios from easy to brutal.

    Each scenario is flown once, and all estimators get the same flight. The result is a page with a
    table of all, their spread, and what the table does not show. A second call runs only missing
    and crashed runs. Exit codes: 2 after a crashed run, 130 after Ctrl-C, else 0, also if
    estimators failed: their failures are what the page is about.
    """
    from runtime.run.summarise import command_line
    from runtime.tools.cli.sweep import carry_out, end
    from runtime.tools.suite.plan import make_plan, read_suite

    form = chosen_format(latex=latex, markdown=markdown, csv=csv, figures=figure)
    with writing("suite", junit, json) as outcomes:
        chosen = (read_suite(file) if file else read_suite()).only(scenario or [], estimator or [])
        plan = make_plan(chosen, out=out.absolute(), seeds=seeds, repeats=repeat)
        rows = carry_out(plan, jobs=jobs, fresh=fresh)
        outcomes += of_rows(map(str, plan.jobs), rows)
    path = page or out / "SUITE.md"
    write_page(chosen, plan, rows, path, command_line())
    if form is not None:
        typer.echo(typeset(table_of(plan, rows, figure or []), form), nl=False)
    typer.echo(f"{len(rows)} runs   the page is {path}", err=form is not None)
    end(rows, judged=False)


COLUMNS = {
    "flight_ate_percent": "error, whole flight, %",
    "ate_percent": "ATE as said, %",
    "final_ate_percent": "ATE final, %",
    "rpe_1m_trans_percent": "RPE of 1 m, %",
    "coverage_percent": "coverage, %",
    "lost_seconds": "lost, s",
    "initialization_seconds": "first pose, s",
    "nees_position": "NEES, position (3 is right)",
    "cpu_p50_ms": "CPU, ms a frame",
    "peak_rss_mb": "memory, MB",
}
"""Figure to the head of its column."""

RANKED = "flight_ate_percent"
"""Figure to compare estimators by: ATE over the whole flight, lost time as 100 % drift."""


def verdict(cell: Combination) -> str:
    """Return in words: passed, failed, or how often of how many; a crash is a failure."""
    if cell.passed == cell.runs:
        return "passed"
    return "**failed**" + f" {cell.runs - (cell.passed or 0)} of {cell.runs}" * bool(cell.passed)


def short(cell: Combination) -> str:
    """Return a cell of the overall table: the error, and the verdict unless all runs passed."""
    error = cell.figures.get(RANKED)
    text = "" if error is None else f"{error.median:.3g}"
    if error is not None and f"{error.least:.3g}" != f"{error.most:.3g}":
        text += f" ({error.least:.3g} to {error.most:.3g})"
    return text if cell.passed == cell.runs else f"{text} {verdict(cell)}".strip()


def cells(
    plan: Plan, rows: Sequence[Row], figures: Sequence[str] = tuple(COLUMNS)
) -> dict[str, dict[str, Combination]]:
    """Return each estimator's results over all seeds and repeats, by scenario and estimator.

    A run equal to another to the bit adds nothing, and is left out. A run that crashed before it
    came to its end counts for both: who crashes now and then has not passed. What the estimator's
    worker cost stands among its figures. A flaw of the flight is not its own.
    """
    groups: dict[tuple[str, ...], dict[tuple[Any, ...], Row]] = {}
    for job, row in in_order(plan, rows):
        scenario, name = (text for _, text in job.settings)
        different = groups.setdefault((scenario, name), {})
        key = job.seed, row.get("digests", {}).get(name, job.id)
        different[key] = row | {"estimators": {name: _with_costs(name, row)}}
        for index, error in enumerate(row.get("crashes", [])):
            different[job.seed, job.id, index] = crashed(job, error)
    table: dict[str, dict[str, Combination]] = {}
    for (scenario, name), group in groups.items():
        cell = combine((scenario, name), name, [*group.values()], figures)
        table.setdefault(scenario, {})[name] = cell
    return table


def table_of(plan: Plan, rows: Sequence[Row], chosen: Sequence[str]) -> Table:
    """Return the table for a paper: a row for each scenario and estimator, the best by scenario.

    Args:
        chosen: Its figures; those of the page if none.
    """
    judged = [
        _with_costs(name, row)
        for job, row in in_order(plan, rows)
        for name in [dict(job.settings)["estimator"]]
    ]
    figures = columns_of(chosen, judged)
    if not chosen:
        present = {
            name
            for figures_of_run in judged
            for name, value in figures_of_run.items()
            if value is not None
        }
        figures = [name for name in COLUMNS if name in present]
    table = [
        msgspec.structs.replace(cell, settings=(scenario,))
        for scenario, row in cells(plan, rows, figures).items()
        for cell in row.values()
    ]
    return figures_table(table, ["scenario"], figures, groups=1)


def worth(plan: Plan, rows: Sequence[Row]) -> dict[str, dict[str, str]]:
    """Return what an exact calibration was worth, by scenario flown with both and estimator.

    The error over the whole flight with the errors of calibration, divided by that without, of the
    same seed: the median, and the range.
    """
    errors: dict[tuple[str, str, int], float] = {}
    for job, row in in_order(plan, rows):
        scenario, name = (text for _, text in job.settings)
        error = row["estimators"].get(name, {}).get(RANKED)
        if error is not None and job.repeat == 1:
            errors[scenario, name, job.seed] = error
    ratios: dict[str, dict[str, list[float]]] = {}
    for (scenario, name, seed), error in errors.items():
        if exact := errors.get((f"{scenario}{EXACT}", name, seed)):
            ratios.setdefault(scenario, {}).setdefault(name, []).append(error / exact)
    return {
        scenario: {name: _times(values) for name, values in estimators.items()}
        for scenario, estimators in ratios.items()
    }


def _times(ratios: Sequence[float]) -> str:
    middle, least, most = (f"{f(ratios):.2g}" for f in (statistics.median, min, max))
    return f"× {middle}" + f" ({least} to {most})" * (least != most)


def repeating(plan: Plan, rows: Sequence[Row]) -> dict[str, str]:
    """Return whether an estimator gave the same when run twice, in words, by its name."""
    texts = {}
    for cell in summarise(plan, rows):
        *_, name = cell.settings
        if cell.repeatable:
            texts[name] = "yes" if cell.repeatable.endswith("equal") else f"no, {cell.repeatable}"
    return texts


def summaries(plan: Plan) -> Iterator[tuple[Job, dict[str, Any]]]:
    """Yield the jobs with a readable ``summary.json``, and its contents."""
    for job in plan.jobs:
        with contextlib.suppress(OSError, ValueError):
            yield job, json.loads((Path(job.out) / "summary.json").read_text(encoding="utf-8"))


def flights(suite: Suite, plan: Plan) -> dict[str, dict[int, str]]:
    """Return the digest of all that the suite's vehicle sent, by scenario and seed.

    Of runs that came to their end.

    Raises:
        ConfigError: Two estimators were given flights that differ.
    """
    rigs = {Path(suite.rig_of(scenario)) for scenario in suite.scenarios}
    nodes = (node for rig in rigs for node in tomllib.loads(rig.read_text())["nodes"])
    flying = {node["name"] for node in nodes}
    digests: dict[str, dict[int, str]] = {}
    for job, summary in summaries(plan):
        if summary.get("error"):  # it ended early: its digest is that of a part
            continue
        sent = {k: v for k, v in summary["digests"].items() if k.partition(".")[0] in flying}
        scenario = dict(job.settings)["scenario"]
        digest = digests.setdefault(scenario, {}).setdefault(job.seed, combined(sent))
        if digest != combined(sent):
            raise ConfigError(f"{job}: expected the flight of the others, found another")
    return digests


def flaws(plan: Plan, rows: Sequence[Row]) -> dict[str, tuple[str, ...]]:
    """Return what is wrong with the flights themselves, as a collision, by scenario."""
    by_scenario: dict[str, dict[str, None]] = {}
    for job, row in in_order(plan, rows):
        for vehicle, flight in row.get("flights", {}).items():
            for reason in flight["failed"]:
                text = f"seed {job.seed}, {vehicle}: {reason}"
                by_scenario.setdefault(dict(job.settings)["scenario"], {})[text] = None
    return {scenario: tuple(reasons) for scenario, reasons in by_scenario.items()}


def _with_costs(name: str, row: Row) -> dict[str, Any]:
    return row["estimators"].get(name, {}) | _costs(name, row)


def _costs(name: str, row: Row) -> dict[str, float | None]:
    """Return the cost of an estimator's worker process, keyed as in `COLUMNS`."""
    for worker, costs in row.get("workers", {}).items():
        if worker.partition(".")[0] == name:
            return {"cpu_p50_ms": costs.get("cpu_p50_ms"), "peak_rss_mb": costs.get("peak_rss_mb")}
    return {}


HEIGHT = 240
"""Of the cameras' pictures, pixels."""


def draw(suite: Suite, cells: Mapping[str, Mapping[str, Combination]], path: Path) -> None:
    """Draw the error of each estimator in each scenario, with its range; crosses have failed."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    names = [e.name for e in suite.estimators if any(e.name in row for row in cells.values())]
    figure = Figure(figsize=(2.1 * len(suite.scenarios) + 2.4, 4.6), layout="constrained")
    axes: Any = figure.add_subplot()
    colours = colormaps["tab20"]
    for index, name in enumerate(names):
        colour = colours(index)
        for place, scenario in enumerate(suite.scenarios):
            cell = cells.get(scenario.name, {}).get(name)
            spread = cell.figures.get(RANKED) if cell else None
            if cell is None or spread is None:
                continue
            x = place + (index + 0.5) / len(names) * 0.8 - 0.4
            axes.plot([x, x], [spread.least, spread.most], color=colour, lw=4, alpha=0.35)
            mark = "o" if cell.passed == cell.runs else "x"
            axes.plot(x, spread.median, mark, color=colour)
        axes.plot([], [], "o", color=colour, label=name)
    for place in range(1, len(suite.scenarios)):
        axes.axvline(place - 0.5, color="0.85", lw=1)
    axes.set_xticks(
        range(len(suite.scenarios)), [f"{s.name}\n({s.level})" for s in suite.scenarios]
    )
    if np.isfinite(axes.dataLim.minposy):  # someone said something, and erred
        axes.set_yscale("log")
    axes.set_ylabel("error over the whole flight, % of the path (cross: failed)")
    axes.grid(axis="y", alpha=0.3)
    figure.legend(loc="outside right upper", fontsize=8)
    figure.savefig(path, dpi=120)


def pictures(plan: Plan, folder: Path) -> dict[str, str]:
    """Write a row of camera images for each scenario into a folder.

    Returns:
        Scenario to the name of its file; without scenarios of which no images are kept.
    """
    pages: dict[str, str] = {}
    for job in plan.jobs:
        name = dict(job.settings)["scenario"]
        if name in pages:
            continue
        frames = sorted((Path(job.out) / "frames").glob("*.jpg"))
        newest = {frame.stem.rpartition("_")[0]: frame for frame in frames}
        files = (np.frombuffer(frame.read_bytes(), np.uint8) for frame in newest.values())
        images = [cv2.imdecode(file, cv2.IMREAD_COLOR) for file in files]
        small = [
            cv2.resize(image, (round(image.shape[1] * HEIGHT / image.shape[0]), HEIGHT))
            for image in images
            if image is not None
        ]
        if small:
            pages[name] = f"{name}.jpg"
            jpeg = cv2.imencode(".jpg", np.hstack(small))[1]
            (folder / pages[name]).write_bytes(jpeg.tobytes())
    return pages


def write_page(suite: Suite, plan: Plan, rows: Sequence[Row], path: Path, command: str) -> None:
    """Write the page and its pictures.

    Args:
        plan: The runs; their folders are where they were made.
        path: Of the page; its pictures go into a folder of its name beside it.
    """
    folder = path.parent / path.stem.lower()
    folder.mkdir(parents=True, exist_ok=True)
    table = cells(plan, rows)
    names = {name for row in table.values() for name in row}
    draw(suite, table, folder / "suite.png")
    text = template(FOLDER / "SUITE.md.jinja").render(
        command=command,
        runs=len(rows),
        seeds=len({job.seed for job in plan.jobs}),
        scenarios=suite.scenarios,
        entrants=[estimator for estimator in suite.estimators if estimator.name in names],
        absent=[estimator for estimator in suite.estimators if estimator.name not in names],
        cells=table,
        verdict=verdict,
        short=short,
        repeats=repeating(plan, rows),
        worth=worth(plan, rows),
        errors=suite.calibration_errors,
        both=[scenario for scenario in suite.scenarios if scenario.calibration == "both"],
        exact=[scenario.name for scenario in suite.scenarios if scenario.calibration == "exact"],
        flights=flights(suite, plan),
        flaws=flaws(plan, rows),
        columns=COLUMNS,
        thresholds=", ".join(f"{name} {value:g}" for name, value in suite.thresholds.items()),
        pictures=pictures(plan, folder),
        folder=folder.name,
        where=_where(plan),
    )
    write(path, (text.rstrip() + "\n").encode())


def _where(plan: Plan) -> dict[str, str]:
    """Return where the runs were made; what differs among them, all of it."""
    environment: dict[str, dict[str, None]] = {}
    for _, summary in summaries(plan):
        for name, value in summary.get("environment", {}).items():
            if value and name != "command":  # without git there is no commit
                environment.setdefault(name, {})[value] = None
    return {name: ", ".join(values) for name, values in environment.items()}
