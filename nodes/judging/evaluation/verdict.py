"""Verdict on an evaluation: figures held against thresholds, and what else went wrong."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import msgspec

from nodes.judging.evaluation.orientations import WRONG
from nodes.judging.evaluation.thresholds import Thresholds
from runtime.figures import is_off
from runtime.host import RunEnd
from runtime.summary import overall
from runtime.time.clock import SECOND

UNDECLARED = "reads_truth: expected it to announce that it reads the truth, found that it listens"


def conclude(
    judged: Mapping[str, dict[str, Any]],  # see `judge`
    thresholds: Thresholds,
    faults: Sequence[str] = (),  # further reasons why all have failed
    end: RunEnd | None = None,
    declared: Collection[str] = (),  # estimators that announced that they read the truth
    flights: Mapping[str, dict[str, Any]] = MappingProxyType({}),
    by_estimator: Mapping[str, Thresholds] = MappingProxyType({}),
    ended_flights: Mapping[str, str] = MappingProxyType({}),
) -> dict[str, Any]:
    """Return the verdict on figures by estimator, for ``evaluation/verdict.json``.

    Args:
        by_estimator: Thresholds of single estimators.
        ended_flights: Commands by which estimators ended the flight of their vehicle.
        flights: Figures of the flights themselves, by vehicle.

    Returns:
        ``passed``, ``estimators``, ``flights``, ``thresholds``; ``failed`` has the reason if there
        are thresholds and no estimator.
    """
    stopped = ""  # by the user, before the plan was flown
    if end is not None and end.by == "user" and not end.planned:
        stopped = f"the user ended the run before its plan was flown: {end.reason}"
    absent = {
        name: {"why": "expected estimates, found none"}
        for name in by_estimator
        if name not in judged
    }
    judged = {**judged, **absent}  # a listed estimator without estimates fails
    estimators = {}
    for name, figures in judged.items():
        of_run = {} if end is None else _of_run(name, figures, end, name in declared)
        failed = []
        if figures.get("ate_rmse_m") is None:
            failed.append(figures.get("why", "expected estimates, found none"))
        known = {**figures, **of_run}
        asked = by_estimator.get(name, thresholds)
        missed = asked.missed(known) if "coverage_percent" in figures else []
        missed += _no_rotations(figures, asked, missed, in_run=end is not None)
        if end is not None:
            by = end.by or "the clock"
            who = f" ({by} ended the run: {end.reason})"
            missed = [text + who * text.startswith("early_end_seconds") for text in missed]
            if of_run["early_end_seconds"] is None:
                unknown = f"ended early (by {by}: {end.reason}); the planned end is not known"
                failed.append(f"early_end_seconds: {unknown}")
            if end.error and node_of(owner_of(name, end), [end.by]):
                failed.append(f"ended_by: expected no error of its own, found: {end.error}")
        failed += missed
        if name in ended_flights:
            failed.append(
                f"commands: expected it not to end the flight, found {ended_flights[name]}"
            )
        if of_run.get("reads_truth") == "undeclared":
            failed.append(UNDECLARED)
        failed += faults
        passed = not failed if failed or asked.any_set() else None
        if stopped:
            passed, failed = None, []
            of_run["why"] = stopped
        estimators[name] = {"passed": passed, **figures, **of_run, "failed": failed}
    flown = {}
    for vehicle, figures in flights.items():
        failed = [] if stopped else thresholds.missed(figures, of_flight=True)
        passed = (
            not failed if failed or (thresholds.any_set(of_flight=True) and not stopped) else None
        )
        flown[vehicle] = {"passed": passed, **figures, "failed": failed}
    verdict = {
        "passed": overall(estimators.values(), flown.values()),
        "estimators": estimators,
        "flights": flown,
        "thresholds": msgspec.to_builtins(thresholds),
    }
    if by_estimator:
        verdict["own_thresholds"] = msgspec.to_builtins(by_estimator)
    if not judged and thresholds.any_set():
        why = "expected an estimator to judge, found none that announced itself or sent a pose"
        verdict |= {"passed": None if stopped else False, "failed": [stopped or why, *faults]}
    return verdict


def _no_rotations(
    figures: Mapping[str, Any], thresholds: Thresholds, missed: Sequence[str], *, in_run: bool
) -> list[str]:
    """Return a sentence if an estimator's orientations are none of its vehicle's.

    Their figures are left out then. Many files have positions only, and may.
    """
    why, limit = figures.get("why_no_rotations", ""), getattr(thresholds, "rot_rmse_deg", None)
    known = any(text.startswith("rot_rmse_deg") for text in missed)
    kind = figures.get("orientations")
    blamed = kind in WRONG or (in_run and kind == "estimate without")
    if not blamed or known or limit is None or is_off(limit):
        return []
    return [f"rot_rmse_deg: expected at most {limit:g}, found none: {why}"]


def planned_end(end: RunEnd | None) -> int | None:
    """Return the planned end (ns) of a run cut short by anyone but the user, if known."""
    if end is None or end.planned or end.by == "user" or end.duration is None:
        return None
    return round(end.duration * SECOND)


def _of_run(name: str, figures: Mapping[str, Any], end: RunEnd, declared: bool) -> dict[str, Any]:
    """Return an estimator's figures from the run's end: early end, restarts, use of the truth."""
    missing: float | None = 0.0
    if not end.planned:  # without a planned duration the missing time is not known
        planned = end.duration
        missing = None if planned is None else max(planned - end.stamp / SECOND, 0.0)
    facts: dict[str, Any] = {"early_end_seconds": missing, "ended_by": end.by or "duration"}
    owner = owner_of(name, end)
    again = end.restarts.get(node_of(owner, end.restarts), 0)
    if again or "restarts" in figures:  # a restart in a new frame is in both counts
        facts["restarts"] = max(figures.get("restarts", 0), again)
    if declared or node_of(owner, end.truth_readers):
        facts["reads_truth"] = "declared" if declared else "undeclared"
    elif node_of(owner, end.truth_relays):
        facts["reads_truth"] = "offered"
    return facts


def owner_of(source: str, end: RunEnd) -> str:
    """Return the node that sends in the name of a source; the source itself if that is unknown."""
    owners = {**{node: node for node in end.restarts}, **end.owners}
    return owners.get(node_of(source, owners), source)


def node_of(source: str, nodes: Iterable[str]) -> str:
    """Return the node of a source: the longest name equal to or above the source; or ""."""
    candidates = (n for n in nodes if n and (source == n or source.startswith(f"{n}/")))
    return max(candidates, key=len, default="")
