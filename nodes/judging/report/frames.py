"""Sheets of the sample images in which an evaluation drew the features of an estimator."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from nodes.judging.report.contents import Run
from nodes.judging.report.style import DPI, WIDTH, Plot, label, sheet
from runtime.paths import source_file, source_of

_COLUMNS = 4
_MOST = 12
_GAP = 6
"""Pixels between images."""
_CAPTION = 26
"""Pixels above each."""


def draw_frames(run: Run) -> list[Plot]:
    """Draw one sheet for each estimator that left images, and each camera that nobody tracks."""
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
    """Read an image: red, green, blue, shape (h, w, 3).

    Raises:
        OSError: It cannot be read.
        ValueError: It is none.
    """
    data = np.fromfile(path, np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_COLOR_RGB) if len(data) else None
    if image is None:
        raise ValueError(f"expected a JPEG or PNG, found {data[:8].tobytes()!r}")
    return image


def _sheet(run: Run, paths: list[Path]) -> Figure | None:
    """Draw a sheet; `None` if there was nothing to draw."""
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
        shown.append((_caption(run, path), small))
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


def _caption(run: Run, path: Path) -> str:
    """Return the time of an image, from the stamp at the end of its name."""
    stamp = path.stem.rpartition("_")[2]
    if not stamp.isdecimal():
        return label(path.stem)
    return f"{(int(stamp) - run.start) / 1e9:.2f} s"
