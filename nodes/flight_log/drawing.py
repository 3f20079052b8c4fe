"""Drawing a flight: plain functions from rows of numbers to PNG files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

Thumbnail = tuple[int, str, npt.NDArray[np.uint8]]
"""Stamp (ns), source, picture (h, w, 1 or 3)."""


def draw_flight(rows: npt.ArrayLike, hits: Sequence[tuple[float, float]], out: Path) -> None:
    """Draw a flight from above and over time.

    Args:
        rows: The flight, shape (n, 7): stamp (ns), position x, y, z (m, NED), linear velocity
            x, y, z (m/s).
        hits: Places of collisions, x and y (m).
        out: The PNG to write.
    """
    from matplotlib.figure import Figure  # half a second, which no flight should wait for

    data = np.array(rows)
    seconds, (x, y, z) = data[:, 0] / 1e9, data[:, 1:4].T
    speed = np.linalg.norm(data[:, 4:7], axis=1)
    length = float(np.linalg.norm(np.diff(data[:, 1:4], axis=0), axis=1).sum())
    figure = Figure(figsize=(12, 6.4), layout="constrained")
    figure.suptitle(
        f"{seconds[-1] - seconds[0]:.1f} s, {length:.1f} m, "
        f"{len(hits)} collision{'' if len(hits) == 1 else 's'}"
    )
    axes = figure.subplot_mosaic([["above", "height"], ["above", "speed"]], width_ratios=[1.25, 1])
    above: Any = axes["above"]
    thin = slice(None, None, max(len(x) // 3000, 1))
    path = above.scatter(y[thin], x[thin], c=speed[thin], s=5, cmap="viridis")
    above.plot(y[0], x[0], "o", color="#1a9850", ms=10, mec="white", label="start")
    above.plot(y[-1], x[-1], "s", color="#d73027", ms=9, mec="white", label="end")
    if hits:
        above.plot([e for _, e in hits], [n for n, _ in hits], "kx", ms=9, label="collision")
    above.set(xlabel="east (m)", ylabel="north (m)", title="from above", aspect="equal")
    above.margins(0.1)
    above.legend(loc="best", framealpha=0.9)
    figure.colorbar(path, ax=above, label="speed (m/s)", shrink=0.7)
    axes["height"].plot(seconds, -z, color="#2f6690")
    axes["height"].set(ylabel="height (m)", title="over time")
    axes["speed"].plot(seconds, speed, color="#2f6690")
    axes["speed"].set(xlabel="time (s)", ylabel="speed (m/s)")
    for axis in axes.values():
        axis.grid(alpha=0.3)
    figure.savefig(out, dpi=120)


def draw_contact_sheet(thumbnails: Sequence[Thumbnail], out: Path) -> None:
    """Draw small pictures in rows, each with its time and camera."""
    from matplotlib.figure import Figure

    columns = math.ceil(math.sqrt(len(thumbnails)))
    rows = math.ceil(len(thumbnails) / columns)
    figure = Figure(figsize=(2.5 * columns, 2.75 * rows), layout="constrained")
    grid: Any = figure.subplots(rows, columns, squeeze=False)
    for axis in grid.flat:
        axis.set_axis_off()
    for axis, (stamp, source, picture) in zip(grid.flat, thumbnails, strict=False):
        axis.imshow(picture.squeeze(), cmap="gray" if picture.shape[-1] == 1 else None)
        axis.set_title(f"{source}  {stamp / 1e9:.2f} s", fontsize=8)
    figure.savefig(out, dpi=110)
