"""What a run left in its folder, read for the report.

Everything is optional, as a run may have been killed at any time: what is not there, or cannot be
read, is named in `Run.missing`, and the rest of the report goes on without it.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

from nodes.evaluation.coverage import Interval, seconds
from nodes.evaluation.judging import Errors
from nodes.evaluation.results import file_name, read_errors
from nodes.report.contents import Estimator, Facts, Run, Verdict
from nodes.report.poses import gaps, lay_on, read_poses
from nodes.report.style import COLORS
from nodes.trajectory import Trajectory

T = TypeVar("T")

SIGNS = ("summary.json", "config.toml", "log.txt", "trajectories", "evaluation")
"""A folder with one of these is a run's."""

_IMAGES = ("flight.png", "images.png")
_LOG_LINES = 200
_NO_ESTIMATES = {"truth", "plan"}
_ABOUT = 0.25
"""Seconds by which two counts of lost time may differ."""
_LOUD = {"WARNING", "ERROR", "CRITICAL"}


def read_run(folder: Path) -> Run:
    """Read what there is.

    Raises:
        ValueError: The folder is not there, or is no run's.
    """
    if not folder.is_dir():
        raise ValueError(f"{folder}: expected the folder of a run, found none")
    if not any((folder / sign).exists() for sign in SIGNS):
        inside = ", ".join(sorted(p.name for p in folder.iterdir())[:5]) or "nothing"
        raise ValueError(
            f"{folder}: expected the folder of a run, with {', '.join(SIGNS[:-1])} "
            f"or {SIGNS[-1]} in it, found {inside}"
        )
    return _Reader(folder).run()


class _Reader:
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.missing: list[str] = []

    def run(self) -> Run:
        facts = self._try("summary.json", _facts, "the run did not end in an orderly way")
        verdict = self._try("evaluation/verdict.json", _verdict, "nothing was evaluated to the end")
        if facts is not None:
            if verdict is not None and verdict.estimators and facts.verdict is None:
                self.missing.append(
                    "evaluation/verdict.json is of an earlier run: by its summary, nobody was "
                    "judged in this one. Trajectories and figures may be that one's, too"
                )
                verdict = None
            verdict = verdict or facts.verdict
        config = self._try("config.toml", _text, "the settings are not known")
        log = self._try("log.txt", _text, "what was logged is not known")
        truth = self._truth()
        plan = self._try("trajectories/plan.tum", read_poses)
        return Run(
            folder=self.folder,
            facts=facts or Facts(),
            verdict=verdict,
            truth=truth,
            plan=plan,
            estimators=self._estimators(verdict, truth),
            frames=_frames(self.folder / "frames"),
            clouds=sorted((self.folder / "clouds").glob("*.ply")),
            images=[p for name in _IMAGES if (p := self.folder / name).is_file()],
            config=config,
            log=_loud(log or ""),
            missing=self.missing,
        )

    def _truth(self) -> Trajectory | None:
        """Read the truth as the evaluation left it, else as the flight log did."""
        evaluated = (self.folder / "trajectories" / "truth.tum").is_file()
        if not evaluated and (self.folder / "trajectory.tum").is_file():
            return self._try("trajectory.tum", read_poses)
        return self._try("trajectories/truth.tum", read_poses, "there is nothing to compare with")

    def _estimators(self, verdict: Verdict | None, truth: Trajectory | None) -> list[Estimator]:
        figures = {} if verdict is None else verdict.estimators
        files = {file_name(name): name for name in figures}
        sent = {p.stem for p in (self.folder / "trajectories").glob("*.tum")} - _NO_ESTIMATES
        files |= {file: file for file in sorted(sent - set(files))}
        if not files:
            self.missing.append("no estimator has sent anything, and none was judged")
        return [
            self._estimator(file, name, COLORS[k % len(COLORS)], figures.get(name, {}), truth)
            for k, (file, name) in enumerate(files.items())
        ]

    def _estimator(
        self, file: str, name: str, color: str, figures: dict[str, Any], truth: Trajectory | None
    ) -> Estimator:
        found = Estimator(name=name, color=color, figures=figures)
        aligned = self._try(f"evaluation/{file}.aligned.tum", read_poses)
        errors = self._try(f"evaluation/{file}.csv", _errors)
        ticks = self._try(f"evaluation/{file}.ticks.csv", _errors)
        if aligned is None:
            estimate = self._try(f"trajectories/{file}.tum", read_poses)
            if estimate is None:
                why = figures.get("why") or "it left no poses"
                self.missing.append(f"{name}: no curves: {why}")
                return found
            if truth is not None:
                try:
                    aligned, errors = lay_on(truth, estimate)
                except ValueError as error:
                    self.missing.append(f"{name}: no curves: {error}")
                    return found
                self.missing.append(
                    f"{name}: the run left no evaluation of it; its first pose was laid on the "
                    "true one for this report, its scale left as it is"
                )
        lost = self._try(f"evaluation/{file}.lost.csv", _intervals)
        if lost is None:
            lost = gaps(aligned, truth)
            known, counted = seconds(lost), figures.get("lost_seconds")
            if isinstance(counted, int | float) and abs(counted - known) > _ABOUT:
                self.missing.append(
                    f"{name}: lost for {counted:.1f} s by the figures; gaps between its poses "
                    f"tell of {known:.1f} s, which are what the figures show"
                )
        return msgspec.structs.replace(
            found, aligned=aligned, of_images=errors, of_ticks=ticks, lost=lost
        )

    def _try(self, name: str, read: Callable[[Path], T], without: str = "") -> T | None:
        """Read a file; say so if it is not there (and is expected) or is not what it should be."""
        path = self.folder / name
        if not path.is_file():
            if without:
                self.missing.append(f"{name} is not there: {without}")
            return None
        try:
            return read(path)
        except (OSError, ValueError, msgspec.MsgspecError) as error:
            text = str(error).replace(f"{path}: ", "").replace(f"{path}:", "line ")
            self.missing.append(f"{name} cannot be read: {text}")
            return None


def _facts(path: Path) -> Facts:
    return msgspec.json.decode(path.read_bytes(), type=Facts)


def _verdict(path: Path) -> Verdict:
    return msgspec.json.decode(path.read_bytes(), type=Verdict)


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8", errors="replace")


def _errors(path: Path) -> Errors:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # numpy's, of a file without rows
        errors = read_errors(path)
    if not len(errors.stamps):
        raise ValueError("expected rows of errors, found none")
    if not (np.isfinite(errors.position).all() and np.isfinite(errors.rotation).all()):
        raise ValueError("expected finite errors, found others")
    return errors


def _intervals(path: Path) -> list[Interval]:
    """Read a file of rows ``start_ns,end_ns`` under a header."""
    rows = [line.split(",") for line in path.read_text(encoding="ascii").splitlines()[1:]]
    return [Interval(int(start), int(end)) for start, end in rows]


def _frames(folder: Path) -> dict[str, list[Path]]:
    found: dict[str, list[Path]] = {}
    for path in sorted(folder.glob("*.jpg")):
        found.setdefault(path.stem.rpartition("_")[0], []).append(path)
    return found


def _loud(log: str) -> list[str]:
    """Return warnings and errors, with the lines that go on about them; the last ones."""
    found: list[str] = []
    loud = False
    for line in log.splitlines():
        words = line.split(None, 2)
        if len(words) > 1 and words[0].replace(".", "", 1).isdigit():
            loud = words[1] in _LOUD
        if loud:
            found.append(line)
    return found[-_LOG_LINES:]
