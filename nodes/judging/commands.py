"""Commands ``judge`` and ``vslamlab``: a run's figures and report for other programs' results.

A program of VSLAM-LAB's contract gets the folder of an exported sequence, and leaves
``<exp_id>_KeyFrameTrajectory.csv`` in that of the experiment (github.com/VSLAM-LAB/VSLAM-LAB,
``Baselines/BaselineVSLAMLab.py``).
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import typer

from runtime.tools.cli.commands import (
    Columns,
    Csv,
    Json,
    JUnit,
    Latex,
    Markdown,
    chosen_format,
    of_verdict,
    writing,
)


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
    alignment: Annotated[
        str, typer.Option(help="auto, none, origin, posyaw, se3 or sim3.")
    ] = "auto",
    align_first: Annotated[
        str, typer.Option(metavar="N", help="Poses, or a time as 5s, that it fits; else all.")
    ] = "",
    scale_free: Annotated[
        bool, typer.Option("--scale-free", help="The estimates' unit of length is their own.")
    ] = False,
    axes: Annotated[str, typer.Option(help="Of the estimates: ned, nwu, enu or optical.")] = "",
    truth_axes: Annotated[str, typer.Option(help="Of the truth, likewise.")] = "",
    columns: Annotated[
        str, typer.Option(metavar="NAMES", help='Of estimates: "sec x y z qw qx qy qz", _ skips.')
    ] = "",
    truth_columns: Annotated[
        str, typer.Option(metavar="NAMES", help="Of the truth, likewise.")
    ] = "",
    times: Annotated[str, typer.Option(help="File of stamps of KITTI's poses.")] = "",
    time_offset: Annotated[
        str, typer.Option(metavar="TIME", help="Added to the estimates' stamps: seconds, or -30ms.")
    ] = "0",
    frames: Annotated[str, typer.Option(help="File of stamps of the images, for coverage.")] = "",
    max_difference: Annotated[str, typer.Option(help="Half of a hole of the truth.")] = "100ms",
    gap: Annotated[str, typer.Option(help="Silence that counts as lost.")] = "500ms",
    body_from_camera: Annotated[
        str, typer.Option(metavar="POSE", help="Where the camera is whose poses these are.")
    ] = "",
    threshold: Annotated[
        list[str] | None,
        typer.Option(metavar="FIGURE=VALUE", help="As ate_percent=1. May be repeated."),
    ] = None,
    out: Annotated[str, typer.Option(help="Folder for results; judged/NAME if not given.")] = "",
    name: Annotated[str, typer.Option(help="Of the folder, and of the page.")] = "trajectories",
    junit: JUnit = None,
    json: Json = None,
    latex: Latex = False,
    markdown: Markdown = False,
    csv: Csv = False,
    figure: Columns = None,
) -> None:
    """Judge trajectories computed elsewhere, as a run judges its estimators.

    Reads TUM, EuRoC, KITTI (with --times), VINS, OpenVINS, OKVIS2, VSLAM-LAB, AirSim and other
    tables whose header names the columns (or --columns), topics of bags (BAG:/odom,
    BAG:/tf:map.base_link), and folders of runs. Figures, report and thresholds are those of a run,
    but for figures that need more than poses, such as latencies. --frames is a times.txt, rgb.txt,
    rgb.csv or cam0/data.csv; without it the flight is that of the truth. --final NAME=FILE is the
    trajectory of the estimate NAME after loop closures, judged beside it.
    Poses are taken as they stand, and the body is the same in truth and estimate, unless a source
    declares its axes: by --axes or --truth-axes, as a run's own files (ned), as a topic (REP 103).
    A source that declares nothing takes the declaration of the other one. ned is NED and FRD; nwu
    is z up, with the body as it is; enu is ENU and FLU; optical are those of a camera that looks
    ahead. If estimates are of a camera, --body-from-camera is its optical frame in the truth's
    body: "tx ty tz qx qy qz qw", a TUM file with one pose, or a camera of the truth's run.
    Alignment is sim3 with --scale-free; none if truth and estimate are both in the frame map;
    origin for an estimate in another named frame and a truth in map; and se3 for all others. Exit
    codes: 0; 1 if a threshold is missed (by default also: poses for 90 % of the flight,
    orientations within 15°, motions over a metre within 75 %; NAME=inf is none); 2 if an input
    cannot be read.
    """
    from rich.console import Console

    from nodes.judging import judged, judgement, mounting, readers
    from nodes.judging.readers.stamps import read_stamps
    from runtime.config.overrides import parse_value
    from runtime.config.reading import convert
    from runtime.errors import ConfigError
    from runtime.tools.cli.brief import print_typeset, print_verdict, verdict_table
    from runtime.tools.cli.commands import warn

    form = chosen_format(latex=latex, markdown=markdown, csv=csv, figures=figure)
    with writing(name, junit, json) as outcomes:
        try:
            settings = {
                "alignment": alignment,
                "align_first": int(align_first) if align_first.isdecimal() else align_first or None,
                "scale_free": scale_free,
                "axes": axes or None,
                "truth_axes": truth_axes or None,
                "columns": columns,
                "truth_columns": truth_columns,
                "time_offset": time_offset,
                "max_difference": max_difference,
                "gap": gap,
                "thresholds": {
                    k: parse_value(v) for k, _, v in (t.partition("=") for t in threshold or ())
                },
            }
            config = convert(settings, judgement.JudgeConfig, "judge")
            true = readers.read_truth(truth, times, config.truth_axes, columns=config.truth_columns)
            camera = mounting.read_mounting(body_from_camera, truth) if body_from_camera else None
            estimates, finals = (
                [
                    readers.read(text, config.axes, times, camera, columns=config.columns)
                    for text in texts
                ]
                for texts in (estimate, final or ())
            )
            stamps = read_stamps(Path(frames)) if frames else None
            true, judgements, verdict, notes = judgement.judge_all(
                true, estimates, stamps, config, {source.name: source for source in finals}
            )
            page = judged.write(Path(out or f"judged/{name}"), true, judgements, verdict, notes)
            outcomes += of_verdict(name, verdict)
        except ValueError as error:
            raise ConfigError(str(error)) from None
    for note in notes:
        warn(note)
    if form is not None:
        print_typeset(verdict, form, figure or [])
        raise typer.Exit(1 if verdict.passed is False else 0)
    console = Console()
    console.print(verdict_table(verdict))
    print_verdict(verdict)
    console.print(f"results in [bold]{page.parent}[/bold]: open {page.name}", highlight=False)
    raise typer.Exit(1 if verdict.passed is False else 0)


def arguments(
    sequence: Path,
    run: Path,  # folder of the experiment, with the name of the run
    mode: str,  # ``mono``, ``rgbd``, ``stereo``, ``mono-vi`` or ``stereo-vi``
    settings: str = "",  # its settings_yaml, if it has one
    *,
    dashes: bool = False,  # for programs in Python; those in C++ lack it
) -> list[str]:
    """Return a program's arguments: ``key:value``, or ``--key value`` with `dashes`."""
    values = {
        "sequence_path": sequence,
        "calibration_yaml": sequence / "calibration.yaml",
        "rgb_csv": sequence / "rgb.csv",
        "exp_folder": run.parent,
        "exp_it" if dashes else "exp_id": run.name,
        **({"settings_yaml": settings} if settings else {}),
        "verbose": 0,
        "mode": mode,
    }
    if dashes:
        return [word for key, value in values.items() for word in (f"--{key}", str(value))]
    return [f"{key}:{value}" for key, value in values.items()]


def run_once(command: Sequence[str], run: Path, limit: float) -> Path:
    """Run a program for at most `limit` real seconds; return its trajectory file.

    Args:
        command: Program and arguments. Its output goes to ``system_output_<exp_id>.txt``.
        run: As of `arguments`.

    Raises:
        ValueError: The program left no trajectory, failed (with its last output), or took too long.
    """
    from nodes.outside.process.program import Program

    trajectory = run.with_name(f"{run.name}_KeyFrameTrajectory.csv")
    trajectory.unlink(missing_ok=True)  # of an earlier experiment
    with run.with_name(f"system_output_{run.name}.txt").open("w", encoding="utf-8") as log:
        program = Program(
            command, Path.cwd(), os.environ, grace=5.0, printed=lambda line: print(line, file=log)
        )
        ended = program.wait(limit)
        program.close()
    if not ended:
        raise ValueError(f"it took more than {limit:g} s, and was ended")
    if program.code or not trajectory.is_file():
        raise ValueError(f"expected {trajectory.name}, found none; it {program.story()}")
    return trajectory


def vslamlab(
    sequence: Annotated[Path, typer.Argument(help="Folder that export --format vslamlab made.")],
    command: Annotated[list[str], typer.Argument(help="The program, and its own arguments.")],
    mode: Annotated[str, typer.Option(help="mono, rgbd, stereo, mono-vi or stereo-vi.")] = "mono",
    dashes: Annotated[bool, typer.Option(help="Arguments as --key value, for Python.")] = False,
    settings: Annotated[str, typer.Option(help="The program's settings_yaml.")] = "",
    repeat: Annotated[int, typer.Option(min=1, help="Runs.")] = 1,
    limit: Annotated[float, typer.Option(min=0, help="Real seconds of a run.")] = 600.0,
    body_from_camera: Annotated[
        str, typer.Option(metavar="POSE", help="As of judge, if its poses are a camera's.")
    ] = "",
    out: Annotated[Path, typer.Option(help="Folder for results.")] = Path("judged/vslamlab"),
) -> None:
    """Run a program of VSLAM-LAB's contract on an exported sequence, and judge its trajectories.

    Started REPEAT times in a row, with key:value for sequence_path, calibration_yaml, rgb_csv,
    exp_folder, exp_id, settings_yaml, verbose and mode. A run that leaves no
    <exp_id>_KeyFrameTrajectory.csv, ends with an error or takes too long has failed. Scale is
    aligned in the mode mono only. Ends with 0; with 1 if a run failed or a threshold was missed;
    with 2 if something is missing.
    """
    from rich.console import Console

    from nodes.judging import judged, judgement, mounting, readers
    from nodes.judging.readers.stamps import read_stamps
    from runtime.config.reading import convert
    from runtime.errors import ConfigError
    from runtime.tools.cli.brief import print_verdict, verdict_table

    sequence, runs = sequence.absolute(), out.absolute().with_name(f"{out.name}_runs")
    estimates, failed = [], {}
    try:
        if shutil.which(command[0]) is None:
            raise ValueError(f"expected a program that can be executed, found none: {command[0]}")
        config = convert(
            {"scale_free": mode == "mono", "gap": "2s"}, judgement.JudgeConfig, "judge"
        )
        truth = readers.read_truth(str(sequence / "groundtruth.csv"))
        images = read_stamps(sequence / "rgb.csv")
        camera = mounting.read_mounting(body_from_camera, "") if body_from_camera else None
        runs.mkdir(parents=True, exist_ok=True)
        for number in range(repeat):
            run = runs / f"{number:05d}"
            run_arguments = arguments(sequence, run, mode, settings, dashes=dashes)
            try:
                path = run_once([*command, *run_arguments], run, limit)
                source = readers.read(f"{run.name}={path}", camera=camera)
                judgement.judge_all(truth, [source], images, config)  # raises, of another flight
                estimates.append(source)
            except ValueError as error:
                failed[run.name] = {"passed": False, "failure": str(error)}
        truth, judgements, verdict, notes = judgement.judge_all(truth, estimates, images, config)
        errors = [result.figures.get("ate_rmse_m", np.nan) for result in judgements.values()]
        if np.isfinite(errors).any():  # of two key frames there is none
            least, middle, most = np.nanpercentile(errors, [0, 50, 100])
            spread = f"ate_rmse_m: median {middle:.4g}, {least:.4g} to {most:.4g}"
            notes.append(f"{len(errors)} of {repeat} runs left a trajectory; {spread}")
        notes += [f"run {name} failed: {row['failure']}" for name, row in failed.items()]
        rows = dict(sorted({**verdict.estimators, **failed}.items()))
        passed = False if failed else verdict.passed
        verdict = msgspec.structs.replace(verdict, passed=passed, estimators=rows)
        page = judged.write(out, truth, judgements, verdict, notes)
    except (ValueError, OSError) as error:
        raise ConfigError(str(error)) from None
    console = Console()
    console.print(verdict_table(verdict))
    console.print("\n".join(notes), highlight=False)
    print_verdict(verdict)
    console.print(f"results in [bold]{page.parent}[/bold]: open {page.name}", highlight=False)
    raise typer.Exit(1 if verdict.passed is False else 0)
