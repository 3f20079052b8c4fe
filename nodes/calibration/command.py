"""``selftest`` and ``lint``: whether a rig is what it says, and whether it says what is meant."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from runtime.tools.cli.common import ConfigFile, Overrides


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
    from nodes.calibration.page import write_page
    from nodes.calibration.selftest import TITLES, prove, subjects
    from nodes.judging.report.style import number
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
                limit = "" if figure.limit is None else f" (at most {number(figure.limit)})"
                value = f"{number(figure.value)}{limit} {figure.unit}"
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
    from runtime.tools import lint as rules
    from runtime.tools import preflight
    from runtime.tools.cli.run import leave_behind

    settings = load_configuration(config, overrides or [])
    brought_up = preflight.of_nodes(settings)
    errors = brought_up.errors
    found = [] if errors else rules.lint(settings, brought_up.announcements, ignore or [])
    for finding in found:
        print(finding)
    for error in errors:
        print(f"error: {config.name}: {error}", file=sys.stderr)
    if not found and not errors:
        print(f"{config}: nothing to say")
    leave_behind(2 if errors else 1 if found else 0)
