"""Figures from estimates and ground truth: pure functions.

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

from nodes.judging.evaluation.alignment import Alignment, AlignmentMethod, align, transform
from nodes.judging.evaluation.metrics import (
    Floats,
    absolute_errors,
    consistency,
    end_error_percent,
    frame_errors,
    interpolated,
    path_errors,
    position_errors,
    rms,
    rotation_errors,
    segment_errors,
)
from nodes.judging.evaluation.orientations import Orientations, examine
from nodes.judging.evaluation.plausibility import too_large_percent, velocity_error_percent
from nodes.judging.evaluation.record import (
    EstimatorRecord,
    Interval,
    MapRecord,
    Stamps,
    answered,
    choose_frames,
    cover,
    nearest,
    seconds,
)
from nodes.judging.evaluation.time_offset import best_time_offset
from nodes.trajectory import HOLE, Trajectory, bridged, is_sparser, pair
from runtime.figures import figure
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
    at_frames = errors[np.where(nearer, after - 1, after % len(poses))]
    rows = np.searchsorted((frames[:-1] + frames[1:]) // 2, poses)  # the image of each pose
    worst = np.full(len(frames), -np.inf)
    np.maximum.at(worst, rows, errors)
    at_frames = np.where(np.bincount(rows, minlength=len(frames)) > 0, worst, at_frames)
    before = np.searchsorted(poses, frames, side="right") - 1
    none = before < 0
    since = np.where(none, path[:1], _path_at(truth, poses)[before])
    held = np.where(none, 0.0, errors[before]) + path - since
    return np.asarray(np.where(missing, held, at_frames))


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
    true, estimated = (interpolated(t.stamps, t.positions, inside) for t in (truth, estimate))
    return position_errors(true, estimated) + away


def _path_at(truth: Trajectory, stamps: Stamps) -> Floats:
    return interpolated(truth.stamps, truth.distances()[:, None], stamps)[:, 0]


MILLISECOND = 1_000_000
_MOST_TICKS = 100_000
_BLOCK = 65_536
_NEAR = SECOND  # nanoseconds from a compared pose within which others count as compared
_BURST = 4  # poses in a usual step, on average, from which one of them counts
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
    note: str = ""  # what a reader of the figures has to know; empty if nothing
    orientations: Orientations | None = None  # whether they are the body's, if that is known
    # The same in the truth's frame, where there is a truth; `None` if there are none.
    aligned: Trajectory | None = None
    image_errors: Errors | None = None  # errors of each pose at the time of its image
    # Errors of the newest pose at each control tick; of a long flight every second one, fourth, ….
    tick_errors: Errors | None = None
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
    alignment: AlignmentMethod | Literal["auto"] = "auto",  # see `choose_alignment`
    align_first: float | None = None,  # see `align`
    rate: float = 400.0,  # control ticks a second
    gap: float = 0.5,  # seconds of silence that count as lost
    hole: int = HOLE,  # time between true poses (ns) over which none is made up
) -> Judgement:
    """Judge an estimator against the truth of the same body.

    Args:
        record: Without arrivals, latencies and errors at control ticks are not among the figures.
            With a `lever`, errors are those at its end, the camera: in a unit of its own an
            estimator knows the camera's place, but not the body's beside it.
        cameras: Stamps of the images (ns), strictly rising, by camera: the flight is that of the
            estimator's camera; without cameras that of the truth.
    """
    end = int(truth.stamps[-1]) if end is None else end
    longest_map = record.longest
    estimate = longest_map.rows.trajectory() if len(longest_map) else None
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
    weighed = None if estimate is None else _weighed(estimate, frames)
    sparse = weighed is not None and is_sparser(truth, weighed)
    longest = bridged(truth, hole) if sparse else hole
    start, stop = coverage.flight
    inside = (truth.stamps >= start) & (truth.stamps <= stop)
    if sparse:  # the truth at images between its poses is not known
        due = truth.stamps[inside]
    due = due[truth.covers(due, longest)]
    lengths = truth.distances(longest)
    path = float(np.ptp(lengths[inside] if inside.any() else lengths))
    sent, lever = estimate, np.array(record.lever)
    truth = truth.moved(lever)
    if estimate is not None and weighed is not None:
        estimate, weighed = estimate.moved(lever), weighed.moved(lever)
    figures: dict[str, Any] = {
        "method": record.method,
        "estimates": len(longest_map),
        "compared": 0 if sparse else int(truth.covers(poses, hole).sum()),
        "coverage_percent": coverage.percent,
        "frame_coverage_percent": None if frames is None else coverage.frames_percent,
        "lost_seconds": seconds(coverage.lost),
        "lost_count": len(coverage.lost),
        "restarts": record.restarts,
        "repeated_stamps": record.repeated,
        "future_stamps": record.future,
        "other_bodies": sum(
            count
            for name, count in longest_map.bodies.items()
            if name.rpartition("/")[2] != body.rpartition("/")[2]
        ),
        "path_m": path,
        # Without any pose, initialization lasts to the end.
        "initialization_seconds": (
            (coverage.flight.end if estimate is None else int(poses[0])) - coverage.flight.start
        )
        / SECOND,
    }

    def without() -> dict[str, float | None]:
        errors = held_errors(truth, due, poses[:0], np.empty(0), coverage.lost)
        return _held(errors, path, due, planned)

    frame = longest_map.frame_id
    how = choose_alignment(record.scale_free, frame) if alignment == "auto" else alignment
    final, final_note = _judge_final(
        record, truth, hole, due, path, alignment, align_first, figures, planned
    )
    if estimate is None or weighed is None:
        figures |= without()
        return Judgement(figures, sent, final_note, lost=coverage.lost, final=final)
    # An interval that lasts to the end of the flight counts as long as it is: it took no less.
    if took := [seconds([interval]) for interval in coverage.lost if interval.start >= poses[0]]:
        figures["relocalization_p50_seconds"] = float(np.median(took))
        figures["relocalization_max_seconds"] = max(took)
    figures["alignment"] = how
    figures["rate_hz"] = (len(estimate) - 1) / estimate.seconds if estimate.seconds else 0.0
    if len(arrivals):
        figures |= _latencies(poses, arrivals, due)
    notes = [record.elsewhere(), _not_compared(truth, poses, longest), final_note]
    if frames is None and len(weighed) < len(estimate):
        notes.append(f"of {len(estimate)} poses in bursts {len(weighed)} weigh, one a usual step")
    try:
        true_poses, estimated = pair(truth, weighed, hole)
        orientations = examine(true_poses, estimated)
        how = figures["alignment"] = _possible(how, alignment, align_first, orientations)
        aligned = align(estimated, true_poses, how, align_first)
    except ValueError as error:  # too little to align, or no time in common
        figures |= {**without(), "why": f"{error}{_elsewhere_in_time(truth, estimate)}"}
        note = "; ".join(filter(None, notes))
        return Judgement(figures, sent, note, lost=coverage.lost, final=final)
    if sparse:
        figures["compared"] = len(true_poses)
    figures["compared_percent"] = 100.0 * float(_near(true_poses.stamps, poses).mean())
    figures |= _errors(
        true_poses, estimated, aligned.trajectory, path, truth.pieces(true_poses.stamps, longest)
    )
    offset = best_time_offset(truth, weighed, with_scale=how == "sim3")
    if offset is not None:
        figures["time_offset_ms"] = 1e3 * offset.seconds
        notes.append(offset.text())
    notes.append(_tilted(true_poses, aligned.trajectory, how))
    if orientations is not None:
        figures["orientations"] = orientations.kind
        figures["body_rotation_deg"] = orientations.degrees
        figures["body_rotation_spread_deg"] = orientations.spread
        notes.append(orientations.text())
    moved, arrived = aligned.trajectory, arrivals[:0]
    whole = transform(estimate, aligned.rotation, aligned.translation, aligned.scale)
    if not sparse:
        rows = truth.covers(poses, hole)
        true_poses, moved = truth.at(poses[rows]), whole.take(rows)
        arrived = arrivals[rows] if len(arrivals) else arrivals
    at_images = Errors(
        stamps=true_poses.stamps,
        since=arrived,
        position=position_errors(true_poses.positions, moved.positions),
        rotation=rotation_errors(true_poses.orientations, moved.orientations),
    )
    held = held_errors(truth, due, true_poses.stamps, at_images.position, coverage.lost)
    figures |= _held(held, path, due, planned)
    figures |= _velocities_and_covariances(longest_map, lever, truth, true_poses, moved, aligned)
    at_ticks = None
    if len(arrivals):
        at_ticks, available = errors_at_ticks(truth, whole, arrivals, rate, hole)
        figures |= available
    if orientations is not None and not orientations.usable:
        figures = {k: v for k, v in figures.items() if not figure(k).of_orientation}
        figures["why_no_rotations"] = orientations.text()
    note = "; ".join(filter(None, notes))
    at_body = moved.moved(-lever)
    return Judgement(
        figures, sent, note, orientations, at_body, at_images, at_ticks, coverage.lost, final
    )


def _weighed(estimate: Trajectory, frames: Stamps | None) -> Trajectory:
    """Return the poses of which errors are means: one an image, or one a step without images.

    Otherwise, many poses where it is easy would hide those where it is not.
    """
    stamps = estimate.stamps
    return estimate.take(one_a_step(stamps) if frames is None else one_an_image(frames, stamps))


def _latencies(poses: Stamps, arrivals: Stamps, due: Stamps) -> dict[str, float]:
    late = arrivals - poses
    period = max((np.median(np.diff(s)) for s in (poses, due) if len(s) > 1), default=0.0)
    too_late = int((late > _LATE * period).sum()) if period else 0
    return {
        "latency_p50_ms": float(np.percentile(late / MILLISECOND, 50)),
        "latency_p99_ms": float(np.percentile(late / MILLISECOND, 99)),
        "not_causal": too_late,
        "not_causal_percent": 100.0 * too_late / len(poses),
    }


def _errors(
    truth: Trajectory,
    estimate: Trajectory,  # in its own frame
    aligned: Trajectory,  # in the truth's
    path: float,  # metres of the flight
    pieces: Stamps,  # of the truth, see `Trajectory.pieces`
) -> dict[str, Any]:
    """Return absolute and relative errors of poses at equal stamps."""
    figures: dict[str, Any] = {
        **absolute_errors(truth, aligned),
        **_aligned_as_a_whole(truth, estimate),
    }
    figures["ate_percent"] = 100.0 * figures["ate_rmse_m"] / path if path > 0 else None
    try:
        if pieces[0] == pieces[-1]:  # or else the length of the path between is not known
            figures["end_error_percent"] = end_error_percent(truth, aligned)
        figures |= frame_errors(truth, aligned, pieces)
        figures |= segment_errors(truth, aligned, path, pieces)
        figures |= path_errors(truth, aligned, pieces=pieces)
    except ValueError as error:  # it did not get that far
        figures["why"] = str(error)
    return figures


def one_an_image(frames: Stamps, poses: Stamps) -> npt.NDArray[np.bool_]:
    """Return a mask of the poses nearest to an image each, within half the image period.

    An image has one pose, and a pose one image: the nearer. If no image has a pose, all count.

    Args:
        frames: Stamps of the images (ns), strictly rising, shape (n,), n ≥ 1.
        poses: Stamps of the poses (ns), strictly rising, shape (m,), m ≥ 1.
    """
    image, distance = nearest(frames, poses)
    order = np.lexsort((distance, image))
    first = np.append(True, np.diff(image[order]) > 0)
    mask = np.zeros(len(poses), np.bool_)
    mask[order[first]] = True
    period = int(np.median(np.diff(frames))) if len(frames) > 1 else 0
    mask &= 2 * distance <= period
    return mask if mask.any() else np.ones(len(poses), np.bool_)


def one_a_step(poses: Stamps) -> npt.NDArray[np.bool_]:
    """Return a mask of the first pose in each usual step, if poses come in bursts; else of all.

    The usual step is the one at which half of the time has passed in longer ones.

    Args:
        poses: Stamps (ns), strictly rising, shape (n,), n ≥ 1.
    """
    everything = np.ones(len(poses), np.bool_)
    if len(poses) < 2:
        return everything
    steps = np.sort(np.diff(poses))
    passed = np.cumsum(steps)
    usual = int(steps[np.searchsorted(passed, passed[-1] / 2)])
    bins = (poses - poses[0]) // usual
    first = np.append(True, np.diff(bins) > 0)
    return first if len(poses) > _BURST * first.sum() else everything


def _near(compared: Stamps, poses: Stamps) -> npt.NDArray[np.bool_]:
    """Return a mask of the poses at most `_NEAR` from a compared one."""
    after = np.clip(np.searchsorted(compared, poses), 0, len(compared) - 1)
    before = np.clip(after - 1, 0, None)
    nearest = np.minimum(abs(compared[after] - poses), abs(compared[before] - poses))
    return np.asarray(nearest <= _NEAR)


def _elsewhere_in_time(truth: Trajectory, estimate: Trajectory) -> str:
    """Return the time offset with which an estimate fits, if it has no time in common."""
    if truth.covers(estimate.stamps).any() or estimate.covers(truth.stamps).any():
        return ""
    offset = best_time_offset(truth, estimate, with_scale=True, anywhere=True)
    if offset is None or offset.after > 0.02 * np.linalg.norm(truth.positions.std(axis=0)):
        return ""
    return f"; with {offset.seconds:+.4f} s added to its stamps it would fit"


def _not_compared(truth: Trajectory, stamps: Stamps, hole: int) -> str:
    """Return how many poses of these stamps (ns) no truth is known for, and why; empty if none."""
    inside = truth.covers(stamps)
    outside, between = (~inside).sum(), (inside & ~truth.covers(stamps, hole)).sum()
    reasons = [f"{outside} outside the truth's time"] if outside else []
    if between:
        longest = int(np.diff(truth.stamps).max()) / SECOND
        reasons += [
            f"{between} between true poses more than {hole / SECOND:g} s apart (as max_difference "
            f"says; the longest hole is {longest:.3g} s)"
        ]
    return f"not compared, of {len(stamps)} poses: {', '.join(reasons)}" if reasons else ""


def _aligned_as_a_whole(truth: Trajectory, estimate: Trajectory) -> dict[str, float]:
    """Return the ATE after each alignment as a whole, and the scale; nothing for a line."""
    figures: dict[str, float] = {}
    wholes: tuple[AlignmentMethod, ...] = ("se3", "sim3")
    with contextlib.suppress(ValueError):
        for how in wholes:
            whole = align(estimate, truth, how)
            errors = position_errors(truth.positions, whole.trajectory.positions)
            figures |= {f"ate_{how}_rmse_m": rms(errors), "scale": whole.scale}
    return figures


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


_LEAST_POSES: dict[AlignmentMethod, int] = {
    "none": 1, "origin": 2, "posyaw": 2, "se3": 3, "sim3": 3
}  # fmt: skip
"""Poses below which an alignment leaves no error to see."""


def _judge_final(
    record: EstimatorRecord,
    truth: Trajectory,  # of the lever's end
    hole: int,
    frames: Stamps,
    path: float,
    alignment: AlignmentMethod | Literal["auto"],
    align_first: float | None,
    figures: dict[str, Any],
    planned: int | None,
) -> tuple[Trajectory | None, str]:
    """Judge the trajectory after loop closures: add figures, return aligned poses and a note."""
    if record.final is None:
        return None, ""
    figures["final_poses"] = len(record.final)
    lever = np.array(record.lever)
    how = alignment
    if how == "auto":
        how = choose_alignment(record.scale_free, record.final_frame_id)
    try:
        final = record.final.take(one_a_step(record.final.stamps)).moved(lever)
        true_poses, estimated = pair(truth, final, hole)
        if (count := len(estimated)) < (least := _LEAST_POSES[how]):
            raise ValueError(f"expected at least {least} poses to align by {how}, found {count}")
        orientations = examine(true_poses, estimated)
        how = _possible(how, alignment, align_first, orientations)
        moved = align(estimated, true_poses, how, align_first).trajectory
    except ValueError as error:
        figures["why_not_final"] = str(error)
        return None, ""
    errors = absolute_errors(true_poses, moved)
    figures["final_ate_rmse_m"] = errors["ate_rmse_m"]
    notes = []
    if orientations is not None:
        notes.append(orientations.text())
    if orientations is None or orientations.usable:
        figures["final_rot_rmse_deg"] = errors["rot_rmse_deg"]
    figures["final_ate_percent"] = 100.0 * errors["ate_rmse_m"] / path if path > 0 else None
    held = interpolated_errors(truth, frames, moved)
    figures |= _held(held, path, frames, planned, "final_")
    offset = best_time_offset(truth, final, with_scale=how == "sim3")
    if offset is not None:
        notes.append(offset.text())
    note = "; ".join(filter(None, notes))
    return moved.moved(-lever), f"after loop closures: {note}" if note else ""


def _possible(
    method: AlignmentMethod,
    asked: AlignmentMethod | Literal["auto"],
    first: float | None,
    orientations: Orientations | None,
) -> AlignmentMethod:
    """Return the alignment that is possible without orientations, if these are missing.

    Raises:
        ValueError: One that needs them was asked for.
    """
    if orientations is None or not orientations.missing:
        return method
    if method != "origin" and not (method == "posyaw" and first == 1):
        return method
    if asked != "auto":
        reason = orientations.text().partition(";")[0]
        raise ValueError(f"alignment: expected orientations for {method}, found none: {reason}")
    return "se3" if orientations.kind == "truth without" else method


_TILT = 10.0  # degrees of a vertical that is reported
_FITS = 0.2  # share of the error that is left without the tilt


def _tilted(truth: Trajectory, aligned: Trajectory, method: AlignmentMethod) -> str:
    """Return a sentence if an estimate's vertical is not the truth's, where it has to be."""
    if method not in {"posyaw", "none"}:
        return ""
    try:
        rigid = align(aligned, truth, "se3")
    except ValueError:
        return ""
    before, after = (
        rms(position_errors(truth.positions, trajectory.positions))
        for trajectory in (aligned, rigid.trajectory)
    )
    tilt = math.degrees(math.acos(float(np.clip(rigid.rotation[2, 2], -1.0, 1.0))))
    if tilt < _TILT or after > _FITS * before:
        return ""
    return (
        f"its vertical is tilted by {tilt:.0f}° against the truth's ({after:.3g} m instead of "
        f"{before:.3g} m if aligned as a whole): {method} needs equal world axes"
    )


def _velocities_and_covariances(
    poses: MapRecord,
    lever: Floats,
    truth: Trajectory,
    true_poses: Trajectory,
    moved: Trajectory,
    aligned: Alignment,
) -> dict[str, Any]:
    """Return the figures of velocities and covariances, as far as they were given."""
    figures: dict[str, Any] = {}
    rotation, scale = aligned.rotation, aligned.scale
    for name, series in (("velocities", poses.velocities), ("covariances", poses.covariances)):
        if len(series):
            figures[f"{name}_percent"] = 100.0 * len(series) / len(poses)
    rows, values = poses.velocities.at(true_poses.stamps)
    if rows.any():
        # The true velocity is the difference of the true positions, as densely as there are.
        near = truth.near(true_poses.stamps[rows])
        true = interpolated(near.stamps, near.velocities(), true_poses.stamps[rows])
        wrong = position_errors(true, scale * values @ rotation.T)
        figures["velocity_rmse_m_per_s"] = rms(wrong)
        figures["velocity_error_percent"] = velocity_error_percent(wrong, true)
    rows, values = poses.covariances.at(true_poses.stamps)
    if rows.any():
        # That of the body, as sent, becomes that of the lever's end, as the errors are.
        turn = np.kron(np.diag([scale, 1.0]), rotation)
        levers = scale * moved.rotations()[rows].apply(lever)
        turns = np.tile(turn, (len(levers), 1, 1))
        turns[:, :3, 3:] = np.cross(levers[:, None], np.eye(3)) @ rotation  # minus its product
        turned = turns @ values.reshape(-1, 6, 6) @ turns.transpose(0, 2, 1)
        figures["covariance_too_large_percent"] = too_large_percent(turned, true_poses.length())
        figures |= consistency(true_poses.take(rows), moved.take(rows), turned)
    return figures


def choose_alignment(scale_free: bool, frame_id: str) -> AlignmentMethod:
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
    blocks = []
    sums = np.zeros(3)
    for start in range(0, len(ticks), _BLOCK):  # which is a multiple of each step
        now = ticks[start : start + _BLOCK]
        rows = newest[np.searchsorted(came, now, side="right") - 1]
        true_poses = truth.at(now)
        since = estimate.stamps[rows]
        position = position_errors(true_poses.positions, estimate.positions[rows])
        rotation = rotation_errors(true_poses.orientations, estimate.orientations[rows])
        sums += (position**2).sum(), (rotation**2).sum(), (now - since).sum()
        blocks.append([values[::step] for values in (now, since, position, rotation)])
    square, turned, age = (sums / len(ticks)).tolist()
    return Errors(*map(np.concatenate, zip(*blocks, strict=True))), {
        "newest_pose_rmse_m": math.sqrt(square),
        "newest_pose_rot_rmse_deg": math.degrees(math.sqrt(turned)),
        "newest_pose_age_ms": age / MILLISECOND,
    }
