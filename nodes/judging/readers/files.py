"""Rows of the table of readers for text files; see `nodes.judging.readers.columns` for the rest.

- TUM (cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats), also with nanoseconds, as
  ORB-SLAM3 writes it.
- EuRoC's ground truth (M. Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016).
- VINS-Mono's and VINS-Fusion's results: as EuRoC's, without biases, with a comma at the end.
- OpenVINS' poses with covariances, and its states (docs.openvins.com, ov_eval and ov_msckf).
- AirSim's recordings (microsoft.github.io/AirSim/modify_recording_data), of a vehicle in NED.
- KITTI (cvlibs.net/datasets/kitti/eval_odometry.php): twelve numbers of a transform, no stamps.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

import msgspec
from scipy.spatial.transform import Rotation

from events import Vector3
from nodes.data.export import mounting
from nodes.judging.readers.axes import AXES, UNDECLARED, Axes
from nodes.judging.readers.columns import (
    POINTS,
    POSITION_COVARIANCE,
    ROTATION_COVARIANCE,
    Column,
    Layout,
    column_of,
    fields_of,
    layout_by_header,
    read_columns,
    read_named,
    separator_of,
    stamps_of,
)
from nodes.judging.readers.source import (
    NO_LEVER,
    Collected,
    Options,
    Reader,
    Source,
    Start,
    decimal_commas,
)
from nodes.trajectory_files import Row, read_kitti, read_rows
from runtime.source_files import source_file

FORMATS = (
    "a trajectory: rows under a header that names the columns, or of TUM (8 fields with blanks "
    "between), KITTI (12), OpenVINS (20), EuRoC (17 with commas), VINS (8 or 11 with a comma at "
    'the end); else say what the columns are, as --columns "sec x y z qw qx qy qz"'
)

NOTHING = "nothing"

_OURS = re.compile(r"base_link \(FRD\) in (?:(map) \(NED|(\S+), as it was sent|)")


def _columns(text: str) -> list[Column]:
    return [column_of(word) for word in text.split()]


TUM = Layout(None, _columns("t x y z qx qy qz qw"))
POSITIONS = Layout(None, _columns("t x y z"))
OPENVINS = Layout(
    None,
    _columns(f"t x y z qx qy qz qw {' '.join((*ROTATION_COVARIANCE, *POSITION_COVARIANCE))}"),
)
STATE = Layout(None, _columns("t qx qy qz qw x y z"))  # OpenVINS': q_GtoI (JPL) is our q_ItoG
VINS = Layout(",", _columns("t x y z qw qx qy qz"), "ns", trailing=True)
VINS_MOVING = Layout(
    ",", _columns("t x y z qw qx qy qz v_ws_w_x v_ws_w_y v_ws_w_z"), "ns", trailing=True
)
EUROC = Layout(",", _columns("t x y z qw qx qy qz v_rs_r_x v_rs_r_y v_rs_r_z _ _ _ _ _ _"), "ns")


def _plain(
    *layouts: Layout,
    name: str,
    recognized: str,
    columns: str,
    stamps: str,
    axes: str = NOTHING,
    usual: Axes = UNDECLARED,
) -> Reader:
    """Return the reader of files without names of columns, recognized by the number of fields."""

    def layout_of(start: Start | None) -> Layout | None:
        if start is None or not start.number:
            return None
        separator = separator_of(start)
        count = len(fields_of(start.row, separator))
        if separator and any(len(fields_of(line, separator)) == count for line in start.head):
            return None  # a header names the columns, with unknown names
        ends = separator is not None and start.row.rstrip().endswith(separator)
        fitting = (
            layout
            for layout in layouts
            if (layout.separator, len(layout.columns)) == (separator, count)
            and (ends or not layout.trailing)
        )
        return next(fitting, None)

    def matches(_: Path, start: Start | None) -> bool:
        return layout_of(start) is not None

    def read(path: Path, _: Options) -> Source:
        layout = layout_of(Start.of(path))
        assert layout is not None
        return read_columns(path, layout, usual=usual)

    return Reader(
        name=name,
        recognized=recognized,
        columns=columns,
        stamps=stamps,
        axes=axes,
        matches=matches,
        read=read,
    )


def _head(start: Start | None) -> str:
    return "\n".join(start.head) if start is not None else ""


def _is_ours(_: Path, start: Start | None) -> bool:
    return start is not None and bool(start.number) and bool(_OURS.search(_head(start)))


def _read_ours(path: Path, _: Options) -> Source:
    """Read a file of a run or of an export: world and body stand in its first lines."""
    start = Start.of(path)
    assert start is not None
    separator = separator_of(start)
    named = layout_by_header(start)
    poses = read_columns(path, named or (EUROC if separator == "," else TUM))
    match = _OURS.search(_head(start))
    assert match is not None
    world_up = "z up" in _head(start)
    return msgspec.structs.replace(
        poses,
        axes=Axes("nwu" if world_up else "ned", "frd"),
        frame_id=match[1] or match[2] or "",
        lever=_lever(path),
    )


class _Verdict(msgspec.Struct):
    """What is used of a run's ``evaluation/verdict.json``."""

    estimators: dict[str, dict[str, Any]] = {}


def _lever(path: Path) -> Vector3:
    """Return the lever with which a run has judged the estimator that one of its files is of."""
    run = path.parent.parent
    verdict = run / "evaluation" / "verdict.json"
    if path.parent.name != "trajectories" or not verdict.is_file():
        return NO_LEVER
    try:
        rows = msgspec.json.decode(verdict.read_bytes(), type=_Verdict).estimators.items()
        eyes = (row.get("compared_at") for name, row in rows if source_file(name) == path.stem)
        if not (eye := next(eyes, None)):
            return NO_LEVER
        x, y, z = mounting(run, eye)[:3, 3].tolist()
    except (ValueError, OSError):  # the folder is damaged, but the poses may be whole
        return NO_LEVER
    return x, y, z


_AIRSIM = {"timestamp", "pos_x", "pos_y", "pos_z", "q_w", "q_x", "q_y", "q_z"}


def _airsim_names(start: Start | None) -> list[str]:
    """Return the names of a recording's columns, in small letters; empty if it is none."""
    lines = start.head if start is not None and start.number else []
    rows = [fields_of(line.casefold(), "\t") for line in lines]
    return next((names for names in rows if {*names} >= _AIRSIM), [])


def _is_airsim(_: Path, start: Start | None) -> bool:
    return bool(_airsim_names(start))


def _read_airsim(path: Path, options: Options) -> Source:
    """Read a recording; of several vehicles, `Options.part` names one."""
    names = _airsim_names(Start.of(path))
    columns = [Column("stamp", "ms") if name == "timestamp" else column_of(name) for name in names]
    vehicle = names.index("vehiclename") if "vehiclename" in names else None
    layout = Layout("\t", columns, "ms")
    return read_columns(path, layout, axes=AXES["ned"], group=vehicle, wanted=options.part)


def _is_state(_: Path, start: Start | None) -> bool:
    return bool(re.search(r"\bq p v bg ba\b", _head(start)))


def _read_state(path: Path, _: Options) -> Source:
    return read_columns(path, STATE)


def _by_header(path: Path, start: Start | None) -> bool:
    if start is None or not start.number:
        return False
    try:
        return layout_by_header(start) is not None
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _is_kitti(_: Path, start: Start | None) -> bool:
    return (
        start is not None
        and separator_of(start) is None
        and not decimal_commas(start.row)
        and len(fields_of(start.row, None)) in {12, 13}
    )


def _read_kitti(path: Path, options: Options) -> Source:
    """Read transforms with the stamps of another file, or with one before each."""
    start = Start.of(path)
    assert start is not None
    collected = Collected(str(path))
    stamps: Sequence[int | None]
    if len(start.row.split()) == 13:
        rows = list(read_rows(path, None, (13,), "timestamp r11 r12 r13 tx r21 … tz"))
        stamps = stamps_of(rows, 0, "s")
        matrices = read_kitti(path, first=1)
    elif not options.times:
        raise ValueError(f"{path}: expected --times beside KITTI's poses, which have no stamps")
    else:
        stamps = [stamp for _, stamp in stamp_rows(Path(options.times))]
        matrices = read_kitti(path)
        if len(stamps) != len(matrices):
            raise ValueError(
                f"{path}: expected {len(stamps)} poses, as many as {options.times} has stamps, "
                f"found {len(matrices)}"
            )
    turns = Rotation.from_matrix(matrices[:, :3, :3]).as_quat(scalar_first=True)
    for stamp, place, turn in zip(stamps, matrices[:, :3, 3].tolist(), turns.tolist(), strict=True):
        collected.add(stamp, place, turn)
    return collected.source(usual=AXES["optical"])


def stamp_rows(path: Path) -> list[tuple[Row, int]]:
    """Return the rows and stamps (ns) of a list of images or of poses: the first field of each.

    With commas nanoseconds (EuRoC, VSLAM-LAB), else seconds (TUM, KITTI), unless the size of the
    numbers says otherwise.

    Raises:
        ValueError: It cannot be read; the message names the line.
    """
    start = Start.of(path)
    commas = start is not None and "," in start.row
    every = read_rows(path, "," if commas else None, range(1, 100), "stamps, …", header=commas)
    rows = list(every)
    stamps = []
    for row, stamp in zip(rows, stamps_of(rows, 0, "ns" if commas else "s"), strict=True):
        if stamp is None:
            row.wrong("a stamp", row.fields[0])
        stamps.append(stamp)
    return list(zip(rows, stamps, strict=True))


def refuse(path: Path, start: Start | None) -> NoReturn:
    """Raise a `ValueError` that names the formats and shows the file's first row."""
    if start is None or not start.number:
        raise ValueError(f"{path}: expected {FORMATS}, found no rows of text")
    numbers = f"numbers {POINTS}, and " if decimal_commas(start.row) else ""
    Row(f"{path}:{start.number}", []).wrong(numbers + FORMATS, start.row)


READERS = (
    Reader(
        name="a run's own",
        recognized="`base_link (FRD) in …` in its first lines",
        columns="TUM's, or EuRoC's after an export",
        stamps="s, or ns",
        axes="as these lines say",
        matches=_is_ours,
        read=_read_ours,
    ),
    Reader(
        name="AirSim",
        recognized="`airsim_rec.txt`: names `TimeStamp`, `POS_X`, `Q_W`; of several vehicles "
        "`FILE:VEHICLE`",
        columns="by name",
        stamps="ms",
        axes="`ned`",
        matches=_is_airsim,
        read=_read_airsim,
        part="vehicle",
    ),
    Reader(
        name="OpenVINS, states",
        recognized="`q p v bg ba` in its header",
        columns="stamp, quaternion x y z w, position, …",
        stamps="s",
        axes=NOTHING,
        matches=_is_state,
        read=_read_state,
    ),
    Reader(
        name="named columns",
        recognized="a header, with `#` or without, that names a stamp, x, y, z and a quaternion or "
        "none: EuRoC, TUM VI, VSLAM-LAB, OKVIS2, OpenVINS with covariances, evalio, MCD, "
        "`rostopic echo -p`",
        columns="by name, with commas, tabs, semicolons or blanks between",
        stamps="as the name says; without a unit ns if whole and with commas, else s",
        axes=NOTHING,
        matches=_by_header,
        read=read_named,
    ),
    _plain(
        TUM,
        POSITIONS,
        name="TUM",
        recognized="8 fields with blanks between; 4 are positions only",
        columns="t x y z qx qy qz qw",
        stamps="s (ns from ORB-SLAM3)",
    ),
    _plain(
        OPENVINS,
        name="OpenVINS",
        recognized="20 fields with blanks between",
        columns="TUM's, and upper triangles of the covariances of rotation and position",
        stamps="s",
    ),
    _plain(
        EUROC,
        name="EuRoC",
        recognized="17 fields with commas between",
        columns="t x y z qw qx qy qz, velocity, biases",
        stamps="ns",
        axes=f"{NOTHING} (drawn with z up)",
        usual=AXES["nwu"],
    ),
    _plain(
        VINS,
        VINS_MOVING,
        name="VINS-Mono, VINS-Fusion",
        recognized="8 or 11 fields with commas, the last of them at the end of the line",
        columns="t x y z qw qx qy qz, velocity",
        stamps="ns",
        axes=f"{NOTHING} (drawn with z up)",
        usual=AXES["nwu"],
    ),
    Reader(
        name="KITTI",
        recognized="12 fields with blanks between, and `--times`; or 13, the first a stamp",
        columns="the first three rows of a transform",
        stamps="s",
        axes=f"{NOTHING} (drawn as a camera's that looks ahead)",
        matches=_is_kitti,
        read=_read_kitti,
    ),
)
