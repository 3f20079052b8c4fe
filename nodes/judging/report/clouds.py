"""Point clouds side by side, painted at one viewpoint and scale, to reveal smearing."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from nodes.judging.report.tables import DPI, WIDTH, Plot, Run, label, sheet
from nodes.mapping import Cloud, read_ply

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Painting = tuple[npt.NDArray[np.uint8], int]

MOST = 1_000_000  # points of a cloud drawn at most: their indices take 20 bits
_DEPTHS = 0xFFFFF
_BACKGROUND = np.array([250, 250, 248], np.uint8)


class Shown(msgspec.Struct, frozen=True, eq=False):
    """A cloud prepared for drawing."""

    name: str
    points: npt.NDArray[np.float32]  # east, north, up, metres, float32, shape (n, 3)
    colors: npt.NDArray[np.uint8]  # red, green, blue, uint8, shape (n, 3)
    total: int


class View(msgspec.Struct, frozen=True, eq=False):
    """An orthographic view."""

    title: str
    axes: Floats  # east, north, up to right, up on the image, towards the viewer; shape (3, 3)
    low: Floats  # corner of the image, metres right and up, shape (2,)
    high: Floats
    # Of the axes, right and up; if empty, a scale bar instead.
    labels: tuple[str, str] | None = None


def visible(cloud: Shown, view: View, pixels: float) -> tuple[Indices, Indices, Indices]:
    """Return rows, columns and cloud indices of each pixel's nearest point; (m,), farthest first.

    Args:
        cloud: At most `MOST` points.
        pixels: Per metre.
    """
    width = _size(view, pixels)[1]
    seen = cloud.points @ view.axes.T.astype(np.float32)
    inside = np.flatnonzero(((seen[:, :2] > view.low) & (seen[:, :2] < view.high)).all(axis=1))
    seen = seen[inside]
    column = ((seen[:, 0] - view.low[0]) * pixels).astype(np.uint64)
    row = ((view.high[1] - seen[:, 1]) * pixels).astype(np.uint64)
    near = seen[:, 2]
    span = float(np.ptp(near)) + 1e-6 if len(near) else 1.0
    depth = ((near - near.min(initial=np.inf)) * (_DEPTHS / span)).astype(np.uint64)
    # One sort of whole numbers (pixel, depth, number of the point) is all the hiding there is.
    keys = np.sort((row * np.uint64(width) + column) << 40 | depth << 20 | inside.astype(np.uint64))
    pixel = keys >> 40
    nearest = np.append(pixel[1:] != pixel[:-1], np.ones(min(len(pixel), 1), bool))
    keys, where = keys[nearest], pixel[nearest].astype(np.int64)
    order = np.argsort(keys >> 20 & 0xFFFFF, kind="stable")
    number = (keys & 0xFFFFF).astype(np.int64)
    return where[order] // width, where[order] % width, number[order]


def paint(cloud: Shown, view: View, pixels: float, dot: int | None = None) -> Painting:
    """Return a cloud painted in a view as an image, shape (h, w, 3), and the dot width.

    Args:
        pixels: Per metre.
        dot: Width of a point in pixels; by default enough to fill gaps.
    """
    height, width = _size(view, pixels)
    row, column, number = visible(cloud, view, pixels)
    if dot is None:
        dot = int(np.clip(np.ceil(np.sqrt(2.0 * height * width / max(len(row), 1))), 2, 5))
    spread = np.arange(dot) - (dot - 1) // 2
    rows = np.clip(row[:, None, None] + spread[:, None], 0, height - 1)
    columns = np.clip(column[:, None, None] + spread, 0, width - 1)
    image = np.full((height * width, 3), _BACKGROUND)
    # Where several dots lie on one pixel, numpy keeps the last: the nearest.
    painted = np.repeat(cloud.colors[number], dot * dot, axis=0)
    image[(rows * width + columns).reshape(-1)] = painted
    return image.reshape(height, width, 3), dot


def _size(view: View, pixels: float) -> tuple[int, int]:
    across, up = np.maximum(np.ceil((view.high - view.low) * pixels), 1).astype(int).tolist()
    return up, across


ABREAST = 3  # clouds side by side in a figure, at most
_ENOUGH = 100_000  # points of a cloud sampled to choose its views, at most
_CLEARANCE = 0.4  # metres from the highest pose to the cut-off of clouds, below ceilings
_AZIMUTH, _ELEVATION = np.radians(35.0), np.radians(42.0)  # of the view from above south-west
_TALLEST, _TITLE = 6.0, 0.55  # height of a view at most, and of its title and labels, inches
_THINNEST = 0.15  # least ratio of a view's shorter side to its longer side
_DETAIL = 3.6  # metres across of the detail


def draw_clouds(run: Run) -> list[Plot]:
    """Draw all readable clouds (`Run.missing` names the others), the first one in each figure."""
    height = _ceiling(run)
    clouds = []
    for path in run.clouds:
        try:
            cloud = read_ply(path, MOST)
        except (OSError, ValueError) as error:
            run.missing.append(f"clouds/{path.name} cannot be read: {error}")
            continue
        if len(cloud.points):
            clouds.append(_shown(path.stem, cloud, height))
        else:
            run.missing.append(f"clouds/{path.name} cannot be drawn: it has no points")
    if not clouds:
        return []
    clouds.sort(key=lambda cloud: "tru" not in cloud.name)  # a true one, if there is one, is first
    first, *others = clouds
    views = _views(first)
    if not others:
        return [_draw_one(first, views, height)]
    step = ABREAST - 1
    groups = [[first, *others[k : k + step]] for k in range(0, len(others), step)]
    return [_draw(group, views, k, height) for k, group in enumerate(groups, start=1)]


def _ceiling(run: Run) -> float | None:
    """Return the cut-off height (m) of clouds: `_CLEARANCE` above the highest true pose."""
    highest = [float(-truth.positions[:, 2].min()) for truth in run.truths.values()]
    return max(highest) + _CLEARANCE if highest else None


def _shown(name: str, cloud: Cloud, height: float | None) -> Shown:
    """Return a cloud's points below `height`, coloured by height if without colours."""
    points = cloud.points[:, [1, 0, 2]] * np.array([1, 1, -1], np.float32)
    colors = cloud.colors
    if colors is None:
        low, high = np.percentile(points[:, 2], (1, 99))
        share = np.clip((points[:, 2] - low) / max(high - low, 1e-9), 0, 1)[:, None]
        ends = np.array([[30, 60, 110], [230, 190, 80]])
        colors = (ends[0] + share * (ends[1] - ends[0])).astype(np.uint8)
    under = points[:, 2] <= (np.inf if height is None else height)
    if under.any():
        points, colors = points[under], colors[under]
    return Shown(name, points, colors, cloud.total)


def _views(cloud: Shown) -> list[View]:
    some = slice(None, None, -(-len(cloud.points) // _ENOUGH))
    points = cloud.points[some].astype(np.float64)
    low, high = np.percentile(points, (0.3, 99.7), axis=0)
    margin = 0.03 * float((high - low).max()) + 0.05
    low, high = low - margin, high + margin
    within = ((points >= low) & (points <= high)).all(axis=1)
    inside = points[within]
    east, north, up = np.eye(3)
    top = View("from above", np.eye(3), *_frame(low[:2], high[:2]), ("east (m)", "north (m)"))
    right = np.cos(_AZIMUTH) * east - np.sin(_AZIMUTH) * north
    away = np.sin(_AZIMUTH) * east + np.cos(_AZIMUTH) * north
    upward = np.sin(_ELEVATION) * away + np.cos(_ELEVATION) * up
    oblique = np.stack([right, upward, np.cross(right, upward)])
    seen = inside @ oblique.T
    corners = _frame(seen[:, :2].min(axis=0), seen[:, :2].max(axis=0))
    whole = View("obliquely", oblique, *corners)
    place = _busiest(inside, cloud.colors[some][within])
    middle = oblique[:2] @ place
    half = np.array([_DETAIL / 2, _DETAIL / 2 * 0.8])
    detail = View("a detail", oblique, middle - half, middle + half)
    return [top, whole, detail]


def _frame(low: Floats, high: Floats) -> tuple[Floats, Floats]:
    """Return the corners of a view, with a least side length even for a single point."""
    middle, half = (low + high) / 2, (high - low) / 2
    half = np.maximum(half, max(_THINNEST * float(half.max()), 0.05))
    return middle - half, middle + half


def _busiest(points: Floats, colors: npt.NDArray[np.uint8]) -> Floats:
    """Return the middle of the 2 m with the most heights and colours."""
    cells = np.floor(points[:, :2] / 2.0).astype(np.int64)
    cells -= cells.min(axis=0)
    index = cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1]
    slots = np.unique(index * 64 + (points[:, 2] * 10).astype(np.int64) % 64)
    heights = np.bincount(slots // 64)
    counts = np.maximum(np.bincount(index), 1)
    grey = colors.mean(axis=1)
    mean, square = np.bincount(index, grey) / counts, np.bincount(index, grey**2) / counts
    contrast = np.sqrt(np.maximum(square - mean**2, 0.0)) + 1.0
    best = int(np.argmax(heights * contrast * np.sqrt(counts)))
    return np.asarray(np.median(points[index == best], axis=0))


def _draw(clouds: list[Shown], views: list[View], number: int, height: float | None) -> Plot:
    across = (WIDTH - 0.6) / len(clouds)
    heights = [min(across * _aspect(view), _TALLEST) + _TITLE for view in views]
    figure = sheet(sum(heights))
    grid: Any = figure.subplots(len(views), len(clouds), squeeze=False, height_ratios=heights)
    for axes, view in zip(grid, views, strict=True):
        pixels = min(across, _TALLEST / _aspect(view)) / (view.high - view.low)[0] * DPI
        dot = None
        for axis, cloud in zip(axes, clouds, strict=True):
            dot = _show(axis, cloud, view, pixels, dot)
    return Plot(f"clouds_{number}", figure, "Clouds", _caption(clouds, height), raster=True)


def _draw_one(cloud: Shown, views: list[View], height: float | None) -> Plot:
    """Draw a single cloud: the view from above beside the others."""
    above, *others = views
    # Widths of the columns such that both are equally tall.
    left = 1.0 / _aspect(above)
    right = 1.0 / sum(_aspect(view) for view in others)
    tall = min((WIDTH - 0.8 - _TITLE / 2) / (left + right), _TALLEST)
    figure = sheet(tall + 2 * _TITLE)
    axes = figure.subplot_mosaic(
        [["0", "1"], ["0", "2"]],
        width_ratios=[left, right],
        height_ratios=[_aspect(view) for view in others],
    )
    for k, view in enumerate(views):
        wide = tall * (right if k else left)
        _show(axes[str(k)], cloud, view, wide / (view.high - view.low)[0] * DPI, None)
    return Plot("clouds_1", figure, "Cloud", _caption([cloud], height), raster=True)


def _aspect(view: View) -> float:
    across, up = (view.high - view.low).tolist()
    return float(up / across)


def _show(axis: Any, cloud: Shown, view: View, pixels: float, dot: int | None) -> int:
    image, dot = paint(cloud, view, pixels, dot)
    extent = (view.low[0], view.high[0], view.low[1], view.high[1])
    axis.imshow(image, extent=extent, interpolation="nearest")
    axis.grid(visible=False)
    axis.set_title(f"{label(cloud.name)}: {view.title}")
    if view.labels is not None:
        axis.set(xlabel=view.labels[0], ylabel=view.labels[1])
    else:
        _bar(axis, view)
    return dot


def _caption(clouds: list[Shown], height: float | None) -> str:
    counts = ", ".join(f"{c.name} " + f"{c.total:,}".replace(",", " ") for c in clouds)
    text = ""
    if len(clouds) > 1:
        text = (
            "One viewpoint and one scale for all: errors of the poses show as walls that are "
            "doubled or smeared. "
        )
    text += f"Points: {counts}."
    if height is not None:
        text += f" What is higher than {height:.1f} m, such as a ceiling, is left out."
    return text


def _bar(axis: Any, view: View) -> None:
    axis.set(xticks=[], yticks=[])
    for spine in axis.spines.values():
        spine.set_visible(False)
    size = view.high - view.low
    length = next((n for n in (10, 5, 2, 1, 0.5, 0.2) if n < 0.3 * size[0]), 0.1)
    x, y = view.low + 0.03 * size[0]
    for color, thickness in (("white", 5.0), ("#222222", 2.5)):
        axis.plot([x, x + length], [y, y], color=color, lw=thickness, solid_capstyle="butt")
    behind = {"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 1.5}
    place = (x + length / 2, y + 0.02 * size[0])
    axis.text(*place, f"{length:g} m", ha="center", va="bottom", bbox=behind)
    axis.set(xlim=(view.low[0], view.high[0]), ylim=(view.low[1], view.high[1]))
