"""Trajectory files: TUM, EuRoC and KITTI, read strictly and written; rows of numbers.

- TUM (cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats): ``timestamp tx ty tz qx qy qz qw``
  in seconds and metres, the scalar last.
- EuRoC's ground truth (M. Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016):
  nanoseconds, position, quaternion with the scalar first, velocity, biases; with commas.
- KITTI (cvlibs.net/datasets/kitti/eval_odometry.php): the first three rows of the transform from
  child to parent, row by row; no stamps, so two such files go together line by line.

Written with nanoseconds, nanometres and 12 decimals of a quaternion. What other programs write is
read by `nodes.judging.readers`.

Files of a run grow with the run, so that a killed run lacks only its last second; those of before a
node's restart are never overwritten.
"""

from __future__ import annotations

import datetime as dt
import decimal
import math
import threading
from collections import deque
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from events import Quaternion, Vector3
from nodes.trajectory import UNIT_LENGTH, Trajectory, not_rotations
from runtime import Node
from runtime.time.clock import SECOND

Floats = npt.NDArray[np.float64]

EUROC_HEADER = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], "
    "q_RS_z [], v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1], "
    "b_w_RS_S_y [rad s^-1], b_w_RS_S_z [rad s^-1], b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], "
    "b_a_RS_S_z [m s^-2]"
)
"""First line of EuRoC's files."""


def read_tum(path: Path, *, whole: bool = True, in_order: bool = True) -> Trajectory:
    """Read a TUM file; stamps keep every nanosecond written.

    Args:
        whole: Whether a last line without its end counts; a killed run's may be cut off.
        in_order: Whether stamps have to rise; else rows are sorted, and the first of equal stamps
            counts.

    Raises:
        ValueError: It cannot be read or holds something else; the message names the line.
    """
    rows = read_rows(path, None, (8,), "timestamp tx ty tz qx qy qz qw", whole=whole)
    poses = [(row, row.seconds(), row.numbers(1, 8)) for row in rows]
    if not in_order:
        poses = list({pose[1]: pose for pose in reversed(poses)}.values())
        poses.sort(key=lambda pose: pose[1])
    return _trajectory([(row, stamp, [*v[:3], v[6], *v[3:6]]) for row, stamp, v in poses])


def write_tum(path: Path, trajectory: Trajectory, comment: str = "") -> None:
    """Write a TUM file, with the lines of a comment before; may raise `OSError`."""
    header = "timestamp[s] tx ty tz[m] qx qy qz qw"
    rows = (tum_row(*pose) for pose in trajectory.poses())
    _write(path, [*_comment(comment), f"# {header}\n", *rows])


def tum_row(stamp: int, position: Vector3, orientation: Quaternion) -> str:
    """Return a pose (ns, metres, w x y z) as a line of a TUM file."""
    (x, y, z), (qw, qx, qy, qz) = position, orientation
    return (
        f"{seconds_text(stamp)} {x:.9f} {y:.9f} {z:.9f} {qx:.12f} {qy:.12f} {qz:.12f} {qw:.12f}\n"
    )


def read_euroc(path: Path) -> Trajectory:
    """Read a EuRoC ground truth of 17 or 8 (TUM VI) columns; a `ValueError` names a wrong line."""
    return _trajectory([(row, stamp, v[:7]) for row, stamp, v in euroc_rows(path, (17, 8))])


def euroc_rows(
    path: Path,
    columns: tuple[int, ...] = (17,),
    tolerance: float = UNIT_LENGTH,
    *,
    whole: bool = True,  # whether a last line without its end counts
) -> Iterator[tuple[Row, int, list[float]]]:
    """Yield a EuRoC ground truth's rows, stamps (ns), values; a `ValueError` names a wrong line."""
    meaning = "timestamp, p x 3, q x 4, v x 3, b_w x 3, b_a x 3"
    for row in read_rows(path, ",", columns, meaning, whole=whole):
        values = row.numbers(1, 17)
        _check_quaternion(row, values[3:7], tolerance)
        yield row, row.nanoseconds(), values


def write_euroc(path: Path, trajectory: Trajectory, comment: str = "") -> None:
    """Write a EuRoC ground truth; velocities by differences, biases zero; may raise `OSError`."""
    velocities = [(x, y, z) for x, y, z in trajectory.velocities().tolist()]
    rows = (
        euroc_row(*pose, velocity)
        for pose, velocity in zip(trajectory.poses(), velocities, strict=True)
    )
    _write(path, [*_comment(comment), f"{EUROC_HEADER}\n", *rows])


def euroc_row(
    stamp: int, position: Vector3, orientation: Quaternion, velocity: Vector3 = (0.0, 0.0, 0.0)
) -> str:
    """Return a pose (ns, metres, w x y z, m/s) as a line of a EuRoC ground truth; biases zero."""
    x, y, z = position
    w, i, j, k = orientation
    u, v, s = velocity
    return (
        f"{stamp},{x:.9f},{y:.9f},{z:.9f},{w:.12f},{i:.12f},{j:.12f},{k:.12f},"
        f"{u:.9f},{v:.9f},{s:.9f},0,0,0,0,0,0\n"
    )


def read_kitti(path: Path, *, first: int = 0) -> Floats:
    """Read a KITTI file: child to parent, (n, 4, 4); a `ValueError` names a wrong line.

    Args:
        first: Number of other fields before the twelve.
    """
    rows = list(read_rows(path, None, (first + 12,), "r11 r12 r13 tx r21 … tz"))
    matrices = np.zeros((len(rows), 4, 4))
    matrices[:, 3, 3] = 1.0
    matrices[:, :3, :] = np.reshape([row.numbers(first, first + 12) for row in rows], (-1, 3, 4))
    if wrong := not_rotations(matrices[:, :3, :3]):
        rows[wrong[0]].wrong("a rotation matrix", str(matrices[wrong[0], :3, :3].tolist()))
    return matrices


def write_kitti(path: Path, trajectory: Trajectory) -> None:
    """Write a KITTI file: poses only, no stamps, no comments; may raise `OSError`."""
    rows = trajectory.matrices()[:, :3, :].reshape(-1, 12).tolist()
    _write(path, [" ".join(f"{value:.12f}" for value in row) + "\n" for row in rows])


def _trajectory(rows: list[tuple[Row, int, list[float]]]) -> Trajectory:
    """Make a trajectory of lines, stamps, and rows of x y z qw qx qy qz, checked line by line."""
    last: int | None = None
    for row, stamp, pose in rows:
        if last is not None and stamp <= last:
            row.wrong(f"a stamp above {last} ns", f"{stamp} ns")
        last = stamp
        _check_quaternion(row, pose[3:], UNIT_LENGTH)
    values = np.array([pose for _, _, pose in rows])
    stamps = np.array([stamp for _, stamp, _ in rows], dtype=np.int64)
    return Trajectory(stamps, values[:, :3], values[:, 3:])


def _check_quaternion(row: Row, quaternion: list[float], tolerance: float) -> None:
    if not abs(math.hypot(*quaternion) - 1.0) <= tolerance:
        row.wrong("a quaternion of length 1", f"w x y z = {quaternion}")


def _comment(text: str) -> list[str]:
    return [f"# {line}\n" for line in text.splitlines()]


def _write(path: Path, lines: Iterable[str]) -> None:
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.writelines(lines)


_TOO_LATE = 1 << 63  # first number of nanoseconds beyond 64 bits
EPOCH = "2020-01-01T00:00:00Z"  # default start of a run in exported files: Unix time of 19 digits
_LATEST = 7 << 60  # latest epoch (ns), with room for a run of decades
_SHOWN = 60  # characters of a wrong line shown in a message


def epoch_of(given: int | str) -> int:
    """Return nanoseconds of Unix time (1970 to 2225), from such or ISO 8601, or `ValueError`."""
    expected = "expected nanoseconds of Unix time or a date as 2020-01-01T00:00:00Z"
    try:
        if isinstance(given, int) or given.isdecimal():
            epoch = int(given)
        else:
            date = dt.datetime.fromisoformat(given)
            if date.tzinfo is None:
                date = date.replace(tzinfo=dt.UTC)
            since = date - dt.datetime(1970, 1, 1, tzinfo=dt.UTC)
            epoch = since // dt.timedelta(microseconds=1) * 1000
    except (ValueError, OverflowError):
        raise ValueError(f"epoch: {expected}, found {given!r:.60}") from None
    if not 0 <= epoch <= _LATEST:
        raise ValueError(f"epoch: {expected}, from 1970 to 2225, found {given!r:.60}")
    return epoch


class Row:
    """A line of a file, split into fields; ``#`` starts a comment."""

    __slots__ = ("fields", "where")

    def __init__(self, where: str, fields: list[str]) -> None:
        self.where, self.fields = where, fields

    def numbers(self, start: int, end: int) -> list[float]:
        """Return fields as finite numbers; a `ValueError` if one is none."""
        try:
            values = [float(field) for field in self.fields[start:end]]
        except ValueError:
            values = [math.nan]
        if not all(map(math.isfinite, values)):
            self.wrong("finite numbers", " ".join(self.fields[start:end]))
        return values

    def seconds(self) -> int:
        """Return the first field (seconds) in exact whole nanoseconds, or raise a `ValueError`."""
        try:
            stamp = int((decimal.Decimal(self.fields[0]) * SECOND).to_integral_value())
        except (decimal.InvalidOperation, ValueError, OverflowError):
            stamp = _TOO_LATE
        if abs(stamp) >= _TOO_LATE:
            unit = "seconds, not in nanoseconds" if 1e23 < abs(stamp) < 1e28 else "seconds"
            self.wrong(f"a stamp in {unit}", self.fields[0])
        return stamp

    def nanoseconds(self) -> int:
        """Return the first field, a whole number; a `ValueError` if it is none."""
        try:
            stamp = int(self.fields[0])
        except ValueError:
            stamp = _TOO_LATE
        if abs(stamp) >= _TOO_LATE:
            self.wrong("a stamp in whole nanoseconds", self.fields[0])
        return stamp

    def wrong(self, expected: str, text: str) -> NoReturn:
        """Raise a `ValueError` with the file and the line."""
        shown = text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"
        raise ValueError(f"{self.where}: expected {expected}, found {shown!r}")


def read_rows(
    path: Path,
    separator: str | None,  # between fields; None for blanks
    columns: Collection[int],  # allowed numbers of fields
    meaning: str,
    *,
    whole: bool = True,  # whether a last line without its end counts
    header: bool = False,  # whether to skip a first line that begins with a letter
) -> Iterator[Row]:
    """Yield the rows of a file; a `ValueError` if unreadable, empty, or of another length."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(
            f"{path}: expected a text file of rows {meaning}, found: {error}"
        ) from None
    if not whole:
        text = text[: text.rfind("\n") + 1]
    empty = True
    for number, line in enumerate(text.splitlines(), start=1):
        content = line.partition("#")[0].strip()
        if not content or (header and number == 1 and content[0].isalpha()):
            continue
        row = Row(f"{path}:{number}", [field.strip() for field in content.split(separator)])
        if len(row.fields) not in columns:
            counts = " or ".join(map(str, columns))
            row.wrong(f"{counts} fields ({meaning})", f"{len(row.fields)}: {content}")
        empty = False
        yield row
    if empty:
        raise ValueError(f"{path}: expected rows of {meaning}, found none")


def seconds_text(stamp: int) -> str:
    """Return nanoseconds as seconds with nine decimals, exactly."""
    whole, rest = divmod(abs(stamp), SECOND)
    return f"{'-' if stamp < 0 else ''}{whole}.{rest:09d}"


_INTERVAL = 500_000_000  # nanoseconds of the run's clock between two writes


def part_name(node: Node[Any], name: str) -> str:
    """Return the name of a node's file or folder; after a restart ``flight-2.png``, and so on."""
    path = Path(name)
    number = f"-{node.restarts + 1}" if node.restarts else ""
    return str(path.with_name(f"{path.stem}{number}{path.suffix}"))


class GrowingFile:
    """A file of lines (a restarted node's goes on): added on the loop, written beside it."""

    def __init__(self, node: Node[Any], path: Path, head: str = "") -> None:
        self._node = node
        self._file = path.open("ab" if node.restarts else "wb", buffering=0)
        self.begin = self._file.tell()  # bytes there before
        self._lines = deque([] if self.begin else [head])
        self._due = 0
        self._writing = False
        self._lock = threading.Lock()

    def add(self, line: str) -> None:
        """Add a line, with its end."""
        self._lines.append(line)
        now = self._node.clock.now()
        if now >= self._due and not self._writing:
            self._due, self._writing = now + _INTERVAL, True
            self._node.start(self._node.offload(self._write))

    def close(self) -> None:
        """Write the remaining lines, and close the file."""
        try:
            self._write()
        finally:
            self._file.close()

    def _write(self) -> None:
        with self._lock:  # the run's end does not wait for a write that it cancels
            if not self._file.closed:
                lines = [self._lines.popleft() for _ in range(len(self._lines))]
                rest = memoryview("".join(lines).encode("ascii"))
                while rest:
                    rest = rest[self._file.write(rest) :]
        self._writing = False
