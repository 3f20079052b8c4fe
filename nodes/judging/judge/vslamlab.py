"""``vslamlab``: programs of VSLAM-LAB's contract, run on an exported sequence and judged.

A program gets the folder of a sequence, and leaves ``<exp_id>_KeyFrameTrajectory.csv`` in that of
the experiment (github.com/VSLAM-LAB/VSLAM-LAB, ``Baselines/BaselineVSLAMLab.py``).
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

    from nodes.judging.judge import judging, sources
    from runtime.config.reading import convert
    from runtime.errors import ConfigError
    from runtime.tools.cli.brief import print_verdict, verdict_table

    sequence, runs = sequence.absolute(), out.absolute().with_name(f"{out.name}_runs")
    found, failed = [], {}
    try:
        if shutil.which(command[0]) is None:
            raise ValueError(f"expected a program that can be executed, found none: {command[0]}")
        config = convert({"scale_free": mode == "mono", "gap": "2s"}, judging.JudgeConfig, "judge")
        truth = sources.read_truth(str(sequence / "groundtruth.csv"), "")
        images = sources.read_stamps(sequence / "rgb.csv")
        camera = sources.read_mounting(body_from_camera, "") if body_from_camera else None
        runs.mkdir(parents=True, exist_ok=True)
        for number in range(repeat):
            run = runs / f"{number:05d}"
            given = arguments(sequence, run, mode, settings, dashes=dashes)
            try:
                path = run_once([*command, *given], run, limit)
                source = sources.read(f"{run.name}={path}", None, "", camera)
                judging.judge_all(truth, [source], images, config)  # raises, of another flight
                found.append(source)
            except ValueError as error:
                failed[run.name] = {"passed": False, "failure": str(error)}
        judgements, verdict, notes = judging.judge_all(truth, found, images, config)
        errors = [each.figures.get("ate_rmse_m", np.nan) for each in judgements.values()]
        if np.isfinite(errors).any():  # of two key frames there is none
            least, middle, most = np.nanpercentile(errors, [0, 50, 100])
            spread = f"ate_rmse_m: median {middle:.4g}, {least:.4g} to {most:.4g}"
            notes.append(f"{len(errors)} of {repeat} runs left a trajectory; {spread}")
        notes += [f"run {name} failed: {each['failure']}" for name, each in failed.items()]
        rows = dict(sorted({**verdict.estimators, **failed}.items()))
        passed = False if failed else verdict.passed
        verdict = msgspec.structs.replace(verdict, passed=passed, estimators=rows)
        page = judging.write(out, truth, judgements, verdict, notes)
    except (ValueError, OSError) as error:
        raise ConfigError(str(error)) from None
    console = Console()
    console.print(verdict_table(verdict))
    console.print("\n".join(notes), highlight=False)
    print_verdict(verdict)
    console.print(f"results in [bold]{page.parent}[/bold]: open {page.name}", highlight=False)
    raise typer.Exit(1 if verdict.passed is False else 0)
