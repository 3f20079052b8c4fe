"""Report data of a run, read by `nodes.judging.report.folder`; its tables, and its style."""

from __future__ import annotations

import contextlib
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import msgspec
import numpy as np
import numpy.typing as npt
from matplotlib.artist import Artist
from matplotlib.figure import Figure

from nodes.judging.evaluation.judging import Errors
from nodes.judging.evaluation.record import Interval
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
from runtime.units import ROUNDING


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
    truth: dict[str, dict[str, Any]] = {}
    judged: dict[str, str] = {}
    judged_hashes: dict[str, str] = {}
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
    image_errors: Errors | None = None
    tick_errors: Errors | None = None
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

    def lever_of(self, estimator: Estimator) -> tuple[float, float, float]:
        """Return the place on the body (m) at which an estimator is compared."""
        eye = estimator.figures.get("compared_at")
        for announced in self.facts.announcements if eye else ():
            if announced["type"] == "CameraAnnouncement" and announced["source"] == eye:
                x, y, z = announced["position"]
                return x, y, z
        return 0.0, 0.0, 0.0

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
    limits = {name: limit for name, limit in thresholds.items() if limit is not None}
    asked = {name: limit for name, limit in limits.items() if math.isfinite(limit)}
    rows = [row for row in FIGURES.values() if row.report]
    top = sorted(rows, key=lambda row: row.report != "head")
    names = dict.fromkeys([*(row.name for row in top), *asked])
    if not main:
        others = dict.fromkeys(k for e in run.estimators for k in e.figures)
        names = {k: None for k in others if k not in names and k not in _NO_FIGURES}
    table = []
    for row in map(figure, names):
        values = [e.figures.get(row.name) for e in run.estimators]
        limit = asked.get(row.name)
        why = [e.figures.get("failed") or () for e in run.estimators]
        missed = [
            any(str(sentence).startswith(f"{row.name}: ") for sentence in sentences)
            for sentences in why
        ]
        known = any(value is not None for value in values)
        if known or any(missed) or (limit is not None and not row.optional):
            cells = list(zip(map(show, values), missed, strict=True))
            threshold = "" if limit is None else f"{row.side} {limit:g}"
            table.append(Row(row.name, row.meaning, row.unit, threshold, cells))
    return table


def show(value: Any) -> str:
    """Return a figure as text."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return number(0.0 if abs(value) < ROUNDING else value)
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
    rows += [(f"{name} as announced, less as it is", _off(e)) for name, e in f.truth.items()]
    rows += [(f"{name} is slow", w.slower) for name, w in f.workers.items() if w.slower]
    rows += [(f"loop stood still in {node}", f"{count} times") for node, count in f.stalls.items()]
    if f.clock is not None and not any(s.dropped or s.missed for s in f.streams.values()):
        rows.append(("dropped or unmatched", "nothing"))
    return rows


def _off(facts: dict[str, Any]) -> str:
    """Return by how much the announced numbers of a sensor are off, number by number."""
    texts = []
    for name, true in facts["true"].items():
        offsets = np.atleast_1d(facts["announced"][name]) - np.atleast_1d(true)
        if offsets.any():
            texts.append(f"{name} {' '.join(f'{value:+.2g}' for value in offsets.tolist())}")
    return "; ".join(texts)


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
    for sensor in run.facts.announcements:
        kind = str(sensor.get("type", "")).removesuffix("Announcement")
        if "rate" not in sensor or not kind:
            continue
        info = sensor.get("info") or {}
        size = [f"{info['width']} × {info['height']}"] if "width" in info else []
        lens = any(info.get("distortion", ())) or info.get("distortion_model") == "equidistant"
        size += [str(info["distortion_model"])] if lens else []
        rest = {k: v for k, v in sensor.items() if k not in _PLACES and v not in (0, 0.0, "", [])}
        texts = [f"{name.replace('_', ' ')} {_text(value)}" for name, value in rest.items()]
        rows.append(
            [str(sensor.get("source")), kind, _text(sensor["rate"]), ", ".join(size + texts)]
        )
    return rows


_PLACES = {
    "type", "source", "stamp", "rate", "info", "frame_id", "parent_frame_id", "position",
    "orientation",
}  # fmt: skip
"""Announcement fields not in the table of sensors."""


def _text(value: Any) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(map(_text, value))
    return f"{value:g}" if isinstance(value, float) else show(value)


def ticks(run: Run) -> list[list[str]]:
    """Return how punctual each ticker was."""
    late = {k: (t.late_p50_us, t.late_p99_us, t.late_max_us) for k, t in run.facts.ticks.items()}
    return [
        [name, f"{t.hz:g}", str(t.calls), *(f"{us:.0f}" for us in late[name]), str(t.missed)]
        for name, t in sorted(run.facts.ticks.items())
    ]


def workers(run: Run) -> list[list[str]]:
    """Return the table of worker processes (estimators and others) and their costs."""
    return [[name, *worker.row()] for name, worker in sorted(run.facts.workers.items())]


def outside(run: Run) -> list[list[str]]:
    """Return the table of systems outside the process and their answers."""
    return [[name, *system.row()] for name, system in sorted(run.facts.outside.items())]


def outputs(run: Run) -> list[list[str]]:
    """Return the table of outputs: name, events sent, events a second."""
    seconds = max(run.facts.sim_seconds or 0.0, 1e-9)
    return [[k, str(n), f"{n / seconds:.1f}"] for k, n in sorted(run.facts.outputs.items())]


def _counts(missed: dict[str, int]) -> str:
    return ", ".join(f"{count} without {field}" for field, count in sorted(missed.items()))


Floats = npt.NDArray[np.float64]

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#6a3d7c", "#6b5b00")
"""Of estimators; six are safe for the colour-blind (Okabe, Ito, "Color universal design", 2008)."""
TRUTHS = ("#3a3a3a", "#8a6d3b", "#4f6f52", "#6b5b7a")  # for the true paths of the vehicles
HIT = "#b3261e"
PLAN = "#111111"
LINE = COLORS[0]  # colour of data of no estimator
WIDTH = 10.0  # inches of a figure across the page
DPI = 110
_MOST = 2500  # points of a plotted line, at most
_LETTERS, _HANDLE = 115, 8  # letters of a legend's row; letters of a line sample
_STYLE: dict[Any, Any] = {
    "axes.axisbelow": True,
    "axes.edgecolor": "#777777",
    "axes.grid": True,
    "axes.labelcolor": "#222222",
    "axes.linewidth": 0.8,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.unicode_minus": True,
    "figure.facecolor": "white",
    "font.family": "DejaVu Sans",  # comes with matplotlib
    "font.size": 9,
    "grid.alpha": 0.6,
    "grid.color": "#d8d8d8",
    "grid.linewidth": 0.7,
    "legend.frameon": False,
    "lines.linewidth": 1.4,
    "path.simplify": True,
    "svg.hashsalt": "report",  # so that equal figures give equal names inside
    "text.parse_math": False,  # names may have dollar signs
    "xtick.color": "#444444",
    "ytick.color": "#444444",
}


class Plot(msgspec.Struct, frozen=True, eq=False):
    """A figure of the report."""

    name: str  # of its files, without suffix
    figure: Figure
    title: str  # what it shows
    caption: str = ""  # how to read it
    raster: bool = False  # whether it is made of pixels: no SVG or PDF
    photo: bool = False  # whether it is of camera images, which the page holds as JPEG

    def write(self, folder: Path, formats: Sequence[str]) -> Path:
        """Write the figure as PNG, and in other formats; return the PNG's path. Reproducible."""
        path = folder / f"{self.name}.png"
        self.figure.savefig(path, dpi=DPI, metadata={"Software": None})
        self.figure.set_layout_engine("none")  # all stays where it is: finding places takes long
        for suffix in {"svg", "pdf"}.intersection(() if self.raster else formats):
            date = {"svg": "Date", "pdf": "CreationDate"}[suffix]
            self.figure.savefig(path.with_suffix(f".{suffix}"), metadata={date: None})
        return path


@contextlib.contextmanager
def drawing(settings: Mapping[str, Any] | None = None) -> Iterator[None]:
    """Draw in the report's style, with other settings of matplotlib, while the block runs."""
    with mpl.rc_context(_STYLE | dict(settings or {})), warnings.catch_warnings():
        # A name may have letters that the font lacks; they are drawn as boxes.
        warnings.filterwarnings("ignore", message="Glyph .* missing")
        yield


def sheet(
    height: float,  # inches, with one row of the legend
    *,
    names: Sequence[str] = (),  # entries of the legend above all
    constrained: bool = True,  # whether axes are placed automatically
    width: float = WIDTH,
) -> Figure:
    """Return an empty figure."""
    rows = -(-len(names) // legend_columns(names))
    size = (width, height + 0.2 * max(rows - 1, 0))
    return Figure(figsize=size, layout="constrained" if constrained else None)


def bounds(points: Floats, least: float | Sequence[float]) -> tuple[Floats, Floats]:
    """Return the corners of points (m; (n, k), NaN allowed), with margin and least side shares."""
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    middle, extent = (low + high) / 2, high - low
    longest = max(float(extent.max()), 0.5)
    half = np.maximum(extent, longest * np.asarray(least)) / 2 + 0.05 * longest
    return middle - half, middle + half


def mark_ends(
    axis: Any, start: tuple[float, float] | None, end: tuple[float, float], color: str
) -> None:
    """Mark the start of a line by a ring, and its end by a square inside the ring's size."""
    style: dict[str, Any] = {"color": color, "ls": "", "zorder": 4}
    if start is not None:
        axis.plot(*start, "o", label="start", ms=12, mfc="none", mew=2.0, **style)
    named = "end" if start is not None else None
    axis.plot(*end, "s", label=named, ms=5, mec="white", **style)


def label(name: str) -> str:
    """Return a name for a legend: shortened, and never hidden by matplotlib."""
    shown = name if len(name) <= 40 else f"{name[:39]}…"
    return f"\u200a{shown}" if shown.startswith("_") else shown


def thin(count: int) -> slice:
    """Return a slice to thin `count` points to at most `_MOST`."""
    return slice(None, None, max(-(-count // _MOST), 1))


def number(value: float, digits: int = 3) -> str:
    """Return a number with `digits` significant digits; no exponent from 1e-4 to 1e7."""
    if not math.isfinite(value):
        return "–" if math.isnan(value) else "∞" if value > 0 else "−∞"
    if value == 0:
        return "0"
    rounded = f"{value:.{digits - 1}e}"
    exponent = int(rounded.partition("e")[2])
    if -5 < exponent < 7:
        rounded = f"{value:.{max(digits - 1 - exponent, 0)}f}"
    return rounded.replace("-", "−")


def wide_range(values: list[Floats], share: float = 95.0) -> bool:
    """Return whether series need a logarithmic axis: percentiles (`share`) differ over 20-fold."""
    tops = [top for v in values if len(v) and (top := float(np.nanpercentile(v, share))) > 0.0]
    return len(tops) > 1 and max(tops) > 20.0 * min(tops)


def legend_columns(names: Sequence[str]) -> int:
    """Return how many columns of a legend fit across the page."""
    longest = max((len(name) for name in names), default=0)
    return max(min(_LETTERS // (longest + _HANDLE), len(names)), 1)


def legend_above(figure: Figure, axes: Any, *extra: Artist) -> None:
    """Draw the legend of some axes, and of further artists, at the top of a figure."""
    handles, names = axes.get_legend_handles_labels()
    handles, names = [*handles, *extra], [*names, *(str(artist.get_label()) for artist in extra)]
    if handles:
        columns = legend_columns(names)
        figure.legend(handles, names, loc="outside upper left", ncols=columns)
