"""The suite's scenarios and estimators, and the plan of their runs."""

from __future__ import annotations

import importlib.util
import shutil
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import msgspec

from runtime.config.overrides import override
from runtime.config.reading import parse
from runtime.errors import CommandError, ConfigError, expect_known
from runtime.paths import unmarked
from runtime.tools.sweep import Plan, make_job, plan_of

FOLDER = Path(__file__).parent
EXACT = "_exact"  # ends the name of a scenario that is flown once more
LEVELS = ("easy", "medium", "hard", "brutal")


class Scenario(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A flight.

    Attributes:
        name: In one word.
        level: How hard it is.
        shows: What is in it, for the page.
        rig: Another file of the vehicle with its sensors than the suite's, in the file relative to
            it.
        set: What differs from the rig's file, as for ``--set``.
        calibration: ``errs``: the suite's `calibration_errors` hold. ``exact``: they do not.
            ``both``: they hold, and it is flown once more without them, with the same seeds, so
            that the page says what exactness was worth.
    """

    name: str
    level: Literal["easy", "medium", "hard", "brutal"]
    shows: str
    rig: str = ""
    set: tuple[str, ...] = ()
    calibration: Literal["errs", "exact", "both"] = "errs"

    @property
    def exact(self) -> Scenario:
        """The same with an exact calibration."""
        return msgspec.structs.replace(self, name=f"{self.name}{EXACT}", calibration="exact")


class Entrant(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An estimator.

    Attributes:
        name: Of its node.
        node: The table of the node without its name.
        reads: What it computes from, for the page.
        module: That must be there; empty if it is a part of the project, or a program.
        install: The command that installs the module, or the page about the program.
    """

    name: str
    node: dict[str, Any]
    reads: str
    module: str = ""
    install: str = ""

    def installed(self, folder: Path) -> bool:
        """Return whether its module or program is there; paths are relative to `folder`."""
        if self.module and importlib.util.find_spec(self.module) is None:
            return False
        program, *_ = self.node.get("command") or [""]
        place = folder / self.node.get("folder", ".") / program if "/" in program else program
        return not program or shutil.which(place) is not None


class Suite(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Scenarios and estimators.

    Attributes:
        rig: Path of the file of the vehicle with its sensors, in which the scenarios change
            something; in the file relative to it.
        thresholds: Of the evaluation: an estimator that misses one has failed.
        calibration_errors: Settings of the rig's errors of calibration, as for ``--set``.
        scenarios: In the order of the page.
        estimators: In the order of the page.
    """

    rig: str
    thresholds: dict[str, float]
    calibration_errors: tuple[str, ...] = ()
    scenarios: tuple[Scenario, ...]
    estimators: tuple[Entrant, ...]

    def rig_of(self, scenario: Scenario) -> str:
        """Return the path of the file of a scenario's vehicle."""
        return str(Path(self.rig).parent / scenario.rig) if scenario.rig else self.rig

    def flown(self) -> list[Scenario]:
        """Return the scenarios, each followed by its exact one if both are flown."""
        pairs = ((s, s.exact) if s.calibration == "both" else (s,) for s in self.scenarios)
        return [scenario for pair in pairs for scenario in pair]

    def only(self, scenarios: Sequence[str], estimators: Sequence[str]) -> Suite:
        """Return a part of the suite; an empty list of names stands for all.

        Raises:
            CommandError: A name is unknown.
        """
        return msgspec.structs.replace(
            self,
            scenarios=_named("scenario", self.scenarios, scenarios),
            estimators=_named("estimator", self.estimators, estimators),
        )


def read_suite(path: Path = FOLDER / "suite.toml") -> Suite:
    """Read a suite.

    Raises:
        ConfigError: Something in it is wrong.
    """
    try:
        suite = msgspec.toml.decode(path.read_bytes(), type=Suite)
    except OSError as error:
        raise ConfigError(f"{path}: expected a readable file, found: {error.strerror}") from None
    except (msgspec.MsgspecError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"{path}: {error}") from None
    return msgspec.structs.replace(suite, rig=str(path.resolve().parent / suite.rig))


def make_plan(suite: Suite, *, out: Path, seeds: int = 1, repeats: int = 2) -> Plan:
    """Plan a run for each scenario, seed and installed estimator.

    Those of one scenario and seed follow each other: they share one flight.

    Args:
        repeats: Runs with the first seed of the first scenario: whether an estimator repeats.

    Raises:
        ConfigError: A scenario or an estimator has settings that do not exist.
    """
    folder = Path(suite.rig).parent
    entrants = [estimator for estimator in suite.estimators if estimator.installed(folder)]
    jobs = (
        make_job(
            parse(_table(suite, scenario, entrant), suite.rig_of(scenario), folder),
            (("scenario", scenario.name), ("estimator", entrant.name)),
            *(seed, folder, out, repeat),
        )
        for scenario in suite.flown()
        for seed in range(1, seeds + 1)
        for entrant in entrants
        for repeat in range(1, repeats + 1 if (scenario, seed) == (suite.scenarios[0], 1) else 2)
    )
    return plan_of(jobs, out)


def _table(suite: Suite, scenario: Scenario, entrant: Entrant) -> dict[str, Any]:
    """Return the settings of a run, as they would stand in a file in the suite's folder."""
    rig = suite.rig_of(scenario)
    try:
        table = tomllib.loads(Path(rig).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{rig}: expected a TOML file of a rig, found: {error}") from None
    errors = () if scenario.calibration == "exact" else suite.calibration_errors
    for change in (f"run.name={scenario.name}", *errors, *scenario.set):
        override(table, change)
    table["nodes"] += [
        {"name": entrant.name, **entrant.node},
        {
            "name": "evaluation",
            "type": "Evaluation",
            "thresholds": dict(suite.thresholds),
            "image_count": 2,
        },
    ]
    return dict(unmarked(table))  # paths start at the suite's folder, not where it is called


def _named(kind: str, parts: tuple[Any, ...], names: Sequence[str]) -> tuple[Any, ...]:
    by_name = {entry.name: entry for entry in parts}
    for name in names:
        message = f"--{kind}: expected one of {', '.join(by_name)}, found {name}"
        expect_known(name, by_name, message, CommandError)
    return tuple(by_name[name] for name in by_name if not names or name in names)
