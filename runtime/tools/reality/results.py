"""The ledger: a CSV with a line for each run of the study, committed with the project.

A run whose row is there with the same key and the same data is not flown again, on whatever
machine it was flown. Lines are sorted, and hold nothing of when and where, so that two ledgers are
merged line by line (``merge=union``), and the same results give the same file.
"""

from __future__ import annotations

import contextlib
import csv
import fcntl
import io
import math
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import msgspec

from runtime.channels.wire import combined
from runtime.errors import ConfigError
from runtime.run.results import write
from runtime.tools.reality.study import Run, Study, System
from runtime.tools.sweep.plan import Job
from runtime.tools.sweep.tables import Row


class Result(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Line of the ledger: a run with its figures; what is unknown is `None`.

    Attributes:
        verdict: ``passed``; ``lost``: too few images have a pose; ``crashed``.
        ate_m: RMS of the poses as they came, laid on the truth as the study says.
        final_ate_m: The same of the trajectory after loop closures.
        final_percent: Share of the images with a pose in that trajectory.
        first_s: Time before the first pose.
        cpu_ms: Processor time of a frame, median.
        flight: Begin of the digest of all that the rig sent.
        key: Of the settings; see `runtime.tools.reality.study.key_of`.
        data: Hash of the ground truth, and of the scan.
        commit: Of this project.
        code: Begin of the hash of the system's own files: node, program.
    """

    sequence: str
    world: str
    condition: str
    seed: int
    system: str
    verdict: Literal["passed", "lost", "crashed"]
    ate_m: float | None = None
    final_ate_m: float | None = None
    rpe_percent: float | None = None
    coverage_percent: float | None = None
    final_percent: float | None = None
    lost_s: float | None = None
    first_s: float | None = None
    path_m: float | None = None
    cpu_ms: float | None = None
    flight: str = ""
    key: str
    data: str
    commit: str = ""
    code: str = ""
    error: str = ""

    @property
    def run(self) -> Run:
        """The run's names."""
        return Run(self.sequence, self.world, self.condition, self.seed, self.system)

    def failed(self, system: System, study: Study) -> bool:
        """Return whether too little is there to judge: no error, or too few poses."""
        coverage = self.final_percent if system.final == "map" else self.coverage_percent
        few = coverage is not None and coverage < study.coverage_percent
        return self.verdict != "passed" or few or not math.isfinite(self.error_m(system))

    def error_m(self, system: System) -> float:
        """Return the error of the kind that is published; infinite if there is none."""
        value = self.final_ate_m if system.final else self.ate_m
        return math.inf if value is None else value


FIELDS = Result.__struct_fields__
DIGITS = 5  # significant ones of a figure


class Ledger:
    """Results in a file.

    Of two lines of one run with one key and data, one that crashed gives way to the other, else
    the first stays.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.results: dict[tuple[Run, str, str], Result] = {}
        self.read()

    def read(self) -> None:
        """Read the file again; other processes may have added to it.

        Raises:
            ConfigError: A line is none.
        """
        if not self.path.is_file():
            return
        with self.path.open(encoding="utf-8", newline="") as file:
            for number, line in enumerate(csv.DictReader(file), 2):
                try:
                    values = {name: text for name, text in line.items() if text != ""}
                    self._enter(msgspec.convert(values, Result, strict=False))
                except (msgspec.MsgspecError, TypeError) as error:
                    raise ConfigError(
                        f"{self.path}: line {number}: expected a run of the study, found: {error}"
                    ) from None

    def _enter(self, result: Result) -> None:
        place = result.run, result.key, result.data
        earlier = self.results.get(place)
        if earlier is None or (earlier.verdict == "crashed" != result.verdict):
            self.results[place] = result

    def add(self, results: Iterable[Result]) -> None:
        """Add results, and write the file as a whole, with those that others have added to it."""
        new = [*results]
        if not new:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with _locked(self.path.parent):
            self.read()
            for result in new:
                self._enter(result)
            write(self.path, self.text().encode())

    def text(self) -> str:
        """Return the file's text: a head, and a line for each result, sorted."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(FIELDS)
        lines = ([_cell(getattr(r, name)) for name in FIELDS] for r in self.results.values())
        writer.writerows(sorted(lines))
        return out.getvalue()

    def has(self, run: Run, key: str, data: str, *, crashed: bool = True) -> bool:
        """Return whether a run is finished; with `crashed`, also if it crashed."""
        result = self.results.get((run, key, data))
        return result is not None and (crashed or result.verdict != "crashed")

    def valid(
        self,
        keys: Mapping[Run, str],
        data: Mapping[tuple[str, str], str],
        *,
        stale: bool = False,
    ) -> tuple[dict[Run, Result], list[Result]]:
        """Return the results that count, by run, and the stale ones.

        A result is stale if its key is not that of its run today, or its data not those that are
        there; of a run that the study no longer has, too. Data that are not there cannot be
        compared, and count.

        Args:
            keys: Of the study's runs today.
            data: Hash of the data by sequence and world, as far as they are there.
            stale: Whether stale results count where there is no other.
        """
        count: dict[Run, Result] = {}
        old: list[Result] = []
        for result in self.results.values():
            now = data.get((result.sequence, result.world), result.data)
            if keys.get(result.run) == result.key and now == result.data:
                count[result.run] = result
            else:
                old.append(result)
        if stale:
            for result in old:
                if result.run in keys:
                    count.setdefault(result.run, result)
        return count, old


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.{DIGITS}g}"
    return "" if value is None else " ".join(str(value).split())


def _short(commit: str) -> str:
    revision, dash, dirty = commit.partition("-")
    return revision[:10] + dash + dirty


class _Summary(msgspec.Struct):
    """Fields of a run's ``summary.json``."""

    digests: dict[str, str] = {}
    environment: dict[str, str] = {}
    code: dict[str, str] = {}


def result_of(
    run: Run, job: Job, row: Row, *, key: str, data: str, study: Study, vehicle: str = "drone"
) -> Result:
    """Return the result of a finished run: its figures, and what its folder says of it."""
    summary = _Summary()
    with contextlib.suppress(OSError, msgspec.MsgspecError):
        text = (Path(job.out) / "summary.json").read_bytes()
        summary = msgspec.json.decode(text, type=_Summary)
    sent = {k: v for k, v in summary.digests.items() if k.partition(".")[0] == vehicle}
    figures: Mapping[str, Any] = row["estimators"].get(run.system, {})
    coverage = figures.get("frame_coverage_percent", figures.get("coverage_percent"))
    final = None
    if coverage and figures.get("estimates") and figures.get("final_poses"):
        final = figures["final_poses"] / figures["estimates"] * coverage
    workers = row.get("workers", {}).items()
    costs = [c.get("cpu_p50_ms") for name, c in workers if name.partition(".")[0] == run.system]
    lost = figures.get("ate_rmse_m") is None or (coverage or 0.0) < study.coverage_percent
    return Result(
        **run._asdict(),
        verdict="crashed" if row["error"] else "lost" if lost else "passed",
        ate_m=figures.get("ate_rmse_m"),
        final_ate_m=figures.get("final_ate_rmse_m"),
        rpe_percent=figures.get("rpe_1m_trans_percent"),
        coverage_percent=coverage,
        final_percent=final,
        lost_s=figures.get("lost_seconds"),
        first_s=figures.get("initialization_seconds"),
        path_m=figures.get("path_m"),
        cpu_ms=next(iter(costs), None),
        flight=combined(sent)[:12] if sent and not row["error"] else "",
        key=key,
        data=data,
        commit=_short(summary.environment.get("commit", "")),
        code=summary.code.get(run.system, "")[:8],
        error=row["error"][:200],
    )
