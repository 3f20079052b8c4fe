"""Lenient reader of a run's folder: missing and unreadable files are named in `Run.missing`."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt

from nodes.judging.evaluation.files import read_errors
from nodes.judging.evaluation.judging import Errors, judge
from nodes.judging.evaluation.record import EstimatorRecord, Interval, cover, seconds
from nodes.judging.report.tables import COLORS, Estimator, Facts, Run, Verdict
from nodes.trajectory import HOLE, Trajectory
from nodes.trajectory_files import read_tum
from runtime.run.results import run_folder
from runtime.source_files import source_file, source_of
from runtime.time.clock import SECOND

Floats = npt.NDArray[np.float64]

GAP = SECOND // 2  # silence counted as lost (ns)
_FARTHEST = 1e12  # limit of coordinates, metres: a diverged estimate overflows squares and plots


def read_poses(path: Path) -> Trajectory:
    """Read a TUM file, perhaps cut off as by a killed run; may raise `ValueError`."""
    poses = read_tum(path, whole=False, in_order=False)
    if (far := np.abs(poses.positions).max()) > _FARTHEST:
        raise ValueError(f"expected positions within {_FARTHEST:g} m, found {far:g} m")
    return poses


def gaps(estimate: Trajectory | None, truth: Trajectory | None) -> list[Interval]:
    """Return where an estimator was silent while there was a truth, by the stamps of its poses."""
    if estimate is None:
        return []
    frames = estimate.stamps if truth is None else truth.stamps
    return cover(frames, estimate.stamps, GAP).lost


def holes(truth: Trajectory | None) -> list[Interval]:
    """Return where a truth is not known: between poses much farther apart than they usually are."""
    if truth is None or len(truth) < 2:
        return []
    steps = np.diff(truth.stamps)
    before = np.flatnonzero(steps > max(HOLE, 10 * np.median(steps)))
    ends = zip(truth.stamps[before].tolist(), truth.stamps[before + 1].tolist(), strict=True)
    return [Interval(*span) for span in ends]


def broken(values: Floats, stamps: npt.NDArray[np.int64], lost: Sequence[Interval]) -> Floats:
    """Return a copy of rows, shape (n,) or (n, k), with NaN in each interval (ns)."""
    values = values.copy()
    for start, end in lost:
        inside = (stamps > start) & (stamps < end)
        values[inside] = np.nan
        after = int(np.searchsorted(stamps, end))
        if after < len(values) and not inside.any():
            values[after] = np.nan
    return values


T = TypeVar("T")
_LOG_LINES = 200
_NO_ESTIMATES = {"truth", "plan"}
_ABOUT = 0.25  # tolerated difference between two counts of lost time, seconds
_LOUD = {"WARNING", "ERROR", "CRITICAL"}


def read_run(folder: Path) -> Run:
    """Read a run's folder; a `ResultsError` if it is missing or no run's."""
    return _Reader(run_folder(folder)).run()


class _Reader:
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.missing: list[str] = []

    def run(self) -> Run:
        facts = self._try("summary.json", _decoder(Facts), "the run did not end in an orderly way")
        verdict = self._try(
            "evaluation/verdict.json", _decoder(Verdict), "nothing was evaluated to the end"
        )
        if facts is not None:
            if verdict is not None and verdict.estimators and facts.verdict is None:
                self.missing.append(
                    "evaluation/verdict.json is of an earlier run: by its summary, nobody was "
                    "judged in this one. Trajectories and figures may be that one's, too"
                )
                verdict = None
            verdict = verdict or facts.verdict
        self.missing += [] if facts is None else facts.notes
        flown = facts is None or not facts.judged
        config = self._try("config.toml", _text, "the settings are not known" if flown else "")
        log = self._try("log.txt", _text, "what was logged is not known" if flown else "")
        first = _first_vehicle(facts or Facts())
        truths = self._by_vehicle("truth", first)
        if not (self.folder / "trajectories" / "truth.tum").is_file():
            self.missing.append(
                "trajectories/truth.tum is not there: there is nothing to compare with"
            )
        return Run(
            folder=self.folder,
            facts=facts or Facts(),
            verdict=verdict,
            truths=truths,
            plans=self._by_vehicle("plan", first),
            collisions=self._collisions(),
            estimators=self._estimators(verdict, truths),
            frames=_frames(self.folder / "frames"),
            clouds=sorted((self.folder / "clouds").glob("*.ply")),
            config=config,
            log=_loud(log or ""),
            missing=self.missing,
        )

    def _by_vehicle(self, what: str, first: str) -> dict[str, Trajectory]:
        """Read the trajectory files of a kind, by vehicle, the first vehicle's first."""
        paths = sorted((self.folder / "trajectories").glob(f"{what}.*tum"))
        names = {
            source_of(p.stem.partition(".")[2]) or first: f"trajectories/{p.name}" for p in paths
        }
        by_vehicle = {vehicle: self._try(name, read_poses) for vehicle, name in names.items()}
        order = sorted(by_vehicle.items(), key=lambda item: item[0] != first)
        return {vehicle: poses for vehicle, poses in order if poses is not None}

    def _collisions(self) -> npt.NDArray[np.float64]:
        places = self._try("trajectories/collisions.csv", _places)
        return np.empty((0, 3)) if places is None else places

    def _estimators(
        self, verdict: Verdict | None, truths: dict[str, Trajectory]
    ) -> list[Estimator]:
        figures = {} if verdict is None else verdict.estimators
        files = {source_file(name): name for name in figures}
        stems = {p.stem for p in (self.folder / "trajectories").glob("*.tum")}
        sent = {name for name in stems if name.partition(".")[0] not in _NO_ESTIMATES}
        files |= {file: source_of(file) for file in sorted(sent - set(files))}
        if not files:
            self.missing.append("no estimator has sent anything, and none was judged")
        return [
            self._estimator(file, name, COLORS[k % len(COLORS)], figures.get(name, {}), truths)
            for k, (file, name) in enumerate(files.items())
        ]

    def _estimator(
        self,
        file: str,
        name: str,
        color: str,
        figures: dict[str, Any],
        truths: dict[str, Trajectory],
    ) -> Estimator:
        first = next(iter(truths.values()), None)
        truth = truths.get(str(figures.get("vehicle")), first)
        final = self._try(f"evaluation/{file}.final.tum", read_poses)
        estimator = Estimator(name=name, color=color, figures=figures, final=final)
        aligned = self._try(f"evaluation/{file}.aligned.tum", read_poses)
        errors = self._try(f"evaluation/{file}.csv", _errors)
        ticks = self._try(f"evaluation/{file}.ticks.csv", _errors)
        if aligned is None:
            estimate = self._try(f"trajectories/{file}.tum", read_poses)
            if estimate is None:
                why = figures.get("why") or "it left no poses"
                self.missing.append(f"{name}: no curves: {why}")
                return estimator
            if truth is not None:
                judged = judge(EstimatorRecord.of(estimate), truth, alignment="origin")
                aligned, errors = judged.aligned, judged.image_errors
                if aligned is None:
                    self.missing.append(f"{name}: no curves: {judged.figures['why']}")
                    return estimator
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
            estimator, aligned=aligned, image_errors=errors, tick_errors=ticks, lost=lost
        )

    def _try(self, name: str, read: Callable[[Path], T], without: str = "") -> T | None:
        """Read a file or return `None`; add to `missing` if invalid, or expected but absent."""
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


def _first_vehicle(facts: Facts) -> str:
    vehicles = (a["source"] for a in facts.announcements if a.get("type") == "VehicleAnnouncement")
    return str(next(vehicles, ""))


def _places(path: Path) -> npt.NDArray[np.float64]:
    rows = [line.split(",")[-4:-1] for line in path.read_text(encoding="utf-8").splitlines()[1:]]
    return np.array(rows, np.float64).reshape(-1, 3)


def _decoder(type_: type[T]) -> Callable[[Path], T]:
    return lambda path: msgspec.json.decode(path.read_bytes(), type=type_)


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
    rows = [line.split(",") for line in path.read_text(encoding="ascii").splitlines()[1:]]
    return [Interval(int(start), int(end)) for start, end in rows]


def _frames(folder: Path) -> dict[str, list[Path]]:
    frames: dict[str, list[Path]] = {}
    for path in sorted(folder.glob("*.jpg")):
        frames.setdefault(path.stem.rpartition("_")[0], []).append(path)
    return frames


def _loud(log: str) -> list[str]:
    lines: list[str] = []
    loud = False
    for line in log.splitlines():
        words = line.split(None, 2)
        if len(words) > 1 and words[0].replace(".", "", 1).isdigit():
            loud = words[1] in _LOUD
        if loud:
            lines.append(line)
    return lines[-_LOG_LINES:]
