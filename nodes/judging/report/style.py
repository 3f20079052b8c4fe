"""Style of a report: a colour per estimator in all figures, plain axes, few digits."""

from __future__ import annotations

import contextlib
import math
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import msgspec
import numpy as np
import numpy.typing as npt
from matplotlib.artist import Artist
from matplotlib.figure import Figure

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
        for each in {"svg", "pdf"}.intersection(() if self.raster else formats):
            date = {"svg": "Date", "pdf": "CreationDate"}[each]
            self.figure.savefig(path.with_suffix(f".{each}"), metadata={date: None})
        return path


@contextlib.contextmanager
def drawing() -> Iterator[None]:
    """Draw in the report's style while the block runs."""
    with mpl.rc_context(_STYLE), warnings.catch_warnings():
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
    """Tell whether series need a logarithmic axis: percentiles (`share`) differ over 20-fold."""
    tops = [top for v in values if len(v) and (top := float(np.nanpercentile(v, share))) > 0.0]
    return len(tops) > 1 and max(tops) > 20.0 * min(tops)


def legend_columns(names: Sequence[str]) -> int:
    """Return how many columns of a legend fit across the page."""
    longest = max((len(name) for name in names), default=0)
    return max(min(_LETTERS // (longest + _HANDLE), len(names)), 1)


def legend_above(figure: Figure, axes: Any, *extra: Artist) -> None:
    """Put the legend of some axes, and of further artists, at the top of a figure."""
    handles, names = axes.get_legend_handles_labels()
    handles, names = [*handles, *extra], [*names, *(str(each.get_label()) for each in extra)]
    if handles:
        columns = legend_columns(names)
        figure.legend(handles, names, loc="outside upper left", ncols=columns)
