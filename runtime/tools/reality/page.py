"""Command ``reality`` and its page ``REALITY.md``: what agrees with published figures."""

from __future__ import annotations

import math
import statistics
from collections import Counter
from collections.abc import Container, Hashable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from runtime.errors import CommandError
from runtime.run.results import write
from runtime.tools.reality import agreement
from runtime.tools.reality.agreement import Cell, Criterion
from runtime.tools.reality.plot import draw
from runtime.tools.reality.results import Ledger, Result, result_of
from runtime.tools.reality.study import (
    FOLDER,
    Planned,
    Published,
    Run,
    Study,
    System,
    keys_of,
    make_plan,
    read_published,
    read_study,
    truths,
)
from runtime.tools.sweep.plan import Job, plan_of
from runtime.tools.sweep.plots import template
from runtime.tools.sweep.tables import Row, decode_rows

Names = Annotated[str, typer.Option(metavar="A,B,…", help="Only these; all if not given.")]


def reality(
    truth: Annotated[
        Path | None,
        typer.Option(help="Folder with EuRoC's ground truth; without, only the page is written."),
    ] = None,
    sequences: Names = "",
    worlds: Names = "",
    conditions: Names = "",
    systems: Names = "",
    outside: Annotated[
        Path | None, typer.Option(metavar="SCAN", help="A scan to fly in, the world `outside`.")
    ] = None,
    seeds: Annotated[
        int | None, typer.Option(min=1, help="Flights of each sequence; 3, of two of them 5.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the runs.")] = Path("sweeps/reality"),
    results: Annotated[
        Path, typer.Option(help="The ledger: a line for each run, to be committed.")
    ] = Path("bench/reality.csv"),
    page: Annotated[Path, typer.Option(help="The page, Markdown.")] = Path("bench/REALITY.md"),
    file: Annotated[
        Path | None, typer.Option(help="Another study.toml than the project's own.")
    ] = None,
    plan: Annotated[
        bool, typer.Option("--plan", help="Say what would be flown, and what not; fly nothing.")
    ] = False,
    stale: Annotated[
        bool, typer.Option("--stale", help="Count results of other settings where no other is.")
    ] = False,
    retry: Annotated[
        bool, typer.Option("--retry", help="Fly again what has crashed, which counts as failed.")
    ] = False,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Runs at the same time, as for `sweep`.")
    ] = None,
) -> None:
    """Compare systems' errors in the simulator with those published for EuRoC.

    EuRoC's rig is carried along EuRoC's motions through worlds of the simulator, and systems with
    published figures are judged as in their papers. Each result is a line of the ledger; what
    stands there is not flown again, so the study can be flown in parts, on several machines.
    Exit codes: 130 after Ctrl-C, else 0, also if systems failed or nothing agreed, as the page
    says.
    """
    from runtime.run.summarise import command_line
    from runtime.tools.cli.sweep import carry_out

    if plan and not truth:
        raise CommandError("--plan: expected --truth, the folder of the ground truth, found none")
    full_study, published = read_study(file) if file else read_study(), read_published()
    published.by_system(full_study)  # refuses a row that is not there before a flight
    study = full_study.only(
        sequences=_names(sequences),
        worlds=_names(worlds),
        conditions=_names(conditions),
        systems=_names(systems),
    )
    out, ledger = out.absolute(), Ledger(results)
    keys = keys_of(study, seeds) if truth else {}
    if truth and not keys:
        raise CommandError(
            "expected --sequences, --worlds and --conditions that the study flies together, "
            "found none"
        )
    planned = make_plan(
        study,
        keys,
        out=out,
        truth=truths(truth, study.sequences),
        outside=outside,
        wanted=lambda run, data: not ledger.has(run, keys[run], data, crashed=not retry),
    )
    for line in plan_lines(study, planned) if truth else ():
        typer.echo(line)
    if plan:
        return
    by_id = {job.id: run for run, job in planned.jobs.items()}

    def enter(*ended: tuple[Job, Row]) -> None:
        ledger.add(
            result_of(run, job, row, key=keys[run], data=planned.data[run[:2]], study=study)
            for job, row in ended
            if not row["error"].startswith(NOT_ITS_OWN) and not row.get("edited")
            for run in [by_id[job.id]]
        )

    def enter_all() -> None:
        rows = rows_in(out)
        enter(*((job, rows[job.id]) for job in planned.jobs.values() if job.id in rows))

    enter_all()  # what ended while an earlier call was interrupted
    missing = [
        job
        for run, job in planned.jobs.items()
        if not ledger.has(run, keys[run], planned.data[run[:2]], crashed=not retry)
    ]
    try:
        if missing:
            carry_out(plan_of(missing, out), jobs=jobs, finished=lambda *ended: enter(ended))
    finally:
        enter_all()
        all_keys = keys_of(full_study)
        seeded_keys = keys_of(full_study, seeds) if seeds else {}
        count, old = ledger.valid(seeded_keys | all_keys, planned.data, stale=stale)
        write_page(full_study, published, all_keys, count, old, page, command_line())
    typer.echo(f"{len(count)} results in {results}   the page is {page}")


NOT_ITS_OWN = "interrupted by", "not started"
"""Begins of the errors of runs that were ended from outside: they are flown again."""


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def rows_in(out: Path) -> dict[str, Row]:
    """Return the rows of the runs in a folder, by job."""
    path = out / "rows.jsonl"
    return decode_rows(path.read_bytes()) if path.is_file() else {}


def plan_lines(study: Study, planned: Planned) -> Iterator[str]:
    """Yield what is planned, in lines: how much, for how long, and what is left out."""
    yield (
        f"{len(planned.jobs)} runs on {planned.flights(study)} flights to do, some "
        f"{planned.hours(study):.1f} processor hours; {planned.finished} are in the ledger"
    )
    for reason, number in planned.absent.items():
        yield f"left out: {number} runs: {reason}"


class Group(msgspec.Struct, frozen=True, kw_only=True):
    """Results of a system in a cell.

    Attributes:
        error: Median over the seeds (m); infinite if most of them failed.
    """

    results: tuple[Result, ...]
    failed: int
    error: float

    @property
    def words(self) -> str:
        """The error, and how many failed."""
        number = len(self.results)
        text = "failed" if math.isinf(self.error) else f"{self.error:.3f}"
        return text + f" ({self.failed} of {number} failed)" * bool(self.failed and number > 1)


def groups(
    study: Study, count: Mapping[Run, Result], condition: str
) -> dict[str, dict[Cell, Group]]:
    """Return the results under a condition by system and cell, in the order of the study."""
    table: dict[str, dict[Cell, Group]] = {}
    for system in study.systems:
        cells: dict[Cell, list[Result]] = {}
        for run, result in sorted(count.items()):
            if (run.system, run.condition) == (system.name, condition):
                cells.setdefault(Cell(run.sequence, run.world), []).append(result)
        for cell, results in cells.items():
            table.setdefault(system.name, {})[cell] = Group(
                results=tuple(results),
                failed=sum(result.failed(system, study) for result in results),
                error=statistics.median(_error(result, study) for result in results),
            )
    return table


def _error(result: Result, study: Study) -> float:
    system = next(system for system in study.systems if system.name == result.system)
    return math.inf if result.failed(system, study) else result.error_m(system)


def ablations(study: Study, count: Mapping[Run, Result]) -> dict[str, dict[str, str]]:
    """Return by condition and system the error divided by that under `Part.against`, in words."""
    errors: dict[str, dict[str, dict[Hashable, float]]] = {}
    for run, result in count.items():
        place = run.sequence, run.world, run.seed
        by_place = errors.setdefault(run.condition, {}).setdefault(run.system, {})
        by_place[place] = _error(result, study)
    ratios = {
        condition.name: agreement.ablation(
            errors[condition.name], errors.get(condition.against or study.conditions[0].name, {})
        )
        for condition in study.conditions[1:]
        if condition.name in errors
    }
    return {
        condition: {name: f"× {ratio:.3g} ({runs})" for name, (ratio, runs) in row.items()}
        for condition, row in ratios.items()
        if row
    }


def differing(study: Study, count: Mapping[Run, Result]) -> list[str]:
    """Return the flights of which results of different bytes count, as words."""
    systems = {system.name: system for system in study.systems}
    digests: dict[tuple[object, ...], set[str]] = {}
    for run, result in count.items():
        if result.flight:
            digests.setdefault((*run[:4], systems[run.system].set), set()).add(result.flight)
    return [
        " ".join(map(str, flight[:4]))
        for flight, flight_digests in digests.items()
        if len(flight_digests) > 1
    ]


def _comparable(
    table: Mapping[str, Mapping[Cell, Group]], systems: Mapping[str, System]
) -> dict[str, dict[Cell, float]]:
    """Return the errors of the systems that count."""
    return {
        name: {cell: group.error for cell, group in row.items()}
        for name, row in table.items()
        if not systems[name].why_not
    }


def _in_world(
    errors: Mapping[str, Mapping[Cell, float]], world: str
) -> dict[str, dict[Cell, float]]:
    return {
        name: {cell: error for cell, error in row.items() if cell.world == world}
        for name, row in errors.items()
    }


def progress(
    study: Study, keys: Mapping[Run, str], count: Mapping[Run, Result]
) -> dict[str, list[str]]:
    """Return by system how many of its runs have been flown, ``3 of 22``, in each of `places`."""
    planned = Counter((run.system, run.world, run.condition) for run in keys)
    flown = Counter((run.system, run.world, run.condition) for run in count if run in keys)
    return {
        system.name: [
            f"{flown[system.name, *place]} of {planned[system.name, *place]}"
            for place in places(keys)
        ]
        for system in study.systems
    }


def places(keys: Mapping[Run, str]) -> list[tuple[str, str]]:
    """Return the worlds and conditions of a study's runs."""
    return [*dict.fromkeys((run.world, run.condition) for run in keys)]


def write_page(
    study: Study,
    published: Published,
    keys: Mapping[Run, str],
    count: Mapping[Run, Result],
    old: Sequence[Result],
    path: Path,
    command: str,
) -> None:
    """Write the page, and the plot into a folder of its name beside it.

    Args:
        keys: All runs of the study.
        count: The results that count.
        old: The stale ones.
    """
    systems = {system.name: system for system in study.systems}
    errors = published.by_system(study)
    judged = [*study.conditions[:1], *(c for c in study.conditions[1:] if c.judged)]
    tables = {condition.name: groups(study, count, condition.name) for condition in judged}
    comparable = {name: _comparable(table, systems) for name, table in tables.items()}
    left_out = {world.name for world in study.worlds if world.why_not}
    counted = {
        condition: {
            name: {cell: error for cell, error in row.items() if cell.world not in left_out}
            for name, row in table.items()
        }
        for condition, table in comparable.items()
    }
    failed = {
        condition: {name: agreement.failing_cells(row) for name, row in table.items()}
        for condition, table in comparable.items()
    }
    failed_in_reality = {name: agreement.failing(row) for name, row in errors.items()}
    folder = path.parent / path.stem.lower()
    folder.mkdir(parents=True, exist_ok=True)
    worlds = [world.name for world in study.worlds]
    first = judged[0].name
    drawn = draw(
        comparable[first],
        errors,
        {name: system.published for name, system in systems.items() if system.published},
        worlds,
        failed[first],
        failed_in_reality,
        folder / "scatter.svg",
    )
    flown = [
        (world, name)
        for name, table in tables.items()
        for world in worlds
        if any(cell.world == world for row in table.values() for cell in row)
    ]
    criteria_by_place = [
        agreement.criteria(_in_world(comparable[name], world), errors) for world, name in flown
    ]
    text = template(FOLDER / "REALITY.md.jinja").render(
        command=command,
        study=study,
        finished=sum(run in count for run in keys),
        whole=len(keys),
        judged=judged,
        criteria=_in_rows([agreement.criteria(counted[c.name], errors) for c in judged]),
        extents=[_extent(c.name, count, counted[c.name], left_out) for c in judged],
        flown=flown,
        by_place=_in_rows(criteria_by_place),
        inverted=[(c.name, agreement.inversions(counted[c.name], errors)[0]) for c in judged],
        rankings=[
            (name, ranking)
            for name, row in comparable.items()
            for ranking in agreement.rankings(row, errors)
        ],
        in_both=[
            (c.name, pair)
            for c in judged[1:]
            for pair in _in_both(comparable[first], comparable[c.name], errors)
        ],
        systems=systems,
        counting=[name for name, system in systems.items() if not system.why_not],
        tables=tables,
        failed=failed,
        failed_in_reality=failed_in_reality,
        published=errors,
        sources=[t for t in published.tables if {*t.rows} & {s.published for s in study.systems}],
        ablations=ablations(study, count),
        drawn=drawn,
        folder=folder.name,
        problems=[r for r in count.values() if r.failed(systems[r.system], study)],
        places=places(keys),
        progress=progress(study, keys, count),
        old=[result for result in old if result.run not in count],
        replaced=sum(result.run in count for result in old),
        stale=sum(result in old for result in count.values()),
        differing=differing(study, count),
        commits=Counter(result.commit or "unknown" for result in count.values()),
        Cell=Cell,
        word=lambda value: "failed" if math.isinf(value) else f"{value:.3f}",
    )
    write(path, (text.rstrip() + "\n").encode())


def _in_both(
    first: agreement.Simulated, other: agreement.Simulated, published: agreement.Published
) -> list[tuple[agreement.Ranking, agreement.Ranking]]:
    """Return the rankings under two conditions, of the systems that were flown under both."""
    tables = [
        {name: {c: e for c, e in row.items() if c in b.get(name, {})} for name, row in a.items()}
        for a, b in ((first, other), (other, first))
    ]
    of_first, of_other = (
        {ranking.cell: ranking for ranking in agreement.rankings(table, published)}
        for table in tables
    )
    return [(ranking, of_other[cell]) for cell, ranking in of_first.items() if cell in of_other]


def _in_rows(columns: Sequence[Sequence[Criterion]]) -> list[tuple[Criterion, ...]]:
    """Return the criteria of several tables, those of one name together."""
    return [*zip(*columns, strict=True)] if columns else []


def _extent(
    condition: str,
    count: Mapping[Run, Result],
    counted: Mapping[str, Mapping[Cell, float]],
    left_out: Container[str],
) -> str:
    """Return how much counts under a condition, in words."""
    runs = [
        run
        for run in count
        if run.condition == condition and run.system in counted and run.world not in left_out
    ]
    kinds = ("system", "sequence", "world", "seed")
    amounts = [(len({getattr(run, kind) for run in runs}), kind) for kind in kinds]
    words = [f"{amount} {kind}{'s' * (amount != 1)}" for amount, kind in amounts]
    return f"{len(runs)} runs: {', '.join(words)}" if runs else "none yet"
