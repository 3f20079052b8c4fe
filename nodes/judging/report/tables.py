"""Report data of a run, read by `nodes.judging.report.folder`, and its tables."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from nodes.judging.evaluation.judging import Errors
from nodes.judging.evaluation.record import Interval
from nodes.judging.report.style import number
from nodes.trajectory import Trajectory
from runtime import summary
from runtime.figures import FIGURES, figure
from runtime.summary import (
    LinkSummary,
    OutsideSummary,
    StreamSummary,
    TickSummary,
    TwiceSummary,
    WorkerSummary,
)


class Facts(msgspec.Struct, frozen=True, kw_only=True):
    """Contents of ``summary.json`` for the report; see `runtime.summary.Summary`.

    Of trajectories judged without a run, ``judged`` has the files by name, ``notes`` the remarks.
    """

    name: str | None = None
    clock: str | None = None
    seed: int | None = None
    reason: str | None = None
    error: str | None = None
    sim_seconds: float | None = None
    wall_seconds: float | None = None
    digest: str | None = None
    inputs_digest: str | None = None
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
    """Contents of ``evaluation/verdict.json``, and without thresholds of the summary's."""

    thresholds: dict[str, float | None] = msgspec.field(default_factory=dict)


class Estimator(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """An estimator of the report, judged or not; see `Judgement`. Without verdict no `figures`."""

    name: str
    color: str
    figures: dict[str, Any] = {}
    aligned: Trajectory | None = None
    of_images: Errors | None = None
    of_ticks: Errors | None = None
    lost: list[Interval] = []
    final: Trajectory | None = None


class Run(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """Contents of a run's folder, as far as read."""

    folder: Path
    facts: Facts
    verdict: Verdict | None
    truths: dict[str, Trajectory]  # true poses, by vehicle; the first vehicle's first
    plans: dict[str, Trajectory]  # poses intended by pilots, by vehicle
    collisions: npt.NDArray[np.float64]  # north, east, down, metres, shape (n, 3)
    estimators: list[Estimator]
    frames: dict[str, list[Path]]  # sample images with features, by estimator's file name
    clouds: list[Path]
    config: str | None
    log: list[str]  # its warnings and errors
    missing: list[str]  # sentences on missing or unreadable files

    @property
    def name(self) -> str:
        """Name of the run."""
        return self.facts.name or self.folder.resolve().name

    @property
    def truth(self) -> Trajectory | None:
        """True poses of the first vehicle."""
        return next(iter(self.truths.values()), None)

    def truth_of(self, estimator: Estimator) -> Trajectory | None:
        """Return the true poses of an estimator's vehicle."""
        return self.truths.get(str(estimator.figures.get("vehicle")), self.truth)

    @property
    def start(self) -> int:
        """Origin of times in the figures (ns): 0, or the first stamp if stamps are Unix time."""
        first = int(self.truth.stamps[0]) if self.truth is not None else 0
        return first if first > 1e15 else 0


_NO_FIGURES = {"passed", "failed", "why"}


class Row(msgspec.Struct, frozen=True):
    """A row of a table of figures."""

    name: str
    meaning: str
    unit: str
    limit: str  # threshold; empty if there is none
    cells: list[tuple[str, bool]]  # by estimator: its value, and whether it is missed


def figures(run: Run, *, main: bool) -> list[Row]:
    """Return the main figures, or all others, with the thresholds there are."""
    thresholds = run.verdict.thresholds if run.verdict is not None else {}
    asked = {name: limit for name, limit in thresholds.items() if limit is not None}
    rows = [each for each in FIGURES.values() if each.report]
    top = sorted(rows, key=lambda each: each.report != "head")
    names = dict.fromkeys([*(each.name for each in top), *asked])
    if not main:
        others = dict.fromkeys(k for e in run.estimators for k in e.figures)
        names = {k: None for k in others if k not in names and k not in _NO_FIGURES}
    found = []
    for row in map(figure, names):
        values = [e.figures.get(row.name) for e in run.estimators]
        limit = asked.get(row.name)
        why = [e.figures.get("failed") or () for e in run.estimators]
        missed = [any(str(each).startswith(f"{row.name}: ") for each in own) for own in why]
        known = any(value is not None for value in values)
        if known or any(missed) or (limit is not None and not row.optional):
            cells = list(zip(map(show, values), missed, strict=True))
            threshold = "" if limit is None else f"{row.side} {limit:g}"
            found.append(Row(row.name, row.meaning, row.unit, threshold, cells))
    return found


def show(value: Any) -> str:
    """Return a figure as text."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return number(value)
    if isinstance(value, list | dict):
        return msgspec.json.encode(value).decode()
    return str(value)


def facts(run: Run) -> list[tuple[str, str]]:
    """Return the table of facts on the run as a whole."""
    f = run.facts
    rows = list(f.judged.items())
    for vehicle, truth in run.truths.items():
        name = f"true path of {vehicle}" if len(run.truths) > 1 else "true path"
        speed = np.linalg.norm(truth.velocities(), axis=1).max()
        text = f"{number(truth.length())} m, at most {number(float(speed))} m/s"
        rows.append((name, text))
    speed = (f.sim_seconds or 0.0) / max(f.wall_seconds or 0.0, 1e-9)
    known = {
        "clock": f.clock,
        "seed": f.seed,
        "time on the run's clock": f.sim_seconds and f"{f.sim_seconds:.2f} s",
        "real time": f.wall_seconds and f"{f.wall_seconds:.2f} s ({number(speed)} × real time)",
        "command": f.environment.get("command") or None,
        "commit": f.environment.get("commit") or None,
        "ended by": f.reason,
        "error": f.error,
        "digest": f.clock and _digest(f),
        "digest of the inputs": f.inputs_digest,
        "run twice": f.twice and (f.twice.first or "it repeats"),
    }
    rows += [(name, str(value)) for name, value in known.items() if value is not None]
    rows += [(f"digest of what {k} was sent", o.inputs) for k, o in f.outside.items() if o.inputs]
    rows += [(f"digest of what {k} answered", o.answers) for k, o in f.outside.items() if o.answers]
    rows += [(f"dropped at {port}", str(s.dropped)) for port, s in f.streams.items() if s.dropped]
    rows += [
        (f"unmatched sets at {port}", _counts(s.missed))
        for port, s in f.streams.items()
        if s.missed
    ]
    rows += [
        (f"link {port}", f"{link.lost} lost, {link.thinned} left out")
        for port, link in f.links.items()
    ]
    rows += [(f"{name} is slow", each.slower) for name, each in f.workers.items() if each.slower]
    rows += [(f"loop stood still in {node}", f"{count} times") for node, count in f.stalls.items()]
    if f.clock is not None and not any(s.dropped or s.missed for s in f.streams.values()):
        rows.append(("dropped or unmatched", "nothing"))
    return rows


def _digest(f: Facts) -> str:
    if f.digest is None:
        return "off"
    if f.clock != "lockstep":
        return f"{f.digest} (not promised: the clock is real)"
    if f.not_deterministic:
        return f"{f.digest} (not promised, because of {', '.join(f.not_deterministic)})"
    return f"{f.digest} (an equal run gives the same)"


def sensors(run: Run) -> list[list[str]]:
    """Return the table of announced sensors: source, kind, rate, and the rest in words."""
    rows = []
    for each in run.facts.announcements:
        kind = str(each.get("type", "")).removesuffix("Announcement")
        if "rate" not in each or not kind:
            continue
        info = each.get("info") or {}
        size = [f"{info['width']} × {info['height']}"] if "width" in info else []
        lens = any(info.get("distortion", ())) or info.get("distortion_model") == "equidistant"
        size += [str(info["distortion_model"])] if lens else []
        rest = {k: v for k, v in each.items() if k not in _PLACES and v not in (0, 0.0, "", [])}
        said = [f"{name.replace('_', ' ')} {_said(value)}" for name, value in rest.items()]
        rows.append([str(each.get("source")), kind, _said(each["rate"]), ", ".join(size + said)])
    return rows


_PLACES = {
    "type", "source", "stamp", "rate", "info", "frame_id", "parent_frame_id", "position",
    "orientation",
}  # fmt: skip
"""Announcement fields not in the table of sensors."""


def _said(value: Any) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(map(_said, value))
    return f"{value:g}" if isinstance(value, float) else show(value)


def ticks(run: Run) -> list[list[str]]:
    """Return how punctual each ticker was."""
    late = {k: (t.late_p50_us, t.late_p99_us, t.late_max_us) for k, t in run.facts.ticks.items()}
    return [
        [name, f"{t.hz:g}", str(t.calls), *(f"{each:.0f}" for each in late[name]), str(t.missed)]
        for name, t in sorted(run.facts.ticks.items())
    ]


def workers(run: Run) -> list[list[str]]:
    """Return the table of worker processes (estimators and others) and their costs."""
    return [[name, *worker.row()] for name, worker in sorted(run.facts.workers.items())]


def outside(run: Run) -> list[list[str]]:
    """Return the table of systems outside the process and their answers."""
    return [[name, *each.row()] for name, each in sorted(run.facts.outside.items())]


def outputs(run: Run) -> list[list[str]]:
    """Return the table of outputs: name, events sent, events a second."""
    seconds = max(run.facts.sim_seconds or 0.0, 1e-9)
    return [[k, str(n), f"{n / seconds:.1f}"] for k, n in sorted(run.facts.outputs.items())]


def _counts(missed: dict[str, int]) -> str:
    return ", ".join(f"{count} without {field}" for field, count in sorted(missed.items()))
