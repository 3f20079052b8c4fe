"""Evaluation of several trajectories against a common truth, and its results folder.

The figures are those of an evaluation, but for those of arrivals: latencies, errors at control
ticks and future stamps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import msgspec
import numpy as np
import numpy.typing as npt

from nodes.judging.evaluation.judging import Judgement, judge
from nodes.judging.evaluation.metrics import How
from nodes.judging.evaluation.node import EvaluationConfig
from nodes.judging.evaluation.record import EstimatorRecord
from nodes.judging.evaluation.results import FRAMES, write_results
from nodes.judging.evaluation.verdict import conclude
from nodes.judging.judge.sources import Axes, Source
from nodes.judging.report.page import write_report
from nodes.judging.report.style import COLORS
from nodes.judging.report.tables import Estimator, Facts, Run, Verdict
from nodes.trajectory import Trajectory
from nodes.trajectory.formats import write_tum
from runtime import Duration
from runtime.errors import ResultsError
from runtime.paths import source_file
from runtime.run import results
from runtime.run.summarise import command_line, commit, environment
from runtime.time.schedule import SECOND


class JudgeConfig(EvaluationConfig):
    """Settings of a judgement: as an evaluation, but ``auto`` is ``se3`` for an unknown frame.

    Attributes:
        scale_free: Whether the estimates' unit of length is their own.
        axes: Those of the estimates' files; see `nodes.judging.judge.sources.AXES`.
        max_difference: From an estimate to the nearest true pose; farther ones are not compared.
    """

    scale_free: bool = False
    axes: Axes | None = None
    max_difference: Duration = Duration(0.1)


def judge_all(
    truth: Source,
    estimates: Sequence[Source],
    frames: npt.NDArray[np.int64] | None,  # stamps of the images (ns), if known
    config: JudgeConfig,
    finals: Mapping[str, Trajectory] = MappingProxyType({}),
) -> tuple[dict[str, Judgement], Verdict, list[str]]:
    """Judge estimates against the truth, at the stamps of the images if known.

    Args:
        finals: The trajectories after loop closures, by estimate.

    Returns:
        Judgements by name, the verdict, and notes on exclusions.

    Raises:
        ValueError: A name is not unique, an estimate is nowhere near a true pose in time, or a
            final trajectory names no estimate.
    """
    names = [source.name for source in estimates]
    if strangers := finals.keys() - {*names}:
        raise ValueError(
            f"final: expected the name of an estimate ({', '.join(names)}), found {min(strangers)}"
        )
    judgements: dict[str, Judgement] = {}
    notes = []
    for source in estimates:
        if source.name in {*judgements, "truth", "plan"}:
            raise ValueError(f"{source.file}: expected a name of its own, NAME={source.file}")
        by_frame: dict[str, How] = {"": "se3", "map": "none"}
        usual = "sim3" if config.scale_free else by_frame.get(source.frame_id, "origin")
        poses, note = _compared(truth.poses, source, config.max_difference)
        record = EstimatorRecord.of(poses)
        record.final = finals.get(source.name)
        judgement = judge(
            record,
            truth.poses,
            cameras=None if frames is None else {"": frames},
            alignment=usual if config.alignment == "auto" else config.alignment,
            gap=config.gap,
        )
        unknown = {"restarts", "repeated_stamps", "future_stamps", "other_bodies"}
        figures = {k: v for k, v in judgement.figures.items() if k not in unknown} | source.counts
        figures["method"] = source.file
        figures["compared"] = int(truth.poses.covers(poses.stamps).sum())
        judgements[source.name] = msgspec.structs.replace(judgement, figures=figures)
        notes += [f"{source.name}: {note}"] if note else []
    verdict = conclude({k: j.figures for k, j in judgements.items()}, config.thresholds)
    return judgements, msgspec.convert(verdict, Verdict), notes


def write(
    out: Path,
    truth: Source,
    judgements: dict[str, Judgement],
    verdict: Verdict,
    notes: Sequence[str],
) -> Path:
    """Write a results folder like a run's, with figures and a report; return the report's path.

    An earlier judgement there is renamed by its time.

    Raises:
        ResultsError: The folder has something else, or cannot be written.
    """
    if (out / "config.toml").exists():
        raise ResultsError(f"{out}: expected no run's folder: name another with --out")
    with results.Folder(out) as folder:
        page = _write(out, truth, judgements, verdict, notes)
        folder.flown()
    return page


def in_memory(
    truth: Source, judgements: dict[str, Judgement], verdict: Verdict, notes: Sequence[str]
) -> Run:
    """Return what `read_run` finds in the folder that `write` writes."""
    estimators = [
        Estimator(
            name=name,
            color=COLORS[k % len(COLORS)],
            figures=verdict.estimators[name],
            aligned=judgement.aligned,
            of_images=judgement.of_images,
            of_ticks=judgement.of_ticks,
            lost=judgement.lost,
            final=judgement.final,
        )
        for k, (name, judgement) in enumerate(judgements.items())
    ]
    return Run(
        folder=Path(),
        facts=Facts(name="trajectories", verdict=verdict),
        verdict=verdict,
        truths={"": truth.poses},
        plans={},
        collisions=np.empty((0, 3)),
        estimators=estimators,
        frames={},
        clouds=[],
        config=None,
        log=[],
        missing=list(notes),
    )


def _write(
    out: Path,
    truth: Source,
    judgements: dict[str, Judgement],
    verdict: Verdict,
    notes: Sequence[str],
) -> Path:
    write_results(out, {}, judgements, msgspec.to_builtins(verdict))
    write_tum(out / "trajectories" / "truth.tum", truth.poses, FRAMES.format("map (NED)"))
    for name, judgement in judgements.items():
        assert judgement.estimate is not None
        path = out / "trajectories" / f"{source_file(name)}.tum"
        write_tum(path, judgement.estimate, FRAMES.format("a frame of its own"))
    facts = Facts(
        name=out.name,
        verdict=verdict,
        environment={**environment(), "command": command_line(), "commit": commit()},
        judged={"truth": truth.file, **{k: j.figures["method"] for k, j in judgements.items()}},
        notes=list(notes),
    )
    text = msgspec.json.format(msgspec.json.encode(facts), indent=2)
    results.write(out / "summary.json", text + b"\n")
    return write_report(out)


def _compared(truth: Trajectory, source: Source, most: float) -> tuple[Trajectory, str]:
    """Return the poses except those far in time from true ones, and a note on exclusions."""
    poses = source.poses
    after = np.searchsorted(truth.stamps, poses.stamps)
    ends = truth.stamps[np.clip([after - 1, after], 0, len(truth) - 1)]
    inside = truth.covers(poses.stamps)
    far = inside & (abs(ends - poses.stamps).min(axis=0) > most * SECOND)
    if far.all():
        raise ValueError(f"{source.file}: expected true poses within {most:g} s of its, found none")
    said = [f"{(~inside).sum()} outside the truth's time"] if not inside.all() else []
    said += [f"{far.sum()} more than {most:g} s from any true pose"] if far.any() else []
    note = f"not compared, of {len(poses)} poses: {', '.join(said)}" if said else ""
    return poses.take(~far), note
