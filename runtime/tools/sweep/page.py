"""A sweep as a page: ``index.html`` beside its tables, with links to each run's own report."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import jinja2

from runtime.run.results import write
from runtime.tools.sweep.plan import Plan
from runtime.tools.sweep.rows import Row
from runtime.tools.sweep.tables import MAIN_FIGURES, in_order, summarise


def write_page(plan: Plan, rows: Sequence[Row]) -> Path:
    """Write the page of a sweep into its folder; its tables and plots are there already.

    Returns:
        The page.
    """
    combinations = summarise(plan, rows)
    figures = [n for n in MAIN_FIGURES if any(n in each.figures for each in combinations)]
    summary = []
    for each in combinations:
        spreads = [each.figures.get(name) for name in figures]
        cells = [
            (f"{s.median:.4g}", f"{s.first:.4g} to {s.third:.4g}", f"{s.least:.4g} to {s.most:.4g}")
            if s
            else ("", "", "")
            for s in spreads
        ]
        judged = "" if each.passed is None else each.passed
        counts = [each.runs, _share(each.failed, each.runs), _share(each.missed, each.runs), judged]
        summary.append(([*each.settings, each.estimator], counts, cells, each.repeatable))
    runs, repeated = [], any(job.repeat > 1 for job in plan.jobs)
    for job, row in in_order(plan, rows):
        report = Path(job.out) / "report.html"
        link = report.relative_to(plan.out).as_posix() if report.is_file() else ""
        state = {True: "passed", False: "failed", None: "not judged"}[row["passed"]]
        settings = [text for _, text in job.settings]
        own = [job.seed, *[job.repeat] * repeated]
        runs.append(([*settings, *own], row["error"] or state, link, bool(row["error"])))
    page = _template().render(
        name=plan.out.name,
        parameters=[parameter.path for parameter in plan.parameters],
        figures=[name.replace("_", " ") for name in figures],
        summary=summary,
        repeated=repeated,
        runs=runs,
        plots=[f"plots/{path.name}" for path in sorted((plan.out / "plots").glob("*.png"))],
    )
    path = plan.out / "index.html"
    write(path, page.encode())
    return path


def _share(count: int, runs: int) -> str:
    return f"{count} ({count / runs:.0%})" if count else "0"


def _template() -> jinja2.Template:
    text = (Path(__file__).parent / "page.html.jinja").read_text(encoding="utf-8")
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.from_string(text)
