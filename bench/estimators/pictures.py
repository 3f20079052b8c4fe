"""The pictures of SUITE.md: the errors of all, and what the cameras see."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bench.estimators.cells import RANKED, Cell
from bench.estimators.plan import Suite
from runtime.tools.sweep.plan import Plan

HEIGHT = 240
"""Of the cameras' pictures, pixels."""


def draw(suite: Suite, cells: Mapping[str, Mapping[str, Cell]], path: Path) -> None:
    """Draw the error of each estimator in each scenario, with its range; crosses have failed."""
    from matplotlib.figure import Figure

    there = [e.name for e in suite.estimators if any(e.name in each for each in cells.values())]
    figure = Figure(figsize=(2.1 * len(suite.scenarios) + 2.4, 4.6), layout="constrained")
    axes: Any = figure.add_subplot()
    for index, name in enumerate(there):
        colour = f"C{index % 10}"
        for place, scenario in enumerate(suite.scenarios):
            cell = cells.get(scenario.name, {}).get(name)
            spread = cell.figures.get(RANKED) if cell else None
            if cell is None or spread is None:
                continue
            x = place + (index + 0.5) / len(there) * 0.8 - 0.4
            axes.plot([x, x], [spread.least, spread.most], color=colour, lw=4, alpha=0.35)
            mark = "o" if cell.passed == cell.runs else "x"
            axes.plot(x, spread.median, mark, color=colour)
        axes.plot([], [], "o", color=colour, label=name)
    for place in range(1, len(suite.scenarios)):
        axes.axvline(place - 0.5, color="0.85", lw=1)
    axes.set_xticks(
        range(len(suite.scenarios)), [f"{s.name}\n({s.level})" for s in suite.scenarios]
    )
    axes.set(yscale="log", ylabel="error over the whole flight, % of the path (cross: failed)")
    axes.grid(axis="y", alpha=0.3)
    figure.legend(loc="outside right upper", fontsize=8)
    figure.savefig(path, dpi=120)


def pictures(plan: Plan, folder: Path) -> dict[str, str]:
    """Put one row of images of each scenario's cameras into a folder.

    Returns:
        Scenario to the name of its file; without those of which no run has kept images.
    """
    found: dict[str, str] = {}
    for job in plan.jobs:
        name = dict(job.settings)["scenario"]
        if name in found:
            continue
        frames = sorted((Path(job.out) / "frames").glob("*.jpg"))
        newest = {frame.stem.rpartition("_")[0]: frame for frame in frames}
        images = [cv2.imread(str(frame)) for frame in newest.values()]
        small = [
            cv2.resize(image, (round(image.shape[1] * HEIGHT / image.shape[0]), HEIGHT))
            for image in images
            if image is not None
        ]
        if small:
            found[name] = f"{name}.jpg"
            cv2.imwrite(str(folder / found[name]), np.hstack(small))
    return found
