"""Evaluation of trajectories from outside a run: their sources, common truth, and results.

The figures are those of an evaluation, but for those of arrivals: latencies, errors at control
ticks and future stamps.

A file's format is recognized by its content; its axes are the user's word, or the format's habit
(`AXES`). Messages of a topic are read in our frames (`nodes.ros2.messages.incoming`); of
``nav_msgs/msg/Path`` the last one counts.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from events import PoseEstimate
from events.frames import Axes as EventAxes
from events.frames import axes_of
from nodes.data.export import mounting
from nodes.data.replay.bags import chosen, open_bag, readable
from nodes.data.replay.reader import BagTopic
from nodes.judging.evaluation.alignment import AlignmentMethod
from nodes.judging.evaluation.judging import Judgement, judge
from nodes.judging.evaluation.node import EvaluationConfig
from nodes.judging.evaluation.record import EstimatorRecord
from nodes.judging.evaluation.verdict import FRAMES, conclude, write_results
from nodes.judging.report.page import write_report
from nodes.judging.report.tables import COLORS, Estimator, Facts, Run, Verdict
from nodes.ros2.messages.incoming import MessageContext
from nodes.ros2.messages.mappings import READERS
from nodes.ros2.messages.typestore import Bag
from nodes.trajectory import Trajectory
from nodes.trajectory_files import (
    Row,
    read_euroc,
    read_kitti,
    read_rows,
    read_tum,
    read_vslamlab,
    write_tum,
)
from runtime.commit import commit
from runtime.errors import ResultsError
from runtime.paths import source_file
from runtime.run import results
from runtime.run.results import newest, run_folder
from runtime.run.sources import content_hash
from runtime.run.summarise import command_line, environment
from runtime.time.clock import SECOND


class JudgeConfig(EvaluationConfig):
    """Settings of a judgement: as an evaluation, but ``auto`` is ``se3`` for an unknown frame.

    Attributes:
        scale_free: Whether the estimates' unit of length is their own.
        axes: Those of the estimates' files; see `nodes.judging.judgement.AXES`.
    """

    scale_free: bool = False
    axes: Axes | None = None


def judge_all(
    truth: Source,
    estimates: Sequence[Source],
    frames: npt.NDArray[np.int64] | None,  # stamps of the images (ns), if known
    config: JudgeConfig,
    finals: Mapping[str, Trajectory] = MappingProxyType({}),
) -> tuple[dict[str, Judgement], Verdict, list[str]]:
    """Judge estimates against the truth, at the stamps of the images if known.

    Args:
        finals: The trajectories after loop closures, by estimate.

    Returns:
        Judgements by name, the verdict, and notes on exclusions.

    Raises:
        ValueError: A name is not unique, an estimate is nowhere near a true pose in time, or a
            final trajectory names no estimate.
    """
    names = [source.name for source in estimates]
    if strangers := finals.keys() - {*names}:
        raise ValueError(
            f"final: expected the name of an estimate ({', '.join(names)}), found {min(strangers)}"
        )
    judgements: dict[str, Judgement] = {}
    notes = []
    for source in estimates:
        if source.name in {*judgements, "truth", "plan"}:
            raise ValueError(f"{source.file}: expected a name of its own, NAME={source.file}")
        by_frame: dict[str, AlignmentMethod] = {"": "se3", "map": "none"}
        usual = "sim3" if config.scale_free else by_frame.get(source.frame_id, "origin")
        record = EstimatorRecord.of(source.poses)
        record.final = finals.get(source.name)
        judgement = judge(
            record,
            truth.poses,
            cameras=None if frames is None else {"": frames},
            alignment=usual if config.alignment == "auto" else config.alignment,
            align_first=config.alignment_span(),
            gap=config.gap,
            hole=config.hole,
        )
        if not judgement.figures["compared"] and truth.poses.covers(source.poses.stamps).any():
            raise ValueError(f"{source.file}: {judgement.figures['why']}")
        unknown = {"restarts", "repeated_stamps", "future_stamps", "other_bodies"}
        figures = {k: v for k, v in judgement.figures.items() if k not in unknown} | source.counts
        figures["method"] = source.file
        judgements[source.name] = msgspec.structs.replace(judgement, figures=figures)
        notes += [f"{source.name}: {judgement.note}"] if judgement.note else []
    verdict = conclude({k: j.figures for k, j in judgements.items()}, config.thresholds)
    return judgements, msgspec.convert(verdict, Verdict), notes


def write(
    out: Path,
    truth: Source,
    judgements: dict[str, Judgement],
    verdict: Verdict,
    notes: Sequence[str],
) -> Path:
    """Write a results folder like a run's, with figures and a report; return the report's path.

    An earlier judgement there is renamed by its time.

    Raises:
        ResultsError: The folder has something else, or cannot be written.
    """
    if (out / "config.toml").exists():
        raise ResultsError(f"{out}: expected no run's folder: name another with --out")
    with results.Folder(out) as folder:
        page = _write(out, truth, judgements, verdict, notes)
        folder.flown()
    return page


def in_memory(
    truth: Source, judgements: dict[str, Judgement], verdict: Verdict, notes: Sequence[str]
) -> Run:
    """Return what `read_run` finds in the folder that `write` writes."""
    estimators = [
        Estimator(
            name=name,
            color=COLORS[k % len(COLORS)],
            figures=verdict.estimators[name],
            aligned=judgement.aligned,
            of_images=judgement.of_images,
            of_ticks=judgement.of_ticks,
            lost=judgement.lost,
            final=judgement.final,
        )
        for k, (name, judgement) in enumerate(judgements.items())
    ]
    return Run(
        folder=Path(),
        facts=Facts(name="trajectories", verdict=verdict),
        verdict=verdict,
        truths={"": truth.poses},
        plans={},
        collisions=np.empty((0, 3)),
        estimators=estimators,
        frames={},
        clouds=[],
        config=None,
        log=[],
        missing=list(notes),
    )


def _write(
    out: Path,
    truth: Source,
    judgements: dict[str, Judgement],
    verdict: Verdict,
    notes: Sequence[str],
) -> Path:
    write_results(out, {}, judgements, msgspec.to_builtins(verdict))
    write_tum(out / "trajectories" / "truth.tum", truth.poses, FRAMES.format("map (NED)"))
    for name, judgement in judgements.items():
        assert judgement.estimate is not None
        path = out / "trajectories" / f"{source_file(name)}.tum"
        write_tum(path, judgement.estimate, FRAMES.format("a frame of its own"))
    files = {"truth": truth.file, **{k: j.figures["method"] for k, j in judgements.items()}}
    facts = Facts(
        name=out.name,
        verdict=verdict,
        environment={**environment(), "command": command_line(), "commit": commit()},
        judged=files,
        judged_hashes={name: _hash(file) for name, file in files.items()},
        notes=list(notes),
    )
    text = msgspec.json.format(msgspec.json.encode(facts), indent=2)
    results.write(out / "summary.json", text + b"\n")
    return write_report(out)


def _hash(file: str) -> str:
    """Return the hash of a file, of a bag for one of its topics; empty for an array or a folder."""
    path = Path(file) if Path(file).exists() else Path(file.rpartition(":/")[0])
    return content_hash(path) if path.is_file() else ""


_PATH, _POSE = "nav_msgs/msg/Path", "geometry_msgs/msg/PoseStamped"
_NEVER = 1 << 62  # stands for the stamp of a message that has none


def read_topic(path: Path, topic: str) -> tuple[Trajectory, EventAxes, EstimatorRecord]:
    """Read the poses of a topic: frames with z up get z down, those of cameras stay optical.

    Returns:
        The poses that count, the kind of their child frame (by default a body), and the record with
        counts of the others.

    Raises:
        ValueError: It cannot be read, or holds something else; the message names the pose.
    """
    record, child = EstimatorRecord(), ""
    with readable(path), contextlib.closing(open_bag(path)) as bag:
        chosen(bag.topics(), (BagTopic(topic=topic, use="estimate"),), "")
        for number, (type_, message) in enumerate(_poses(bag, topic), start=1):
            try:
                event = _estimate(type_, message)
            except ValueError as error:
                raise ValueError(f"{path}:{topic}: pose {number}: {error}") from None
            child = child or event.child_frame_id
            record.add(event, None)
    if not len(record):
        raise ValueError(f"{path}:{topic}: expected poses, found none")
    return record.rows.trajectory(), axes_of(child), record


def _poses(bag: Bag, topic: str) -> Iterator[tuple[str, Any]]:
    """Yield type and message for each pose of a topic; a Path gives the newest message's poses."""
    path = bag.topics()[topic][0] == _PATH
    for _, type_, _, message in bag.messages([topic], newest=path):
        if not path:
            yield type_, message
        for pose in message.poses if path else ():
            pose.header.frame_id = pose.header.frame_id or message.header.frame_id
            yield _POSE, pose


def _estimate(type_: str, message: Any) -> PoseEstimate:
    q = (message.pose if type_ == _POSE else message.pose.pose).orientation
    length = float(np.linalg.norm([q.w, q.x, q.y, q.z]))
    if not abs(length - 1.0) < 0.01:
        raise ValueError(f"expected a quaternion of length 1, found one of length {length:.6g}")
    event = READERS[type_, "estimate"].read(message, MessageContext(source="bag", now=_NEVER))
    assert isinstance(event, PoseEstimate)
    # A run begins at 0; a node that forgets the stamp sends many of these, which are counted.
    return msgspec.structs.replace(event, stamp=0) if event.stamp == _NEVER else event


Floats = npt.NDArray[np.float64]
Axes = Literal["ned", "nwu", "enu", "optical"]

_SAME, _HALF_TURN, _OPTICAL = np.eye(4), np.diag([1.0, -1.0, -1.0, 1.0]), np.eye(4)[[2, 0, 1, 3]]
AXES: dict[Axes, tuple[Floats, Floats]] = {
    "ned": (_SAME, _SAME),
    "nwu": (_HALF_TURN, _SAME),
    "enu": (np.eye(4)[[1, 0, 2, 3]] * [1.0, 1.0, -1.0, 1.0], _HALF_TURN),
    "optical": (_OPTICAL, _OPTICAL),
}
"""Transforms from a file's world to NED, and from its body to the truth's body, shape (4, 4).

``ned``: our own files and TUM's; ``nwu``: z up, the body as it is, as EuRoC and VSLAM-LAB; ``enu``:
REP 103, with a body FLU; ``optical``: both of a camera that looks ahead, as KITTI.
"""

_FORMATS = (
    "a trajectory: rows of TUM (8 fields with blanks between), KITTI (12), EuRoC (17 with commas), "
    "or 8 with commas under a header that names the columns (EuRoC, VSLAM-LAB)"
)
_SCALAR = re.compile(r"q\w*w\b")  # of a header: the column of a quaternion's scalar part
_FRAME = re.compile(r"# base_link \(FRD\) in (\S+), as it was sent")  # of a run's estimate
_LONGEST_STEP = 10 * 86_400 * SECOND  # more are stamps of different units or clocks


class Source(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """A trajectory from outside: poses of the truth's body in a world NED."""

    name: str
    file: str
    poses: Trajectory
    frame_id: str = ""  # of the poses, if the source says so
    counts: dict[str, int] = {}  # figures that only a topic has: restarts and repeated stamps


def read_truth(text: str, times: str) -> Source:
    """Read true poses of a file, a topic, or a run's folder; a `ValueError` names the line."""
    path = newest(Path(text))
    own = path / "trajectories" / "truth.tum"
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        run_folder(path)  # raises, of a folder that is none
        text = str(own)
    found = read(str(own) if own.is_file() else text, None, times)
    if odd := {name: count for name, count in found.counts.items() if count}:
        raise ValueError(f"{text}: expected one truth with stamps that rise, found {odd}")
    return found


def read(text: str, axes: Axes | None, times: str = "", camera: Floats | None = None) -> Source:
    """Read a trajectory: a file, or a topic as ``bag:/topic``.

    Args:
        text: Its place, after an optional ``NAME=``.
        axes: Those of a file, if they are not its format's; a topic's are REP 103's.
        times: File of the stamps of a KITTI file.
        camera: Transform from the optical frame to the body, shape (4, 4), if the poses are a
            camera's; the body's axes are then of no account.

    Raises:
        ValueError: It cannot be read; the message names file and line, or pose.
    """
    name, equals, file = text.partition("=")
    if not equals or Path(text).exists():
        name, file = "", text
    bag, colon, topic = file.rpartition(":/")
    path = newest(Path(bag if colon and not Path(file).exists() else file))
    if path.suffix in {".mcap", ".db3", ".bag"} or (path / "metadata.yaml").is_file():
        topic = f"/{topic}" if colon and not Path(file).exists() else ""
        poses, child, record = read_topic(path, topic)
        name, frame_id = name or topic.strip("/"), record.frame_id
        counts = {"restarts": record.restarts, "repeated_stamps": record.repeated}
        world, body = _SAME, _OPTICAL if child == "optical" else _SAME
        if camera is not None and child == "body":  # as which a camera's poses were read, then
            camera = camera @ _HALF_TURN
    else:
        usual, frame_id, poses = _read_file(path, times)
        name, counts = name or path.stem, {}
        world, body = AXES[axes or usual]
    if far := np.flatnonzero(np.diff(poses.stamps) > _LONGEST_STEP).tolist():
        before, after = (poses.stamps[far[0] + k] / SECOND for k in (0, 1))
        raise ValueError(
            f"{file}: pose {far[0] + 2}: expected stamps of one unit and one clock, found "
            f"{after:.3f} s after {before:.3f} s"
        )
    body = body if camera is None else camera
    if world is not _SAME or body is not _SAME:
        matrices = world @ poses.matrices() @ np.linalg.inv(body)
        poses = Trajectory.from_matrices(poses.stamps, matrices)
    return Source(name=name, file=file, poses=poses, frame_id=frame_id, counts=counts)


def read_mounting(text: str, run: str) -> Floats:
    """Return the transform from a camera's optical frame to the body, shape (4, 4).

    Given as ``tx ty tz qx qy qz qw`` (metres, the scalar last), a TUM file with one pose, or the
    name of a camera that the run announced.

    Raises:
        ValueError: It is none of these.
    """
    if Path(text).is_file():
        return np.asarray(read_tum(Path(text)).matrices()[0])
    row = Row("--body-from-camera", text.replace(",", " ").split())
    if len(row.fields) == 1 and Path(run).is_dir():
        return mounting(newest(Path(run)), text)
    if len(row.fields) != 7:
        row.wrong('"tx ty tz qx qy qz qw", a file, or a camera of the run that is the truth', text)
    values = np.array([row.numbers(0, 7)])
    pose = Trajectory(np.array([0]), values[:, :3], values[:, [6, 3, 4, 5]])
    return np.asarray(pose.matrices()[0])


def read_stamps(path: Path) -> npt.NDArray[np.int64]:
    """Return the stamps (ns) of a list of images or of poses: the first field of each row.

    With commas nanoseconds (EuRoC, VSLAM-LAB), else seconds (TUM, KITTI).

    Raises:
        ValueError: It cannot be read, or the stamps do not rise; the message names the line.
    """
    commas = "," in _start(path)[2]
    rows = list(read_rows(path, "," if commas else None, range(1, 100), "stamps, …", header=commas))
    stamps = np.array([row.nanoseconds() if commas else row.seconds() for row in rows], np.int64)
    if back := np.flatnonzero(np.diff(stamps) <= 0).tolist():
        before, after = stamps[back[0] : back[0] + 2]
        rows[back[0] + 1].wrong(f"a stamp above {before} ns", f"{after} ns")
    return stamps


def _read_file(path: Path, times: str) -> tuple[Axes, str, Trajectory]:
    """Return the usual axes of a file's format, the frame named in the file, and its poses."""
    number, head, row = _start(path)
    commas = "," in row
    fields = row.split("," if commas else None)
    names = head[-1].lower().split(",") if head else []
    scalar = [k for k, name in enumerate(names) if _SCALAR.search(name)]
    if commas and len(fields) == 8 and scalar == [7]:
        return "nwu", "", read_vslamlab(path)
    if commas and (len(fields) == 17 or (len(fields) == 8 and scalar == [4])):
        return "nwu", "", read_euroc(path)
    if not commas and len(fields) == 8:
        named = _FRAME.search("\n".join(head))
        return "ned", named[1] if named else "", read_tum(path)
    if commas or len(fields) != 12:
        Row(f"{path}:{number}", fields).wrong(_FORMATS, row)
    if not times:
        raise ValueError(f"{path}: expected --times beside KITTI's poses, which have no stamps")
    stamps, matrices = read_stamps(Path(times)), read_kitti(path)
    if len(stamps) != len(matrices):
        raise ValueError(
            f"{path}: expected {len(stamps)} poses, as many as {times} has stamps, "
            f"found {len(matrices)}"
        )
    return "optical", "", Trajectory.from_matrices(stamps, matrices)


def _start(path: Path) -> tuple[int, list[str], str]:
    """Return the line number of a file's first row, the lines before, and the row."""
    head: list[str] = []
    try:
        with path.open(encoding="utf-8-sig") as file:
            for number, line in enumerate(map(str.strip, file), start=1):
                if line and not (line[0] == "#" or line[0].isalpha()):
                    return number, head, line
                head += [line] if line else []
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: expected {_FORMATS}, found: {error}") from None
    raise ValueError(f"{path}: expected {_FORMATS}, found no rows")
