"""Command ``plot``: runs in one figure, a sweep or a comparison, as SVG or PDF for a paper.

Runs are drawn as their reports draw one: trajectories from above, position errors over time and
over the distance flown. A style file (TOML) has the size, font, colours and labels.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import typer
from matplotlib.colors import is_color_like
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont
from matplotlib.rcsetup import cycler
from matplotlib.text import Text

from nodes.judging.evaluation.record import Interval
from nodes.judging.report.curves import scale_axis
from nodes.judging.report.folder import Floats, broken, holes, read_run
from nodes.judging.report.tables import (
    COLORS,
    TRUTHS,
    WIDTH,
    Estimator,
    Run,
    drawing,
    label,
    legend_columns,
    thin,
)
from nodes.trajectory import Trajectory
from runtime.config.reading import convert
from runtime.errors import CommandError, ConfigError, ResultsError, expect_known
from runtime.run.results import replacing
from runtime.time.clock import SECOND
from runtime.tools.cli.commands import warn
from runtime.tools.comparison import COMPARISONS, draw_slopes, read_slopes
from runtime.tools.sweep.plots import figures_of
from runtime.tools.sweep.tables import decode_rows, plan_from

Panel = Literal["above", "time", "distance"]
Positive = Annotated[float, msgspec.Meta(gt=0)]

_INCH = 25.4  # millimetres
_DATES = {".svg": "Date", ".pdf": "CreationDate"}
_DASHES = ("-", (0, (5, 2)), (0, (2, 1.5)), (0, (6, 2, 1, 2)))
"""Line styles: the next one for each round of the colours."""


class PlotStyle(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Contents of a style file.

    Attributes:
        size_mm: Width and height of the figure; if not given, as in a report.
        font: Family, such as "serif" or "DejaVu Sans". In an SVG the reader's machine needs it.
        font_size: Points.
        line_width: Points.
        colours: Of the estimators in their order, as matplotlib takes them, and again from the
            first; lines are dashed then.
        truth: Colour of the true paths.
        grid: Whether there are grid lines.
        legend: Whether there is a legend.
        labels: Another text for a text of the plot: a name in the legend, an axis, a title.
    """

    size_mm: tuple[Positive, Positive] | None = None
    font: str = "DejaVu Sans"
    font_size: Positive = 9.0
    line_width: Positive = 1.3
    colours: tuple[str, ...] = COLORS
    truth: str = TRUTHS[0]
    grid: bool = True
    legend: bool = True
    labels: dict[str, str] = {}

    def __post_init__(self) -> None:
        if not self.colours:
            raise ValueError("expected a colour at least, found none - at `$.colours`")
        for colour in (*self.colours, self.truth):
            if not is_color_like(colour):
                raise ValueError(f"expected colours such as #0072b2 or black, found {colour!r}")

    def settings(self) -> dict[str, Any]:
        """Return matplotlib's settings."""
        return {
            "axes.grid": self.grid,
            "axes.prop_cycle": cycler(color=self.colours),
            "axes.titlesize": self.font_size,
            "axes.titleweight": "normal",
            "figure.titlesize": self.font_size,
            "font.family": self.font,
            "font.size": self.font_size,
            "legend.fontsize": self.font_size,
            "lines.linewidth": self.line_width,
            "pdf.fonttype": 42,  # TrueType, as publishers want it
            "svg.fonttype": "none",  # text stays text
        }


def read_style(path: Path | None) -> PlotStyle:
    """Read a style file; the usual style without one. Raises `ConfigError`."""
    if path is None:
        return PlotStyle()
    try:
        table = msgspec.toml.decode(path.read_bytes())
    except OSError as error:
        raise ConfigError(f"{path}: expected a readable file, found: {error.strerror}") from None
    except msgspec.DecodeError as error:
        raise ConfigError(f"{path}: expected TOML, found: {error}") from None
    style = convert(table, PlotStyle, str(path))
    try:
        findfont(FontProperties(family=style.font), fallback_to_default=False)
    except ValueError:
        warn(f"{path}: font: {style.font} is not on this machine: texts are placed as DejaVu Sans")
    return style


class Curve(msgspec.Struct, frozen=True, eq=False):
    """An estimator of a run, as it is drawn."""

    name: str  # in the legend
    run: Run
    estimator: Estimator


def curves_of(folders: Sequence[Path], estimators: Sequence[str] = ()) -> list[Curve]:
    """Read runs; return their judged estimators, or those of the given names.

    A name is that of the run, of the estimator, or of both: the shortest unique one.

    Raises:
        ResultsError: A folder is no run's, or has no judged estimator.
        CommandError: No run has an estimator of a given name.
    """
    ends = Counter(folder.name for folder in folders)
    judged: list[tuple[str, Run, Estimator]] = []
    for folder in folders:
        run = read_run(folder)
        drawable = [e for e in run.estimators if e.aligned is not None]
        if not drawable:
            why = "; ".join(run.missing) or "none"
            raise ResultsError(f"{folder}: expected an estimator with poses, found: {why}")
        name = folder.name if ends[folder.name] == 1 and folder.name else str(folder)
        judged += [(name, run, estimator) for estimator in drawable]
    known = list(dict.fromkeys(estimator.name for *_, estimator in judged))
    for wanted in estimators:
        message = f"--estimator: expected one of {', '.join(known)}, found {wanted}"
        expect_known(wanted, known, message, CommandError)
    chosen = [entry for entry in judged if not estimators or entry[2].name in estimators]
    several = len({name for name, *_ in chosen}) > 1
    alike = several and len({estimator.name for *_, estimator in chosen}) == 1
    curves = []
    for name, run, estimator in chosen:
        words = [name] * several + [estimator.name] * (not alike)
        curves.append(Curve(": ".join(words), run, estimator))
    return curves


def draw_overlay(curves: Sequence[Curve], panels: Sequence[Panel], style: PlotStyle) -> Figure:
    """Return a figure of some curves: its panels in a row, or in a column if it is higher."""
    size = (WIDTH, 3.6 if len(panels) > 1 else WIDTH / 1.6)
    if style.size_mm is not None:
        size = style.size_mm[0] / _INCH, style.size_mm[1] / _INCH
    figure = Figure(figsize=size, layout="constrained")
    shape = (1, len(panels)) if size[0] >= size[1] else (len(panels), 1)
    places: Any = figure.subplots(*shape, squeeze=False)
    for axes, panel in zip(places.flat, panels, strict=True):
        _PANELS[panel](axes, curves, style)
    if style.legend:
        handles: dict[str, Any] = {}
        for axes in places.flat:
            for handle, name in zip(*axes.get_legend_handles_labels(), strict=True):
                handles.setdefault(name, handle)
        shown = [style.labels.get(name, name) for name in handles]
        letters = size[0] / WIDTH * 9.0 / style.font_size  # of what the page of a report has
        columns = max(int(legend_columns(shown) * letters), 1)
        figure.legend(
            list(handles.values()), list(handles), loc="outside upper left", ncols=columns
        )
    return figure


def _looks(index: int, style: PlotStyle) -> dict[str, Any]:
    turn, colour = divmod(index, len(style.colours))
    return {
        "color": style.colours[colour], "ls": _DASHES[turn % len(_DASHES)], "lw": style.line_width,
    }  # fmt: skip


def _draw_above(axes: Any, curves: Sequence[Curve], style: PlotStyle) -> None:
    drawn: list[Trajectory] = []
    for curve in curves:
        truth = curve.run.truth_of(curve.estimator)
        if truth is None or any(_same(truth, other) for other in drawn):
            continue
        drawn.append(truth)
        name = "truth" if len(drawn) == 1 else f"truth {len(drawn)}"
        looks = {"color": style.truth, "lw": 2.4 * style.line_width, "alpha": 0.4}
        _path(axes, truth, holes(truth), name, looks)
    within = _within(drawn)
    for index, curve in enumerate(curves):
        poses = curve.estimator.aligned
        assert poses is not None
        lost = [*curve.estimator.lost, *holes(curve.run.truth_of(curve.estimator))]
        _path(axes, poses, lost, label(curve.name), _looks(index, style), within)
    axes.set(xlabel="east (m)", ylabel="north (m)")
    axes.set_aspect("equal", adjustable="datalim")


def _within(truths: Sequence[Trajectory]) -> tuple[Floats, Floats] | None:
    """Return the corners beyond which estimates are cut off: a width of the truth farther."""
    if not truths:
        return None
    true = np.concatenate([truth.positions for truth in truths])
    low, high = true.min(axis=0), true.max(axis=0)
    beyond = max(float((high - low).max()), 0.5)
    return low - beyond, high + beyond


def _same(one: Trajectory, other: Trajectory) -> bool:
    return len(one) == len(other) and np.array_equal(one.positions, other.positions)


def _path(
    axes: Any,
    poses: Trajectory,
    lost: Sequence[Interval],
    name: str,
    looks: Mapping[str, Any],
    within: tuple[Floats, Floats] | None = None,
) -> None:
    some = thin(len(poses))
    points = broken(poses.positions[some], poses.stamps[some], lost)
    if within is not None:
        points[((points < within[0]) | (points > within[1])).any(axis=1)] = np.nan
    axes.plot(points[:, 1], points[:, 0], label=name, **looks)


def _draw_errors(
    axes: Any, curves: Sequence[Curve], style: PlotStyle, place: Callable[[Curve, Any], Floats]
) -> None:
    series: list[Floats] = []
    for index, curve in enumerate(curves):
        errors = curve.estimator.image_errors
        if errors is None:
            continue
        some = thin(len(errors.stamps))
        stamps = errors.stamps[some]
        lost = [*curve.estimator.lost, *holes(curve.run.truth_of(curve.estimator))]
        line = broken(errors.position[some], stamps, lost)
        axes.plot(place(curve, stamps), line, label=label(curve.name), **_looks(index, style))
        series.append(errors.position)
    axes.set_ylabel("position error (m)")
    scale_axis(axes, series, "y")
    axes.margins(x=0.01)


def _draw_time(axes: Any, curves: Sequence[Curve], style: PlotStyle) -> None:
    _draw_errors(axes, curves, style, lambda curve, stamps: (stamps - curve.run.start) / SECOND)
    axes.set_xlabel("time (s)")


def _draw_distance(axes: Any, curves: Sequence[Curve], style: PlotStyle) -> None:
    def place(curve: Curve, stamps: Any) -> Floats:
        truth = curve.run.truth_of(curve.estimator)
        if truth is None:
            return np.full(len(stamps), np.nan)
        return np.asarray(np.interp(stamps, truth.stamps, truth.distances()), np.float64)

    _draw_errors(axes, curves, style, place)
    axes.set_xlabel("distance flown (m)")


_PANELS: dict[str, Callable[[Any, Sequence[Curve], PlotStyle], None]] = {
    "above": _draw_above,
    "time": _draw_time,
    "distance": _draw_distance,
}


def save(figure: Figure, out: Path, style: PlotStyle) -> None:
    """Write a figure in the format of the path's suffix, its texts replaced by their labels."""
    for text in figure.findobj(Text):
        if isinstance(text, Text):
            text.set_text(style.labels.get(text.get_text(), text.get_text()))
    with replacing(out) as new:
        figure.savefig(new, format=out.suffix[1:], metadata={_DATES[out.suffix]: None})


def draw_sweep(folder: Path, out: Path, style: PlotStyle) -> list[Path]:
    """Draw the plots of a finished sweep; return their paths.

    Raises:
        ResultsError: It has none.
    """
    plan, rows = plan_from(decode_rows((folder / "rows.jsonl").read_bytes()).values(), folder)
    figures = dict(figures_of(plan, rows))
    if not figures:
        raise ResultsError(
            f"{folder}: expected a setting with several values and figures, found none to plot"
        )
    paths = []
    for name, figure in figures.items():
        path = out if len(figures) == 1 else out.with_stem(f"{out.stem}_{name}")
        _save_page(figure, path, style)
        paths.append(path)
    return paths


def draw_comparison(folder: Path, out: Path, style: PlotStyle) -> list[Path]:
    """Draw the flights of a comparison as lines from A to B; return the path."""
    _save_page(draw_slopes(read_slopes(folder)), out, style)
    return [out]


def _save_page(figure: Figure, path: Path, style: PlotStyle) -> None:
    """Write a figure that was drawn for a page in the size and font of a style."""
    if style.size_mm is not None:
        figure.set_size_inches(style.size_mm[0] / _INCH, style.size_mm[1] / _INCH)
    for text in figure.findobj(Text):
        if isinstance(text, Text):
            text.set_fontsize(style.font_size)
    save(figure, path, style)


_WHOLE: dict[str, Callable[[Path, Path, PlotStyle], list[Path]]] = {
    COMPARISONS: draw_comparison,  # whose runs are those of a sweep, too
    "rows.jsonl": draw_sweep,
}
"""What draws a folder that stands alone, by the file that shows what it is."""


def plot(
    folders: Annotated[
        list[Path],
        typer.Argument(
            metavar="RUN…",
            help="Folders of runs or judgements; or of one sweep, or one comparison.",
        ),
    ],
    out: Annotated[
        Path, typer.Option(help="File to write; its suffix is the format: .svg or .pdf.")
    ] = Path("plot.svg"),
    panel: Annotated[
        list[str] | None,
        typer.Option(
            help="Part of the figure: above, time or distance. May be repeated; all if not given."
        ),
    ] = None,
    estimator: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Only this estimator. May be repeated."),
    ] = None,
    style: Annotated[
        Path | None, typer.Option(help="TOML file with size, font, labels and colours.")
    ] = None,
) -> None:
    """Plot several runs in one figure, a sweep or a comparison, as SVG with text as text or as PDF.

    Of runs the panels are the trajectories from above, and the position errors over time and over
    the distance flown; of a sweep there is a plot for each setting that was varied, in a file of
    its own if there are several; of a comparison each flight is a line from A to B. The style file
    has any of size_mm (width, height), font, font_size, line_width, colours, truth (a colour),
    grid, legend, and a table labels, which has another text for a text of the plot:
    "a: vo" = "ours". A file that is there is replaced.
    """
    if out.suffix not in _DATES:
        raise CommandError(f"--out {out}: expected a file .svg or .pdf, found {out.suffix!r}")
    if not out.absolute().parent.is_dir():
        raise CommandError(f"--out {out}: expected a folder {out.parent}, found none")
    for name in panel or ():
        message = f"--panel: expected one of {', '.join(_PANELS)}, found {name}"
        expect_known(name, _PANELS, message, CommandError)
    look = read_style(style)
    whole = [
        (folder, draw)
        for folder in folders
        for file, draw in _WHOLE.items()
        if (folder / file).is_file()
    ][:1]
    if whole and len(folders) > 1:
        raise CommandError(
            f"{whole[0][0]}: expected runs, or one sweep or comparison, found it among others"
        )
    try:
        with drawing(look.settings() | {"text.parse_math": bool(whole)}):
            if whole:
                _only_of_runs(panel, estimator)
                ((folder, draw),) = whole
                paths = draw(folder, out, look)
            else:
                panels: Iterable[Any] = dict.fromkeys(panel or _PANELS)
                save(draw_overlay(curves_of(folders, estimator or ()), [*panels], look), out, look)
                paths = [out]
    except ValueError as error:
        raise ConfigError(str(error)) from None
    for path in paths:
        print(path)


def _only_of_runs(panel: Sequence[str] | None, estimator: Sequence[str] | None) -> None:
    for name, value in (("--panel", panel), ("--estimator", estimator)):
        if value:
            raise CommandError(f"{name}: expected runs, found a folder of which all is plotted")
