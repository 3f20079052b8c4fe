"""Sequences, worlds, conditions, systems of the study, published figures, and the plan of runs."""

from __future__ import annotations

import copy
import functools
import hashlib
import itertools
import json
import math
import tomllib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

import msgspec

from runtime.config.overrides import override
from runtime.config.reading import parse
from runtime.errors import CommandError, ConfigError, expect_known
from runtime.recorded import MotionError, MotionFile, read_motion
from runtime.run.results import write
from runtime.run.sources import content_hash, hashed
from runtime.tools import preflight
from runtime.tools.suite.plan import Entrant
from runtime.tools.sweep.plan import Job, make_job

T = TypeVar("T")

FOLDER = Path(__file__).parent
RATE = 20.0  # of the rig's cameras, for estimates of processor time
REST = 2.5  # s, before the motion


class Run(NamedTuple):
    """A run by its names; the settings of its job."""

    sequence: str
    world: str
    condition: str
    seed: int
    system: str


class Part(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A sequence, world or condition.

    Attributes:
        name: In one word.
        shows: What it is, for the page.
        set: What differs from the rig, as for ``--set``.
        sequences: Sequences flown with it; all if empty.
        worlds: Worlds flown in with it; all if empty.
        seeds: Flights of a sequence, if not that of the command.
        scan: Whether it is the world given by ``--outside``.
        why_not: Why results in this world are reported and not counted; empty if they are counted.
        judged: Whether agreement is judged under this condition, as it is under the first.
        against: Condition that this one is compared with; the first if empty.
    """

    name: str
    shows: str = ""
    judged: bool = False
    against: str = ""
    set: tuple[str, ...] = ()
    sequences: tuple[str, ...] = ()
    worlds: tuple[str, ...] = ()
    seeds: int = 0
    scan: bool = False
    why_not: str = ""


class System(Entrant, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An estimator with published figures, or one that is flown beside them.

    Attributes:
        published: Row of its published figures; empty if there are none.
        alignment: With the truth, before errors are computed; ``origin`` is by the position and
            heading of the first pose.
        final: Whose error is published: the final ``map``'s, its ``keyframes``' alone, whose share
            of the images says nothing, or, if empty, that of the poses as they came.
        set: What its flight needs to have different, as for ``--set``.
        cost_ms: Processor time of a frame, for the estimate.
        why_not: Why it is reported and not counted; empty if it is counted.
    """

    published: str = ""
    alignment: Literal["origin", "se3", "sim3"] = "se3"
    final: Literal["", "map", "keyframes"] = ""
    set: tuple[str, ...] = ()
    cost_ms: float = 50.0
    why_not: str = ""


class Study(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All parts of the study, in the order of the page.

    Attributes:
        rig: Path of the file of the carried rig; in the file relative to it.
        coverage_percent: Share of the images with a pose below which a system has failed.
        frame_ms: Processor time of a frame of the flight itself, for the estimate.
        remarks: Sections of the page before its verdicts, Markdown: what the study does not show,
            and what was decided when.
    """

    rig: str
    coverage_percent: float
    frame_ms: float
    remarks: str = ""
    sequences: tuple[Part, ...]
    worlds: tuple[Part, ...]
    conditions: tuple[Part, ...]
    systems: tuple[System, ...]

    def only(self, **names: Sequence[str]) -> Study:
        """Return a part of the study, by names of `sequences`, `worlds`, `conditions`, `systems`.

        Raises:
            CommandError: A name is unknown.
        """
        chosen = {}
        for field, selected in names.items():
            by_name = {part.name: part for part in getattr(self, field)}
            for name in selected:
                message = f"--{field}: expected some of {', '.join(by_name)}, found {name}"
                expect_known(name, by_name, message, CommandError)
            chosen[field] = tuple(p for n, p in by_name.items() if not selected or n in selected)
        return msgspec.structs.replace(self, **chosen)


class PublishedTable(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A table of a paper."""

    source: str
    shows: str
    sequences: str
    rows: dict[str, str]


class Published(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Published errors, by table."""

    tables: tuple[PublishedTable, ...]

    def errors(self) -> dict[str, dict[str, float]]:
        """Return errors (m) by row and sequence; infinite for a failure, missing if unknown.

        Raises:
            ConfigError: A row has more or fewer words than its table has sequences.
        """
        rows: dict[str, dict[str, float]] = {}
        for table in self.tables:
            names = table.sequences.split()
            for row, text in table.rows.items():
                columns = text.split()
                if len(columns) != len(names):
                    raise ConfigError(
                        f"published.toml: {row}: expected {len(names)} words, found {len(columns)}"
                    )
                pairs = zip(names, columns, strict=True)
                rows[row] = {n: math.inf if w == "x" else float(w) for n, w in pairs if w != "-"}
        return rows

    def by_system(self, study: Study) -> dict[str, dict[str, float]]:
        """Return errors (m) by the system, of those that have a row, and sequence.

        Raises:
            ConfigError: A system names a row that is not there.
        """
        rows = self.errors()
        named = {system.name: system.published for system in study.systems if system.published}
        for name, row in named.items():
            expected = f"{name}: published: expected a row of published.toml, found {row}"
            expect_known(row, rows, expected, ConfigError)
        return {name: rows[row] for name, row in named.items()}


def read_study(path: Path = FOLDER / "study.toml") -> Study:
    """Read a study; raise `ConfigError` if something in it is wrong."""
    study = _read(path, Study)
    _check(study, path)
    return msgspec.structs.replace(study, rig=str(path.resolve().parent / study.rig))


def _check(study: Study, path: Path) -> None:
    """Raise `ConfigError` if a name stands twice, or one that is spoken of does not stand there."""
    kinds: dict[str, tuple[Part | System, ...]] = {
        "sequences": study.sequences,
        "worlds": study.worlds,
        "conditions": study.conditions,
        "systems": study.systems,
    }
    for kind, parts in kinds.items():
        counts = Counter(part.name for part in parts)
        if twice := [name for name, count in counts.items() if count > 1]:
            raise ConfigError(f"{path}: {kind}: expected each name once, found twice {twice[0]}")
        if not parts:
            raise ConfigError(f"{path}: {kind}: expected at least one, found none")
    for part in (*study.worlds, *study.conditions):
        spoken_of = {"sequences": part.sequences, "worlds": part.worlds}
        if part.against:
            spoken_of["conditions"] = (part.against,)
        for kind, selected in spoken_of.items():
            names = [other.name for other in kinds[kind]]
            for name in selected:
                field = "against" if kind == "conditions" else kind
                message = (
                    f"{path}: {part.name}: {field}: expected of {', '.join(names)}, found {name}"
                )
                expect_known(name, names, message, ConfigError)


def read_published(path: Path = FOLDER / "published.toml") -> Published:
    """Read published figures; raise `ConfigError` if something in them is wrong."""
    return _read(path, Published)


def _read(path: Path, kind: type[T]) -> T:
    try:
        return msgspec.toml.decode(path.read_bytes(), type=kind)
    except OSError as error:
        raise ConfigError(f"{path}: expected a readable file, found: {error.strerror}") from None
    except (msgspec.MsgspecError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"{path}: {error}") from None


def truths(folder: Path | None, sequences: Iterable[Part]) -> dict[str, Path]:
    """Return the files of the sequences' ground truth, by the sequence.

    A file belongs to a sequence if its name, or that of a folder around it, begins with that of
    the sequence; of several the CSV in EuRoC's layout counts, then the first by name.

    Raises:
        CommandError: There is no such folder.
    """
    if folder is None:
        return {}
    if not folder.is_dir():
        raise CommandError(f"--truth: expected a folder, found {folder}")
    files = sorted(
        (path for path in folder.resolve().rglob("*") if path.suffix in {".csv", ".txt", ".tum"}),
        key=lambda path: (path.suffix != ".csv", "original" in path.name, str(path)),
    )
    paths: dict[str, Path] = {}
    for path in files:
        words = [*path.relative_to(folder.resolve()).parent.parts, path.name]
        if "mav0" in words and "state_groundtruth_estimate0" not in words:
            continue  # other sensors of a whole data set
        for part in sequences:
            if any(word.startswith(part.name) for word in words):
                paths.setdefault(part.name, path)
    return paths


class Planned(msgspec.Struct, frozen=True, kw_only=True):
    """Runs to fly, and those that cannot be flown.

    Attributes:
        jobs: Job of each run to fly, in the order to fly them.
        data: Hash of the truth, and of the scan, by sequence and world, as far as they are there.
        absent: Why runs are left out, with how many, in words.
        finished: How many are finished already.
        seconds: Length of each sequence, with the rest before it.
    """

    jobs: dict[Run, Job]
    data: dict[tuple[str, str], str]
    absent: dict[str, int]
    finished: int
    seconds: dict[str, float]

    def hours(self, study: Study) -> float:
        """Return an estimate of the processor hours of the runs and their flights."""
        systems = {system.name: system for system in study.systems}
        frames = {run: self.seconds[run.sequence] * RATE for run in self.jobs}
        flights = {(*run[:4], systems[run.system].set): frames[run] for run in self.jobs}
        flown = sum(flights.values()) * study.frame_ms
        return (flown + sum(frames[r] * systems[r.system].cost_ms for r in frames)) / 3.6e6

    def flights(self, study: Study) -> int:
        """Return how many flights the runs need; systems share them."""
        systems = {system.name: system for system in study.systems}
        return len({(*run[:4], systems[run.system].set) for run in self.jobs})


def runs_of(study: Study, seeds: int | None) -> Iterator[Run]:
    """Yield all runs of a study, those first that say most: conditions, then seeds, then worlds."""
    most = max([seeds or 0, *(part.seeds or 3 for part in study.sequences)])
    for condition, seed, world, sequence in itertools.product(
        study.conditions, range(1, most + 1), study.worlds, study.sequences
    ):
        fits = sequence.name in (world.sequences or [sequence.name])
        fits &= sequence.name in (condition.sequences or [sequence.name])
        fits &= world.name in (condition.worlds or [world.name])
        if fits and seed <= (seeds or sequence.seeds or 3):
            for system in sorted(study.systems, key=lambda system: system.set):  # by flight
                yield Run(sequence.name, world.name, condition.name, seed, system.name)


def keys_of(study: Study, seeds: int | None = None) -> dict[Run, str]:
    """Return the key of the settings of each run, in the order to fly them."""
    folder = Path(study.rig).parent
    return {run: key_of(table_of(study, run), folder) for run in runs_of(study, seeds)}


def make_plan(
    study: Study,
    keys: Mapping[Run, str],
    *,
    out: Path,
    truth: Mapping[str, Path],
    outside: Path | None = None,
    wanted: Callable[[Run, str], bool] = lambda *_: True,
) -> Planned:
    """Plan runs, and say which of them cannot be flown, and why.

    Args:
        keys: The runs.
        truth: File of the ground truth of each sequence.
        outside: File of the scan for the world that is one.
        wanted: Whether a run is to be flown, by the hash of its data.

    Raises:
        ConfigError: Something in it has settings that do not exist.
    """
    folder = Path(study.rig).parent
    systems = {system.name: system for system in study.systems}
    scans = {world.name for world in study.worlds if world.scan}
    installed = {name: system.installed(folder) for name, system in systems.items()}
    fits = _Fits(out / "fits.json")
    scan = f"+{_hash(outside, '--outside')}" if outside else ""
    data, seconds = {}, {}
    for name, path in truth.items():
        stamps = read_motion(MotionFile(path=str(path), axes="nwu")).stamps
        seconds[name] = float(stamps[-1] - stamps[0]) / 1e9 + REST
        for world in study.worlds:
            if not world.scan or scan:
                data[name, world.name] = _hash(path, "--truth") + scan * world.scan
    jobs: dict[Run, Job] = {}
    absent: Counter[str] = Counter()
    finished = 0
    for run in keys:
        table = table_of(study, run)
        if run.sequence not in truth:
            absent[f"{run.sequence}: no file of its truth in the folder of --truth"] += 1
            continue
        if run.world in scans and outside is None:
            absent[f"{run.world}: no scan is given by --outside"] += 1
            continue
        if not wanted(run, data[run.sequence, run.world]):
            finished += 1
            continue
        if not installed[run.system]:
            absent[f"{run.system}: not installed ({systems[run.system].install})"] += 1
            continue
        override(table, f"drone.trajectory={json.dumps(str(truth[run.sequence]))}")
        if run.world in scans and outside:
            override(table, f"drone.world={json.dumps(str(outside.resolve()))}")
        if reason := fits.misfit(table, run, data[run.sequence, run.world], folder):
            absent[reason] += 1
            continue
        settings = tuple(zip(Run._fields, map(str, run), strict=True))
        jobs[run] = make_job(parse(table, study.rig, folder), settings, run.seed, folder, out)
    return Planned(jobs=jobs, data=data, absent=dict(absent), finished=finished, seconds=seconds)


def _hash(path: Path, option: str) -> str:
    if not path.is_file():
        raise CommandError(f"{option}: expected a file, found {path}")
    return content_hash(path)[:8]


def table_of(study: Study, run: Run) -> dict[str, Any]:
    """Return the settings of a run, as they would stand in a file, without its files."""
    try:
        table = copy.deepcopy(_loads(Path(study.rig).read_text(encoding="utf-8")))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{study.rig}: expected a TOML file of a rig, found: {error}") from None
    system = next(system for system in study.systems if system.name == run.system)
    parts = [
        part
        for parts, name in zip((study.sequences, study.worlds, study.conditions), run, strict=False)
        for part in parts
        if part.name == name
    ]
    for change in [*(c for part in parts for c in part.set), *system.set]:
        override(table, change)
    override(table, f'drone.trajectory="{run.sequence}"')
    evaluation = {"alignment": system.alignment, "image_count": 0}
    table["nodes"] += [
        copy.deepcopy({"name": system.name, **system.node}),
        {"name": "evaluation", "type": "Evaluation", **evaluation},
    ]
    return table


@functools.cache
def _loads(text: str) -> dict[str, Any]:
    return tomllib.loads(text)


def key_of(table: Mapping[str, Any], folder: Path) -> str:
    """Return the key of a run's settings: equal on all machines, whatever their folders.

    Settings as they stand in the files, without defaults, and the content of templates. Code and
    ground truth are no part of it: rows have their commit, and the hash of their data.
    """
    files = [file for node in table["nodes"] for file in node.get("files", ())]
    texts = [content_hash(folder / file["template"]) for file in files]
    settings = json.dumps(table, sort_keys=True, default=str)
    return hashlib.sha256(hashed([settings, *texts]).encode()).hexdigest()[:12]


class _Fits:
    """Cache, in a file, of whether motions fit into worlds: a check takes 10 s."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._reasons: dict[str, str] = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            self._reasons = {}

    def misfit(self, table: Mapping[str, Any], run: Run, data: str, folder: Path) -> str:
        """Return why a motion does not fit into a world; empty if it does."""
        (vehicle,) = (copy.deepcopy(n) for n in table["nodes"] if n["name"] == "drone")
        vehicle["cameras"] = [{**eye, "calibration_error": False} for eye in vehicle["cameras"]]
        reduced = {**vehicle, "cameras": "", "trajectory": "", "imu": "", "world": run.world}
        name = hashed([data, json.dumps(reduced, sort_keys=True, default=str)])
        if name not in self._reasons:
            config = {"run": table["run"], "nodes": [vehicle]}
            try:
                errors = preflight.of_nodes(parse(config, "rig.toml", folder)).errors
            except MotionError as error:
                errors = [str(error)]
            self._reasons[name] = errors[0] if errors else ""
            self._path.parent.mkdir(parents=True, exist_ok=True)
            write(self._path, json.dumps(self._reasons, indent=1).encode())
        reason = self._reasons[name]
        return f"{run.sequence} in {run.world}: {reason}" if reason else ""
