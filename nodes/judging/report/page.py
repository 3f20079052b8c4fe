"""The report page (a single file without network or scripts), its node and its command."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import jinja2
import numpy as np
import typer

from nodes.judging.report import tables
from nodes.judging.report.clouds import draw_clouds
from nodes.judging.report.curves import (
    draw_axes,
    draw_distributions,
    draw_errors,
    draw_latency,
    draw_relative,
)
from nodes.judging.report.folder import read_run
from nodes.judging.report.tables import Plot, Run, drawing
from nodes.judging.report.trajectories import draw_frames, draw_trajectories
from runtime import Node, NodeConfig
from runtime.run.results import run_folder
from runtime.summary import OUTSIDE_COLUMNS, WORKER_COLUMNS

PAGE = "report.html"
PLOTS = "plots"
_OURS = (
    "trajectories", "errors", "axes", "distributions", "latency", "relative", "frames_*",
    "clouds_*",
)  # fmt: skip  # names of the figures; those of an earlier report are removed

_QUALITY = [cv2.IMWRITE_JPEG_QUALITY, 88]

_ALIGNED = {
    "none": "in the truth's frame as it is",
    "origin": "laid on the truth at its first pose",
    "posyaw": "laid on the truth by position and heading",
    "se3": "laid on the truth as a whole (SE3)",
    "sim3": "laid on the truth as a whole, with scale (Sim3)",
}  # how estimates and the truth were brought together, in words


def write_report(out: Path, formats: Sequence[str] = ("png", "svg")) -> Path:
    """Write ``report.html`` and its figures, ``plots/*``, anew; return the page's path.

    Args:
        out: A run's folder, whatever is in it.
        formats: Of the figures: png (always, if there is any), svg, pdf; none for tables only.

    Raises:
        ResultsError: The folder is missing or no run's.
        OSError: Something cannot be written.
    """
    run = read_run(out)
    plots = out / PLOTS
    plots.mkdir(exist_ok=True)
    for pattern in _OURS:
        for old in plots.glob(f"{pattern}.*"):
            old.unlink()
    shown: list[list[dict[str, str]]] = [[], [], []]
    if formats:
        curves = (
            draw_trajectories,
            draw_errors,
            draw_axes,
            draw_distributions,
            draw_latency,
            draw_relative,
        )
        with drawing():
            for place, figures in zip(
                shown,
                ((draw(run) for draw in curves), draw_clouds(run), draw_frames(run)),
                strict=True,
            ):
                place += [embedded(f, plots, formats) for f in figures if f is not None]
    page = out / PAGE
    page.write_text(render(run, *shown), encoding="utf-8", newline="\n")
    return page


def render(
    run: Run,
    curves: list[dict[str, str]],
    clouds: list[dict[str, str]],
    frames: list[dict[str, str]],
) -> str:
    """Return the page."""
    return page_of(Path(__file__).parent / "page.html.jinja").render(
        run=run,
        main=tables.figures(run, main=True),
        others=tables.figures(run, main=False),
        facts=tables.facts(run),
        sensors=tables.sensors(run),
        ticks=tables.ticks(run),
        workers=tables.workers(run),
        outside=tables.outside(run),
        outside_columns=("system", *OUTSIDE_COLUMNS),
        worker_columns=("worker", *WORKER_COLUMNS),
        outputs=tables.outputs(run),
        curves=curves,
        frames=frames,
        clouds=clouds,
        verdicts=[_verdict(*row) for row in _judged(run)],
    )


def page_of(template: Path) -> jinja2.Template:
    """Return a page's template; the report's ``style.css.jinja`` can be included."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader([template.parent, Path(__file__).parent]),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    return environment.get_template(template.name)


def embedded(plot: Plot, folder: Path, formats: Sequence[str] = ()) -> dict[str, str]:
    """Write a figure; return its title, caption and data URI for a self-contained page."""
    data, kind = plot.write(folder, formats).read_bytes(), "png"
    if plot.photo:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        if image is not None:
            data, kind = cv2.imencode(".jpg", image, _QUALITY)[1].tobytes(), "jpeg"
    return {
        "title": plot.title,
        "caption": plot.caption,
        "source": f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}",
    }


def _judged(run: Run) -> list[tuple[str, dict[str, Any], str]]:
    rows = [(estimator.name, estimator.figures, estimator.color) for estimator in run.estimators]
    verdict = run.facts.verdict
    summary = {} if verdict is None else dict(verdict.estimators)
    for vehicle, flight in (verdict.flights if verdict else {}).items():
        if flight["passed"] is not None:
            summary[f"flight of {vehicle}"] = flight
    known = {name for name, _, _ in rows}
    return rows + [(name, f, "inherit") for name, f in summary.items() if name not in known]


def _verdict(name: str, figures: dict[str, Any], color: str) -> dict[str, Any]:
    passed = figures.get("passed")
    failed = figures.get("failed")
    if passed is None and "why" in figures:
        failed = [figures["why"]]
    alignment = _ALIGNED.get(str(figures.get("alignment")), "")
    if "compared_at" in figures:
        alignment = f"{alignment}, compared at {figures['compared_at']}"
    vehicle = f"of {figures['vehicle']}" if "vehicle" in figures else ""
    return {
        "name": name,
        "color": color,
        "method": str(figures.get("method") or ""),
        "alignment": "; ".join(filter(None, (vehicle, alignment))),
        "state": "not judged" if passed is None else "passed" if passed else "failed",
        "failed": [str(sentence) for sentence in failed] if isinstance(failed, list) else [],
    }


class ReportConfig(NodeConfig):
    """Settings of the report.

    Attributes:
        figures: Formats of the figures in ``plots``: png (as on the page), svg, pdf; none for
            tables only.
    """

    figures: tuple[Literal["png", "svg", "pdf"], ...] = ("png", "svg")


class Report(Node[ReportConfig]):
    """Writer of ``report.html`` and its figures, from all other nodes' files, at the very end."""

    files = ("plots", "report.html")

    async def on_shutdown(self) -> None:
        """Schedule the report for after the run's summary is written."""
        if self.out is not None:
            self.after_run(self._write)

    def _write(self, out: Path) -> None:
        write_report(out, self.config.figures)


def report(
    run: Annotated[Path, typer.Argument(help="The folder of a run: runs/<name> for the latest.")],
    format_: Annotated[
        list[str] | None,
        typer.Option(
            "--format",
            help="Of the figures, beside png: svg or pdf. May be repeated; svg if not given.",
        ),
    ] = None,
) -> None:
    """Write a run's report.html and its figures (plots/*) anew.

    The page names what a killed or unjudged run lacks. It is HTML whatever the format of the
    figures; a browser prints it as PDF.
    """
    from runtime.errors import CommandError, ConfigError, expect_known

    for name in format_ or ():
        message = f"--format: expected png, svg or pdf, found {name}"
        expect_known(name, ("png", "svg", "pdf"), message, CommandError)
    try:
        print(write_report(run_folder(run), ("png", *(format_ or ("svg",)))))
    except (ValueError, OSError) as error:
        raise ConfigError(str(error)) from None
