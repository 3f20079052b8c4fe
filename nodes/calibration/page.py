"""The self-test as a page: figures, curves and where each point fell, in one file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import jinja2
import numpy as np

from nodes.calibration.selftest import TITLES, Result
from nodes.judging.report import style
from nodes.judging.report.page import embedded
from runtime.paths import source_file


def write_page(path: Path, name: str, results: Sequence[Result]) -> None:
    """Write the page, and its plots beside it.

    Raises:
        OSError: A file cannot be written.
    """
    here = Path(__file__).parent
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader([here, here.parent / "report"]),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    with style.drawing():
        plots = {
            result.vehicle: [
                embedded(plot.write(path.parent, ()), plot.title, plot.caption, plot.photo)
                for plot in _plots(result)
            ]
            for result in results
        }
    page = environment.get_template("selftest.html.jinja").render(
        name=name, results=results, titles=TITLES, plots=plots, text=style.number
    )
    path.write_text(page, encoding="utf-8", newline="\n")


def _plots(result: Result) -> Iterator[style.Plot]:
    for source, points in result.points.items():
        figure = style.sheet(5.0, width=6.0)
        axes = figure.add_subplot()
        longest = float(np.nanmax(np.abs(points.off), initial=1e-3))
        axes.quiver(*points.pixels.T, *points.off.T, angles="xy", width=0.002, color=style.LINE)
        axes.invert_yaxis()
        axes.set(aspect="equal", xlabel="column", ylabel="row")
        yield style.Plot(
            f"points_{source_file(source)}",
            figure,
            f"{source}: points beside their pixels",
            f"Each arrow is one sphere in one image; the longest is {longest:.3f} px. Without "
            "errors they are short and point anywhere.",
        )
    if result.curves:
        figure = style.sheet(3.4)
        for place, curve in enumerate(result.curves, 1):
            axes = figure.add_subplot(1, 2, place)
            axes.loglog(curve.seconds, curve.measured, "o", ms=4, color=style.LINE)
            axes.loglog(curve.seconds, curve.announced, color="#3a3a3a")
            unit = "rad/s" if curve.name == "gyroscope" else "m/s²"
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_major_formatter(lambda value, _: f"{value:g}")
                axis.set_minor_formatter(lambda *_: "")
            axes.set(title=curve.name, xlabel="averaging time (s)", ylabel=f"deviation ({unit})")
        yield style.Plot(
            f"allan_{result.vehicle}",
            figure,
            "Allan deviation",
            "Points: measured, mean of three axes. Line: what the announced densities give.",
        )
