"""Verdict on an evaluation: figures held against thresholds."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import msgspec

from runtime.figures import FIGURES, Figure
from runtime.host import RunEnd
from runtime.summary import overall
from runtime.time.schedule import SECOND


class _Limits(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    def given(self, *, of_flight: bool = False) -> bool:
        """Return whether any threshold of an estimator, or else of a flight, is not its default."""
        return any(getattr(self, each.name) != each.default for each in _asked(of_flight))

    def missed(self, figures: Mapping[str, Any], *, of_flight: bool = False) -> list[str]:
        """Return a sentence for each missed threshold of an estimator, or else of the flight."""
        asked = _asked(of_flight)
        found = (each.missed(getattr(self, each.name), figures.get(each.name)) for each in asked)
        return [*filter(None, found)]


def _asked(of_flight: bool) -> list[Figure]:
    return [each for each in _ASKED if each.of_flight == of_flight]


_ASKED = [each for each in FIGURES.values() if each.limit]

if TYPE_CHECKING:

    class Thresholds(_Limits, frozen=True):
        """Settings: thresholds of the figures; `None` for no threshold."""

        def __init__(self, **limits: float | None) -> None: ...

else:
    Thresholds = msgspec.defstruct(
        "Thresholds",
        [
            (each.name, kind, each.default)
            if each.default is not None
            else (each.name, kind | None, None)
            for each in _ASKED
            for kind in [int if each.counts else float]
        ],
        bases=(_Limits,),
        module=__name__,
        namespace={
            "__doc__": "What an estimator's figures may be; what is not given, and has no default, "
            "is not asked for.\n\nAttributes:\n"
            + "".join(f"    {each.name}: {each.setting}\n" for each in _ASKED)
        },
        frozen=True,
        kw_only=True,
        forbid_unknown_fields=True,
    )

UNDECLARED = "reads_truth: expected it to announce that it reads the truth, found that it listens"


def conclude(
    found: Mapping[str, dict[str, Any]],  # see `judge`
    thresholds: Thresholds,
    faults: Sequence[str] = (),  # further reasons why all have failed
    end: RunEnd | None = None,
    declared: Collection[str] = (),  # estimators that announced that they read the truth
    flights: Mapping[str, dict[str, Any]] = MappingProxyType({}),
    own: Mapping[str, Thresholds] = MappingProxyType({}),  # thresholds of single estimators
) -> dict[str, Any]:
    """Return the verdict on figures by estimator, for ``evaluation/verdict.json``.

    Args:
        flights: Figures of the flights themselves, by vehicle.

    Returns:
        ``passed``, ``estimators``, ``flights``, ``thresholds``; ``failed`` has the reason if there
        are thresholds and no estimator.
    """
    stopped = ""  # by the user, before the plan was flown
    if end is not None and end.by == "user" and not end.planned:
        stopped = f"the user ended the run before its plan was flown: {end.reason}"
    absent = {name: {"why": "expected estimates, found none"} for name in own if name not in found}
    found = {**found, **absent}  # who is asked for something and is not there has failed
    estimators = {}
    for name, figures in found.items():
        of_run = {} if end is None else _of_run(name, figures, end, name in declared)
        failed = []
        if figures.get("ate_rmse_m") is None:
            failed.append(figures.get("why", "expected estimates, found none"))
        known = {**figures, **of_run}
        asked = own.get(name, thresholds)
        missed = asked.missed(known) if "coverage_percent" in figures else []
        if end is not None:
            by = end.by or "the clock"
            who = f" ({by} ended the run: {end.reason})"
            missed = [text + who * text.startswith("early_end_seconds") for text in missed]
            if of_run["early_end_seconds"] is None:
                unknown = f"ended early (by {by}: {end.reason}); the planned end is not known"
                failed.append(f"early_end_seconds: {unknown}")
            if end.error and node_of(name, [end.by]):
                failed.append(f"ended_by: expected no error of its own, found: {end.error}")
        failed += missed
        if of_run.get("reads_truth") == "undeclared":
            failed.append(UNDECLARED)
        failed += faults
        passed = not failed if failed or asked.given() else None
        if stopped:
            passed, failed = None, []
            of_run["why"] = stopped
        estimators[name] = {"passed": passed, **figures, **of_run, "failed": failed}
    flown = {}
    for vehicle, figures in flights.items():
        failed = [] if stopped else thresholds.missed(figures, of_flight=True)
        passed = (
            not failed if failed or (thresholds.given(of_flight=True) and not stopped) else None
        )
        flown[vehicle] = {"passed": passed, **figures, "failed": failed}
    verdict = {
        "passed": overall(estimators.values(), flown.values()),
        "estimators": estimators,
        "flights": flown,
        "thresholds": msgspec.to_builtins(thresholds),
    }
    if own:
        verdict["own_thresholds"] = msgspec.to_builtins(own)
    if not found and thresholds.given():
        why = "expected an estimator to judge, found none that announced itself or sent a pose"
        verdict |= {"passed": None if stopped else False, "failed": [stopped or why, *faults]}
    return verdict


def planned_end(end: RunEnd | None) -> int | None:
    """Return the planned end (ns) of a run cut short by anyone but the user, if known."""
    if end is None or end.planned or end.by == "user" or end.duration is None:
        return None
    return round(end.duration * SECOND)


def _of_run(name: str, figures: Mapping[str, Any], end: RunEnd, declared: bool) -> dict[str, Any]:
    """Return an estimator's figures from the run's end: early end, restarts, use of the truth."""
    missing: float | None = 0.0
    if not end.planned:  # of a run that has no planned duration nobody knows how much is missing
        planned = end.duration
        missing = None if planned is None else max(planned - end.stamp / SECOND, 0.0)
    found: dict[str, Any] = {"early_end_seconds": missing, "ended_by": end.by or "duration"}
    again = end.restarts.get(node_of(name, end.restarts), 0)
    if again or "restarts" in figures:  # who restarts in a new frame has it in both
        found["restarts"] = max(figures.get("restarts", 0), again)
    if declared or node_of(name, end.truth_readers):
        found["reads_truth"] = "declared" if declared else "undeclared"
    return found


def node_of(source: str, nodes: Iterable[str]) -> str:
    """Return the node of a source: the longest name equal to or above the source; or ""."""
    own = (n for n in nodes if n and (source == n or source.startswith(f"{n}/")))
    return max(own, key=len, default="")
