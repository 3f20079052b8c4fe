"""Files of an evaluation in a run's folder.

trajectories/truth.tum              the true poses; it grows with the run
trajectories/<estimator>.tum        the estimates as they were sent; likewise (of ``a/b``: a+b.tum)
trajectories/plan.tum               where the pilot meant to be
trajectories/truth.<vehicle>.tum    both of the second vehicle, the third, …
trajectories/collisions.csv         what the vehicles hit, when and where
evaluation/<estimator>.csv          errors of each estimate at the time of its image
evaluation/<estimator>.lost.csv     when it had no pose
evaluation/<estimator>.ticks.csv    errors of the newest pose there was at each control tick (of a
                                    long run every second one, fourth, …)
evaluation/<estimator>.aligned.tum  the estimates in the truth's frame
evaluation/<estimator>.final.tum    the same of its trajectory after loop closures, if it sent one
evaluation/verdict.json             all figures
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from nodes.judging.evaluation.judging import Errors, Judgement
from nodes.trajectory import Trajectory
from nodes.trajectory_files import write_tum
from runtime.source_files import source_file

FRAMES = "base_link (FRD) in {}: timestamp[s] tx ty tz[m] qx qy qz qw"


def write_results(
    out: Path,
    plans: Mapping[str, Trajectory | None],
    judgements: dict[str, Judgement],
    verdict: dict[str, Any],
) -> None:
    """Write the files above into a run's folder, except those written during the run."""
    trajectories, evaluation = out / "trajectories", out / "evaluation"
    trajectories.mkdir(exist_ok=True)
    evaluation.mkdir(exist_ok=True)
    for file, plan in plans.items():
        if plan is not None:
            write_tum(trajectories / f"{file}.tum", plan, FRAMES.format("map (NED)"))
    for source, judgement in judgements.items():
        name = source_file(source)
        if judgement.aligned is not None:
            comment = FRAMES.format("map (NED), aligned")
            write_tum(evaluation / f"{name}.aligned.tum", judgement.aligned, comment)
        if judgement.final is not None:
            comment = FRAMES.format("map (NED), after loop closures, aligned")
            write_tum(evaluation / f"{name}.final.tum", judgement.final, comment)
        rows = [f"{start},{end}\n" for start, end in judgement.lost]
        lost = "".join(["start_ns,end_ns\n", *rows])
        (evaluation / f"{name}.lost.csv").write_text(lost, encoding="ascii")
        if judgement.image_errors is not None:
            _write_errors(evaluation / f"{name}.csv", "arrival_ns", judgement.image_errors)
        if judgement.tick_errors is not None:
            _write_errors(evaluation / f"{name}.ticks.csv", "pose_ns", judgement.tick_errors)
    text = msgspec.json.format(msgspec.json.encode(verdict), indent=2)
    (evaluation / "verdict.json").write_bytes(text + b"\n")


def read_errors(path: Path) -> Errors:
    """Read a file of errors; may raise `OSError` or `ValueError`."""
    with path.open(encoding="ascii") as file:
        known = file.readline().count(",") == 3  # or else not when each came
    times, columns = ((0, 1), (2, 3)) if known else ((0,), (1, 2))
    stamps = np.loadtxt(path, np.int64, delimiter=",", skiprows=1, usecols=times, ndmin=2)
    errors = np.loadtxt(path, delimiter=",", skiprows=1, usecols=columns, ndmin=2)
    return Errors(stamps[:, 0], stamps[:, 1:].ravel(), errors[:, 0], errors[:, 1])


def _write_errors(path: Path, since: str, errors: Errors) -> None:
    known = len(errors.since) > 0
    times = (f"{stamp}," for stamp in errors.stamps.tolist())
    if known:
        times = (f"{time}{came}," for time, came in zip(times, errors.since.tolist(), strict=True))
    rows = zip(times, errors.position.tolist(), errors.rotation.tolist(), strict=True)
    lines = [f"stamp_ns,{f'{since},' if known else ''}position_error_m,rotation_error_rad\n"]
    lines += [f"{time}{p:.9f},{r:.9f}\n" for time, p, r in rows]
    path.write_text("".join(lines), encoding="ascii")
