"""Trajectories from above, from the side and as height over time; sheets of sample images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from nodes.judging.evaluation.record import Interval
from nodes.judging.report.folder import Floats, broken, holes
from nodes.judging.report.tables import (
    DPI,
    HIT,
    PLAN,
    TRUTHS,
    WIDTH,
    Plot,
    Run,
    bounds,
    label,
    legend_columns,
    mark_ends,
    sheet,
    thin,
)
from nodes.trajectory import Trajectory
from runtime.source_files import source_file, source_of

_LEFT, _RIGHT, _TOP, _BOTTOM = 0.7, 0.2, 0.5, 0.5
_ASIDE, _BETWEEN = 0.75, 0.8  # inches around the axes, and between them
_ROW = 0.2  # inches of a row of the legend
_TALLEST = 6.0  # inches of the view from above, at most
_TIME = 1.3  # inches of the height over time, at least
Rectangle = tuple[float, float, float, float]  # left, bottom, width, height; inches


class _Line(msgspec.Struct, frozen=True, eq=False):
    """A line to draw: stamps (ns), points east, north, up (m)."""

    name: str
    stamps: npt.NDArray[np.int64]
    points: Floats
    style: dict[str, Any]


def draw_trajectories(run: Run) -> Plot | None:
    """Draw truth, plan and aligned estimates at one scale; `None` if there is none of them."""
    lines = _lines(run)
    if not lines:
        return None
    low, high = _bounds(lines)
    marks = ["start", "end", *(["collision"] if len(run.collisions) else [])]
    columns = legend_columns([*(line.name for line in lines), *marks])
    top = _TOP + _ROW * -(-(len(lines) + len(marks)) // columns)
    east, north, up = (high - low).tolist()
    height, *places = _layout(east, north, up, top)
    figure = sheet(height, constrained=False)
    above, beside, later = (
        figure.add_axes((x / WIDTH, y / height, w / WIDTH, h / height)) for x, y, w, h in places
    )
    for line in lines:
        x, y, z = line.points.T
        above.plot(x, y, label=line.name, **line.style)
        beside.plot(x, z, **line.style)
        later.plot((line.stamps - run.start) / 1e9, z, **line.style)
    for line in lines:
        if line.style["color"] != PLAN:
            _ends(above, beside, line, main=line is lines[0] or line.style["color"] in TRUTHS)
    for axis, rows in ((above, [0, 1]), (beside, [0, 2])) if len(run.collisions) else ():
        hits = _shown(run.collisions)[:, rows]
        axis.plot(*hits.T, "x", color=HIT, ms=8, mew=1.8, zorder=5, label="collision")
    above.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    above.set(xlabel="east (m)", ylabel="north (m)", title="from above")
    beside.set(xlim=(low[0], high[0]), ylim=(low[2], high[2]))
    beside.set(xlabel="east (m)", ylabel="height (m)", title="from the side (looking north)")
    later.set(xlabel="time (s)", ylabel="height (m)", title="height over time")
    later.set_ylim(low[2], high[2])
    later.margins(x=0.01)
    handles, names = above.get_legend_handles_labels()
    figure.legend(
        handles,
        names,
        loc="upper left",
        bbox_to_anchor=((_LEFT - 0.1) / WIDTH, 1.0 - 0.05 / height),
        ncols=columns,
    )
    astray = any(((p < low) | (p > high)).any() for p in (line.points for line in lines))
    return Plot("trajectories", figure, "Trajectories", _caption(run, astray=astray))


def _caption(run: Run, *, astray: bool) -> str:
    how = {str(e.figures["alignment"]) for e in run.estimators if "alignment" in e.figures}
    methods = f" (alignment: {', '.join(sorted(how))})" if how else ""
    text = "Both views have one scale."
    if any(e.aligned is not None for e in run.estimators):
        text += (
            f" Estimates as laid on the truth for the evaluation{methods}; "
            "their lines are broken where they were lost or no truth is known."
        )
    if astray:
        text += " What goes farther astray than this is cut off."
    return text


def _lines(run: Run) -> list[_Line]:
    lines = []
    several = len(run.truths) > 1
    for k, (vehicle, truth) in enumerate(run.truths.items()):
        style = {"color": TRUTHS[k % len(TRUTHS)], "lw": 3.2, "alpha": 0.45}
        style["solid_capstyle"] = "round"
        lines.append(
            _line(f"truth of {label(vehicle)}" if several else "truth", truth, style, holes(truth))
        )
    for vehicle, plan in run.plans.items():
        style = {"color": PLAN, "lw": 0.9, "ls": (0, (5, 3))}
        lines.append(_line(f"plan of {label(vehicle)}" if several else "plan", plan, style))
    for estimator in run.estimators:
        if estimator.aligned is not None:
            style = {"color": estimator.color, "lw": 1.3}
            unknown = [*estimator.lost, *holes(run.truth_of(estimator))]
            lines.append(_line(label(estimator.name), estimator.aligned, style, unknown))
        if estimator.final is not None:
            style = {"color": estimator.color, "lw": 1.3, "ls": (0, (2, 1.5))}
            lines.append(
                _line(f"{label(estimator.name)} after loop closures", estimator.final, style)
            )
    return lines


def _line(
    name: str, poses: Trajectory, style: dict[str, Any], lost: Sequence[Interval] = ()
) -> _Line:
    some = thin(len(poses))
    stamps = poses.stamps[some]
    return _Line(name, stamps, _shown(broken(poses.positions[some], stamps, lost)), style)


def _shown(positions: Floats) -> Floats:
    """Return NED positions as east, north, up, shape (n, 3)."""
    return positions[:, [1, 0, 2]] * [1.0, 1.0, -1.0]


def _bounds(lines: list[_Line]) -> tuple[Floats, Floats]:
    """Return the corners of plotted lines; estimates count to twice the truth's width."""
    points = np.concatenate([line.points for line in lines])
    true = [line.points for line in lines if line.style["color"] in TRUTHS]
    if true:
        first = np.concatenate(true)
        low, high = np.nanmin(first, axis=0), np.nanmax(first, axis=0)
        beyond = max(float((high - low).max()), 0.5)
        points = np.clip(points, low - beyond, high + beyond)
    # A vehicle that hovers, or one that goes straight ahead, still has a figure of some shape.
    return bounds(points, (0.4, 0.4, 0.12))


def _layout(
    east: float, north: float, up: float, top: float
) -> tuple[float, Rectangle, Rectangle, Rectangle]:
    """Return the figure's height, and places of above, side (beside if tall), time; inches."""
    across = WIDTH - _LEFT - _RIGHT
    if north < 0.7 * east:
        scale = min(across / east, _TALLEST / north)
        width, view, side = east * scale, north * scale, up * scale
        left = _LEFT + (across - width) / 2
        second = _BOTTOM + _TIME + _BETWEEN
        first = second + side + _BETWEEN
        return (
            first + view + top,
            (left, first, width, view),
            (left, second, width, side),
            (left, _BOTTOM, width, _TIME),
        )
    scale = min((across - _ASIDE) / (2 * east), _TALLEST / north)
    width, view, side = east * scale, north * scale, up * scale
    right = _LEFT + width + _ASIDE
    rest = max(view - side - _BETWEEN, _TIME)
    tall = max(view, side + _BETWEEN + rest)
    return (
        _BOTTOM + tall + top,
        (_LEFT, _BOTTOM + tall - view, width, view),
        (right, _BOTTOM + tall - side, width, side),
        (right, _BOTTOM, WIDTH - _RIGHT - right, rest),
    )


def _ends(above: Any, beside: Any, line: _Line, *, main: bool) -> None:
    """Mark the end of a line, and the start of the main line."""
    known = line.points[~np.isnan(line.points[:, 0])]
    if len(known):
        (first, last), color = known[[0, -1]].tolist(), line.style["color"]
        for axis, row in ((above, 1), (beside, 2)):
            start = (first[0], first[row]) if main else None
            mark_ends(axis, start, (last[0], last[row]), color)


_COLUMNS = 4
_MOST = 12
_GAP = 6  # pixels between images
_CAPTION = 26  # pixels above each


def draw_frames(run: Run) -> list[Plot]:
    """Draw a sheet for each estimator with images, and for each untracked camera."""
    names = {source_file(e.name): e.name for e in run.estimators}
    plots = []
    for file, paths in run.frames.items():
        step = -(-len(paths) // _MOST)
        figure = _sheet(run, paths[::step])
        if figure is not None:
            title, caption = f"Images of {source_of(file)}", "Sample images of the camera."
            if (name := names.get(file)) is not None:
                title = f"Images and features of {name}"
                caption = (
                    "Rings: tracked features; green agree with the estimated motion, red don't."
                )
            plots.append(Plot(f"frames_{file}", figure, title, caption, raster=True, photo=True))
    return plots


def read_image(path: Path) -> npt.NDArray[Any]:
    """Read an image (h, w, 3), red, green, blue; may raise `OSError` or `ValueError`."""
    data = np.fromfile(path, np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
    if image is None:
        raise ValueError(f"expected a JPEG or PNG, found {data[:8].tobytes()!r}")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def _sheet(run: Run, paths: list[Path]) -> Figure | None:
    columns = min(_COLUMNS, len(paths))
    width = (round(WIDTH * DPI) - _GAP * (_COLUMNS - 1)) // _COLUMNS
    shown = []
    for path in paths:
        try:
            image = read_image(path)
        except (OSError, ValueError) as error:
            run.missing.append(f"frames/{path.name} cannot be read: {error}")
            continue
        height = max(round(image.shape[0] * width / image.shape[1]), 1)
        small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        shown.append((_frames_caption(run, path), small))
    if not shown:
        return None
    tallest = max(image.shape[0] for _, image in shown) + _CAPTION + _GAP
    rows = math.ceil(len(shown) / columns)
    canvas = np.full((rows * tallest, columns * (width + _GAP) - _GAP, 3), 255, np.uint8)
    figure = sheet(canvas.shape[0] / DPI, constrained=False, width=canvas.shape[1] / DPI)
    axis: Any = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axis.set_axis_off()
    for k, (text, image) in enumerate(shown):
        top, left = k // columns * tallest, k % columns * (width + _GAP)
        canvas[top + _CAPTION : top + _CAPTION + image.shape[0], left : left + width] = image
        axis.text(left + 2, top + _CAPTION - 6, text, fontsize=9, color="#222222")
    axis.imshow(canvas, interpolation="nearest", aspect="auto")
    return figure


def _frames_caption(run: Run, path: Path) -> str:
    stamp = path.stem.rpartition("_")[2]
    if not stamp.isdecimal():
        return label(path.stem)
    return f"{(int(stamp) - run.start) / 1e9:.2f} s"
