"""From figures to a verdict: what they may be, and what they are."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import msgspec

from runtime.host import RunEnd
from runtime.summary import overall
from runtime.time.schedule import SECOND


class Thresholds(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What an estimator's figures may be; what is not given, and has no default, is not asked for.

    All are upper limits but `AT_LEAST`, which are lower ones.

    Attributes:
        ate_rmse_m: Absolute trajectory error, metres.
        ate_percent: The same in percent of the true path.
        held_ate_percent: The same over the whole flight, time without a pose included.
        final_ate_percent: The same of the trajectory after loop closures.
        ate_max_m: Greatest position error, metres.
        rot_rmse_deg: Rotation error.
        rpe_trans_percent: Relative pose error of the position.
        rpe_rot_deg_per_m: Relative pose error of the orientation.
        drift_percent: Error of the last pose seen from the first, in percent of the path.
        lost_seconds: Time without a pose.
        initialization_seconds: Time before the first pose.
        latency_p99_ms: From exposure to estimate.
        available_rmse_m: Error of the newest pose there was at each control tick.
        available_age_ms: Mean age of that pose.
        velocity_rmse_m_per_s: Error of the velocities that come with poses.
        nees_position: Mean normalized error squared of the position; 3 if covariances are true.
        within_3_sigma_percent: Share of the positions within 3 sigma of their covariance, at least.
        plan_rmse_m: How far the vehicle was from its `PlannedPose`.
        coverage_percent: Share of the flight with poses, at least.
        frame_coverage_percent: Share of the images with a pose, at least.
        velocities_percent: Share of the poses that come with a velocity, at least; if it is not
            given, 95 as soon as any of them does.
        covariances_percent: The same of covariances.
        covariance_invalid: Covariances that are not symmetric and positive definite.
        restarts: Times that it began anew: in a frame of its own, or as a node.
        repeated_stamps: Poses whose stamp was not later than that of the one before.
        future_stamps: Poses and losses whose time had not come when they arrived.
        not_causal: Poses that came so late that they may be made of later images.
        other_bodies: Poses of another body than the truth's.
        early_end: Seconds that the run ended before its plan.
        collisions: Of the vehicle.
    """

    ate_rmse_m: float | None = None
    ate_percent: float | None = None
    held_ate_percent: float | None = None
    final_ate_percent: float | None = None
    ate_max_m: float | None = None
    rot_rmse_deg: float | None = None
    rpe_trans_percent: float | None = None
    rpe_rot_deg_per_m: float | None = None
    drift_percent: float | None = None
    lost_seconds: float | None = None
    initialization_seconds: float | None = None
    latency_p99_ms: float | None = None
    available_rmse_m: float | None = None
    available_age_ms: float | None = None
    velocity_rmse_m_per_s: float | None = None
    nees_position: float | None = None
    within_3_sigma_percent: float | None = None
    plan_rmse_m: float | None = None
    coverage_percent: float = 90.0
    frame_coverage_percent: float | None = None
    velocities_percent: float | None = None
    covariances_percent: float | None = None
    covariance_invalid: int = 0
    restarts: int = 0
    repeated_stamps: int = 0
    future_stamps: int = 0
    not_causal: int | None = None
    other_bodies: int = 0
    early_end: float = 0.0
    collisions: int = 0

    @property
    def given(self) -> bool:
        """Whether anything is asked for beyond what is asked of everybody."""
        return self != Thresholds()

    def missed(self, figures: dict[str, Any]) -> list[str]:
        """Return a sentence for each threshold that is not met."""
        found = []
        for name in self.__struct_fields__:
            limit, value = getattr(self, name), figures.get(name)
            if limit is None and name in _CHERRIES and value is not None:
                limit = 95.0
            if limit is None or (value is None and name in IF_ANY):
                continue
            side = "least" if name in AT_LEAST else "most"
            if value is None:
                found.append(f"{name}: expected at {side} {limit:g}, found none")
            elif not (value >= limit if name in AT_LEAST else value <= limit):
                found.append(f"{name}: expected at {side} {limit:g}, found {value:.4g}")
        return found


_CHERRIES = {"velocities_percent", "covariances_percent"}
"""Shares of what comes with all poses, or with none: with some it would be with chosen ones."""

AT_LEAST = {
    "coverage_percent",
    "frame_coverage_percent",
    "within_3_sigma_percent",
    *_CHERRIES,
}
"""Thresholds that are lower limits."""

IF_ANY = {
    "velocity_rmse_m_per_s",
    "nees_position",
    "within_3_sigma_percent",
    "covariance_invalid",
    "restarts",
    "repeated_stamps",
    "future_stamps",
    "not_causal",
    "other_bodies",
    "early_end",
    "collisions",
}
"""Figures of what not everybody sends, and counts: where there is none, no threshold is missed."""

UNDECLARED = "reads_truth: expected it to announce that it reads the truth, found that it listens"


def conclude(
    found: Mapping[str, dict[str, Any]],
    thresholds: Thresholds,
    faults: Sequence[str] = (),
    end: RunEnd | None = None,
    declared: Collection[str] = (),
) -> dict[str, Any]:
    """Return the verdict on figures by estimator, as ``evaluation/verdict.json`` has it.

    Args:
        found: See `judge`.
        thresholds: What the figures may be.
        faults: Further reasons why all have failed.
        end: How the run ended, if there was one.
        declared: Those who announced that they read the truth.

    Returns:
        ``passed``, ``estimators``, ``thresholds``; and in ``failed`` why nobody has passed, if
        thresholds were given and nobody was there to meet them.
    """
    stopped = ""  # by the user, before the plan was flown
    if end is not None and end.by == "user" and not end.planned:
        stopped = f"the user ended the run before its plan was flown: {end.reason}"
    estimators = {}
    for name, figures in found.items():
        of_run = {} if end is None else _of_run(name, figures, end, name in declared)
        failed = []
        if figures.get("ate_rmse_m") is None:
            failed.append(figures.get("why", "expected estimates, found none"))
        known = {**figures, **of_run}
        missed = thresholds.missed(known) if "coverage_percent" in figures else []
        if end is not None:
            who = f" ({end.by or 'the clock'} ended the run: {end.reason})"
            missed = [text + who * text.startswith("early_end") for text in missed]
            if end.error and node_of(name, [end.by]):
                failed.append(f"ended_by: expected no error of its own, found: {end.error}")
        failed += missed
        if of_run.get("reads_truth") == "undeclared":
            failed.append(UNDECLARED)
        failed += faults
        passed = not failed if failed or thresholds.given else None
        if stopped:
            passed, failed = None, []
            of_run["why"] = stopped
        estimators[name] = {"passed": passed, **figures, **of_run, "failed": failed}
    verdict = {
        "passed": overall(figures["passed"] for figures in estimators.values()),
        "estimators": estimators,
        "thresholds": msgspec.to_builtins(thresholds),
    }
    if not found and thresholds.given:
        why = "expected an estimator to judge, found none that announced itself or sent a pose"
        verdict |= {"passed": None if stopped else False, "failed": [stopped or why, *faults]}
    return verdict


def planned_end(end: RunEnd | None) -> int | None:
    """Return when the flight should have ended (ns), if it ended before and that is known."""
    if end is None or end.planned or end.by == "user" or end.duration is None:
        return None
    return round(end.duration * SECOND)


def _of_run(name: str, figures: Mapping[str, Any], end: RunEnd, declared: bool) -> dict[str, Any]:
    """Return the figures of an estimator that only the run's end tells."""
    missing: float = 0.0
    if not end.planned:
        # Of a run that has no planned duration nobody knows how much is missing.
        missing = max((end.duration or 0.0) - end.stamp / SECOND, 0.0) or 1.0
    found = {"early_end": missing, "ended_by": end.by or "duration"}
    again = end.restarts.get(node_of(name, end.restarts), 0)
    if again or "restarts" in figures:  # who restarts in a new frame has it in both
        found["restarts"] = max(figures.get("restarts", 0), again)
    if declared or node_of(name, end.truth_readers):
        found["reads_truth"] = "declared" if declared else "undeclared"
    return found


def node_of(source: str, nodes: Iterable[str]) -> str:
    """Return the node that a source names: the longest name that it is, or is below; "" if none."""
    own = (n for n in nodes if n and (source == n or source.startswith(f"{n}/")))
    return max(own, key=len, default="")
