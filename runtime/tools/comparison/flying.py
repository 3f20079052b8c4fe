"""Flights of a comparison: flown until all is decided, or read from folders of finished sweeps."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from runtime.config.reading import load_configuration
from runtime.errors import ConfigError
from runtime.figures import FIGURES
from runtime.run.results import newest, write
from runtime.tools.comparison.page import change, write_page
from runtime.tools.comparison.statistics import (
    USUAL,
    Comparison,
    Key,
    compare_rows,
    compare_until_sure,
)
from runtime.tools.sweep import Plan, Row, make_job, run_here, sharing
from runtime.tools.sweep.plan import Parameter
from runtime.tools.sweep.process import Ended
from runtime.tools.sweep.tables import decode_rows

Fly = Callable[[Plan], Sequence[Row]]  # carries out a plan: returns a row for each of its jobs

Looks = dict[str, list[int]]
"""Numbers of flights that were looked at, by what was compared; kept for later calls."""


class Compared(msgspec.Struct, frozen=True):
    """Result of a comparison.

    Attributes:
        margin: Largest change that does not matter, as `Comparison.change`.
        page: ``compare.html``, with a line from A to B for each flight.
    """

    rows: list[Comparison]
    margin: float
    page: Path

    @property
    def worse(self) -> bool:
        """Whether a figure is worse; with a margin, whether one may be worse by more than that."""
        return any(each.fails(self.margin) for each in self.rows)

    def __repr__(self) -> str:
        told = [f"{e.estimator} {e.figure}: {change(e)}, {e.words}" for e in self.rows]
        return "\n".join([*told, f"page: {self.page}"])


def compare(
    what: Sequence[Path],
    a: Sequence[str] = (),
    b: Sequence[str] = (),
    *,
    seeds: int = 12,
    repeats: int = 1,
    figures: Sequence[str] = (),
    margin: float = 0.0,
    overrides: Sequence[str] = (),
    out: Path = Path("compared"),
    fly: Fly = run_here,
) -> Compared:
    """Compare two versions of the same files, or two folders, and write the page.

    Args:
        what: Files, one a scenario; or two folders of finished sweeps or runs.
        figures: `USUAL` if none.

    Raises:
        ConfigError: A file, a folder, a setting or a figure is wrong.
    """
    for each in figures:
        if each not in FIGURES:
            raise ConfigError(f"--figure {each}: expected one of {', '.join(FIGURES)}")
    options: dict[str, Any] = {"figures": figures or USUAL, "margin": margin}
    if all(path.is_dir() for path in what):
        if len(what) != 2 or a or b:
            raise ConfigError("compare: expected two folders, without --a and --b")
        found = compare_rows(*map(read_folder, what), **options)
    else:
        if not (a or b):
            raise ConfigError("compare: expected --a or --b: in what the two sides differ")
        found = _fly(what, (a, b), seeds, repeats, overrides, out.absolute(), fly, options)
    page = write_page(found, out, list(a) or [str(what[0])], list(b) or [str(what[-1])])
    return Compared(found, margin, page)


def _fly(
    files: Sequence[Path],
    changes: tuple[Sequence[str], Sequence[str]],
    seeds: int,
    repeats: int,
    overrides: Sequence[str],
    out: Path,
    fly: Fly,
    options: Mapping[str, Any],
) -> list[Comparison]:
    first: dict[Path, int] = {}
    planned = []
    for file, (side, own) in itertools.product(files, zip("AB", changes, strict=True)):
        config = load_configuration(file, [*overrides, *own])
        first.setdefault(file, config.run.seed)
        settings = (("side", side), ("scenario", file.stem))
        numbers = range(first[file], first[file] + seeds), range(1, repeats + 1)
        for seed, number in itertools.product(*numbers):
            planned.append(make_job(config, settings, seed, file.resolve().parent, out, number))
    begin = {file.stem: seed for file, seed in first.items()}
    if len(begin) < len(first):
        raise ConfigError(f"compare: expected files of different names, found {[*map(str, files)]}")
    parameters = (
        Parameter(path="side", texts=("A", "B")),
        Parameter(path="scenario", texts=tuple(begin)),
    )

    def compare_first(flights: int, error: float) -> list[Comparison]:
        now = [
            job
            for job in sharing(planned)
            if job.seed < begin[dict(job.settings)["scenario"]] + flights
        ]
        rows = fly(Plan(parameters=parameters, jobs=tuple(now), out=out))
        sides: dict[str, dict[Key, list[Row]]] = {"A": {}, "B": {}}
        for job, row in zip(now, rows, strict=True):
            (_, side), (_, scenario) = job.settings
            sides[side].setdefault((scenario, job.seed), []).append(row)
        return compare_rows(sides["A"], sides["B"], error=error, **options)

    same = sorted(j.id for j in planned if j.seed == begin[dict(j.settings)["scenario"]])
    key = hashlib.sha256(" ".join(same).encode()).hexdigest()[:16]
    file = out / "looks.json"
    looks = msgspec.json.decode(file.read_bytes(), type=Looks) if file.is_file() else {}
    found = compare_until_sure(compare_first, seeds, looks.setdefault(key, []))
    write(file, msgspec.json.encode(looks))
    return found


def read_folder(folder: Path) -> dict[Key, list[Row]]:
    """Read the rows of a finished sweep or run by flight; or raise `ConfigError`."""
    found: dict[Key, list[Row]] = {}
    if (folder / "rows.jsonl").is_file():
        for row in decode_rows((folder / "rows.jsonl").read_bytes()).values():
            settings = " ".join(f"{path}={text}" for path, text in row["parameters"].items())
            found.setdefault((settings or "run", row["seed"]), []).append(row)
        return found
    try:
        data = (newest(folder) / "summary.json").read_bytes()
        ended = msgspec.json.decode(data, type=Ended)
        head = msgspec.json.decode(data)
    except (OSError, msgspec.MsgspecError) as error:
        raise ConfigError(
            f"{folder}: expected the folder of a sweep (rows.jsonl) or of a run, found: {error}"
        ) from None
    verdict = ended.verdict
    row = Row(
        id="", parameters={}, seed=head["seed"], exit_code=0, error=head.get("error") or "",
        passed=verdict.passed if verdict else None, digest=None, sim_seconds=ended.sim_seconds,
        run_seconds=None, wall_seconds=None, estimators=verdict.estimators if verdict else {},
    )  # fmt: skip
    return {("run", head["seed"]): [row]}
