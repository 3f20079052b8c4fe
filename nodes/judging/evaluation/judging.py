"""Figures from estimates and ground truth: pure functions, and the flight of a vehicle.

Every image of the flight has an error, lest giving up look better than drifting. While lost, the
last pose is held, and the length of the true path since then is added: being lost costs as much as
a drift of 100 %, also on a closed tour.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from events import Collision, Odometry, PlannedPose, PositionSetpoint, Vector3
from events.frames import from_yaw
from nodes.judging.evaluation.metrics import (
    Alignment,
    Floats,
    How,
    absolute_errors,
    align,
    consistency,
    end_error_percent,
    frame_errors,
    interpolated,
    path_errors,
    position_errors,
    rms,
    rotation_errors,
    segment_errors,
    transform,
)
from nodes.judging.evaluation.plausibility import too_large_percent, velocity_error_percent
from nodes.judging.evaluation.record import (
    EstimatorRecord,
    Interval,
    Stamps,
    answered,
    choose_frames,
    cover,
    seconds,
)
from nodes.trajectory import HOLE, PoseRows, RecentPoses, Trajectory, associate
from runtime.time.clock import SECOND


def held_errors(
    truth: Trajectory, frames: Stamps, poses: Stamps, errors: Floats, lost: Sequence[Interval]
) -> Floats:
    """Return the position error at each image of a flight (m), by the poses as first sent.

    An image has the error of the worst pose nearest to it in time; without one, of the nearest
    pose; within a lost interval, of the last pose plus the true path length since. Before the first
    pose, that is the path length since the first image.

    Args:
        frames: Stamps of the flight's images (ns), strictly rising, within the truth's time.
        poses: Stamps of poses, strictly rising, shape (n,), n ≥ 0.
        errors: Their distances to the truth after alignment, metres, shape (n,).
        lost: Intervals without a pose; see `nodes.judging.evaluation.record.cover`.
    """
    path = _path_at(truth, frames)
    if not len(poses) or not len(frames):
        return np.asarray(path - path[:1])
    missing = np.zeros(len(frames), np.bool_)
    for start, end in lost:
        missing |= (frames >= start) & (frames <= end)
    missing &= ~answered(frames, poses)
    after = np.clip(np.searchsorted(poses, frames), 1, max(len(poses) - 1, 1))
    nearer = abs(poses[after - 1] - frames) <= abs(poses[after % len(poses)] - frames)
    found = errors[np.where(nearer, after - 1, after % len(poses))]
    own = np.searchsorted((frames[:-1] + frames[1:]) // 2, poses)  # the image of each pose
    worst = np.full(len(frames), -np.inf)
    np.maximum.at(worst, own, errors)
    found = np.where(np.bincount(own, minlength=len(frames)) > 0, worst, found)
    before = np.searchsorted(poses, frames, side="right") - 1
    none = before < 0
    since = np.where(none, path[:1], _path_at(truth, poses)[before])
    held = np.where(none, 0.0, errors[before]) + path - since
    return np.asarray(np.where(missing, held, found))


def interpolated_errors(truth: Trajectory, frames: Stamps, estimate: Trajectory) -> Floats:
    """Return the position error at each image of a flight (m), by poses corrected later.

    Poses are interpolated; before the first and after the last one, the nearer is held, and the
    true path length from there added.

    Args:
        frames: Stamps of the flight's images (ns), strictly rising, within the truth's time.
    """
    first, last = int(estimate.stamps[0]), int(estimate.stamps[-1])
    inside = np.clip(frames, first, last)
    away = abs(_path_at(truth, frames) - _path_at(truth, inside))
    true, said = (interpolated(t.stamps, t.positions, inside) for t in (truth, estimate))
    return position_errors(true, said) + away


def _path_at(truth: Trajectory, stamps: Stamps) -> Floats:
    return interpolated(truth.stamps, truth.distances()[:, None], stamps)[:, 0]


MILLISECOND = 1_000_000
_MOST_TICKS = 100_000
_BLOCK = 65_536
_LATE = 5  # largest delay of a pose, image periods: two of the estimator, two of a camera


class Errors(msgspec.Struct, frozen=True, eq=False):
    """Errors over time, a row per pose; all arrays of shape (n,)."""

    stamps: Stamps  # of the image, or of the control tick, ns
    since: Stamps  # arrival of the estimate, or stamp of a tick's pose, ns; shape (0,) if not known
    position: Floats  # metres, after alignment
    rotation: Floats  # radians, after alignment


class Judgement(msgspec.Struct, frozen=True, eq=False):
    """Final judgement of an estimator."""

    figures: dict[str, Any]  # by name, which ends with the unit
    estimate: Trajectory | None  # as sent
    note: str = ""  # of poses that are not compared
    # The same in the truth's frame, where there is a truth; `None` if there are none.
    aligned: Trajectory | None = None
    of_images: Errors | None = None  # errors of each pose at the time of its image
    # Errors of the newest pose at each control tick; of a long flight every second one, fourth, ….
    of_ticks: Errors | None = None
    lost: list[Interval] = []  # intervals without a pose
    final: Trajectory | None = None  # trajectory after loop closures in the truth's frame, if sent


def judge(
    record: EstimatorRecord,
    truth: Trajectory,
    *,
    cameras: Mapping[str, Stamps] | None = None,
    end: int | None = None,  # end of the run (ns); of the truth if not given
    planned: int | None = None,  # planned end (ns), if it ended before
    body: str = "base_link",  # frame of the truth's body
    alignment: How | Literal["auto"] = "auto",  # see `choose_alignment`
    rate: float = 400.0,  # control ticks a second
    gap: float = 0.5,  # seconds of silence that count as lost
    hole: int = HOLE,  # time between true poses (ns) over which none is made up
) -> Judgement:
    """Judge an estimator against the truth of the same body.

    Args:
        record: Without arrivals, latencies and errors at control ticks are not among the figures.
        cameras: Stamps of the images (ns), strictly rising, by camera: the flight is that of the
            estimator's camera; without cameras that of the truth.
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
    due = due[truth.covers(due, hole)]
    start, stop = coverage.flight
    inside = (truth.stamps >= start) & (truth.stamps <= stop)
    path = float(np.ptp(truth.distances()[inside] if inside.any() else truth.distances()))
    figures: dict[str, Any] = {
        "method": record.method,
        "estimates": len(record),
        "compared": int(truth.covers(poses, hole).sum()),
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
        errors = held_errors(truth, due, poses[:0], np.empty(0), coverage.lost)
        return _held(errors, path, due, planned)

    how = choose_alignment(record.scale_free, record.frame_id) if alignment == "auto" else alignment
    final = _judge_final(record, truth, hole, due, path, alignment, figures, planned)
    note = _not_compared(truth, poses, hole)
    judgement = Judgement(figures, estimate, note, lost=coverage.lost, final=final)
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
        figures["not_causal_percent"] = 100.0 * figures["not_causal"] / len(poses)
    try:
        there, kept = associate(truth, estimate, hole)
        aligned = align(kept, there, how)
    except ValueError as error:  # too little to align, or no time in common
        figures |= {**without(), "why": str(error)}
        return judgement
    moved = aligned.trajectory
    figures |= absolute_errors(there, moved) | _aligned_as_a_whole(there, kept)
    figures["ate_percent"] = 100.0 * figures["ate_rmse_m"] / path if path > 0 else None
    try:
        figures["end_error_percent"] = end_error_percent(there, moved)
        figures |= frame_errors(there, moved) | segment_errors(there, moved, path)
        figures |= path_errors(there, moved)
    except ValueError as error:  # it did not get that far
        figures["why"] = str(error)
    inside = truth.covers(poses, hole)
    of_images = Errors(
        stamps=there.stamps,
        since=arrivals[inside] if len(arrivals) else arrivals,
        position=position_errors(there.positions, moved.positions),
        rotation=rotation_errors(there.orientations, moved.orientations),
    )
    held = held_errors(truth, due, there.stamps, of_images.position, coverage.lost)
    figures |= _held(held, path, due, planned)
    figures |= _said_with_poses(record, truth, there, aligned)
    whole = transform(estimate, aligned.rotation, aligned.translation, aligned.scale)
    of_ticks = None
    if len(arrivals):
        of_ticks, available = errors_at_ticks(truth, whole, arrivals, rate, hole)
        figures |= available
    return Judgement(figures, estimate, note, moved, of_images, of_ticks, coverage.lost, final)


def _not_compared(truth: Trajectory, stamps: Stamps, hole: int) -> str:
    """Return how many poses of these stamps (ns) no truth is known for, and why; empty if none."""
    inside = truth.covers(stamps)
    outside, between = (~inside).sum(), (inside & ~truth.covers(stamps, hole)).sum()
    said = [f"{outside} outside the truth's time"] if outside else []
    if between:
        longest = int(np.diff(truth.stamps).max()) / SECOND
        said += [
            f"{between} between true poses more than {hole / SECOND:g} s apart (as max_difference "
            f"says; the longest hole is {longest:.3g} s)"
        ]
    return f"not compared, of {len(stamps)} poses: {', '.join(said)}" if said else ""


def _aligned_as_a_whole(truth: Trajectory, estimate: Trajectory) -> dict[str, float]:
    """Return the ATE after each alignment as a whole, and the scale; nothing for a line."""
    found: dict[str, float] = {}
    wholes: tuple[How, How] = ("se3", "sim3")
    with contextlib.suppress(ValueError):
        for how in wholes:
            laid = align(estimate, truth, how)
            errors = position_errors(truth.positions, laid.trajectory.positions)
            found |= {f"ate_{how}_rmse_m": rms(errors), "scale": laid.scale}
    return found


def to_planned_end(
    errors: Floats, path: float, frames: Stamps, planned: int | None
) -> tuple[float, float]:
    """Return the RMS of the errors at the images of a flight, and its path, to its planned end, m.

    What would have been flown after an early end is not known: images go on at their usual rate and
    the vehicle at its mean speed so far. An estimator is lost meanwhile: the path since is added to
    the error of the last image.

    Args:
        errors: At each image, metres, shape (n,), n ≥ 1.
        path: Length of the flight's true path (m).
        frames: Stamps of the images (ns), strictly rising, shape (n,).
        planned: Planned end (ns); `None` if the flight came to its end.
    """
    if planned is None or len(frames) < 2 or planned <= frames[-1]:
        return rms(errors), path
    missing = (planned - int(frames[-1])) / int(frames[-1] - frames[0])  # in flights so far
    count = round(missing * (len(frames) - 1))
    last, since = float(errors[-1]), path * missing
    total = float(np.sum(errors**2))
    if count:  # the sum of (last + since · k / count)² for k from 1 to count
        total += count * last**2 + last * since * (count + 1)
        total += since**2 * (count + 1) * (2 * count + 1) / (6 * count)
    return math.sqrt(total / (len(errors) + count)), path + since


def _held(
    errors: Floats, path: float, frames: Stamps, planned: int | None, prefix: str = ""
) -> dict[str, float | None]:
    if not len(errors):
        return {f"{prefix}flight_ate_rmse_m": None, f"{prefix}flight_ate_percent": None}
    error, length = to_planned_end(errors, path, frames, planned)
    return {
        f"{prefix}flight_ate_rmse_m": error,
        f"{prefix}flight_ate_percent": 100.0 * error / length if path > 0 else None,
    }


def _judge_final(
    record: EstimatorRecord,
    truth: Trajectory,
    hole: int,
    frames: Stamps,
    path: float,
    alignment: How | Literal["auto"],
    figures: dict[str, Any],
    planned: int | None,
) -> Trajectory | None:
    """Judge the trajectory after loop closures: add figures, return aligned poses."""
    if record.final is None:
        return None
    figures["final_poses"] = len(record.final)
    if alignment == "auto":
        alignment = choose_alignment(record.scale_free, record.final_frame_id)
    try:
        there, kept = associate(truth, record.final, hole)
        moved = align(kept, there, alignment).trajectory
    except ValueError as error:
        figures["why_not_final"] = str(error)
        return None
    errors = absolute_errors(there, moved)
    figures |= {f"final_{name}": errors[name] for name in ("ate_rmse_m", "rot_rmse_deg")}
    figures["final_ate_percent"] = 100.0 * errors["ate_rmse_m"] / path if path > 0 else None
    held = interpolated_errors(truth, frames, moved)
    figures |= _held(held, path, frames, planned, "final_")
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
        figures["velocity_error_percent"] = velocity_error_percent(wrong, true)
    rows, said = record.covariances.at(there.stamps)
    if rows.any():
        turn = np.kron(np.diag([scale, 1.0]), rotation)
        turned = turn @ said.reshape(-1, 6, 6) @ turn.T
        figures["covariance_too_large_percent"] = too_large_percent(turned, there.length())
        figures |= consistency(there.take(rows), aligned.trajectory.take(rows), turned)
    return figures


def beside_the_plan(truth: Trajectory, plan: Trajectory) -> dict[str, float]:
    """Return root mean square and maximum of distances from the plan, m; empty without overlap."""
    rows = np.flatnonzero(truth.covers(plan.stamps))
    if not len(rows):
        return {}
    there = truth.at(plan.stamps[rows])
    distances = position_errors(there.positions, plan.positions[rows])
    return {"plan_rmse_m": rms(distances), "plan_max_m": float(distances.max())}


def choose_alignment(scale_free: bool, frame_id: str) -> How:
    """Return ``sim3`` for a unit of its own, ``none`` in ``map``, else ``origin`` (first pose)."""
    if scale_free:
        return "sim3"
    return "none" if frame_id == "map" else "origin"


def errors_at_ticks(
    truth: Trajectory,
    estimate: Trajectory,
    arrivals: npt.NDArray[np.int64],  # of the estimates (ns), shape (n,)
    rate: float,  # ticks a second, from the first arrival to the end of the truth
    hole: int = HOLE,  # as of `Trajectory.covers`
) -> tuple[Errors | None, dict[str, float]]:
    """Return the errors of the newest pose at each control tick, and their figures.

    The errors of a long flight are those of every second tick, fourth, …; `None` without ticks.
    """
    first, last = max(int(arrivals.min()), int(truth.stamps[0])), int(truth.stamps[-1])
    ticks = np.arange(first, last + 1, SECOND / rate).astype(np.int64)
    ticks = ticks[truth.covers(ticks, hole)]
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
        "newest_pose_rmse_m": math.sqrt(square),
        "newest_pose_rot_rmse_deg": math.degrees(math.sqrt(turned)),
        "newest_pose_age_ms": age / MILLISECOND,
    }


class Flight:
    """Flight of a vehicle so far: its true poses, the last of them, and collisions in order."""

    def __init__(self) -> None:
        self.truth = PoseRows()
        self.recent = RecentPoses()
        self.path = 0.0  # length of the path, metres
        self._position: Vector3 | None = None
        self.body = "base_link"  # frame of its body
        self.collisions: list[Collision] = []
        self._plan = PoseRows()
        self._setpoints = PoseRows()

    def add(self, event: Odometry) -> None:
        """Add a true pose."""
        self.body = event.child_frame_id
        self.path += math.dist(self._position or event.position, event.position)
        self._position = event.position
        self.truth.add(event.stamp, event.position, event.orientation)
        self.recent.add(event.stamp, event.position, event.orientation)

    def add_plan(self, event: PlannedPose | PositionSetpoint) -> None:
        """Add a planned pose or a set-point."""
        rows = self._plan if isinstance(event, PlannedPose) else self._setpoints
        rows.add(event.stamp, event.position, from_yaw(event.yaw))

    def plan(self) -> Trajectory | None:
        """Return the planned path: from planned poses, or else from set-points."""
        rows = self._plan if len(self._plan) else self._setpoints
        return rows.trajectory() if len(rows) else None

    def figures(self, truth: Trajectory | None) -> dict[str, float]:
        """Return the number of collisions, and the distance from planned poses."""
        found: dict[str, float] = {"collisions": len(self.collisions)}
        if truth is not None and len(self._plan):
            found |= beside_the_plan(truth, self._plan.trajectory())
        return found


def collision_rows(collisions: Sequence[Collision]) -> str:
    """Return collisions as a CSV file."""
    rows = [
        f"{c.stamp},{c.source},{c.other},{','.join(f'{p:.3f}' for p in c.position)},{c.speed:.3f}\n"
        for c in collisions
    ]
    return "".join(["stamp_ns,vehicle,other,north_m,east_m,down_m,speed_m_s\n", *rows])
