"""Runs of a sweep, all checked before the first starts.

Arguments of ``--vary``: a setting and its values, and their places on an axis.
"""

from __future__ import annotations

import hashlib
import itertools
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import tomli_w

from runtime.config.model import Config, to_builtins
from runtime.config.overrides import parse_value
from runtime.config.reading import load_configuration
from runtime.errors import ConfigError
from runtime.run.made_from import RUN, Roots, roots_of
from runtime.tools import flights
from runtime.tools.flights import flight_of, settings_key
from runtime.units import Duration

_CLOSING = {"[": "]", "{": "}"}


class Parameter(msgspec.Struct, frozen=True):
    """A setting varied by a sweep.

    Attributes:
        texts: Its values as they were written, each as ``--set`` takes it.
    """

    path: str
    texts: tuple[str, ...]


class Axis(msgspec.Struct, frozen=True):
    """Positions of a parameter's values in a plot.

    Attributes:
        places: One for each value, in the order of the values.
        unit: Of the places; empty if they have none.
        words: Whether the values have no place of their own, and just follow one another.
    """

    places: tuple[float, ...]
    unit: str = ""
    words: bool = False


def parameter(change: str) -> Parameter:
    """Read ``PATH=V1,V2,…``; raise `ConfigError` for all else, or a value parse_value twice."""
    path, equals, text = change.partition("=")
    where = f"--vary {change}"
    if not equals or not path.strip():
        raise ConfigError(f"{where}: expected PATH=V1,V2,…, found no path with values")
    texts = split(text, where)
    for index, one in enumerate(texts):
        if one in texts[:index]:
            raise ConfigError(f"{where}: expected different values, found {one} a second time")
    return Parameter(path.strip(), texts)


def split(text: str, where: str) -> tuple[str, ...]:
    """Split values at commas outside brackets and quotes.

    A quote opens a text where a value begins; in the middle of a bare word it is a letter.

    Raises:
        ConfigError: A value is empty, or a bracket or quote is not closed; `where` begins the
            message.
    """
    pieces = [""]
    expected: list[str] = []  # what closes the brackets and the quote that are open
    letters = iter(text)
    for letter in letters:
        inside = expected[-1] if expected else ""
        if letter == "," and not expected:
            pieces.append("")
            continue
        pieces[-1] += letter
        if inside in {'"', "'"}:
            if letter == inside:
                expected.pop()
            elif letter == "\\" and inside == '"':
                pieces[-1] += next(letters, "")
        elif letter == inside:
            expected.pop()
        elif letter in _CLOSING:
            expected.append(_CLOSING[letter])
        elif letter in {'"', "'"} and (expected or pieces[-1].strip() == letter):
            expected.append(letter)
    if expected:
        raise ConfigError(f"{where}: expected a closing {expected[-1]}, found the end")
    values = tuple(piece.strip() for piece in pieces)
    if not all(values):
        raise ConfigError(f'{where}: expected a value between commas, found none ("" is a text)')
    return values


def value(text: str) -> Any:
    """Return the TOML value of a text, or else the text itself, as for ``--set``."""
    try:
        return parse_value(text)
    except ValueError:  # which reading the settings refuses
        return text.strip()


def axis(texts: Sequence[str]) -> Axis:
    """Place values on an axis: numbers and durations by size, all else in sequence."""
    values = [value(text) for text in texts]
    if all(type(v) in {int, float} and math.isfinite(v) for v in values):
        return Axis(tuple(float(v) for v in values))
    try:
        seconds = [Duration.parse(v) for v in values]
    except ValueError:
        return Axis(tuple(float(index) for index in range(len(values))), words=True)
    longest = max(seconds, default=0.0)
    unit, scale = ("s", 1.0) if longest >= 1 else ("ms", 1e3) if longest >= 1e-3 else ("µs", 1e6)
    return Axis(tuple(s * scale for s in seconds), unit)


LEAST_LIMIT, SLOWEST, USUAL = 600.0, 30.0, 120.0
"""Time limit of a run: base (real s), factor per second, default duration (s).

A run beyond its limit hangs.
"""


class Job(msgspec.Struct, frozen=True, kw_only=True):
    """A run of a sweep, with all data for another machine to run the job.

    Attributes:
        id: Of these settings, this seed and this repeat, in this sweep or any other.
        text: The settings as TOML, defaults and seed included.
        folder: Of the file that they come from; modules of its nodes are looked for there.
        settings: What is varied, as path and value, in the order of the parameters.
        seed: Of the run's random numbers.
        flight: Equal for runs with equal flights, if these can be recorded; else empty, and it is
            flown by the run itself.
        record: Whether its flight is worth recording; else it is used if there is one.
        limit: Real seconds that it may take.
        repeat: The how manieth run with these settings and this seed; they differ if something
            in it does not depend on these alone.
        out: Absolute path of the folder for the run's results.
        roots: Where the parts begin that it is made from; a finished run is valid as long as these
            do not change.
    """

    id: str
    text: str
    folder: str
    settings: tuple[tuple[str, str], ...]
    seed: int
    out: str
    flight: str = ""
    record: bool = False
    limit: float = LEAST_LIMIT
    repeat: int = 1
    roots: Roots = Roots()

    def __str__(self) -> str:
        """Return settings, seed and repeat as a text, unique in the sweep."""
        words = [*(f"{path}={text}" for path, text in self.settings), f"seed={self.seed}"]
        return " ".join(words + [f"repeat={self.repeat}"] * (self.repeat > 1))


class Plan(msgspec.Struct, frozen=True, kw_only=True):
    """A whole sweep.

    Attributes:
        jobs: All runs: the first parameter changes slowest, then the seed, the repeat quickest.
        out: Absolute path of the folder for everything.
    """

    jobs: tuple[Job, ...]
    out: Path

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Varied parameters, with their values in the order of the jobs."""
        texts: dict[str, dict[str, None]] = {}
        for path, text in (setting for job in self.jobs for setting in job.settings):
            texts.setdefault(path, {})[text] = None
        return tuple(Parameter(path, tuple(own)) for path, own in texts.items())


def make_plan(
    config: Path,
    vary: Sequence[str] = (),
    *,
    overrides: Sequence[str] = (),
    seeds: int = 1,
    repeats: int = 1,
    out: Path | None = None,
    fly: bool = False,
    limit: float | None = None,
) -> Plan:
    """Plan a sweep.

    Args:
        vary: ``PATH=V1,V2,…``, the paths as in `overrides`.
        overrides: ``node.key=value`` or ``run.key=value``, the same for all runs.
        seeds: How many seeds each combination is run with, from the file's on.
        repeats: How often it is run with each seed.
        out: Folder for everything; ``sweeps/<name of the run>`` if not given.
        fly: Whether each run flies itself, even if another has an equal flight.
        limit: Real seconds that a run may take; plenty for its duration, if not given.

    Raises:
        ConfigError: Something is wrong with the file, a path or a value, or two combinations
            come to the same settings.
    """
    for option, count in (("--seeds", seeds), ("--repeat", repeats)):
        if count < 1:
            raise ConfigError(f"{option}: expected at least 1, found {count}")
    parameters = [parameter(change) for change in vary]
    _refuse_repeated([p.path for p in parameters], [o.partition("=")[0] for o in overrides])
    pairs = ([(p.path, text) for text in p.texts] for p in parameters)
    loaded = {chosen: _load(config, overrides, chosen) for chosen in itertools.product(*pairs)}
    first = loaded[next(iter(loaded))].run
    out = (out or Path("sweeps") / first.name).absolute()
    jobs: dict[str, Job] = {}
    numbers = range(first.seed, first.seed + seeds), range(1, repeats + 1)
    for (settings, resolved), seed, repeat in itertools.product(loaded.items(), *numbers):
        job = make_job(resolved, settings, seed, config.resolve().parent, out, repeat)
        if job.id in jobs:
            raise ConfigError(
                f"--vary: expected combinations that differ, found the same settings for "
                f"{jobs[job.id]} and {job}"
            )
        jobs[job.id] = msgspec.structs.replace(
            job, limit=limit or job.limit, flight="" if fly else job.flight
        )
    return plan_of(jobs.values(), out)


def plan_of(jobs: Iterable[Job], out: Path) -> Plan:
    """Return the plan of some jobs, with `record` set for jobs of a shared flight."""
    planned = tuple(jobs)
    counts = Counter(job.flight for job in planned)
    return Plan(
        jobs=tuple(
            msgspec.structs.replace(job, record=job.flight != "" and counts[job.flight] > 1)
            for job in planned
        ),
        out=out,
    )


def _refuse_repeated(varied: list[str], fixed: list[str]) -> None:
    for index, path in enumerate(varied):
        if path == "run.seed":
            raise ConfigError("--vary run.seed: expected --seeds N for several seeds")
        if path in varied[:index]:
            raise ConfigError(f"--vary {path}: expected each path once, found it a second time")
        if path in (other.strip() for other in fixed):
            raise ConfigError(f"--vary {path}: expected a path without --set, found both")


def _load(config: Path, overrides: Sequence[str], settings: tuple[tuple[str, str], ...]) -> Config:
    changes = [f"{path}={text}" for path, text in settings]
    try:
        return load_configuration(config, [*overrides, *changes])
    except ConfigError as error:
        if not changes:
            raise
        raise ConfigError(f"with {' '.join(changes)}: {error}") from error


def make_job(
    config: Config,
    settings: tuple[tuple[str, str], ...],
    seed: int,
    folder: Path,
    out: Path,
    repeat: int = 1,
) -> Job:
    """Make a job of a sweep.

    Args:
        config: Its settings, but for the seed.
        settings: Varied settings, as pairs of name and value.
        folder: Where modules of its nodes are looked for.
        out: Absolute path of the sweep's folder.
        repeat: The how manieth run with these settings and this seed.
    """
    config = msgspec.structs.replace(config, run=msgspec.structs.replace(config.run, seed=seed))
    text = tomli_w.dumps(to_builtins(config))
    part = flight_of(config)
    key = hashlib.sha256(text.encode()).hexdigest()[:16] + f"-{repeat}" * (repeat > 1)
    return Job(
        id=key, text=text, folder=str(folder), settings=settings, seed=seed,
        out=str(out / "runs" / key), flight=settings_key(part) if part is not None else "",
        limit=LEAST_LIMIT + SLOWEST * (config.run.duration or USUAL), repeat=repeat,
        roots=roots_of(config, folder, (*RUN, flights.__name__)),
    )  # fmt: skip
