"""From the estimates and the truth to figures, and from figures to a verdict.

Pure functions; `nodes.evaluation.node` collects, and `nodes.evaluation.results` writes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from nodes.evaluation.alignment import How, align, transform
from nodes.evaluation.coverage import Interval, Stamps, choose_frames, cover, seconds
from nodes.evaluation.metrics import (
    absolute_errors,
    drift_percent,
    path_errors,
    position_errors,
    rms,
    rotation_errors,
)
from nodes.evaluation.record import EstimatorRecord
from nodes.trajectory import Trajectory, associate
from runtime.schedule import SECOND
from runtime.summary import overall

Floats = npt.NDArray[np.float64]

MILLISECOND = 1_000_000


class Thresholds(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What an estimator's figures may be; what is not given, and has no default, is not asked for.

    All are upper limits but those of coverage, which are lower ones.

    Attributes:
        ate_rmse_m: Absolute trajectory error, metres.
        ate_percent: The same in percent of the true path.
        ate_max_m: Greatest position error, metres.
        rot_rmse_deg: Rotation error.
        rpe_trans_percent: Relative pose error of the position.
        rpe_rot_deg_per_m: Relative pose error of the orientation.
        drift_percent: Error of the last pose seen from the first, in percent of the path.
        lost_seconds: Time without a pose.
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
    ate_max_m: float | None = None
    rot_rmse_deg: float | None = None
    rpe_trans_percent: float | None = None
    rpe_rot_deg_per_m: float | None = None
    drift_percent: float | None = None
    lost_seconds: float | None = None
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


class Errors(msgspec.Struct, frozen=True, eq=False):
    """Errors over time, one row a pose; all arrays of shape (n,).

    Attributes:
        stamps: Nanoseconds: of the image, or of the control tick.
        since: Nanoseconds: when the estimate came; for ticks, the stamp of the pose there was.
            Shape (0,) if not known.
        position: Metres, after alignment.
        rotation: Radians, after alignment.
    """

    stamps: Stamps
    since: Stamps
    position: Floats
    rotation: Floats

    def thinned(self, most: int) -> Errors:
        """Return every row, or of more than `most` every second, fourth, …."""
        step = 1
        while len(self.stamps) > most * step:
            step *= 2
        kept = slice(None, None, step)
        return Errors(self.stamps[kept], self.since[kept], self.position[kept], self.rotation[kept])


class Judgement(msgspec.Struct, frozen=True, eq=False):
    """All that is known of one estimator at the end.

    Attributes:
        figures: Its figures, by name (a unit is the name's end).
        estimate: Its estimates, as it sent them.
        aligned: The same in the truth's frame, where there is a truth; `None` if it sent none.
        of_images: Errors of each pose at the time of its image.
        of_ticks: Errors of the newest pose there was at each control tick.
        lost: When it had no pose.
    """

    figures: dict[str, Any]
    estimate: Trajectory | None
    aligned: Trajectory | None = None
    of_images: Errors | None = None
    of_ticks: Errors | None = None
    lost: list[Interval] = []


def judge(
    record: EstimatorRecord,
    truth: Trajectory,
    *,
    cameras: Mapping[str, Stamps] | None = None,
    end: int | None = None,
    alignment: How | Literal["auto"] = "auto",
    rate: float = 400.0,
    delta: float = 1.0,
    gap: float = 0.5,
) -> Judgement:
    """Judge an estimator against the truth.

    Args:
        record: What it sent. Where arrivals are not known, latencies and errors at control ticks
            are not among the figures.
        truth: The true poses of the same body.
        cameras: Stamps of the images (ns), strictly rising, by camera. The flight is from the
            first to the last image of the camera that the estimator follows; without cameras it
            is that of the truth.
        end: When the run ended (ns); the end of the truth if not given.
        alignment: How the two frames are brought together; see `choose_alignment`.
        rate: Control ticks a second.
        delta: Metres of path over which relative errors are taken.
        gap: Seconds of silence that count as lost.
    """
    end = int(truth.stamps[-1]) if end is None else end
    estimate = record.rows.trajectory() if len(record) else None
    poses = np.empty(0, np.int64) if estimate is None else estimate.stamps
    arrivals = record.arrivals()
    frames = choose_frames(cameras or {}, poses)
    waits = 0
    if len(arrivals):
        # The last images of an orderly run are not answered yet, if answers take their time.
        usual = int(np.median(arrivals - poses))
        waits = min(max(usual, 0), round(gap * SECOND))
    due = truth.stamps if frames is None else frames
    due = due[: max(int(np.searchsorted(due, end - waits, side="right")), 1)]
    coverage = cover(due, poses, round(gap * SECOND), record.reported_lost(end))
    inside = (truth.stamps >= coverage.flight.start) & (truth.stamps <= coverage.flight.end)
    flight = truth.take(inside) if inside.any() else truth
    figures: dict[str, Any] = {
        "method": record.method,
        "estimates": len(record),
        "coverage_percent": coverage.percent,
        "frame_coverage_percent": None if frames is None else coverage.frames_percent,
        "lost_seconds": seconds(coverage.lost),
        "lost_count": len(coverage.lost),
        "restarts": record.restarts,
        "repeated_stamps": record.repeated,
        "future_stamps": record.future,
        "path_m": flight.length(),
    }
    if estimate is None:
        return Judgement(figures=figures, estimate=None, lost=coverage.lost)
    how = choose_alignment(record) if alignment == "auto" else alignment
    figures["alignment"] = how
    figures["rate_hz"] = (len(estimate) - 1) / estimate.seconds if estimate.seconds else 0.0
    if len(arrivals):
        latencies = (arrivals - poses) / MILLISECOND
        figures["latency_p50_ms"] = float(np.percentile(latencies, 50))
        figures["latency_p99_ms"] = float(np.percentile(latencies, 99))
    figures["first_s"] = (int(poses[0]) - coverage.flight.start) / SECOND
    try:
        there, kept = associate(truth, estimate)
        aligned = align(kept, there, how)
    except ValueError as error:  # too little to align, or no time in common
        return Judgement(
            figures={**figures, "why": str(error)}, estimate=estimate, lost=coverage.lost
        )
    moved = aligned.trajectory
    figures |= {"scale": aligned.scale, **absolute_errors(there, moved)}
    path = flight.length()
    figures["ate_percent"] = 100.0 * figures["ate_rmse_m"] / path if path > 0 else None
    try:
        figures |= path_errors(there, moved, delta)
        figures["drift_percent"] = drift_percent(there, moved)
    except ValueError as error:  # it did not get that far
        figures["why"] = str(error)
    inside = truth.covers(poses)
    of_images = Errors(
        stamps=there.stamps,
        since=arrivals[inside] if len(arrivals) else arrivals,
        position=position_errors(there.positions, moved.positions),
        rotation=rotation_errors(there.orientations, moved.orientations),
    )
    whole = transform(estimate, aligned.rotation, aligned.translation, aligned.scale)
    of_ticks = errors_at_ticks(truth, whole, arrivals, rate) if len(arrivals) else None
    if of_ticks is not None:
        figures |= {
            "available_rmse_m": rms(of_ticks.position),
            "available_rot_rmse_deg": float(np.degrees(rms(of_ticks.rotation))),
            "available_age_ms": float(np.mean(of_ticks.stamps - of_ticks.since)) / MILLISECOND,
        }
    return Judgement(figures, estimate, moved, of_images, of_ticks, coverage.lost)


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


def beside_the_plan(truth: Trajectory, plan: Trajectory) -> dict[str, float]:
    """Return how far the vehicle flew from where its pilot meant it to be.

    Args:
        truth: Its true poses.
        plan: Where it was to be at each stamp, in the same frame.

    Returns:
        Root mean square and maximum of the distances, metres; empty if the truth covers no stamp
        of the plan.
    """
    rows = np.flatnonzero(truth.covers(plan.stamps))
    if not len(rows):
        return {}
    there = truth.at(plan.stamps[rows])
    distances = position_errors(there.positions, plan.positions[rows])
    return {"plan_rmse_m": rms(distances), "plan_max_m": float(distances.max())}


def choose_alignment(record: EstimatorRecord) -> How:
    """Return what an estimate's frame allows.

    ``sim3`` if its unit is its own, ``none`` if it claims to be in ``map``, else ``origin``: its
    first pose is laid on the true one.
    """
    if record.scale_free:
        return "sim3"
    return "none" if record.frame_id == "map" else "origin"


def errors_at_ticks(
    truth: Trajectory, estimate: Trajectory, arrivals: npt.NDArray[np.int64], rate: float
) -> Errors | None:
    """Return the errors of the newest pose that a controller would have had at each of its ticks.

    Args:
        truth: True poses.
        estimate: Aligned poses.
        arrivals: When each came (ns), shape (n,).
        rate: Ticks a second, from the first estimate's arrival to the end of the truth.

    Returns:
        The errors; `None` if there was no tick.
    """
    first, last = max(int(arrivals.min()), int(truth.stamps[0])), int(truth.stamps[-1])
    ticks = np.arange(first, last + 1, SECOND / rate).astype(np.int64)
    if not len(ticks):
        return None
    order = np.argsort(arrivals, kind="stable")
    came = np.searchsorted(arrivals[order], ticks, side="right")
    # Should poses overtake each other, the newest by stamp is the one to go by.
    newest = np.maximum.accumulate(order)[came - 1]
    there = truth.at(ticks)
    return Errors(
        stamps=ticks,
        since=estimate.stamps[newest],
        position=position_errors(there.positions, estimate.positions[newest]),
        rotation=rotation_errors(there.orientations, estimate.orientations[newest]),
    )
