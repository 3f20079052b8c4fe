"""Flights of a comparison: flown until all is decided, or read from folders of finished sweeps.

Its page has a table, and each flight as a line from A to B.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import io
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from runtime.config.explain import show
from runtime.config.reading import load_configuration
from runtime.errors import ConfigError, ResultsError
from runtime.figures import FIGURES, figure
from runtime.run.results import newest, write
from runtime.tools.comparison.statistics import (
    USUAL,
    Comparison,
    Key,
    Word,
    compare_rows,
    compare_until_sure,
)
from runtime.tools.sweep import Job, Plan, Row, make_plan, plan_of, run_here
from runtime.tools.sweep.console import listed
from runtime.tools.sweep.plots import decades, template
from runtime.tools.sweep.process import Ended, add_inputs
from runtime.tools.sweep.tables import decode_rows

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COMPARISONS = "compare.json"
"""Name of the file of a comparison's rows, beside its page."""

Fly = Callable[[Plan], Sequence[Row]]  # carries out a plan: returns a row for each of its jobs

Looks = dict[str, list[int]]
"""Numbers of flights that were looked at, by what was compared; kept for later calls."""


class Compared(msgspec.Struct, frozen=True):
    """Result of a comparison.

    Attributes:
        margin: Largest change that does not matter, as `Comparison.change`.
        page: ``compare.html``, with a line from A to B for each flight.
        notes: Sentences on pairs that are not the same flight.
    """

    rows: list[Comparison]
    margin: float
    page: Path
    notes: tuple[str, ...] = ()

    @property
    def worse(self) -> bool:
        """Return whether a figure is worse; with a margin, whether one may be by more than that."""
        return any(row.fails(self.margin) for row in self.rows)

    def __repr__(self) -> str:
        lines = [f"{e.estimator} {e.figure}: {e.interval}, {e.words}" for e in self.rows]
        return "\n".join([*lines, *self.notes, f"page: {self.page}"])


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
        ConfigError: A file, a folder, a setting or a figure is wrong, or two folders are of other
            flights.
    """
    for name in figures:
        if name not in FIGURES:
            raise ConfigError(f"--figure {name}: expected one of {', '.join(FIGURES)}")
    options: dict[str, Any] = {"figures": figures or USUAL, "margin": margin}
    notes: list[str] = []
    if all(path.is_dir() for path in what):
        if len(what) != 2 or a or b:
            raise ConfigError("compare: expected two folders, without --a and --b")
        sides = [read_folder(path) for path in what]
        notes += check_flights(*sides, whole=False)
        notes += [*_edited(zip("AB", sides, strict=True))]
        rows = compare_rows(*sides, **options)
    else:
        if not (a or b):
            raise ConfigError("compare: expected --a or --b: in what the two sides differ")
        rows = _fly(what, (a, b), seeds, repeats, overrides, out.absolute(), fly, options, notes)
    names = list(a) or [str(what[0])], list(b) or [str(what[-1])]
    page = write_page(rows, out, *names, notes)
    return Compared(rows, margin, page, tuple(notes))


def _fly(
    files: Sequence[Path],
    changes: tuple[Sequence[str], Sequence[str]],
    seeds: int,
    repeats: int,
    overrides: Sequence[str],
    out: Path,
    fly: Fly,
    options: Mapping[str, Any],
    notes: list[str],
) -> list[Comparison]:
    first_seeds: dict[str, int] = {}  # first seed by scenario
    planned: list[Job] = []
    for file in files:
        seed = first_seeds[file.stem] = load_configuration(file, [*overrides, *changes[0]]).run.seed
        for side, side_changes in zip("AB", changes, strict=True):
            equal = [*overrides, *side_changes, f"run.seed={seed}"]
            flown = make_plan(file, overrides=equal, seeds=seeds, repeats=repeats, out=out)
            settings = (("side", side), ("scenario", file.stem))
            planned += [msgspec.structs.replace(job, settings=settings) for job in flown.jobs]
    if len(first_seeds) < len({*files}):
        raise ConfigError(f"compare: expected files of different names, found {[*map(str, files)]}")
    plan = plan_of(planned, out)

    flights_by_key: dict[Key, set[str]] = {}
    for job in planned:
        flights_by_key.setdefault((dict(job.settings)["scenario"], job.seed), set()).add(job.flight)
    changed = {key for key, settings in flights_by_key.items() if len(settings) > 1}

    def compare_first(flights: int, error: float) -> list[Comparison]:
        jobs = [
            j for j in plan.jobs if j.seed < first_seeds[dict(j.settings)["scenario"]] + flights
        ]
        rows = fly(msgspec.structs.replace(plan, jobs=tuple(jobs)))
        sides: dict[str, dict[Key, list[Row]]] = {"A": {}, "B": {}}
        for job, row in zip(jobs, rows, strict=True):
            (_, side), (_, scenario) = job.settings
            sides[side].setdefault((scenario, job.seed), []).append(row)
        notes[:] = check_flights(*(_unchanged(runs, changed) for runs in sides.values()))
        return compare_rows(sides["A"], sides["B"], error=error, **options)

    same = sorted(j.id for j in planned if j.seed == first_seeds[dict(j.settings)["scenario"]])
    key = hashlib.sha256(" ".join(same).encode()).hexdigest()[:16]
    file = out / "looks.json"
    looks = msgspec.json.decode(file.read_bytes(), type=Looks) if file.is_file() else {}
    comparisons = compare_until_sure(compare_first, seeds, looks.setdefault(key, []))
    write(file, msgspec.json.encode(looks))
    return comparisons


def _unchanged(side: Mapping[Key, list[Row]], changed: set[Key]) -> dict[Key, list[Row]]:
    """Return the runs of flights that the settings of A and B do not change themselves."""
    return {key: rows for key, rows in side.items() if key not in changed}


def check_flights(
    a: Mapping[Key, Sequence[Row]], b: Mapping[Key, Sequence[Row]], *, whole: bool = True
) -> list[str]:
    """Return sentences on pairs of runs whose estimators were fed something else.

    Equal seeds and settings are not enough: code, worlds and pilots may have changed.

    Args:
        whole: Whether both sides are of the same files and code, so that those without fingerprints
            are no reason to doubt.

    Raises:
        ConfigError: The runs have other names, too: they are of different scenarios.
    """
    differing: dict[Key, list[str]] = {}
    unknown = []
    for key in [key for key in a if key in b]:
        (name, inputs_a), (other_name, inputs_b) = _inputs(a[key]), _inputs(b[key])
        if inputs_a is None or inputs_b is None:
            unknown += [key] * all(not row["error"] for row in (*a[key], *b[key]))
        elif names := sorted(
            n for n in {*inputs_a, *inputs_b} if inputs_a.get(n) != inputs_b.get(n)
        ):
            differing[key] = names
            if name != other_name:
                raise ConfigError(
                    f"compare: expected two sides of the same flights, found {show(name)} and "
                    f"{show(other_name)} with seed {key[1]}, in which {_some(names)} differ"
                )
    common = sum(key in b for key in a)
    notes = []
    if differing:
        names = list(dict.fromkeys(name for parts in differing.values() for name in parts))
        notes.append(
            f"{len(differing)} of {common} flights are not the same for A and B: {_some(names)} "
            "differ; what is compared is of different flights"
        )
    if unknown and not whole:
        notes.append(
            f"whether {len(unknown)} of {common} flights are the same for A and B is not known: "
            "there are no fingerprints of their inputs"
        )
    return notes


def _edited(sides: Iterable[tuple[str, Mapping[Key, Sequence[Row]]]]) -> Iterator[str]:
    """Yield a sentence for a side of which files were edited while its runs were under way."""
    for side, runs in sides:
        edited = [row["edited"] for rows in runs.values() for row in rows if row.get("edited")]
        if edited:
            changes = listed(dict.fromkeys(change for parts in edited for change in parts))
            yield f"{len(edited)} runs of {side} are of a mixture: {changes} while they ran"


def _inputs(rows: Sequence[Row]) -> tuple[str, dict[str, str] | None]:
    """Return name and fingerprints of the inputs of the first run that has some."""
    inputs = [(row.get("name", ""), row.get("inputs")) for row in rows if not row["error"]]
    return next((entry for entry in inputs if entry[1] is not None), ("", None))


def _some(names: Sequence[str]) -> str:
    more = len(names) - 3
    return ", ".join(names[:3]) + f" and {more} more" * (more > 0)


def read_folder(folder: Path) -> dict[Key, list[Row]]:
    """Read the rows of a finished sweep or run by flight; or raise `ConfigError`."""
    flights: dict[Key, list[Row]] = {}
    if (folder / "rows.jsonl").is_file():
        for row in decode_rows((folder / "rows.jsonl").read_bytes()).values():
            settings = " ".join(f"{path}={text}" for path, text in row["parameters"].items())
            if "inputs" not in row:  # of an earlier version
                with contextlib.suppress(OSError, msgspec.MsgspecError):
                    add_inputs(row, _ended(folder / "runs" / row["id"]))
            flights.setdefault((settings or "run", row["seed"]), []).append(row)
        return flights
    try:
        ended = _ended(newest(folder))
    except (OSError, msgspec.MsgspecError) as error:
        raise ConfigError(
            f"{folder}: expected the folder of a sweep (rows.jsonl) or of a run, found: {error}"
        ) from None
    verdict = ended.verdict
    row = Row(
        id="", parameters={}, seed=ended.seed, exit_code=0, error=ended.error or "",
        passed=verdict.passed if verdict else None, digest=None, sim_seconds=ended.sim_seconds,
        run_seconds=None, wall_seconds=None, estimators=verdict.estimators if verdict else {},
    )  # fmt: skip
    add_inputs(row, ended)
    return {("run", ended.seed): [row]}


def _ended(folder: Path) -> Ended:
    return msgspec.json.decode((folder / "summary.json").read_bytes(), type=Ended)


COLOURS = {
    "better": "#1a7f37",
    "worse": "#b3261e",
    "identical": "#5c646c",
    "no difference": "#5c646c",
    "not enough runs": "#9a6700",
    "not comparable": "#9a6700",
}


def write_page(
    comparisons: Sequence[Comparison],
    out: Path,
    a: Sequence[str],
    b: Sequence[str],
    notes: Sequence[str] = (),
) -> Path:
    """Write ``compare.html`` and its rows as ``compare.json`` into a folder, made if missing.

    Returns:
        Path of the page.
    """
    out.mkdir(parents=True, exist_ok=True)
    text = msgspec.json.encode(comparisons)
    write(out / COMPARISONS, msgspec.json.format(text, indent=2) + b"\n")
    image = io.BytesIO()
    draw_slopes(comparisons).savefig(image, format="png", dpi=120, metadata={"Software": None})
    page = template(Path(__file__).with_name("page.html.jinja")).render(
        sides=[(side, " ".join(changes)) for side, changes in (("A", a), ("B", b)) if changes],
        comparisons=comparisons,
        notes=notes,
        figure=figure,
        image=base64.b64encode(image.getvalue()).decode(),
    )
    path = out / "compare.html"
    write(path, page.encode())
    return path


class Slopes(msgspec.Struct, frozen=True):
    """Drawn part of a `Comparison`: JSON has no infinity, which a change may be."""

    estimator: str
    figure: str
    verdict: Word
    flights: dict[str, tuple[float | None, float | None]]


def read_slopes(folder: Path) -> list[Slopes]:
    """Read a comparison from its folder, to draw it. Raises `ResultsError`."""
    path = folder / COMPARISONS
    try:
        return msgspec.json.decode(path.read_bytes(), type=list[Slopes])
    except (OSError, msgspec.MsgspecError) as error:
        raise ResultsError(f"{path}: expected what compare writes, found: {error}") from None


def draw_slopes(comparisons: Sequence[Comparison | Slopes]) -> Figure:
    """Draw each flight as a line from A to B, a panel for each figure."""
    from matplotlib.figure import Figure

    columns = min(max(len(comparisons), 1), 4)
    height = math.ceil(max(len(comparisons), 1) / columns)
    sheet = Figure(figsize=(2.9 * columns, 3.4 * height), layout="constrained")
    handles: dict[str, Any] = {}
    several = len({comparison.estimator for comparison in comparisons}) > 1
    for index, comparison in enumerate(comparisons, 1):
        axes: Any = sheet.add_subplot(height, columns, index)
        values = [v for pair in comparison.flights.values() for v in pair if v is not None]
        most = max(values, default=1.0)
        failed = most * 1.6 if figure(comparison.figure).limit != "least" else 0.0
        scenarios = list(dict.fromkeys(name.rpartition(",")[0] for name in comparison.flights))
        for name, pair in comparison.flights.items():
            ends = [failed if value is None else value for value in pair]
            scenario = name.rpartition(",")[0]
            colour = f"C{scenarios.index(scenario) % 10}"
            handles[scenario], *_ = axes.plot([0, 1], ends, "-", color=colour, alpha=0.6, lw=1.2)
            for place, value in enumerate(pair):
                mark = "x" if value is None else "o"
                axes.plot(place, ends[place], mark, color=colour, ms=6 if mark == "x" else 4)
        if values and failed > 0 and decades(values):
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter("{x:g}")
        axes.set_xticks([0, 1], ["A", "B"])
        axes.set_xlim(-0.25, 1.25)
        title = f"{comparison.estimator}\n" * several + f"{comparison.figure}\n{comparison.verdict}"
        axes.set_title(title, fontsize=9, color=COLOURS[comparison.verdict])
        axes.grid(alpha=0.3, axis="y")
    if len(handles) > 1:
        sheet.legend(handles.values(), handles, loc="outside lower center", fontsize=8, ncols=4)
    return sheet
