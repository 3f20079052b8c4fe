"""From the estimates and the truth to figures.

Pure functions; `nodes.judging.evaluation.node` collects, and `nodes.judging.evaluation.results`
writes.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from typing import Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from nodes.judging.evaluation.alignment import Alignment, How, align, transform, umeyama
from nodes.judging.evaluation.consistency import consistency
from nodes.judging.evaluation.coverage import Interval, Stamps, choose_frames, cover, seconds
from nodes.judging.evaluation.metrics import (
    absolute_errors,
    drift_percent,
    interpolated,
    path_errors,
    position_errors,
    rms,
    rotation_errors,
    share_errors,
)
from nodes.judging.evaluation.record import EstimatorRecord
from nodes.judging.evaluation.whole_flight import held_errors, interpolated_errors
from nodes.trajectory import Trajectory, associate
from runtime.time.schedule import SECOND

Floats = npt.NDArray[np.float64]

MILLISECOND = 1_000_000
_MOST_TICKS = 100_000
_BLOCK = 65_536
_LATE = 5
"""Periods that a pose may be late: whoever answers image by image needs two, and its camera one or
two. Later than that, it had images after its own for it, if it answers them all."""


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


class Judgement(msgspec.Struct, frozen=True, eq=False):
    """All that is known of one estimator at the end.

    Attributes:
        figures: Its figures, by name (a unit is the name's end).
        estimate: Its estimates, as it sent them.
        aligned: The same in the truth's frame, where there is a truth; `None` if it sent none.
        of_images: Errors of each pose at the time of its image.
        of_ticks: Errors of the newest pose there was at each control tick; of a long flight at
            every second one, fourth, ….
        lost: When it had no pose.
        final: Its trajectory after loop closures in the truth's frame, if it sent one.
    """

    figures: dict[str, Any]
    estimate: Trajectory | None
    aligned: Trajectory | None = None
    of_images: Errors | None = None
    of_ticks: Errors | None = None
    lost: list[Interval] = []
    final: Trajectory | None = None


def judge(
    record: EstimatorRecord,
    truth: Trajectory,
    *,
    cameras: Mapping[str, Stamps] | None = None,
    end: int | None = None,
    planned: int | None = None,
    body: str = "base_link",
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
        planned: When it was to end (ns), if it ended before.
        body: Frame of the truth's body, whose pose is to be estimated.
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
    coverage = cover(due, poses, round(gap * SECOND), record.reported_lost(end), planned)
    due = due[truth.covers(due)]
    start, stop = coverage.flight
    inside = (truth.stamps >= start) & (truth.stamps <= stop)
    path = float(np.ptp(truth.distances()[inside] if inside.any() else truth.distances()))
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
        "other_bodies": sum(
            count
            for name, count in record.bodies.items()
            if name.rpartition("/")[2] != body.rpartition("/")[2]
        ),
        "path_m": path,
        # Who never has a pose is at it until the end.
        "initialization_seconds": (
            (coverage.flight.end if estimate is None else int(poses[0])) - coverage.flight.start
        )
        / SECOND,
    }

    def without() -> dict[str, float | None]:
        return _held(held_errors(truth, due, poses[:0], np.empty(0), coverage.lost), path)

    how = choose_alignment(record.scale_free, record.frame_id) if alignment == "auto" else alignment
    final = _judge_final(record, truth, due, path, alignment, figures)
    judgement = Judgement(figures, estimate, lost=coverage.lost, final=final)
    if estimate is None:
        figures |= without()
        return judgement
    # An interval that lasts to the end of the flight counts as long as it is: it took no less.
    if took := [seconds([each]) for each in coverage.lost if each.start >= poses[0]]:
        figures["relocalization_p50_seconds"] = float(np.median(took))
        figures["relocalization_max_seconds"] = max(took)
    figures["alignment"] = how
    figures["rate_hz"] = (len(estimate) - 1) / estimate.seconds if estimate.seconds else 0.0
    if len(arrivals):
        latencies = (arrivals - poses) / MILLISECOND
        figures["latency_p50_ms"] = float(np.percentile(latencies, 50))
        figures["latency_p99_ms"] = float(np.percentile(latencies, 99))
        period = max((np.median(np.diff(s)) for s in (poses, due) if len(s) > 1), default=0.0)
        figures["not_causal"] = int((arrivals - poses > _LATE * period).sum()) if period else 0
    try:
        there, kept = associate(truth, estimate)
        aligned = align(kept, there, how)
    except ValueError as error:  # too little to align, or no time in common
        figures |= {**without(), "why": str(error)}
        return judgement
    moved = aligned.trajectory
    figures |= {"scale": aligned.scale, **absolute_errors(there, moved)}
    figures["ate_percent"] = 100.0 * figures["ate_rmse_m"] / path if path > 0 else None
    try:
        figures["drift_percent"] = drift_percent(there, moved)
        figures["drift_m_per_s"] = figures["drift_percent"] * there.length() / 100 / there.seconds
        figures |= share_errors(there, moved, path)
        figures |= path_errors(there, moved, delta)
    except ValueError as error:  # it did not get that far
        figures["why"] = str(error)
    inside = truth.covers(poses)
    of_images = Errors(
        stamps=there.stamps,
        since=arrivals[inside] if len(arrivals) else arrivals,
        position=position_errors(there.positions, moved.positions),
        rotation=rotation_errors(there.orientations, moved.orientations),
    )
    held = held_errors(truth, due, there.stamps, of_images.position, coverage.lost)
    figures |= _held(held, path) | _said_with_poses(record, truth, there, aligned)
    if not record.scale_free:
        with contextlib.suppress(ValueError):  # on one line
            scale = umeyama(moved.positions, there.positions, with_scale=True)[2]
            figures["scale_error_percent"] = 100.0 * abs(scale - 1.0)
    whole = transform(estimate, aligned.rotation, aligned.translation, aligned.scale)
    of_ticks = None
    if len(arrivals):
        of_ticks, available = errors_at_ticks(truth, whole, arrivals, rate)
        figures |= available
    return Judgement(figures, estimate, moved, of_images, of_ticks, coverage.lost, final)


def _held(errors: Floats, path: float, prefix: str = "") -> dict[str, float | None]:
    """Return the figures of errors over the whole flight."""
    known = len(errors) > 0
    return {
        f"{prefix}held_ate_rmse_m": rms(errors) if known else None,
        f"{prefix}held_ate_percent": 100.0 * rms(errors) / path if known and path > 0 else None,
    }


def _judge_final(
    record: EstimatorRecord,
    truth: Trajectory,
    frames: Stamps,
    path: float,
    alignment: How | Literal["auto"],
    figures: dict[str, Any],
) -> Trajectory | None:
    """Judge the trajectory after loop closures: add its figures, and return it aligned."""
    if record.final is None:
        return None
    figures["final_poses"] = len(record.final)
    if alignment == "auto":
        alignment = choose_alignment(record.scale_free, record.final_frame_id)
    try:
        there, kept = associate(truth, record.final)
        moved = align(kept, there, alignment).trajectory
    except ValueError as error:
        figures["why_not_final"] = str(error)
        return None
    errors = absolute_errors(there, moved)
    figures |= {f"final_{name}": errors[name] for name in ("ate_rmse_m", "rot_rmse_deg")}
    figures["final_ate_percent"] = 100.0 * errors["ate_rmse_m"] / path if path > 0 else None
    figures |= _held(interpolated_errors(truth, frames, moved), path, "final_")
    return moved


def _said_with_poses(
    record: EstimatorRecord, truth: Trajectory, there: Trajectory, aligned: Alignment
) -> dict[str, Any]:
    """Return the figures of velocities and covariances, as far as they were given."""
    figures: dict[str, Any] = {}
    rotation, scale = aligned.rotation, aligned.scale
    for name, each in (("velocities", record.velocities), ("covariances", record.covariances)):
        if len(each):
            figures[f"{name}_percent"] = 100.0 * len(each) / len(record)
    rows, said = record.velocities.at(there.stamps)
    if rows.any():
        # The true velocity is the difference of the true positions, as densely as there are.
        near = truth.near(there.stamps[rows])
        true = interpolated(near.stamps, near.velocities(), there.stamps[rows])
        wrong = position_errors(true, scale * said @ rotation.T)
        figures["velocity_rmse_m_per_s"] = rms(wrong)
    rows, said = record.covariances.at(there.stamps)
    if rows.any():
        turn = np.kron(np.diag([scale, 1.0]), rotation)
        turned = turn @ said.reshape(-1, 6, 6) @ turn.T
        figures |= consistency(there.take(rows), aligned.trajectory.take(rows), turned)
    return figures


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


def choose_alignment(scale_free: bool, frame_id: str) -> How:
    """Return what an estimate's frame allows.

    ``sim3`` if its unit is its own, ``none`` if it claims to be in ``map``, else ``origin``: its
    first pose is laid on the true one.
    """
    if scale_free:
        return "sim3"
    return "none" if frame_id == "map" else "origin"


def errors_at_ticks(
    truth: Trajectory, estimate: Trajectory, arrivals: npt.NDArray[np.int64], rate: float
) -> tuple[Errors | None, dict[str, float]]:
    """Return the errors of the newest pose that a controller would have had at each of its ticks.

    Args:
        truth: True poses.
        estimate: Aligned poses.
        arrivals: When each came (ns), shape (n,).
        rate: Ticks a second, from the first estimate's arrival to the end of the truth.

    Returns:
        The errors, of a long flight those of every second tick, fourth, …; and the figures of all.
        `None` and nothing if there was no tick.
    """
    first, last = max(int(arrivals.min()), int(truth.stamps[0])), int(truth.stamps[-1])
    ticks = np.arange(first, last + 1, SECOND / rate).astype(np.int64)
    if not len(ticks):
        return None, {}
    order = np.argsort(arrivals, kind="stable")
    # Should poses overtake each other, the newest by stamp is the one to go by.
    newest, came = np.maximum.accumulate(order), arrivals[order]
    step = 2 ** max(math.ceil(math.log2(len(ticks) / _MOST_TICKS)), 0)
    kept = []
    sums = np.zeros(3)
    for start in range(0, len(ticks), _BLOCK):  # which is a multiple of each step
        now = ticks[start : start + _BLOCK]
        rows = newest[np.searchsorted(came, now, side="right") - 1]
        there = truth.at(now)
        since = estimate.stamps[rows]
        position = position_errors(there.positions, estimate.positions[rows])
        rotation = rotation_errors(there.orientations, estimate.orientations[rows])
        sums += (position**2).sum(), (rotation**2).sum(), (now - since).sum()
        kept.append([each[::step] for each in (now, since, position, rotation)])
    square, turned, age = (sums / len(ticks)).tolist()
    return Errors(*map(np.concatenate, zip(*kept, strict=True))), {
        "available_rmse_m": math.sqrt(square),
        "available_rot_rmse_deg": math.degrees(math.sqrt(turned)),
        "available_age_ms": age / MILLISECOND,
    }
