"""From figures to a verdict: what they may be, and what they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec

from runtime.summary import overall


class Thresholds(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What an estimator's figures may be; what is not given, and has no default, is not asked for.

    All are upper limits but those of coverage, which are lower ones.

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
        plan_rmse_m: How far the vehicle was from its `PlannedPose`.
        coverage_percent: Share of the flight with poses, at least.
        frame_coverage_percent: Share of the images with a pose, at least.
        restarts: Times that it began anew in a frame of its own.
        repeated_stamps: Poses whose stamp was not later than that of the one before.
        future_stamps: Poses whose time had not come when they arrived.
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
    plan_rmse_m: float | None = None
    coverage_percent: float = 90.0
    frame_coverage_percent: float | None = None
    restarts: int = 0
    repeated_stamps: int = 0
    future_stamps: int = 0
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
            if limit is None or (value is None and name in COUNTS):
                continue
            side = "least" if name in AT_LEAST else "most"
            if value is None:
                found.append(f"{name}: expected at {side} {limit:g}, found none")
            elif not (value >= limit if name in AT_LEAST else value <= limit):
                found.append(f"{name}: expected at {side} {limit:g}, found {value:.4g}")
        return found


AT_LEAST = {"coverage_percent", "frame_coverage_percent"}
"""Thresholds that are lower limits."""

COUNTS = {"restarts", "repeated_stamps", "future_stamps", "collisions"}
"""Figures that are counted; where there was nothing to count, none was found."""


def conclude(
    found: Mapping[str, dict[str, Any]], thresholds: Thresholds, faults: Sequence[str] = ()
) -> dict[str, Any]:
    """Return the verdict on figures by estimator, as ``evaluation/verdict.json`` has it.

    Args:
        found: See `judge`.
        thresholds: What the figures may be.
        faults: Further reasons why all have failed.
    """
    estimators = {}
    for name, figures in found.items():
        failed = []
        if figures.get("ate_rmse_m") is None:
            failed.append(figures.get("why", "expected estimates, found none"))
        if "coverage_percent" in figures:
            failed += thresholds.missed(figures)
        failed += faults
        passed = not failed if failed or thresholds.given else None
        estimators[name] = {"passed": passed, **figures, "failed": failed}
    return {
        "passed": overall(figures["passed"] for figures in estimators.values()),
        "estimators": estimators,
        "thresholds": msgspec.to_builtins(thresholds),
    }
