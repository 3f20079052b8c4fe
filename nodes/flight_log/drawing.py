"""Drawing a flight: plain functions from poses and images to PNG files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from nodes.trajectory import Trajectory

Thumbnail = tuple[int, str, npt.NDArray[np.uint8]]
"""Stamp (ns), source, image (h, w, 1 or 3)."""


def draw_flight(flight: Trajectory, hits: Sequence[tuple[float, float]], out: Path) -> None:
    """Draw a flight from above and over time, in the report's style.

    Args:
        flight: Its poses, in NED.
        hits: Places of collisions, x and y (m).
        out: The PNG to write.
    """
    # Matplotlib takes half a second to import, for which no flight should wait.
    from nodes.report.style import DPI, LINE, bounds, drawing, mark_ends, sheet, thin

    some = thin(len(flight))
    seconds = flight.stamps[some] / 1e9
    x, y, z = flight.positions[some].T
    speed = np.linalg.norm(flight.velocities(), axis=1)[some]
    with drawing():
        figure = sheet(5.0)
        collisions = f"{len(hits)} collision{'' if len(hits) == 1 else 's'}"
        figure.suptitle(f"{flight.seconds:.1f} s, {flight.length():.1f} m, {collisions}")
        axes = figure.subplot_mosaic(
            [["above", "height"], ["above", "speed"]], width_ratios=[1.25, 1]
        )
        above: Any = axes["above"]
        points = above.scatter(y, x, c=speed, s=5, cmap="viridis", vmin=0.0)
        mark_ends(above, (y[0], x[0]), (y[-1], x[-1]), LINE)
        if hits:
            above.plot([e for _, e in hits], [n for n, _ in hits], "kx", ms=9, label="collision")
        # A flight straight ahead, or on the spot, still gets axes of some breadth.
        (left, bottom), (right, top) = (c.tolist() for c in bounds(np.stack([y, x], axis=1), 0.4))
        above.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
        above.set(xlabel="east (m)", ylabel="north (m)", title="from above")
        above.legend(loc="best", frameon=True, framealpha=0.9)
        figure.colorbar(points, ax=above, label="speed (m/s)", shrink=0.7)
        axes["height"].plot(seconds, -z, color=LINE)
        axes["height"].set(ylabel="height (m)", title="over time")
        axes["speed"].plot(seconds, speed, color=LINE)
        top = max(1.05 * float(speed.max()), 0.1)
        axes["speed"].set(xlabel="time (s)", ylabel="speed (m/s)", ylim=(0.0, top))
        figure.savefig(out, dpi=DPI, metadata={"Software": None})


def draw_contact_sheet(thumbnails: Sequence[Thumbnail], out: Path) -> None:
    """Draw small images in rows, each with its time and camera."""
    from matplotlib.figure import Figure

    columns = math.ceil(math.sqrt(len(thumbnails)))
    rows = math.ceil(len(thumbnails) / columns)
    figure = Figure(figsize=(2.5 * columns, 2.75 * rows), layout="constrained")
    grid: Any = figure.subplots(rows, columns, squeeze=False)
    for axis in grid.flat:
        axis.set_axis_off()
    for axis, (stamp, source, image) in zip(grid.flat, thumbnails, strict=False):
        axis.imshow(image.squeeze(), cmap="gray" if image.shape[-1] == 1 else None)
        axis.set_title(f"{source}  {stamp / 1e9:.2f} s", fontsize=8)
    figure.savefig(out, dpi=110)
