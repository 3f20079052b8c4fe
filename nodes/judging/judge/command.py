"""``judge`` command: a run's figures and report for trajectories from files and bags."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from runtime.tools.cli.outcomes import Json, JUnit, of_verdict, writing


def judge(
    truth: Annotated[str, typer.Option(help="True poses: FILE, BAG:/TOPIC, or a run's folder.")],
    estimate: Annotated[
        list[str],
        typer.Option(metavar="[NAME=]FILE", help="Poses, or BAG:/TOPIC. May be repeated."),
    ],
    final: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=FILE", help="The same after loop closures. May be repeated."),
    ] = None,
    alignment: Annotated[str, typer.Option(help="auto, none, origin, se3 or sim3.")] = "auto",
    scale_free: Annotated[
        bool, typer.Option("--scale-free", help="The estimates' unit of length is their own.")
    ] = False,
    times: Annotated[str, typer.Option(help="File of stamps of KITTI's poses.")] = "",
    frames: Annotated[str, typer.Option(help="File of stamps of the images, for coverage.")] = "",
    max_difference: Annotated[str, typer.Option(help="To the nearest true pose.")] = "100ms",
    gap: Annotated[str, typer.Option(help="Silence that counts as lost.")] = "500ms",
    body_from_camera: Annotated[
        str, typer.Option(metavar="POSE", help="Where the camera is whose poses these are.")
    ] = "",
    axes: Annotated[str, typer.Option(help="Of the files: ned, nwu, enu or optical.")] = "",
    threshold: Annotated[
        list[str] | None,
        typer.Option(metavar="FIGURE=VALUE", help="As ate_percent=1. May be repeated."),
    ] = None,
    out: Annotated[str, typer.Option(help="Folder for results; judged/NAME if not given.")] = "",
    name: Annotated[str, typer.Option(help="Of the folder, and of the page.")] = "trajectories",
    junit: JUnit = None,
    json: Json = None,
) -> None:
    """Judge trajectories computed elsewhere, as a run judges its estimators.

    Reads TUM, EuRoC, KITTI (with --times: seconds, one a line) and VSLAM-LAB files, and Path,
    Odometry, PoseStamped and PoseWithCovarianceStamped topics of bags. Figures, report and
    thresholds are those of a run, but for figures that need more than poses, such as latencies.
    --frames is a times.txt, rgb.txt, rgb.csv or cam0/data.csv; without it the flight is that of the
    truth. --final NAME=FILE is the trajectory of the estimate NAME after loop closures, judged
    beside it.
    Alignment is sim3 with --scale-free; otherwise none for an estimate in the frame map, origin for
    one in another named frame, and se3 for all others. World and body are NED and FRD in TUM files;
    z up, with the body as it is, in EuRoC and VSLAM-LAB files (nwu); those of a camera that looks
    ahead in KITTI files (optical); enu is ENU and FLU. --axes sets the axes of other files. If
    estimates are of a camera, --body-from-camera is its optical frame in the truth's body: "tx ty
    tz qx qy qz qw", a TUM file with one pose, or a camera of the truth's run. Exit codes: 0; 1 if a
    threshold is missed (by default also: poses for 90 % of the flight); 2 if an input cannot be
    read.
    """
    from rich.console import Console

    from nodes.judging.judge import judging, sources
    from runtime.config.messages import given
    from runtime.config.reading import convert
    from runtime.errors import ConfigError
    from runtime.tools.cli.brief import print_verdict, verdict_table
    from runtime.tools.cli.commands import warn

    with writing(name, junit, json) as outcomes:
        try:
            said = {
                "alignment": alignment,
                "scale_free": scale_free,
                "axes": axes or None,
                "max_difference": max_difference,
                "gap": gap,
                "thresholds": {
                    k: given(v) for k, _, v in (t.partition("=") for t in threshold or ())
                },
            }
            config = convert(said, judging.JudgeConfig, "judge")
            true = sources.read_truth(truth, times)
            camera = sources.read_mounting(body_from_camera, truth) if body_from_camera else None
            found = [sources.read(each, config.axes, times, camera) for each in estimate]
            stamps = sources.read_stamps(Path(frames)) if frames else None
            corrected = [sources.read(each, config.axes, times, camera) for each in final or ()]
            finals = {each.name: each.poses for each in corrected}
            judgements, verdict, notes = judging.judge_all(true, found, stamps, config, finals)
            page = judging.write(Path(out or f"judged/{name}"), true, judgements, verdict, notes)
            outcomes += of_verdict(name, verdict)
        except ValueError as error:
            raise ConfigError(str(error)) from None
    for note in notes:
        warn(note)
    console = Console()
    console.print(verdict_table(verdict))
    print_verdict(verdict)
    console.print(f"results in [bold]{page.parent}[/bold]: open {page.name}", highlight=False)
    raise typer.Exit(1 if verdict.passed is False else 0)
