"""What an evaluation leaves in a run's folder, for people, for plots and for other tools.

trajectories/truth.tum              the true poses
trajectories/<estimator>.tum        the estimates as they were said
trajectories/plan.tum               where the pilot meant to be
evaluation/<estimator>.csv          errors of each estimate at the time of its image
evaluation/<estimator>.lost.csv     when it had no pose
evaluation/<estimator>.ticks.csv    errors of the newest pose there was at each control tick
evaluation/<estimator>.aligned.tum  the estimates in the truth's frame
evaluation/verdict.json             all figures
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from nodes.evaluation.judging import Errors, Judgement
from nodes.trajectory import Trajectory
from nodes.trajectory.formats import write_tum

FRAMES = "base_link (FRD) in {}: timestamp[s] x y z[m] qx qy qz qw"


def write_results(
    out: Path,
    truth: Trajectory | None,
    plan: Trajectory | None,
    judgements: dict[str, Judgement],
    verdict: dict[str, Any],
    *,
    partial: bool = False,
) -> None:
    """Write all of the above into a run's folder.

    Args:
        out: The folder.
        truth: True poses, if any came.
        plan: Where the pilot meant to be, if it said so.
        judgements: By source of the estimator.
        verdict: All figures.
        partial: What is known is not all there was: the trajectories that have grown with the run
            are left as they are.
    """
    trajectories, evaluation = out / "trajectories", out / "evaluation"
    trajectories.mkdir(exist_ok=True)
    evaluation.mkdir(exist_ok=True)
    if truth is not None and not partial:
        write_tum(trajectories / "truth.tum", truth, FRAMES.format("map (NED)"))
    if plan is not None:
        write_tum(trajectories / "plan.tum", plan, FRAMES.format("map (NED)"))
    for source, judgement in judgements.items():
        name = file_name(source)
        if judgement.estimate is not None and not partial:
            comment = FRAMES.format("the estimator's own frame")
            write_tum(trajectories / f"{name}.tum", judgement.estimate, comment)
        if judgement.aligned is not None:
            comment = FRAMES.format("map (NED), aligned")
            write_tum(evaluation / f"{name}.aligned.tum", judgement.aligned, comment)
        rows = [f"{start},{end}\n" for start, end in judgement.lost]
        lost = "".join(["start_ns,end_ns\n", *rows])
        (evaluation / f"{name}.lost.csv").write_text(lost, encoding="ascii")
        if judgement.of_images is not None:
            _write_errors(evaluation / f"{name}.csv", "arrival_ns", judgement.of_images)
        if judgement.of_ticks is not None:
            _write_errors(evaluation / f"{name}.ticks.csv", "pose_ns", judgement.of_ticks)
    text = msgspec.json.format(msgspec.json.encode(verdict), indent=2)
    (evaluation / "verdict.json").write_bytes(text + b"\n")


def file_name(source: str) -> str:
    """Return the name of an estimator's files: its source, without what divides folders."""
    return source.replace("/", "_")


def read_errors(path: Path) -> Errors:
    """Read one of the files of errors.

    Raises:
        OSError: It cannot be read.
        ValueError: It holds something else.
    """
    stamps = np.loadtxt(path, np.int64, delimiter=",", skiprows=1, usecols=(0, 1), ndmin=2)
    errors = np.loadtxt(path, delimiter=",", skiprows=1, usecols=(2, 3), ndmin=2)
    return Errors(stamps[:, 0], stamps[:, 1], errors[:, 0], errors[:, 1])


def _write_errors(path: Path, since: str, errors: Errors) -> None:
    rows = zip(
        errors.stamps.tolist(),
        errors.since.tolist(),
        errors.position.tolist(),
        errors.rotation.tolist(),
        strict=True,
    )
    lines = [f"stamp_ns,{since},position_error_m,rotation_error_rad\n"]
    lines += [f"{stamp},{came},{p:.9f},{r:.9f}\n" for stamp, came, p, r in rows]
    path.write_text("".join(lines), encoding="ascii")
