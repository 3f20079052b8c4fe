"""Rows as tables: ``table.csv``, ``summary.csv``, ``timing.csv`` and ``costs.csv``.

``table.csv`` and ``summary.csv`` hold nothing that differs between two equal sweeps in lockstep;
whatever depends on the machine is in ``timing.csv`` (runs) and ``costs.csv`` (their workers).

What is remembered of each run: ``rows.jsonl``, one line a run, added when the run ends. What runs
were made from is in ``made_from.jsonl``, a line for each set of parts, to which the rows refer.
"""

from __future__ import annotations

import contextlib
import csv
import fcntl
import json
import statistics
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, NotRequired, TypedDict

import msgspec

from runtime.errors import ConfigError
from runtime.figures import IN_SWEEPS, figure
from runtime.run.made_from import Parts, changes, key_of
from runtime.tools.sweep.plan import Job, Plan, value


class Row(TypedDict):
    """Results of a run. All go through JSON, so non-finite figures become `None`.

    Keys:
        id: Of the job.
        exit_code: Of the process; negative for the signal that ended it, `None` if there was no
            process.
        repeat: Which of the runs with equal settings and seed it is.
        digest: Of all events; `None` if off, or if equal runs may differ in it.
        digests: Name of an estimator to the digest of all that it has sent.
        crashes: Errors of the run's earlier tries, made from the same; a run that has crashed is
            tried again.
        sim_seconds: Seconds of the run's clock.
        run_seconds: Real seconds from the first update to the end.
        wall_seconds: Real seconds of the whole process.
        estimators: Name to figures, as the run's verdict has them.
        name: Of the run.
        inputs: Fingerprints of what estimators are fed, by output and announcement; missing if
            there are no digests.
        made_from: Key of what the run was made from.
        parts: What it was made from; in the files it stands once, under that key.
        edited: What of it changed while the run was under way, in words.
    """

    id: str
    parameters: dict[str, str]
    seed: int
    exit_code: int | None
    error: str
    passed: bool | None
    digest: str | None
    sim_seconds: float | None
    run_seconds: float | None
    wall_seconds: float | None
    estimators: dict[str, dict[str, Any]]
    repeat: NotRequired[int]
    digests: NotRequired[dict[str, str]]
    crashes: NotRequired[list[str]]
    flights: NotRequired[dict[str, dict[str, Any]]]
    workers: NotRequired[dict[str, dict[str, float | None]]]
    name: NotRequired[str]
    inputs: NotRequired[dict[str, str]]
    made_from: NotRequired[str]
    parts: NotRequired[Parts]
    edited: NotRequired[list[str]]


def crashed(job: Job, error: str) -> Row:
    """Return the row of a crashed run."""
    return Row(
        id=job.id, parameters=dict(job.settings), seed=job.seed, repeat=job.repeat, exit_code=None,
        error=error, passed=None, digest=None, sim_seconds=None, run_seconds=None,
        wall_seconds=None, estimators={},
    )  # fmt: skip


def decode_rows(text: bytes) -> dict[str, Row]:
    """Return the rows of a ``rows.jsonl`` by job; lines cut short are left out."""
    rows: dict[str, Row] = {}
    for line in text.splitlines():
        with contextlib.suppress(msgspec.MsgspecError):
            _replace(rows, msgspec.json.decode(line, type=Row))
    return rows


def _replace(rows: dict[str, Row], row: Row) -> Row:
    """Replace a job's earlier row; the new row lists that one's crash, if of the same code."""
    earlier = rows.get(row["id"])
    keys = {entry["made_from"] for entry in (earlier, row) if entry and "made_from" in entry}
    if earlier is not None and len(keys) < 2:
        crashes = earlier.get("crashes", []) + [earlier["error"]] * bool(earlier["error"])
        if crashes:
            row["crashes"] = crashes
    rows[row["id"]] = row
    return row


class Rows:
    """A file of rows, open for adding; a context manager.

    Of several rows of one job the last one counts, and knows how the earlier ones crashed. A line
    that was cut short, by a full disk or a power cut, is as if it were not there.

    Raises:
        ConfigError: Another sweep has it open.
    """

    MADE_FROM = "made_from.jsonl"

    def __init__(self, path: Path, *, fresh: bool = False) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file: IO[bytes] = path.open("a+b")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._file.close()
            raise ConfigError(
                f"{path}: expected it free, found another sweep writing it: wait for it, or name "
                "another folder with --out"
            ) from None
        if fresh:
            self._file.truncate(0)
        self._file.seek(0)
        text = self._file.read()
        self._rows = decode_rows(text)
        if text and not text.endswith(b"\n"):
            self._file.write(b"\n")
        self._made_from = path.with_name(self.MADE_FROM)
        self._parts = _decode_parts(self._made_from)

    def __enter__(self) -> Rows:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def get(self, job: Job) -> Row | None:
        """Return a job's row, finished or crashed, or `None`."""
        return self._rows.get(job.id)

    def changes(self, row: Row, now: Parts) -> list[str]:
        """Return what a run was made from that is different now, in words; nothing if it is valid.

        A run without a record, such as one of an earlier version, counts as changed.
        """
        if edited := row.get("edited"):
            return [f"{part} while it ran" for part in edited]
        parts = self._parts.get(row.get("made_from", ""))
        if parts is None:
            return ["nothing says what they were made from"]
        return changes(parts, now)

    def add(self, row: Row) -> Row:
        """Write a row, and return the row as read back."""
        if (parts := row.pop("parts", None)) is not None:
            key = row["made_from"] = key_of(parts)
            if key not in self._parts:  # before the row that refers to it
                self._parts[key] = parts
                with self._made_from.open("ab") as file:
                    file.write(b"\n" + msgspec.json.encode(_Set(key, parts)) + b"\n")
        line = msgspec.json.encode(row)
        self._file.write(line + b"\n")
        self._file.flush()
        return _replace(self._rows, msgspec.json.decode(line, type=Row))


class _Set(msgspec.Struct):
    """Line of ``made_from.jsonl``: parts of some runs."""

    key: str
    parts: Parts


def _decode_parts(path: Path) -> dict[str, Parts]:
    parts: dict[str, Parts] = {}
    for line in path.read_bytes().splitlines() if path.is_file() else ():
        with contextlib.suppress(msgspec.MsgspecError):  # cut short, or empty
            entry = msgspec.json.decode(line, type=_Set)
            parts[entry.key] = entry.parts
    return parts


class Spread(msgspec.Struct, frozen=True):
    """A figure over several runs: median, first and third quartile, least and most."""

    median: float
    first: float
    third: float
    least: float
    most: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread:
        """Summarise a value or more; quartiles are interpolated between values."""
        first, median, third = (values[0],) * 3
        if len(values) > 1:
            first, median, third = statistics.quantiles(values, n=4, method="inclusive")
        return cls(median, first, third, min(values), max(values))

    def __str__(self) -> str:
        """Return the median and, if they differ, the least and the most."""
        ends = f" ({self.least:.3g}–{self.most:.3g})" * (self.least < self.most)
        return f"{self.median:.3g}{ends}"


SPREAD = {"median": "median", "q1": "first", "q3": "third", "min": "least", "max": "most"}
"""Column of each main figure in ``summary.csv`` to field of `Spread`."""


MAIN = tuple(sorted(IN_SWEEPS, key=lambda name: figure(name).unit != "%"))
"""Main figures for readers: first the relative ones."""


class Combination(msgspec.Struct, frozen=True, kw_only=True):
    """A combination of settings and an estimator, over all seeds and repeats.

    Attributes:
        estimator: Its name; empty if no run has a verdict.
        crashed: How many of these came to nothing; no figure knows of them.
        failed: How many did not meet them.
        repeatable: Whether runs with equal settings and seed gave the same, in words; empty if
            there were no two of them.
        alignment: How its trajectories were laid on the truth, ``origin``; ``origin or sim3`` if
            the runs differ in it. Errors after different alignments are different things.
        figures: Figure to its spread, of the main ones or those asked for.
        reasons: Why runs came to nothing or missed a threshold, each with its first figures.
    """

    settings: tuple[str, ...]
    estimator: str
    alignment: str = ""
    runs: int
    crashed: int
    passed: int | None
    failed: int = 0
    repeatable: str = ""
    figures: dict[str, Spread]
    reasons: tuple[str, ...] = ()


def write_tables(plan: Plan, rows: Sequence[Row]) -> None:
    """Write the four tables into the plan's folder; rows of other plans are left out."""
    jobs = in_order(plan, rows)
    paths = [p.path for p in plan.parameters]
    head = ["run", *paths, "seed", *["repeat"] * any(job.repeat > 1 for job, _ in jobs)]
    runs: list[dict[str, Any]] = [
        {**row, "run": job.id, "repeat": job.repeat, **dict(job.settings)} for job, row in jobs
    ]
    times = ["wall_seconds", "run_seconds", "sim_seconds"]
    _write(plan.out / "timing.csv", [*head, *times], runs)
    costs = [
        {**run, "worker": name, **costs}
        for run in runs
        for name, costs in run.get("workers", {}).items()
    ]
    keys = dict.fromkeys(
        key for _, row in jobs for c in row.get("workers", {}).values() for key in c
    )
    _write(plan.out / "costs.csv", [*head, "worker", *keys], costs)
    head += ["exit_code", "error", "passed", "sim_seconds", "digest", "estimator"]
    present = {key for _, row in jobs for figures in row["estimators"].values() for key in figures}
    first = [name for name in ("alignment", *IN_SWEEPS) if name in present]
    columns = {
        name: f"estimator_{name}" if name in head else name
        for name in [*first, *sorted(present - {*first})]
    }
    table = [
        {**run, "estimator": name, **{column: figures.get(key) for key, column in columns.items()}}
        for run in runs
        for name, figures in (run["estimators"] or {"": {}}).items()
    ]
    _write(plan.out / "table.csv", [*head, *columns.values()], table)
    head = [*paths, "estimator", "alignment", "runs", "crashed", "failed", "passed", "repeatable"]
    head += [f"{name}_{statistic}" for name in IN_SWEEPS for statistic in SPREAD]
    summary = [
        {
            **msgspec.structs.asdict(combination),
            **dict(zip(paths, combination.settings, strict=True)),
            **{
                f"{name}_{statistic}": getattr(spread, field)
                for name, spread in combination.figures.items()
                for statistic, field in SPREAD.items()
            },
        }
        for combination in summarise(plan, rows)
    ]
    _write(plan.out / "summary.csv", head, summary)


def records(rows: Iterable[Row]) -> list[dict[str, Any]]:
    """Return a record for each run and estimator: what was varied, and all figures."""
    return [
        {
            **{path: value(text) for path, text in row["parameters"].items()},
            "seed": row["seed"],
            "repeat": row.get("repeat", 1),
            "estimator": name,
            "error": row["error"],
            "passed": row["passed"],
            **figures,
        }
        for row in rows
        for name, figures in (row["estimators"] or {"": {}}).items()
    ]


def plan_from(rows: Iterable[Row], out: Path) -> tuple[Plan, list[Row]]:
    """Return the plan of finished runs, without their settings, and its rows.

    Of a folder with several sweeps it is that of the runs that vary the same as the last one.
    """
    matching = [*rows]
    matching = [
        row for row in matching if row["parameters"].keys() == matching[-1]["parameters"].keys()
    ]
    jobs = [
        Job(
            id=row["id"], text="", folder="", settings=tuple(row["parameters"].items()),
            seed=row["seed"], out="", repeat=row.get("repeat", 1),
        )
        for row in matching
    ]  # fmt: skip
    return Plan(jobs=tuple(jobs), out=out), matching


def in_order(plan: Plan, rows: Iterable[Row]) -> list[tuple[Job, Row]]:
    """Return the rows of a plan's jobs, in their order."""
    by_id = {row["id"]: row for row in rows}
    return [(job, by_id[job.id]) for job in plan.jobs if job.id in by_id]


def summarise(
    plan: Plan, rows: Iterable[Row], wanted: Sequence[str] = IN_SWEEPS
) -> list[Combination]:
    """Sum up the seeds of each combination and estimator, in a stable order."""
    jobs = in_order(plan, rows)
    groups: dict[tuple[str, ...], list[Row]] = {}
    for job, row in jobs:
        groups.setdefault(tuple(text for _, text in job.settings), []).append(row)
    names = list(dict.fromkeys(name for _, row in jobs for name in row["estimators"]))
    return [
        combine(settings, name, group, wanted)
        for settings, group in groups.items()
        for name in [n for n in names if any(n in row["estimators"] for row in group)] or [""]
    ]


def numbers(values: Iterable[Any]) -> list[float]:
    """Return the numbers among the values."""
    return [float(v) for v in values if isinstance(v, int | float) and not isinstance(v, bool)]


def combine(
    settings: tuple[str, ...],
    name: str,
    group: Sequence[Row],
    wanted: Iterable[str] = IN_SWEEPS,
) -> Combination:
    """Sum up the runs of a combination for one estimator, by its name."""
    figures = [row["estimators"].get(name, {}) for row in group]
    passed = [f["passed"] for f in figures if isinstance(f.get("passed"), bool)]
    values = {figure: numbers(f.get(figure) for f in figures) for figure in wanted}
    reasons: dict[str, str] = {}
    for row, figures_of_row in zip(group, figures, strict=True):
        for reason in map(str, filter(None, [row["error"], *(figures_of_row.get("failed") or [])])):
            reasons.setdefault(reason.partition(":")[0], reason)
    return Combination(
        settings=settings, estimator=name,
        alignment=" or ".join(sorted({f["alignment"] for f in figures if f.get("alignment")})),
        runs=len(group), crashed=sum(bool(row["error"]) for row in group),
        passed=sum(passed) if passed else None, failed=passed.count(False),
        repeatable=_repeatable(name, group), reasons=tuple(reasons.values()),
        figures={figure: Spread.of(samples) for figure, samples in values.items() if samples},
    )  # fmt: skip


def _repeatable(name: str, group: Sequence[Row]) -> str:
    """Return whether an estimator gave equal outputs for equal settings and seed, as text."""
    seeds: dict[int, list[Row]] = {}
    for row in group:
        if name in row.get("digests", {}):
            seeds.setdefault(row["seed"], []).append(row)
    repeated = [rows for rows in seeds.values() if len(rows) > 1]
    if not repeated:
        return ""
    differing = [rows for rows in repeated if len({row["digests"][name] for row in rows}) > 1]
    if not differing:
        runs = sum(map(len, repeated))
        return f"{runs} of {runs} equal"
    errors = [numbers(r["estimators"][name].get("ate_percent") for r in rows) for rows in differing]
    least, most = max(
        ((min(values), max(values)) for values in errors if values),
        key=lambda ends: ends[1] - ends[0],
        default=(0.0, 0.0),
    )
    return "differs" + f": {least:.3g} to {most:.3g} %" * (most > 0)


def _write(path: Path, head: Sequence[str], lines: Iterable[Mapping[str, Any]]) -> None:
    """Write the columns of the head; what a line has besides is left out."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(head)
        writer.writerows([_cell(line.get(name)) for name in head] for line in lines)


def _cell(value: Any) -> str:
    """Return a value as a table's cell: like JSON, but texts without quotes."""
    if value is None:
        return ""
    if isinstance(value, str):
        return value
    if isinstance(value, list) and all(isinstance(v, str) for v in value):
        return "; ".join(value)
    return json.dumps(value)
