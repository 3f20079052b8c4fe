"""``SUITE.md``: one table of all, one for each scenario, and what they do not show."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import jinja2
import msgspec

from bench.estimators.pictures import draw, pictures
from bench.estimators.plan import Entrant, Suite
from runtime.environment import commit, environment
from runtime.results import write
from runtime.tools.sweep.plan import Plan
from runtime.tools.sweep.rows import Row
from runtime.tools.sweep.tables import Spread, in_order, numbers, summarise

COLUMNS = {
    "held_ate_percent": "error, whole flight, %",
    "ate_percent": "ATE as said, %",
    "final_ate_percent": "ATE final, %",
    "rpe_trans_percent": "RPE of 1 m, %",
    "coverage_percent": "coverage, %",
    "lost_seconds": "lost, s",
    "initialization_seconds": "first pose, s",
    "cpu_p50_ms": "CPU, ms a frame",
    "peak_rss_mb": "memory, MB",
}
"""Figure to the head of its column."""

RANKED = "held_ate_percent"
"""The figure by which all are compared: a pose that is missing counts with the last one said."""


class Cell(msgspec.Struct, frozen=True, kw_only=True):
    """One estimator in one scenario, over all seeds and repeats.

    Attributes:
        entrant: The estimator.
        runs: How many runs there are.
        passed: How many of them met the thresholds.
        errors: What ended those that came to nothing, each once.
        figures: Figure to its spread over the runs that have it.
        repeatable: Whether all repeats of a seed gave the same, in words.
    """

    entrant: Entrant
    runs: int
    passed: int
    errors: tuple[str, ...]
    figures: Mapping[str, Spread]
    repeatable: str

    @property
    def verdict(self) -> str:
        """In words: passed, failed, or how often of how many."""
        if self.passed == self.runs:
            return "passed"
        return "**failed**" + f" {self.runs - self.passed} of {self.runs}" * bool(self.passed)

    @property
    def short(self) -> str:
        """The cell of the table of all: the error, and whether it failed."""
        error = self.figures.get(RANKED)
        words = "" if error is None else f"{error.median:.3g}"
        if error is not None and f"{error.least:.3g}" != f"{error.most:.3g}":
            words += f" ({error.least:.3g} to {error.most:.3g})"
        return words if self.passed == self.runs else f"{words} {self.verdict}".strip()


def cells(suite: Suite, plan: Plan, rows: Sequence[Row]) -> dict[str, dict[str, Cell]]:
    """Return what became of each estimator, by scenario and estimator."""
    groups: dict[tuple[str, ...], list[Row]] = {}
    for job, row in in_order(plan, rows):
        groups.setdefault(tuple(text for _, text in job.settings), []).append(row)
    repeatable = {each.settings: each.repeatable for each in summarise(plan, rows)}
    found: dict[str, dict[str, Cell]] = {}
    for scenario in suite.scenarios:
        for entrant in suite.estimators:
            key = (scenario.name, entrant.name)
            if group := groups.get(key):
                found.setdefault(scenario.name, {})[entrant.name] = Cell(
                    entrant=entrant,
                    runs=len(group),
                    passed=sum(row["passed"] is True for row in group),
                    errors=tuple(dict.fromkeys(row["error"] for row in group if row["error"])),
                    figures=_figures(entrant.name, group),
                    repeatable=repeatable[key],
                )
    return found


def _figures(name: str, group: Sequence[Row]) -> dict[str, Spread]:
    figures = [row["estimators"].get(name, {}) | _costs(name, row) for row in group]
    values = {figure: numbers(each.get(figure) for each in figures) for figure in COLUMNS}
    return {figure: Spread.of(each) for figure, each in values.items() if each}


def _costs(name: str, row: Row) -> dict[str, float | None]:
    """Return what an estimator's process costs, by the names of `COLUMNS`."""
    for worker, costs in row.get("workers", {}).items():
        if worker.startswith(f"{name}."):
            return {"cpu_p50_ms": costs.get("cpu_p50_ms"), "peak_rss_mb": costs.get("peak_rss_mb")}
    return {}


def write_page(suite: Suite, plan: Plan, rows: Sequence[Row], path: Path, command: str) -> None:
    """Write the page and its pictures.

    Args:
        suite: What was to be measured.
        plan: The runs; their folders are where they were made.
        rows: What came of them.
        path: Of the page; its pictures go into a folder ``suite`` beside it.
        command: That made it.
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
