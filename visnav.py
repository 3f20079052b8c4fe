"""Runs, sweeps, comparisons and judgements from Python; and the console command ``visnav``.

    import visnav

    run = visnav.run("config.toml", set={"pilot.speed": 1.5}, seed=7)
    run.passed, run.figures["odometry"]["ate_percent"]
    run.truth.positions, run.estimates["odometry"].positions
    run.show()

    old = visnav.load("runs/tour")
    table = visnav.sweep("config.toml", {"camera.rate": [10, 30]}, seeds=3)
    compared = visnav.compare("config.toml", b={"odometry.corners": 500}, margin=5)
    judged = visnav.judge("groundtruth.txt", {"mine": "estimate.txt"}, alignment="se3")

A run has a thread and an event loop of its own, so it may be started from a notebook, whose own
loop goes on, and from any thread. The first Ctrl-C ends it in order, with complete results, before
it is raised here as `KeyboardInterrupt`.

This module stands outside the packages, so that it can tell when `runtime` is another project's.
"""

from __future__ import annotations

import contextlib
import copy
import importlib.util
import sys
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt
    from matplotlib.figure import Figure

    from nodes.judging.report.tables import Run as _Results
    from nodes.judging.report.tables import Verdict
    from nodes.trajectory import Trajectory
    from runtime.config.model import Config
    from runtime.tools.comparison import Compared

__all__ = ["Run", "compare", "judge", "load", "run", "sweep"]


class Run:
    """Results of one run, or of trajectories that were judged without one.

    Attributes:
        folder: With all files; `None` if nothing was written.
        summary: Contents of ``summary.json``, as `json` reads it; empty if nothing was flown.
    """

    def __init__(
        self, results: _Results, folder: Path | None, summary: Mapping[str, Any] | None = None
    ) -> None:
        self.folder = folder
        self.summary = dict(summary or {})
        self._results = results

    @property
    def name(self) -> str:
        """Name of the run."""
        return self._results.name

    @property
    def verdict(self) -> Verdict | None:
        """Contents of ``evaluation/verdict.json``; `None` if nothing was evaluated."""
        return self._results.verdict

    @property
    def passed(self) -> bool | None:
        """Whether all estimators met their thresholds; `None` if one was not judged."""
        return self.verdict.passed if self.verdict else None

    @property
    def figures(self) -> dict[str, dict[str, Any]]:
        """Figures by estimator, by the names that thresholds have: ``ate_percent``."""
        return self.verdict.estimators if self.verdict else {}

    @property
    def truth(self) -> Trajectory | None:
        """True poses of the (first) vehicle: base_link (FRD) in map (NED)."""
        return self._results.truth

    @property
    def estimates(self) -> dict[str, Trajectory]:
        """Poses by estimator, aligned with the truth as the figure ``alignment`` says."""
        return {e.name: e.aligned for e in self._results.estimators if e.aligned is not None}

    @property
    def report(self) -> Path | None:
        """The page ``report.html``, if there is one."""
        page = None if self.folder is None else self.folder / "report.html"
        return page if page is not None and page.is_file() else None

    def show(self) -> list[Figure]:
        """Draw trajectories and errors; in a notebook, display them as images and return none."""
        from nodes.judging.report.curves import draw_errors
        from nodes.judging.report.tables import drawing
        from nodes.judging.report.trajectories import draw_trajectories

        with drawing():
            plots = [draw(self._results) for draw in (draw_trajectories, draw_errors)]
        figures = [plot.figure for plot in plots if plot is not None]
        with contextlib.suppress(ImportError):
            from IPython import get_ipython
            from IPython.display import Image, display

            if get_ipython() is not None:  # which draws no figures itself until asked to
                with drawing():
                    display(*(Image(data=_png(figure), format="png") for figure in figures))
                return []
        return figures

    def __repr__(self) -> str:
        from runtime.units import significant

        states = {True: "passed", False: "failed", None: "not judged"}
        words = []
        for name, figures in self.figures.items():
            ate = figures.get("ate_percent")
            error = ""
            if ate is not None:
                error = f", ATE {significant(ate, 3)} % of the path ({figures['alignment']})"
            missed = "".join(f", {reason}" for reason in figures.get("failed", ()))
            words.append(f"{name} {states[figures['passed']]}{error}{missed}")
        where = "" if self.folder is None else f" in {self.folder}"
        return f"<{self.name}{where}: {'; '.join(words) or 'no estimator'}>"

    def _repr_html_(self) -> str:
        from html import escape

        from nodes.judging.report.tables import figures

        rows = [
            ["", "unit", *(estimator.name for estimator in self._results.estimators)],
            *(
                [row.meaning, row.unit, *(text for text, _ in row.cells)]
                for row in figures(self._results, main=True)
            ),
        ]
        cells = "".join(
            f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows
        )
        return f"<p>{escape(repr(self))}</p><table>{cells}</table>"


def run(
    config: str | Path | Mapping[str, Any],
    *,
    set: Mapping[str, Any] | None = None,  # noqa: A002  # as the command's --set
    seed: int | None = None,
    out: str | Path | None = None,
    quiet: bool = False,
) -> Run:
    """Run the nodes of a configuration to their end.

    Args:
        config: A file, or the same as a table: ``{"run": {...}, "nodes": [{"name": ...}, ...]}``,
            where ``type`` may be a class; one of a notebook, too.
        set: Settings to change, as ``{"pilot.speed": 1.5, "run.duration": "5s"}``.
        seed: Of the run's random numbers; short for ``run.seed``.
        out: Folder for results; ``runs/<name>/<time>`` if not given. An earlier run there is
            renamed to ``<out>.<its time>``.
        quiet: Whether to show no progress.

    Raises:
        VisnavError: The configuration is wrong, or the run failed; what was recorded until then is
            in its folder. A missed threshold is no error: see `Run.passed`.
        KeyboardInterrupt: After Ctrl-C, once the run has ended; `load` has its results.
    """
    _check_runtime()
    from runtime.errors import ConfigError
    from runtime.run.results import Folder
    from runtime.run.threaded_run import ThreadedRun
    from runtime.tools.cli.run import observed
    from runtime.tools.preflight import of_file

    changes = dict(set or {})
    if seed is not None:
        changes["run.seed"] = seed
    settings = _settings(config, changes)
    findings = of_file(settings)
    if findings.errors:
        raise ConfigError("; ".join(findings.errors))
    for warning in findings.warnings:
        warnings.warn(warning, stacklevel=2)
    folder = Folder(Path(out or Path("runs") / settings.run.name), by_time=out is None)
    handlers, watch = observed(
        settings, settings.run.name, quiet=quiet, trace=None, top=False, web=None
    )
    thread = ThreadedRun(settings, folder, handlers, watch)
    thread.start()
    thread.wait()
    return load(folder.path)


def load(folder: str | Path) -> Run:
    """Load the results of a run or of `judge`, also of a run that failed.

    Args:
        folder: Of the run; of ``runs/<name>``, the latest.

    Raises:
        ResultsError: The folder is not there, or is no run's.
    """
    import msgspec

    from nodes.judging.report.folder import read_run
    from runtime.run.results import run_folder

    folder = run_folder(Path(folder))
    results = read_run(folder)
    summary = folder / "summary.json"
    return Run(
        results, folder, msgspec.json.decode(summary.read_bytes()) if summary.is_file() else {}
    )


def sweep(
    config: str | Path,
    vary: Mapping[str, Sequence[Any]],
    *,
    seeds: int = 1,
    repeat: int = 1,
    set: Mapping[str, Any] | None = None,  # noqa: A002  # as the command's --set
    out: str | Path | None = None,
    jobs: int | None = None,
    fresh: bool = False,
) -> Any:
    """Run a file with every combination of some settings, each run in a process of its own.

    What is finished already is not run again, unless code, programs or files that it was made from
    have changed, which is logged; see the command ``sweep``.

    Args:
        vary: Values by setting: ``{"camera.rate": [10, 30]}``.
        seeds: How many seeds each combination is run with, from the file's on.
        repeat: How often it is run with each seed.
        set: Settings to change in all runs.
        out: Folder for results; ``sweeps/<name>`` if not given.
        jobs: Runs at the same time; by default, as many as fit on the cores.
        fresh: Whether to run everything, also what is finished.

    Returns:
        A row for each run and estimator, with what was varied, seed, repeat, estimator, passed,
        error and all figures: a `pandas.DataFrame` if pandas is installed, else a list of dicts.

    Raises:
        ConfigError: Something is wrong with the file, a path or a value.
        KeyboardInterrupt: After Ctrl-C, once all runs have ended; those that came to their end
            are kept.
    """
    _check_runtime()
    from runtime.tools import sweep as sweeping

    plan = sweeping.make_plan(
        Path(config),
        [f"{path}={','.join(map(_toml, values))}" for path, values in vary.items()],
        overrides=_changes(set or {}),
        seeds=seeds,
        repeats=repeat,
        out=None if out is None else Path(out),
    )
    rows = sweeping.run_here(plan, jobs=jobs, fresh=fresh)
    sweeping.write_tables(plan, rows)
    sweeping.draw_plots(plan, rows)
    sweeping.write_page(plan, rows)
    table = sweeping.records(rows)
    try:
        import pandas as pd
    except ImportError:
        return table
    return pd.DataFrame(table)


def compare(
    *what: str | Path,
    a: Mapping[str, Any] | None = None,
    b: Mapping[str, Any] | None = None,
    seeds: int = 12,
    repeat: int = 1,
    figures: Sequence[str] = (),
    margin: float = 0.0,
    set: Mapping[str, Any] | None = None,  # noqa: A002  # as the command's --set
    out: str | Path = "compared",
    jobs: int | None = None,
) -> Compared:
    """Compare two versions over equal flights: is B better than A? See the command ``compare``.

    What is flown already is kept as in `sweep`.

    Args:
        what: Files, one a scenario; or two folders of finished sweeps or runs, A and B.
        a: Settings of A: ``{"odometry.corners": 300}``; the files as they are, if not given.
        b: Settings of B.
        seeds: Flights of each file, at most: half of them may be enough.
        repeat: Runs with each flight, averaged.
        figures: What to compare; if not given, errors, rotation and coverage.
        margin: Change that does not matter, in percent, or in the figure's unit where it may be 0.
        set: Settings to change in both.
        out: Folder for runs and page.
        jobs: Runs at the same time; by default, as many as fit on the cores.

    Returns:
        `rows`, one a figure of an estimator, with `change`, `low`, `high`, `p` and the verdict in
        `words`; `worse`, with which the command ends with 1; the `page`; and `notes`, which are
        warned of, on flights that are not the same for A and B.

    Raises:
        ConfigError: A file, a folder, a setting or a figure is wrong, or nothing is in common.
        KeyboardInterrupt: After Ctrl-C, once all runs have ended; the next call goes on.
    """
    _check_runtime()
    import functools

    from runtime.tools import comparison
    from runtime.tools import sweep as sweeping

    compared = comparison.compare(
        [Path(path) for path in what],
        _changes(a or {}),
        _changes(b or {}),
        seeds=seeds,
        repeats=repeat,
        figures=figures,
        margin=margin,
        overrides=_changes(set or {}),
        out=Path(out),
        fly=functools.partial(sweeping.run_here, jobs=jobs),
    )
    for note in compared.notes:
        warnings.warn(note, stacklevel=2)
    return compared


def judge(
    truth: str | Path | npt.NDArray[np.float64] | Trajectory,
    estimates: Any,
    *,
    final: Any = None,
    alignment: str = "auto",
    align_first: int | str | None = None,
    scale_free: bool = False,
    axes: str | None = None,
    truth_axes: str | None = None,
    columns: str = "",
    truth_columns: str = "",
    times: str | Path = "",
    time_offset: float | str = 0.0,
    frames: str | Path | npt.NDArray[np.int64] | None = None,
    max_difference: float | str = 0.1,
    gap: float | str = 0.5,
    body_from_camera: str | npt.NDArray[np.float64] | None = None,
    thresholds: Mapping[str, float] | None = None,
    out: str | Path | None = None,
) -> Run:
    """Judge trajectories that somebody else computed, as a run judges its estimators.

    An estimator that was lost for most of a sequence does not look good: poses for 90 % of the
    flight's time, and with `frames` for 30 % of the images, are asked for by default, and shares of
    it are figures. Arguments are the options of the command ``judge``.

    Args:
        truth: A trajectory: a file (TUM, EuRoC, KITTI, VINS, OpenVINS, AirSim, …), ``BAG:/TOPIC``,
            the folder of a run, a `Trajectory`, or an array of TUM's rows, shape (n, 8): seconds,
            x, y, z in metres, and a quaternion x, y, z, w; or (n, 4), without the quaternion.
        estimates: One, named after its file or ``estimate``; or several by name.
        final: Trajectories after loop closures, by the names of their estimates; or one, of the
            only estimate.
        alignment: ``auto``, ``none``, ``origin``, ``posyaw``, ``se3`` or ``sim3``; see the command.
        align_first: Poses (a number) or time (``"5s"``) that the alignment fits; by default all.
        scale_free: Whether the estimates' unit of length is their own.
        axes: Of the estimates, instead of what they declare: ned, nwu, enu or optical.
        truth_axes: Of the truth, likewise.
        columns: Meaning of the columns of the estimates' files: ``"sec x y z qw qx qy qz"``.
        truth_columns: Of the truth's, likewise.
        times: File of the stamps of poses without any, such as KITTI's.
        time_offset: Added to the estimates' stamps: seconds, or a text as ``"-30ms"``.
        frames: Stamps of the images, for the share of them that have a pose: a file, or
            nanoseconds, shape (n,), strictly rising.
        max_difference: From a time to the nearest true pose in a hole of the truth: seconds, or
            ``"100ms"``.
        gap: Silence that counts as lost, likewise; more for files of key frames.
        body_from_camera: Optical frame in the truth's body, if the estimates are a camera's: as in
            the command, or a transform of shape (4, 4).
        thresholds: What figures may be: ``{"ate_percent": 1}``.
        out: Folder for figures and report; if not given, nothing is written.

    Raises:
        OSError: A file cannot be read.
        ValueError: A trajectory is none, or cannot be compared; the message says where.
        ConfigError: A setting is wrong.
    """
    _check_runtime()
    import numpy as np

    from nodes.judging import judged, judgement, mounting, readers
    from nodes.judging.readers.memory import of_memory
    from nodes.judging.readers.stamps import read_stamps
    from runtime.config.reading import convert

    config = convert(
        {
            "alignment": alignment,
            "align_first": align_first,
            "scale_free": scale_free,
            "axes": axes,
            "truth_axes": truth_axes,
            "columns": columns,
            "truth_columns": truth_columns,
            "time_offset": time_offset,
            "max_difference": max_difference,
            "gap": gap,
            "thresholds": dict(thresholds or {}),
        },
        judgement.JudgeConfig,
        "judge",
    )
    camera = None
    if isinstance(body_from_camera, str) and body_from_camera:
        camera = mounting.read_mounting(body_from_camera, str(truth))
    elif body_from_camera is not None and not isinstance(body_from_camera, str):
        camera = mounting.mounting_of(np.asarray(body_from_camera, np.float64))

    def read(trajectory: Any, name: str) -> readers.Source:
        if isinstance(trajectory, str | Path):
            text = f"{name}={trajectory}" if name else str(trajectory)
            return readers.read(text, config.axes, str(times), camera, columns=config.columns)
        name = name or "estimate"
        return of_memory(name, trajectory, config.axes, camera)

    true = (
        readers.read_truth(str(truth), str(times), config.truth_axes, columns=config.truth_columns)
        if isinstance(truth, str | Path)
        else of_memory("truth", truth, config.truth_axes)
    )
    named = estimates if isinstance(estimates, Mapping) else {"": estimates}
    sources = [read(trajectory, name) for name, trajectory in named.items()]
    if final is not None and not isinstance(final, Mapping):
        final = {sources[0].name: final} if len(sources) == 1 else {"final": final}
    finals = {name: read(trajectory, name) for name, trajectory in (final or {}).items()}
    stamps = (
        read_stamps(Path(frames))
        if isinstance(frames, str | Path)
        else None
        if frames is None
        else np.asarray(frames)
    )
    true, judgements, verdict, notes = judgement.judge_all(true, sources, stamps, config, finals)
    for note in notes:
        warnings.warn(note, stacklevel=2)
    if out is not None:
        judged.write(Path(out), true, judgements, verdict, notes)
        return load(out)
    return Run(judged.in_memory(true, judgements, verdict, notes), None)


def _png(figure: Figure) -> bytes:
    import io

    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _settings(config: str | Path | Mapping[str, Any], changes: Mapping[str, Any]) -> Config:
    from runtime.config.overrides import override
    from runtime.config.reading import find_modules_in, load_configuration, parse

    if not isinstance(config, Mapping):
        return load_configuration(Path(config), _changes(changes))
    find_modules_in(Path.cwd())
    table = _plain(copy.deepcopy(dict(config)))
    for change in _changes(changes):
        override(table, change)
    return parse(table, "config")


def _changes(changes: Mapping[str, Any]) -> list[str]:
    return [f"{path}={_toml(value)}" for path, value in changes.items()]


def _toml(value: Any) -> str:
    from runtime.config.parameters import toml

    return toml(_plain(value))


def _plain(value: Any) -> Any:
    """Return what TOML knows for a value of Python's: a class is named, an array is a list."""
    if isinstance(value, Mapping):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    if isinstance(value, type):
        return f"{value.__module__}:{value.__qualname__}"
    if isinstance(value, Path):
        return str(value)
    return value.tolist() if hasattr(value, "tolist") else value


def main() -> None:
    """Run the command line, if the packages found are those installed together with this file."""
    try:
        _check_runtime()
        from runtime.extras import check_events

        check_events()
        from runtime.tools.cli import program
    except KeyboardInterrupt:  # importing takes a moment
        print("error: interrupted", file=sys.stderr)
        sys.exit(130)
    except ImportError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    program()


def _check_runtime() -> None:
    """Raise ImportError if `runtime` is not the package beside this file."""
    expected = Path(__file__).resolve().parent / "runtime"
    spec = importlib.util.find_spec("runtime")
    origin = Path(spec.origin).resolve() if spec is not None and spec.origin else None
    if origin != expected / "__init__.py":
        raise ImportError(
            f"expected the package runtime in {expected}, found {origin or 'none'}: "
            "another package of this name stands in the way"
        )
    if not (expected / "node.py").is_file():
        raise ImportError(
            f"expected the package runtime of visnav-runtime in {expected}, found another one "
            "installed over it: remove that one and install visnav-runtime again"
        )
