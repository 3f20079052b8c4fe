"""``selftest`` and ``lint``: whether a rig is what it says, and whether it says what is meant."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from nodes.calibration.selftest import TITLES, Result
from nodes.judging.report import style
from nodes.judging.report.page import embedded, page_of
from runtime.paths import source_file
from runtime.tools.cli.commands import ConfigFile, Overrides


def selftest(
    config: ConfigFile,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the page; runs/<name>-selftest if not given.")
    ] = None,
    overrides: Overrides = None,
    standing: Annotated[
        str,
        typer.Option(help="How long the IMU may stand for its Allan deviation, simulated time."),
    ] = "600s",
) -> None:
    """Fly a file's vehicles in a room of known surfaces, and prove what they announce.

    Each vehicle flies alone, on a short path about all axes: the ideal IMU integrates to the
    truth; the Allan deviation of the noisy one is as announced; known points fall on their pixels,
    row time included; depth lies on true surfaces; exported calibrations project the same; and
    the stamps of image, depth, pose and IMU agree. Writes selftest.html, with all figures.
    Ends with 0 if all is proven, and 1 if something is not as announced.
    """
    from nodes.calibration.selftest import prove, subjects
    from runtime.config.reading import load_configuration
    from runtime.errors import ConfigError
    from runtime.run.results import claim
    from runtime.tools.cli.run import leave_behind
    from runtime.units import Duration

    settings = load_configuration(config, overrides or [])
    try:
        seconds = float(Duration.parse(standing))
    except ValueError as error:
        raise ConfigError(f"--standing: {error}") from None
    folder = out or Path("runs") / f"{settings.run.name}-selftest"
    claim(folder)
    results = []
    for spec in subjects(settings):
        result = prove(settings, spec, folder / spec.name, seconds)
        results.append(result)
        for proof, figures in result.figures.items():
            state = "passed" if all(figure.passed for figure in figures) else "FAILED"
            print(
                f"{spec.name}: {proof}. {TITLES[proof]}: {state if figures else 'not applicable'}"
            )
            for figure in figures:
                limit = "" if figure.limit is None else f" (at most {style.number(figure.limit)})"
                value = f"{style.number(figure.value)}{limit} {figure.unit}"
                print(f"    {figure.subject}: {figure.name}: {value}")
                if figure.remark:
                    print(f"        {figure.remark}")
    page = folder / "selftest.html"
    write_page(page, settings.run.name, results)
    print(page)
    leave_behind(0 if all(result.passed() for result in results) else 1)


def lint(
    config: ConfigFile,
    overrides: Overrides = None,
    ignore: Annotated[
        list[str] | None,
        typer.Option(metavar="RULE", help="Leave a rule out; may be repeated."),
    ] = None,
) -> None:
    """Say what a careful colleague would about a rig: a line for each finding.

    Nothing flies; the nodes are brought up as by check. A rule says what is odd and what to change:
    baselines, exposures, rates, lenses, latencies, missing noise and mountings, stamps that cannot
    match, estimators that lack a sensor. What is meant is accepted in the file, by
    [run] accept = ["rule"] or ["rule:drone/camera"]. Ends with 0, with 1 if there is a finding,
    with 2 if the file is wrong.
    """
    import sys

    from runtime.config.reading import load_configuration
    from runtime.tools import preflight
    from runtime.tools.cli.run import leave_behind

    settings = load_configuration(config, overrides or [])
    brought_up = preflight.of_nodes(settings)
    errors = brought_up.errors
    found = [] if errors else preflight.lint(settings, brought_up.announcements, ignore or [])
    for finding in found:
        print(finding)
    for error in errors:
        print(f"error: {config.name}: {error}", file=sys.stderr)
    if not found and not errors:
        print(f"{config}: nothing to say")
    leave_behind(2 if errors else 1 if found else 0)


def write_page(path: Path, name: str, results: Sequence[Result]) -> None:
    """Write the page, and its plots beside it.

    Raises:
        OSError: A file cannot be written.
    """
    with style.drawing():
        plots = {r.vehicle: [embedded(plot, path.parent) for plot in _plots(r)] for r in results}
    page = page_of(Path(__file__).with_name("selftest.html.jinja")).render(
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
