"""Plots of errors over time, error distributions, latencies and relative errors."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import NullFormatter

from nodes.judging.evaluation.metrics import path_pairs, relative_errors
from nodes.judging.report.folder import Floats, broken, holes
from nodes.judging.report.tables import (
    Estimator,
    Plot,
    Run,
    label,
    legend_above,
    number,
    sheet,
    thin,
    wide_range,
)
from nodes.trajectory import Trajectory

SECOND = 1e9
MILLISECOND = 1e6
LENGTHS = (1.0, 2.0, 5.0, 10.0, 20.0)  # path lengths of the relative errors, metres
_STYLES: dict[str, Any] = {"at image time": "-", "newest at control ticks": (0, (4, 2))}
"""Of the lines of distributions."""
_LOST = "lost, in the estimator's colour"
_SHOWN = 95  # percentile of the errors at the end of the axis of distributions, at least
_FEWEST = 5  # least number of pose pairs for a box


def draw_errors(run: Run) -> Plot | None:
    """Draw position and rotation error of each estimate over time, lost intervals shaded."""
    known = [(e, e.image_errors) for e in run.estimators if e.image_errors is not None]
    if not known:
        return None
    figure = sheet(4.6, names=[*(estimator.name for estimator, _ in known), _LOST])
    axes: Any = figure.subplots(2, 1, sharex=True)
    for estimator, errors in known:
        for axis, values in zip(axes, (errors.position, np.degrees(errors.rotation)), strict=True):
            some = thin(len(values))
            stamps = errors.stamps[some]
            line = broken(values[some], stamps, [*estimator.lost, *holes(run.truth_of(estimator))])
            seconds = (stamps - run.start) / SECOND
            axis.plot(seconds, line, color=estimator.color, lw=1.2, label=label(estimator.name))
    lost = any(estimator.lost for estimator in run.estimators)
    for axis in axes if lost else ():
        _shade(run, axis)
    scale_axis(axes[0], [e.position for _, e in known], "y")
    scale_axis(axes[1], [np.degrees(e.rotation) for _, e in known], "y")
    axes[0].set_ylabel("position error (m)")
    axes[1].set(ylabel="rotation error (°)", xlabel="time (s)")
    axes[0].margins(x=0.01)
    patch = Patch(facecolor="#bbbbbb", alpha=0.5, label=_LOST)
    legend_above(figure, axes[0], *([patch] if lost else []))
    when = "; ".join(
        f"{e.name} "
        + ", ".join(
            f"{(a - run.start) / SECOND:.1f}–{(b - run.start) / SECOND:.1f} s" for a, b in e.lost
        )
        for e in run.estimators
        if e.lost
    )
    caption = "Each estimate against the truth at the time of its image."
    caption += f" Lost (shaded): {when}." if lost else " Nobody was lost."
    return Plot("errors", figure, "Errors over time", caption)


def _shade(run: Run, axis: Any) -> None:
    for estimator in run.estimators:
        for start, end in estimator.lost:
            a, b = (start - run.start) / SECOND, (end - run.start) / SECOND
            axis.axvspan(a, b, facecolor=estimator.color, alpha=0.18, lw=0, zorder=0.5)


def _known(run: Run) -> list[tuple[Estimator, Trajectory, Trajectory]]:
    """Return estimators with poses of the point compared, and the true ones at their stamps."""
    known = []
    for estimator in run.estimators:
        truth = run.truth_of(estimator)
        if estimator.aligned is not None and truth is not None:
            inside = estimator.aligned.take(truth.covers(estimator.aligned.stamps))
            at = run.lever_of(estimator)
            known.append((estimator, inside.moved(at), truth.moved(at).at(inside.stamps)))
    return known


def draw_axes(run: Run) -> Plot | None:
    """Draw the position error of each estimate along north, east and down over time."""
    known = _known(run)
    if not known:
        return None
    figure = sheet(4.6, names=[estimator.name for estimator, *_ in known])
    axes: Any = figure.subplots(3, 1, sharex=True)
    for estimator, inside, truth in known:
        errors = inside.positions - truth.positions
        some = thin(len(inside))
        stamps = inside.stamps[some]
        lines = broken(errors[some], stamps, [*estimator.lost, *holes(run.truth_of(estimator))]).T
        for axis, line in zip(axes, lines, strict=True):
            seconds = (stamps - run.start) / SECOND
            axis.plot(seconds, line, color=estimator.color, lw=1.2, label=label(estimator.name))
    for axis, name in zip(axes, ("north", "east", "down"), strict=True):
        axis.set_ylabel(f"{name} (m)")
    axes[0].margins(x=0.01)
    axes[2].set_xlabel("time (s)")
    legend_above(figure, axes[0])
    return Plot(
        "axes",
        figure,
        "Position error along each axis",
        "Estimate less truth, along north, east and down, at the time of each image.",
    )


def draw_distributions(run: Run) -> Plot | None:
    """Draw the cumulative distribution of errors, at image time and at the control ticks."""
    known = [e for e in run.estimators if e.image_errors is not None or e.tick_errors is not None]
    if not known:
        return None
    styles = _STYLES if any(estimator.tick_errors is not None for estimator in known) else {}
    figure = sheet(3.4, names=[*(estimator.name for estimator in known), *styles])
    axes: Any = figure.subplots(1, 2, sharey=True)
    shares = np.linspace(0.0, 1.0, 401)
    series: tuple[list[Floats], list[Floats]] = ([], [])
    for estimator in known:
        name: str | None = label(estimator.name)
        for errors, style in zip(
            (estimator.image_errors, estimator.tick_errors), _STYLES.values(), strict=True
        ):
            if errors is None:
                continue
            for k, values in enumerate((errors.position, np.degrees(errors.rotation))):
                series[k].append(values)
                axes[k].plot(
                    np.quantile(values, shares),
                    100.0 * shares,
                    color=estimator.color,
                    ls=style,
                    label=None if k else name,
                )
            name = None
    for axis, both in zip(axes, series, strict=True):
        scale_axis(axis, both, "x", _SHOWN)
        axis.set_ylim(0, 101)
    axes[0].set(xlabel="position error (m)", ylabel="share of poses below (%)")
    axes[1].set(xlabel="rotation error (°)")
    lines = [Line2D([], [], color="#666666", ls=ls, label=what) for what, ls in styles.items()]
    legend_above(figure, axes[0], *lines)
    dashed = (
        "Dashed: the newest pose a controller had at each of its ticks against the truth at that "
        "tick; the distance between the two is what latency and frame rate cost. "
    )
    return Plot(
        "distributions",
        figure,
        "Distribution of the errors",
        "Solid: each estimate against the truth at the time of its image. "
        f"{dashed if styles else ''}The axes end where {_SHOWN} % of the widest curve are below.",
    )


def draw_latency(run: Run) -> Plot | None:
    """Draw how long estimates took, and how old the newest was at the control ticks."""
    took = [
        (e, (e.image_errors.since - e.image_errors.stamps) / MILLISECOND)
        for e in run.estimators
        if e.image_errors is not None and len(e.image_errors.since)
    ]
    age = [
        (e, (e.tick_errors.stamps - e.tick_errors.since) / MILLISECOND)
        for e in run.estimators
        if e.tick_errors is not None
    ]
    if not took and not age:
        return None
    figure = sheet(3.0, names=[estimator.name for estimator in run.estimators])
    axes: Any = figure.subplots(1, 2)
    _shares(axes[0], took, "from exposure to estimate (ms)", "share of estimates up to (%)")
    _shares(axes[1], age, "age of the newest pose (ms)", "share of control ticks up to (%)")
    axes[0].set_title("latency")
    axes[1].set_title("newest pose of a controller")
    legend_above(figure, axes[0] if took else axes[1])
    return Plot(
        "latency",
        figure,
        "Latency",
        "Left: from the exposure of an image to the arrival of its pose. Right: how long ago that "
        "exposure was, at each tick of the controller. Each line tells what share took at most so "
        "long. Far longer times, as of the last pose of one that is lost, are cut off.",
    )


def _shares(axis: Any, series: list[tuple[Estimator, Floats]], xlabel: str, ylabel: str) -> None:
    """Draw cumulative distributions of values; histograms of stepped ones would have gaps."""
    axis.set(xlabel=xlabel, ylabel=ylabel, ylim=(0, 101))
    if not series:
        axis.text(0.5, 0.5, "not known", ha="center", transform=axis.transAxes, color="#777777")
        return
    low = min(float(values.min()) for _, values in series)
    # An estimator that was lost has a few poses of any age: the rest is to be seen as well.
    high = max(min(float(np.percentile(v, 99.5)), 5.0 * float(np.median(v))) for _, v in series)
    margin = max(0.05 * (high - low), 5.0)
    left, right = max(low - margin, 0.0), high + margin
    shares = np.linspace(0.0, 100.0, 401)
    for estimator, values in series:
        line = np.percentile(values, shares, method="inverted_cdf")
        x = np.concatenate([[left], line, [max(right, line[-1])]])
        y = np.concatenate([[0.0], shares, [100.0]])
        axis.step(x, y, color=estimator.color, lw=1.3, label=label(estimator.name), where="post")
    axis.set_xlim(left, right)


def draw_relative(run: Run) -> Plot | None:
    """Draw boxes of the relative errors over several lengths of path."""
    known = _known(run)
    boxes = []
    for place, length in enumerate(LENGTHS):
        for k, (estimator, inside, truth) in enumerate(known):
            shifts, angles = relative_errors(truth, inside, *path_pairs(truth.distances(), length))
            if len(shifts) >= _FEWEST:
                share = 0.7 / len(known)
                where = place + (k - (len(known) - 1) / 2) * share
                values = 100.0 * shifts / length, np.degrees(angles) / length
                boxes.append((estimator, where, 0.8 * share, length, values))
    if not boxes:
        return None
    figure = sheet(3.4, names=[estimator.name for estimator, *_ in known])
    axes: Any = figure.subplots(1, 2)
    for row, axis in enumerate(axes):
        for estimator in dict.fromkeys(estimator for estimator, *_ in boxes):
            estimator_boxes = [box for box in boxes if box[0] is estimator]
            _boxes(
                axis,
                estimator,
                [(where, width, v[row]) for _, where, width, _, v in estimator_boxes],
            )
        scale_axis(axis, [values[row] for *_, values in boxes], "y", 95)
        axis.set_xticks(range(len(LENGTHS)), [f"{length:g}" for length in LENGTHS])
        axis.set(xlabel="length of path (m)", xlim=(-0.6, len(LENGTHS) - 0.4))
        axis.grid(visible=False, axis="x")
    axes[0].set(ylabel="position: error (% of the length)")
    axes[1].set(ylabel="rotation: error (°/m)")
    legend_above(figure, axes[0])
    reached = max(length for *_, length, _ in boxes)
    short = "" if reached == LENGTHS[-1] else f" The path gives none beyond {reached:g} m."
    return Plot(
        "relative",
        figure,
        "Relative error over path length",
        "How far motions over a length of path are off. Boxes: quartiles and median; whiskers: "
        f"5th and 95th percentile; all pairs of poses that far apart along the true path.{short}",
    )


def _boxes(axis: Any, estimator: Estimator, boxes: list[tuple[float, float, Floats]]) -> None:
    names = ("whislo", "q1", "med", "q3", "whishi")
    statistics = [
        dict(zip(names, np.percentile(v, (5, 25, 50, 75, 95)).tolist(), strict=True))
        for _, _, v in boxes
    ]
    drawn = axis.bxp(
        statistics,
        positions=[where for where, _, _ in boxes],
        widths=[width for _, width, _ in boxes],
        showfliers=False,
        patch_artist=True,
        manage_ticks=False,
        boxprops={"facecolor": f"{estimator.color}40", "edgecolor": estimator.color},
        medianprops={"color": estimator.color, "lw": 1.8},
        whiskerprops={"color": estimator.color},
        capprops={"color": estimator.color},
    )
    drawn["boxes"][0].set_label(label(estimator.name))


def scale_axis(axis: Any, series: list[Floats], which: str, share: float = 100.0) -> None:
    """Start an axis (``x``, ``y``) at 0, or make it logarithmic for series of very unlike size."""
    top = 1.05 * max((float(np.nanpercentile(v, share)) for v in series if len(v)), default=1.0)
    if not wide_range(series):
        axis.set(**{f"{which}lim": (0, top or 1.0)})
        return
    low = min(float(np.nanpercentile(v[v > 0], 5)) for v in series if (v > 0).any())
    axis.set(**{f"{which}scale": "log", f"{which}lim": (max(low / 2, top * 1e-6), top * 1.4)})
    ruler = getattr(axis, f"{which}axis")
    ruler.set_major_formatter(lambda value, _: number(value, 1))
    ruler.set_minor_formatter(NullFormatter())
