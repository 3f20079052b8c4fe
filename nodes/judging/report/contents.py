"""What there is to report of a run: plain data, read by `nodes.judging.report.folder`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from nodes.judging.evaluation.coverage import Interval
from nodes.judging.evaluation.judging import Errors
from nodes.trajectory import Trajectory
from runtime import summary
from runtime.summary import (
    LinkSummary,
    OutsideSummary,
    StreamSummary,
    TickSummary,
    TwiceSummary,
    WorkerSummary,
)


class Facts(msgspec.Struct, frozen=True, kw_only=True):
    """What the report wants of ``summary.json``; see `runtime.summary.Summary`.

    Of trajectories that were judged without a run (`nodes.judging.judge`), ``judged`` has the files
    that they came from, by name, and ``notes`` has what is to be said of them.
    """

    name: str | None = None
    clock: str | None = None
    seed: int | None = None
    reason: str | None = None
    error: str | None = None
    sim_seconds: float | None = None
    wall_seconds: float | None = None
    digest: str | None = None
    not_deterministic: list[str] = []
    verdict: Verdict | None = None
    outputs: dict[str, int] = {}
    streams: dict[str, StreamSummary] = {}
    links: dict[str, LinkSummary] = {}
    ticks: dict[str, TickSummary] = {}
    workers: dict[str, WorkerSummary] = {}
    outside: dict[str, OutsideSummary] = {}
    twice: TwiceSummary | None = None
    stalls: dict[str, int] = {}
    announcements: list[dict[str, Any]] = []
    environment: dict[str, str] = {}
    judged: dict[str, str] = {}
    notes: list[str] = []


class Verdict(summary.Verdict, frozen=True):
    """What ``evaluation/verdict.json`` holds, and without thresholds the summary."""

    thresholds: dict[str, float | None] = msgspec.field(default_factory=dict)


class Estimator(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """One of those that were judged, or that would have been.

    Attributes:
        name: Its source.
        color: In every figure.
        figures: From the verdict; empty if there is none.
        aligned: Its poses in the truth's frame.
        of_images: Errors of each pose at the time of its image.
        of_ticks: Errors of the newest pose there was at each control tick.
        lost: When it had no pose.
        final: Its trajectory after loop closures in the truth's frame.
    """

    name: str
    color: str
    figures: dict[str, Any] = {}
    aligned: Trajectory | None = None
    of_images: Errors | None = None
    of_ticks: Errors | None = None
    lost: list[Interval] = []
    final: Trajectory | None = None


class Run(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """One run's folder.

    Attributes:
        folder: Where it is.
        facts: From the summary.
        verdict: What the evaluation concluded.
        truths: True poses, by vehicle; the first vehicle's first.
        plans: Where pilots meant their vehicles to be, by vehicle.
        collisions: Where vehicles hit something: north, east, down, metres, shape (n, 3).
        estimators: By order of the verdict.
        frames: Sample images with features, by estimator's file name.
        clouds: Files of clouds.
        config: Text of ``config.toml``.
        log: Its warnings and errors.
        missing: Sentences that say what is not there or cannot be read.
    """

    folder: Path
    facts: Facts
    verdict: Verdict | None
    truths: dict[str, Trajectory]
    plans: dict[str, Trajectory]
    collisions: npt.NDArray[np.float64]
    estimators: list[Estimator]
    frames: dict[str, list[Path]]
    clouds: list[Path]
    config: str | None
    log: list[str]
    missing: list[str]

    @property
    def name(self) -> str:
        """Name of the run."""
        return self.facts.name or self.folder.resolve().name

    @property
    def truth(self) -> Trajectory | None:
        """True poses of the first vehicle."""
        return next(iter(self.truths.values()), None)

    def truth_of(self, estimator: Estimator) -> Trajectory | None:
        """Return the true poses of the vehicle that an estimator was judged by."""
        return self.truths.get(str(estimator.figures.get("vehicle")), self.truth)

    @property
    def start(self) -> int:
        """What times in the figures count from: 0, or for stamps of a calendar the first one."""
        first = int(self.truth.stamps[0]) if self.truth is not None else 0
        return first if first > 1e15 else 0
