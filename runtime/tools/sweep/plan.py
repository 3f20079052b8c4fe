"""Which runs a sweep consists of, all of them checked before the first one starts."""

from __future__ import annotations

import hashlib
import itertools
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

import msgspec
import tomli_w

from runtime.config.model import Config, to_builtins
from runtime.config.reading import load_configuration
from runtime.errors import ConfigError
from runtime.tools.flights.part import flight_of, settings_key
from runtime.tools.sweep.values import Parameter, parameter

LEAST_LIMIT, SLOWEST, USUAL = 600.0, 30.0, 120.0
"""Real seconds that each run may take, and those for each second of its duration, and how long it
is taken to be if it has none: what takes longer hangs."""


class Job(msgspec.Struct, frozen=True, kw_only=True):
    """One run, with all that another machine needs to know of it.

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

    def __str__(self) -> str:
        """Return what tells it from the others of its sweep."""
        words = [*(f"{path}={text}" for path, text in self.settings), f"seed={self.seed}"]
        return " ".join(words + [f"repeat={self.repeat}"] * (self.repeat > 1))


class Plan(msgspec.Struct, frozen=True, kw_only=True):
    """A whole sweep.

    Attributes:
        parameters: What is varied.
        jobs: All runs: the first parameter changes slowest, then the seed, the repeat quickest.
        out: Absolute path of the folder for everything.
    """

    parameters: tuple[Parameter, ...]
    jobs: tuple[Job, ...]
    out: Path


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
        config: The TOML file.
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
    parameters = tuple(parameter(change) for change in vary)
    _refuse_repeated([p.path for p in parameters], [o.partition("=")[0] for o in overrides])
    loaded = []
    for texts in itertools.product(*(p.texts for p in parameters)):
        settings = tuple(zip((p.path for p in parameters), texts, strict=True))
        loaded.append((settings, _load(config, overrides, settings)))
    first = loaded[0][1].run
    out = (out or Path("sweeps") / first.name).absolute()
    jobs: dict[str, Job] = {}
    for settings, resolved in loaded:
        runs = itertools.product(range(first.seed, first.seed + seeds), range(1, repeats + 1))
        for seed, repeat in runs:
            job = make_job(resolved, settings, seed, config.resolve().parent, out, repeat)
            if job.id in jobs:
                raise ConfigError(
                    f"--vary: expected combinations that differ, found the same settings for "
                    f"{jobs[job.id]} and {job}"
                )
            jobs[job.id] = msgspec.structs.replace(
                job, limit=limit or job.limit, flight="" if fly else job.flight
            )
    return Plan(parameters=parameters, jobs=sharing(jobs.values()), out=out)


def sharing(jobs: Iterable[Job]) -> tuple[Job, ...]:
    """Return jobs of which those record their flight that share it with another."""
    found = tuple(jobs)
    counts = Counter(job.flight for job in found)
    return tuple(
        msgspec.structs.replace(job, record=job.flight != "" and counts[job.flight] > 1)
        for job in found
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
    """Make one run of a sweep.

    Args:
        config: Its settings, but for the seed.
        settings: What tells it from the others, as pairs of name and value.
        seed: Of its random numbers.
        folder: Where modules of its nodes are looked for.
        out: Absolute path of the sweep's folder.
        repeat: The how manieth run with these settings and this seed.
    """
    config = msgspec.structs.replace(config, run=msgspec.structs.replace(config.run, seed=seed))
    text = tomli_w.dumps(to_builtins(config))
    part = flight_of(config)
    key = hashlib.sha256(text.encode()).hexdigest()[:16] + f"-{repeat}" * (repeat > 1)
    return Job(
        id=key,
        text=text,
        folder=str(folder),
        settings=settings,
        seed=seed,
        out=str(out / "runs" / key),
        flight=settings_key(part) if part is not None else "",
        limit=LEAST_LIMIT + SLOWEST * (config.run.duration or USUAL),
        repeat=repeat,
    )
