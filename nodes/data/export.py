"""``export``: a run's trajectories, measurements and calibration, as files for other tools.

A run leaves ``trajectories/truth.tum`` and ``trajectories/<estimator>.tum``, in ``map`` (NED) or
the estimator's own frame, as sent; nothing here aligns them. Exported stamps are Unix time, and
files say which epoch is the run's time 0. TUM's files keep the run's frames, EuRoC's world is
north, west, up, KITTI's poses are those of the left camera, from identity.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from enum import Enum
from pathlib import Path
from typing import IO, Annotated, Any

import msgspec
import numpy as np
import numpy.typing as npt
import typer

from events import Event, Quaternion, Vector3
from events.frames import OPTICAL_TO_FRD
from events.geometry import pose_matrix
from events.sensors import numbers
from nodes.trajectory import Trajectory, associate
from nodes.trajectory_files import EPOCH, epoch_of, read_tum, write_euroc, write_kitti, write_tum
from runtime.run.results import run_folder
from runtime.sensors import fields_of, measured
from runtime.source_files import source_file

FORMATS = ("tum", "euroc", "kitti")
TRUTH = "truth"
PLAN = "plan"  # with `TRUTH`, the names of files without an estimate
_COMMENT = {
    ("tum", TRUTH): "ground truth: base_link (FRD) in map (NED: x north, y east, z down)",
    ("tum", ""): "estimate, as it was sent: base_link (FRD) in the estimator's frame",
    ("euroc", TRUTH): "ground truth: base_link (FRD) in the world (x north, y west, z up)",
    ("euroc", ""): "estimate: base_link (FRD) in the estimator's frame, turned to z up",
}
_VELOCITIES = "\nvelocities: by differences of the positions; biases: not known (zeros)"


def export_trajectories(
    run: Path, form: str, out: Path | None = None, epoch: int | str = EPOCH
) -> list[Path]:
    """Write a run's true trajectory and its estimates in another format.

    ``tum`` and ``euroc`` give a file each for the truth and every estimator. ``euroc`` adds the
    estimates in TUM's format for evo. ``kitti`` gives a pair for every estimator, at the
    estimator's stamps: poses of the first announced camera (else one at the body's origin that
    looks ahead) from its first pose.

    Args:
        form: One of `FORMATS`.
        out: Folder for the files, made if need be; ``export/<form>`` in the run's folder if None.
        epoch: The run's time 0: a date (ISO 8601), or nanoseconds of Unix time.

    Raises:
        ValueError: A trajectory or the epoch is missing or malformed, or a file of that name is
            there with something else.
        OSError: A file cannot be written.
    """
    zero = epoch_of(epoch)
    if form not in FORMATS:
        raise ValueError(f"format: expected one of {', '.join(FORMATS)}, found {form!r}")
    truths, estimates = load(run)
    if form == "kitti" and not estimates:
        raise ValueError(
            f"{run / 'trajectories'}: expected an estimate to give KITTI's poses their times, "
            f"found {TRUTH}.tum only"
        )
    # Before anything is written: a run that has no such pair leaves no half of an export.
    pairs = {
        name: associate(
            truths.get(_truth_name(run, name), truths[TRUTH]),
            estimate,
            name=f"{run / 'trajectories' / name}.tum",
        )
        for name, estimate in (estimates.items() if form == "kitti" else ())
    }
    folder = out or run / "export" / form
    folder.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    mounted = mounting(run) if pairs else np.eye(4)
    for name, (true, estimate) in pairs.items():
        for path, poses in (
            (folder / f"{name}.{TRUTH}.kitti.txt", true),
            (folder / f"{name}.kitti.txt", estimate),
        ):
            matrices = poses.matrices() @ mounted
            matrices = np.linalg.inv(matrices[0]) @ matrices
            write_kitti(path, Trajectory.from_matrices(poses.stamps, matrices))
            written.append(path)
    if form == "kitti":
        return written
    world = np.diag([1.0, -1.0, -1.0, 1.0]) if form == "euroc" else np.eye(4)
    comments = {
        name: _COMMENT[form, TRUTH if name in truths else ""] for name in truths | estimates
    }
    files = [
        (name, folder / f"{name}.{suffix}")
        for name in comments
        for suffix in ("csv", "tum")
        if (form == "euroc" if suffix == "csv" else form == "tum" or name in estimates)
    ]
    for name, path in files:
        _check_replaced(path, comments[name])
    for name, path in files:
        trajectory = (truths | estimates)[name]
        comment = f"{comments[name]}\nthe run's time 0 is {zero} ns"
        placed = Trajectory.from_matrices(trajectory.stamps + zero, world @ trajectory.matrices())
        if path.suffix == ".csv":
            write_euroc(path, placed, comment + _VELOCITIES)
        else:
            write_tum(path, placed, comment)
    return [path for _, path in files]


def _check_replaced(path: Path, comment: str) -> None:
    """Raise a `ValueError` if a file is there that an export with this comment did not write."""
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            first = file.readline().strip()
    except FileNotFoundError:
        return
    if first != f"# {comment}":
        raise ValueError(
            f"{path}: expected no file, or one that an earlier export in this format wrote "
            f"(# {comment}), found {first!r:.80}: choose another folder (--out)"
        )


def mounting(run: Path, camera: str = "") -> npt.NDArray[np.float64]:
    """Return the transform from an announced camera to its body, shape (4, 4).

    The default is the first one on a body, else one at the body's origin that looks ahead.

    Raises:
        ValueError: The run's summary is none, or there is no such camera.
    """
    path = run / "summary.json"
    try:
        content = path.read_bytes() if path.is_file() else b"{}"
        announced = msgspec.json.decode(content, type=_Summary).announcements
    except (OSError, msgspec.DecodeError) as error:
        raise ValueError(f"{path}: expected the run's summary, found: {error}") from None
    mounted_cameras = [
        (announcement.source, pose_matrix(announcement.position, announcement.orientation))
        for announcement in announced
        if announcement.type == "CameraAnnouncement" and announcement.parent_frame_id != "map"
    ]
    chosen = [mounted for source, mounted in mounted_cameras if camera in {"", source}]
    if camera and not chosen:
        sources = ", ".join(source for source, _ in mounted_cameras) or "none"
        raise ValueError(
            f"{path}: expected {camera!r} among the cameras on a body, found {sources}"
        )
    return chosen[0] if chosen else pose_matrix((0.0, 0.0, 0.0), OPTICAL_TO_FRD)


class _Announced(msgspec.Struct):
    type: str
    source: str = ""
    parent_frame_id: str = "map"
    position: Vector3 = (0.0, 0.0, 0.0)
    orientation: Quaternion = OPTICAL_TO_FRD


class _Summary(msgspec.Struct):
    announcements: list[_Announced] = []


def load(run: Path) -> tuple[dict[str, Trajectory], dict[str, Trajectory]]:
    """Read a run's true trajectories and its estimates, both by the names of their files.

    Truths are ``truth`` and, of further vehicles, ``truth.<vehicle>``.

    Raises:
        ValueError: A trajectory is missing or malformed.
    """
    folder = run / "trajectories"
    if not (folder / f"{TRUTH}.tum").is_file():
        names = ", ".join(sorted(p.name for p in folder.glob("*.tum"))) or "no trajectories"
        raise ValueError(
            f"{folder / TRUTH}.tum: expected the run's true trajectory, found {names}: "
            "a run leaves its trajectories if a node of type Evaluation is in it"
        )
    truths, estimates = {TRUTH: read_tum(folder / f"{TRUTH}.tum")}, {}
    for path in sorted(folder.glob("*.tum")):
        kind = path.stem.partition(".")[0]
        if kind == TRUTH:
            truths[path.stem] = read_tum(path)
        elif kind != PLAN:
            estimates[path.stem] = read_tum(path)
    return truths, estimates


def _truth_name(run: Path, estimate: str) -> str:
    """Return the truth's name in an estimate's verdict; `TRUTH` if not named."""
    path = run / "evaluation" / "verdict.json"
    if not path.is_file():
        return TRUTH
    estimators = msgspec.json.decode(path.read_bytes(), type=_Verdict).estimators
    vehicles = {source_file(name): f.get("vehicle", "") for name, f in estimators.items()}
    return f"{TRUTH}.{source_file(vehicles.get(estimate, ''))}"


class _Verdict(msgspec.Struct):
    estimators: dict[str, dict[str, Any]] = {}


def export_measurements(run: Path, out: Path | None = None, epoch: int | str = EPOCH) -> list[Path]:
    """Write the samples of IMUs, barometers, receivers, … as ``<source>.<kind>.csv``.

    Rows are in order of arrival; a column is named by field and unit.

    Args:
        out: Folder for the files, made if need be; ``export/csv`` in the run's folder if None.
        epoch: The run's time 0: a date (ISO 8601), or nanoseconds of Unix time.

    Raises:
        ValueError: There is no measurement, or the epoch is none.
        OSError: A file cannot be written.
    """
    zero = epoch_of(epoch)
    recordings = sorted(run.glob("*.mcap"))
    if not recordings:
        raise ValueError(
            f"{run}: expected a recording (*.mcap), found none: a run leaves one if a node of type "
            "McapRecorder is in it"
        )
    folder = out or run / "export" / "csv"
    folder.mkdir(parents=True, exist_ok=True)
    files: dict[Path, IO[str]] = {}
    with ExitStack() as stack:
        for path in recordings:
            for event in _measurements(path):
                kind = next(known for known in measured() if isinstance(event, known))
                name = f"{source_file(event.source)}.{kind.__name__}.csv"
                file = files.get(folder / name)
                if file is None:
                    opened = (folder / name).open("w", encoding="utf-8", newline="\n")
                    file = files[folder / name] = stack.enter_context(opened)
                    file.write(_header(event))
                values = (v for field in fields_of(kind) for v in numbers(event, field))
                file.write(f"{zero + event.stamp},{','.join(map(repr, values))}\n")
    if not files:
        raise ValueError(f"{recordings[0]}: expected measurements of small sensors, found none")
    return sorted(files)


def _measurements(recording: Path) -> Iterator[Event]:
    from nodes.data.replay.bags import Recorded  # which imports the MCAP library

    reader = Recorded(recording)
    events = reader.events(0, None, lambda kind, _: bool(fields_of(kind)))
    yield from (recorded.event for recorded in events)


def _header(event: Event) -> str:
    columns = ["stamp (ns)"]
    for field, unit in fields_of(type(event)).items():
        axes = ("_x", "_y", "_z") if len(numbers(event, field)) == 3 else ("",)
        columns += [f"{field}{axis} ({unit})" for axis in axes]
    return ",".join(columns) + "\n"


class Format(Enum):
    """Choices of ``--format``."""

    tum = "tum"
    euroc = "euroc"
    kitti = "kitti"
    csv = "csv"
    kalibr = "kalibr"
    openvins = "openvins"
    vins = "vins"
    basalt = "basalt"
    orbslam3 = "orbslam3"
    vslamlab = "vslamlab"


def export(
    run: Annotated[Path, typer.Argument(help="The folder of a run: runs/<name> for the latest.")],
    form: Annotated[Format, typer.Option("--format", "-f", help="Format of the files.")],
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for the files; if not given RUN/export/FORMAT."),
    ] = None,
    epoch: Annotated[
        str, typer.Option(help="The run's time 0: a date, or nanoseconds of Unix time.")
    ] = "2020-01-01T00:00:00Z",
    camera: Annotated[
        str | None,
        typer.Option(help="Of a calibration: a camera, or a vehicle; the first if not given."),
    ] = None,
) -> None:
    """Write a run's trajectories, measurements or calibration, as other tools read them.

    tum, euroc and kitti are true and estimated trajectories for evo. tum and euroc give a file for
    the truth and each estimator; euroc turns the world z up and adds the estimates in TUM's format
    for evo_ape. kitti has no stamps: a pair of files for every estimator, poses of the first
    camera, from identity. csv gives a file for each IMU, barometer, magnetometer, satellite
    receiver, range finder and the wind, if the run has a recording. kalibr, openvins, vins
    (VINS-Fusion), basalt, orbslam3 and vslamlab are calibrations: cameras, IMU and their
    transforms; vslamlab adds images, IMU data and ground truth if the run has a recording. A lens
    that a format cannot express is refused.
    """
    from nodes.calibration.formats import announcements, export_calibration, left_out
    from nodes.data.dataset.recording import choose
    from runtime.errors import ConfigError
    from runtime.tools.cli.commands import warn

    run = run_folder(run)
    try:
        if form.value in FORMATS:
            written = export_trajectories(run, form.value, out, epoch)
        elif form is Format.csv:
            written = export_measurements(run, out, epoch)
        else:
            written = export_calibration(run, form.value, out, epoch, camera)
            for warning in left_out(choose(announcements(run), camera), form.value):
                warn(warning)
    except (ValueError, OSError) as error:
        raise ConfigError(str(error)) from None
    for path in written:
        print(path)
