"""Evaluation of trajectories from outside a run: common axes and truth, and results.

The figures are those of an evaluation, but for those of arrivals: latencies, errors at control
ticks and future stamps. What is read, and how, is a table: `nodes.judging.readers`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType

import msgspec
import numpy as np
import numpy.typing as npt

from nodes.judging.evaluation.alignment import AlignmentMethod
from nodes.judging.evaluation.judging import Judgement, judge
from nodes.judging.evaluation.node import EvaluationConfig
from nodes.judging.evaluation.record import EstimatorRecord
from nodes.judging.evaluation.thresholds import Thresholds
from nodes.judging.evaluation.verdict import conclude
from nodes.judging.readers import Axes, AxesName, Source, complaints, to_common_axes
from nodes.judging.report.tables import Verdict
from nodes.trajectory import Trajectory
from runtime import Duration
from runtime.time.clock import SECOND

Floats = npt.NDArray[np.float64]
Stamps = npt.NDArray[np.int64]

IMAGES_PERCENT = 30.0
"""Share of the images with a pose that is asked for where their stamps are given, but for files of
key frames (a longer ``gap``): an estimator may skip two images of three, not eight of nine."""


class JudgeConfig(EvaluationConfig):
    """Settings of a judgement: as an evaluation, but ``auto`` is ``se3`` for an unknown frame.

    Attributes:
        scale_free: Whether the estimates' unit of length is their own.
        columns: Meaning of the columns of the estimates' text files: ``sec x y z qw qx qy qz``.
        truth_columns: Likewise of the truth's.
        axes: Those of the estimates; see `nodes.judging.readers.AXES`. By default, what they
            declare, or else the truth's.
        truth_axes: Likewise of the truth.
        time_offset: Added to the estimates' stamps: seconds, or a text as ``-30ms``.
    """

    scale_free: bool = False
    columns: str = ""
    truth_columns: str = ""
    axes: AxesName | None = None
    truth_axes: AxesName | None = None
    time_offset: float | str = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        offset_of(self.time_offset)


def offset_of(offset: float | str) -> int:
    """Return nanoseconds of seconds, or of a text as ``-30ms``; a `ValueError` if it is neither."""
    sign, size = 1, offset
    if isinstance(offset, str):
        text = offset.strip()
        sign, size = (-1 if text.startswith("-") else 1), text.lstrip("+-")
        try:
            size = float(size)
        except ValueError:
            size = str(size)
    elif offset < 0:
        sign, size = -1, -offset
    try:
        return sign * round(Duration.parse(size) * SECOND)
    except ValueError as error:
        raise ValueError(f"time_offset: {error}, after a sign or none; found {offset!r}") from None


def judge_all(
    truth: Source,
    estimates: Sequence[Source],
    frames: Stamps | None,  # stamps of the images (ns), if known
    config: JudgeConfig,
    finals: Mapping[str, Source] = MappingProxyType({}),
) -> tuple[Source, dict[str, Judgement], Verdict, list[str]]:
    """Judge estimates against the truth, at the stamps of the images if known.

    Args:
        finals: The trajectories after loop closures, by estimate.

    Returns:
        The truth in the report's axes, judgements by name, the verdict, and notes on what was left
        out.

    Raises:
        ValueError: A name is not unique, an estimate is nowhere near a true pose in time, a final
            trajectory names no estimate, images are at other times than the truth, or axes are not
            known.
    """
    names = [source.name for source in estimates]
    if strangers := finals.keys() - {*names}:
        raise ValueError(
            f"final: expected the name of an estimate ({', '.join(names)}), found {min(strangers)}"
        )
    if frames is not None:
        _check_frames(truth, frames)
    judgements: dict[str, Judgement] = {}
    notes = [*complaints(), *(f"truth: {note}" for note in truth.notes)]
    notes += _without_axes(truth, estimates, config)
    truth, moved = to_common_axes(
        truth, [*estimates, *finals.values()], worlds_matter=config.alignment == "none"
    )
    moved = [_later(source, offset_of(config.time_offset)) for source in moved]
    corrected = dict(zip(finals, moved[len(estimates) :], strict=True))
    for source in moved[: len(estimates)]:
        if source.name in {*judgements, "truth", "plan"}:
            raise ValueError(f"{source.file}: expected a name of its own, NAME={source.file}")
        final = corrected.get(source.name)
        judgement = _judge_one(truth, source, final, frames, config)
        judgements[source.name] = judgement
        for one in [source] if final is None else [source, final]:
            notes += [f"{source.name}: {note}" for note in one.notes]
        notes += [f"{source.name}: {judgement.note}"] if judgement.note else []
    verdict = _conclude(judgements, config, known=frames is not None)
    return truth, judgements, verdict, notes


def _without_axes(truth: Source, estimates: Sequence[Source], config: JudgeConfig) -> Iterator[str]:
    """Yield a sentence where given axes change nothing, as the other side declares none."""
    if config.axes and truth.axes == Axes():
        yield (
            f"truth: declares no axes, so those of the estimates (--axes {config.axes}) are taken "
            "for its own; if they are not, say which by --truth-axes"
        )
    for source in estimates:
        if config.truth_axes and source.axes == Axes():
            yield (
                f"{source.name}: declares no axes, so those of the truth (--truth-axes "
                f"{config.truth_axes}) are taken for its own; if they are not, say which by --axes"
            )


def _judge_one(
    truth: Source,
    source: Source,
    final: Source | None,
    frames: Stamps | None,
    config: JudgeConfig,
) -> Judgement:
    record = EstimatorRecord.of(source.poses)
    record.final = None if final is None else final.poses
    if config.scale_free:  # the body's place beside the camera is in metres, its poses are not
        record.lever = source.lever
    for stamp, row in _rows(source, source.covariances):
        record.longest.covariances.add(stamp, row)
    for stamp, row in _rows(source, source.velocities):
        record.longest.velocities.add(stamp, row)
    judgement = judge(
        record,
        truth.poses,
        cameras=None if frames is None else {"": frames},
        alignment=_usual(truth, source, config) if config.alignment == "auto" else config.alignment,
        align_first=config.alignment_span(),
        gap=config.gap,
        hole=config.hole,
    )
    figures = judgement.figures
    if not figures["compared"]:
        figures = {**figures, "why": _why_not(truth, source, figures["why"])}
    unknown = {"restarts", "repeated_stamps", "future_stamps", "other_bodies"}
    figures = {k: v for k, v in figures.items() if k not in unknown} | source.counts
    figures["method"] = source.file
    note = "; ".join(filter(None, (judgement.note, _option_for(judgement))))
    return msgspec.structs.replace(judgement, figures=figures, note=note)


def _option_for(judgement: Judgement) -> str:
    """Return the options that fix the mismatch of body or clock in a judgement's note."""
    options = {
        "turned": "declare the axes of both by --axes and --truth-axes, or say where the camera "
        "is by --body-from-camera",
        "order": "name the columns by --columns",
    }
    orientations = judgement.orientations
    hints = [options.get(orientations.kind, "")] if orientations is not None else []
    if "added to its stamps it would fit" in judgement.note:
        hints.append("shift it by --time-offset")
    if "needs equal world axes" in judgement.note:
        hints.append("declare both by --axes and --truth-axes")
    return "; ".join(filter(None, hints))


def _why_not(truth: Source, source: Source, why: str) -> str:
    """Return why nothing is compared, with the option that may be meant, or raise `ValueError`."""
    if truth.poses.covers(source.poses.stamps).any():
        step = truth.poses.step() / SECOND
        if "max_difference" in why:
            why += f"; --max-difference {np.ceil(step * 60) / 100:g}s lets them count"
        raise ValueError(f"{source.file}: {why}")
    _, fits, offset = why.partition("; with ")
    return _no_common_time(truth, source) + (f"{fits}{offset} (--time-offset)" if fits else "")


def _usual(truth: Source, source: Source, config: JudgeConfig) -> AlignmentMethod:
    """Return how an estimate is aligned: as in a run where both name their frames."""
    if config.scale_free:
        return "sim3"
    oriented = not (truth.positions_only or source.positions_only)
    if truth.frame_id != "map" or not source.frame_id or not oriented:
        return "se3"
    return "none" if source.frame_id == "map" else "origin"


def _later(source: Source, offset: int) -> Source:
    """Return a source with an offset (ns) added to its stamps."""
    poses = source.poses
    poses = Trajectory(poses.stamps + offset, poses.positions, poses.orientations)
    return msgspec.structs.replace(source, poses=poses) if offset else source


def _rows(source: Source, values: Floats | None) -> Iterator[tuple[int, tuple[float, ...]]]:
    """Yield stamps and rows of what some of the poses have."""
    if values is not None:
        rows = values.reshape(len(values), -1)
        known = np.isfinite(rows).all(axis=1)
        stamps = source.poses.stamps[known].tolist()
        yield from zip(stamps, map(tuple, rows[known].tolist()), strict=True)


def _conclude(judgements: dict[str, Judgement], config: JudgeConfig, *, known: bool) -> Verdict:
    """Return the verdict; a missed coverage names the option that may be meant."""
    figures = {name: judgement.figures for name, judgement in judgements.items()}
    by_estimator: dict[str, Thresholds] = {}
    asked = msgspec.structs.asdict(config.thresholds)["frame_coverage_percent"]
    if known and asked is None and config.gap <= _USUAL_GAP:
        few = msgspec.structs.replace(config.thresholds, frame_coverage_percent=IMAGES_PERCENT)
        by_estimator = {
            name: few
            for name, row in figures.items()
            if row["frame_coverage_percent"] < IMAGES_PERCENT
        }
    verdict = conclude(figures, config.thresholds, by_estimator=by_estimator)
    hints = {
        "frame_coverage_percent": "of key frames only, set --gap; else say what is enough by "
        "--threshold frame_coverage_percent=…",
    }
    if not known:
        hints["coverage_percent"] = (
            "of the truth's time; if the images cover less of it, name their stamps with --frames"
        )
    for row in verdict["estimators"].values():
        row["failed"] = [
            f"{text} ({hints[name]})" if (name := text.partition(":")[0]) in hints else text
            for text in row["failed"]
        ]
    return msgspec.convert(verdict, Verdict)


_USUAL_GAP = JudgeConfig().gap
_CALENDAR = 10**17  # least stamp (ns) taken for Unix time (1973)
_UNITS = {"seconds": 1.0, "milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}


def _no_common_time(truth: Source, source: Source) -> str:
    """Return why nothing can be compared: another unit, another clock, no stamps at all."""
    first, last = truth.poses.stamps[[0, -1]].tolist()
    begin, end = source.poses.stamps[[0, -1]].tolist()
    spans = (
        f"expected poses within the truth's time, {first / SECOND:.3f} to {last / SECOND:.3f} s, "
        f"found {begin / SECOND:.3f} to {end / SECOND:.3f} s"
    )
    if not begin and not end:
        return "expected stamps, found that all are zero: the sender sets none"
    for one, other in ((source, truth), (truth, source)):
        for unit, scale in _UNITS.items():
            if unit == "seconds" or one.poses.stamps[-1] <= 0:
                continue
            shrunk = one.poses.stamps[-1] / scale
            if scale > 1 and 0.9 < shrunk / max(int(other.poses.stamps[-1]), 1) < 1.1:
                which = "the estimate" if one is source else "the truth"
                return f"{spans}: are the stamps of {which} in {unit}, and read as seconds?"
    if (last > _CALENDAR) != (end > _CALENDAR):
        return f"{spans}: one is Unix time, the other counts from a beginning"
    return spans


def _check_frames(truth: Source, frames: Stamps) -> None:
    """Raise a `ValueError` unless stamps of images are whole ns, rise, and are at the truth's time.

    Those of a file are checked by `read_stamps`, too, with the line.
    """
    if frames.dtype.kind not in "iu" or frames.ndim != 1 or not len(frames):
        raise ValueError(
            f"frames: expected stamps in whole nanoseconds, shape (n,), found {frames.dtype} of "
            f"shape {frames.shape}"
        )
    if back := np.flatnonzero(np.diff(frames) <= 0).tolist():
        before, after = frames[back[0] : back[0] + 2]
        raise ValueError(
            f"frames: row {back[0] + 1}: expected a stamp above {before} ns, found {after} ns"
        )
    if len(frames) > 1 and float(np.median(np.diff(frames))) < 1_000_000:
        raise ValueError(
            "frames: expected nanoseconds, found stamps of another unit, "
            f"{np.median(np.diff(frames)):g} apart"
        )
    if not truth.poses.covers(frames).any():
        first, last = truth.poses.stamps[[0, -1]].tolist()
        raise ValueError(
            f"frames: expected images within the truth's time, {first} to {last} ns, found "
            f"{frames[0]} to {frames[-1]} ns"
        )
