"""``judge``: trajectories that somebody else computed, with a run's figures and report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


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
) -> None:
    """Judge trajectories that somebody else computed, as a run judges its estimators.

    Reads TUM, EuRoC, KITTI (with --times: seconds, a line each) and VSLAM-LAB files, and Path,
    Odometry, PoseStamped and PoseWithCovarianceStamped of bags. Figures, report and thresholds are
    those of a run; what poses alone do not tell, such as latencies, is absent. --frames is a
    times.txt, rgb.txt, rgb.csv or cam0/data.csv; without it the flight is that of the truth.

    --final NAME=FILE is the trajectory after loop closures of the estimate NAME: its figures stand
    beside those of the poses that were said at the time.

    An estimate is laid on the truth by sim3 if it is --scale-free; if it names its frame, not at
    all in map and else at its origin; otherwise by se3. World and body are NED and FRD in TUM's
    files; z up, and the body as it is, in EuRoC's and VSLAM-LAB's (nwu); those of a camera that
    looks ahead in KITTI's (optical); enu is ENU and FLU. --axes says so of other estimates. If
    estimates are of a camera, --body-from-camera is where its optical frame sits in the truth's
    body: "tx ty tz qx qy qz qw", a file of TUM's with one pose, or a camera of the truth's run.

    Ends with 0; with 1 if a threshold was missed (also by default: poses for 90 % of the flight);
    with 2 if something cannot be read.
    """
    from rich.console import Console

    from nodes.judging.judge import judging, sources
    from runtime.config.messages import given
    from runtime.config.reading import convert
    from runtime.errors import ConfigError
    from runtime.tools.cli.commands import warn
    from runtime.tools.cli.run import print_verdict
    from runtime.tools.cli.tables import verdict_table

    try:
        said = {
            "alignment": alignment,
            "scale_free": scale_free,
            "axes": axes or None,
            "max_difference": max_difference,
            "gap": gap,
            "thresholds": {k: given(v) for k, _, v in (t.partition("=") for t in threshold or ())},
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
    except ValueError as error:
        raise ConfigError(str(error)) from None
    for note in notes:
        warn(note)
    console = Console()
    console.print(verdict_table(verdict))
    print_verdict(console, verdict)
    console.print(f"results in [bold]{page.parent}[/bold]: open {page.name}", highlight=False)
    raise typer.Exit(1 if verdict.passed is False else 0)
