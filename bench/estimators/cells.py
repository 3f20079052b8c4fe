"""What became of each estimator in each scenario: the figures of the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec

from bench.estimators.plan import Entrant, Suite
from runtime.tools.sweep.plan import Plan
from runtime.tools.sweep.tables import Row, Spread, in_order, numbers, summarise

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
        reasons: Why runs failed, each once, with the figures of the first of them.
        figures: Figure to its spread over the runs that have it.
        repeatable: Whether all repeats of a seed gave the same, in words.
    """

    entrant: Entrant
    runs: int
    passed: int
    reasons: tuple[str, ...]
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
                    reasons=_reasons(entrant.name, group),
                    figures=_figures(entrant.name, group),
                    repeatable=repeatable[key],
                )
    return found


def _reasons(name: str, group: Sequence[Row]) -> tuple[str, ...]:
    """Return why runs came to nothing or missed a threshold; each threshold once."""
    found: dict[str, str] = {}
    for row in group:
        missed = row["estimators"].get(name, {}).get("failed") or []
        for reason in [row["error"]] * bool(row["error"]) + missed:
            found.setdefault(reason.partition(":")[0], reason)
    return tuple(found.values())


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
