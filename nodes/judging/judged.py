"""Results of a judgement: a folder like a run's, or the same in memory."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np

from nodes.judging.evaluation.files import FRAMES, write_results
from nodes.judging.evaluation.judging import Judgement
from nodes.judging.readers import Source
from nodes.judging.report.page import write_report
from nodes.judging.report.tables import COLORS, Estimator, Facts, Run, Verdict
from nodes.trajectory_files import write_tum
from runtime.commit import commit
from runtime.errors import ResultsError
from runtime.run import results
from runtime.run.sources import content_hash
from runtime.run.summarise import command_line, environment
from runtime.source_files import source_file


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
        write_results(out, {}, judgements, msgspec.to_builtins(verdict))
        write_tum(out / "trajectories" / "truth.tum", truth.poses, FRAMES.format("map (NED)"))
        for name, judgement in judgements.items():
            assert judgement.estimate is not None
            path = out / "trajectories" / f"{source_file(name)}.tum"
            write_tum(path, judgement.estimate, FRAMES.format("a frame of its own"))
        files = {"truth": truth.file, **{k: j.figures["method"] for k, j in judgements.items()}}
        facts = Facts(
            name=out.name,
            verdict=verdict,
            environment={**environment(), "command": command_line(), "commit": commit()},
            judged=files,
            judged_hashes={name: _hash(file) for name, file in files.items()},
            notes=list(notes),
        )
        text = msgspec.json.format(msgspec.json.encode(facts), indent=2)
        results.write(out / "summary.json", text + b"\n")
        page = write_report(out)
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
            image_errors=judgement.image_errors,
            tick_errors=judgement.tick_errors,
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


def _hash(file: str) -> str:
    """Return the hash of a file, of a bag for one of its topics; empty for an array or a folder."""
    path = Path(file) if Path(file).exists() else Path(file.rpartition(":/")[0])
    return content_hash(path) if path.is_file() else ""
