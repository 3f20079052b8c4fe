"""A trajectory from outside (`Source`), a row of the table (`Reader`), and how rows become poses.

Rows that cannot be compared are left out and counted: numbers that are none, stamps that repeat or
go back, poses in other frames than that of most.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
import numpy as np
import numpy.typing as npt

from events import Vector3
from nodes.judging.readers.axes import UNDECLARED, Axes
from nodes.trajectory import UNIT_LENGTH, Trajectory

Floats = npt.NDArray[np.float64]

_TOO_LATE = 1 << 63  # first number of nanoseconds beyond 64 bits
_BLANKS = " \r\n\v\f"  # without tabs
IDENTITY = (1.0, 0.0, 0.0, 0.0)
NO_LEVER = (0.0, 0.0, 0.0)


class Options(msgspec.Struct, frozen=True, kw_only=True):
    """Options of a reader besides the path.

    Attributes:
        part: Text after the path and a colon: a bag's topic, a table's vehicle; "" if none.
        times: File of the stamps of poses without any, such as KITTI's.
        columns: Meaning of a text file's columns, a word each; see `nodes.judging.readers.columns`.
    """

    part: str = ""
    times: str = ""
    columns: str = ""


class Source(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """A trajectory from outside, as it stands in its file or topic.

    Attributes:
        name: Short name, of a table's column.
        file: Place as it was given.
        poses: Stamps (ns), positions (m), orientations of unit length, w x y z.
        frame_id: Frame of the poses; "" if the source does not name it.
        axes: Axes that the source declares.
        usual: Axes of such files as a rule, for drawing only: they change no error.
        positions_only: Whether the source has no orientations; those of `poses` are identity.
        counts: Figures of the source: restarts, repeated stamps.
        notes: What was left out, in words.
        covariances: Of the poses, in ROS's order (x, y, z, and angles about the frame's fixed
            axes), shape (n, 6, 6); NaN for poses without one.
        velocities: In the poses' frame (m/s), shape (n, 3); NaN for poses without one.
        lever: Place on the body (m) of the camera whose poses these were, or are judged as.
    """

    name: str
    file: str
    poses: Trajectory
    frame_id: str = ""
    axes: Axes = UNDECLARED
    usual: Axes = UNDECLARED
    positions_only: bool = False
    counts: dict[str, int] = {}
    notes: tuple[str, ...] = ()
    covariances: Floats | None = None
    velocities: Floats | None = None
    lever: Vector3 = NO_LEVER


class Start(msgspec.Struct, frozen=True):
    """Beginning of a text file.

    Attributes:
        number: Line of the first row; 0 if there is none.
        head: Lines before it, without blanks around, but with tabs, beside which a field may be
            empty: comments, names of columns.
        row: The first row, so, and without a comment after it: a line with a number in it.
    """

    number: int
    head: list[str]
    row: str

    @classmethod
    def of(cls, path: Path) -> Start | None:
        """Read a file's beginning; `None` of what is no text, an `OSError` if it is not there."""
        head: list[str] = []
        try:
            with path.open(encoding="utf-8-sig") as file:
                for number, line in enumerate(file, start=1):
                    row = line.partition("#")[0].strip(_BLANKS)
                    if not row.lstrip().startswith("%") and any(map(is_number, words(row))):
                        return cls(number, head, row)
                    head += [line.strip(_BLANKS)] if line.strip() else []
        except UnicodeDecodeError:
            return None
        return cls(0, head, "")


class Reader(msgspec.Struct, frozen=True, kw_only=True):
    """A row of the table of readers.

    Attributes:
        name: Name of the format.
        recognized: How a file or folder is recognized, in words.
        columns: What it holds.
        stamps: Unit of its stamps, in words.
        axes: What it declares of its axes, in words.
        matches: Whether a path is of this format; `Start` is `None` of what is no text.
        read: Reader of such a path; raises `ValueError` with the file and the line.
        part: What `Options.part` is, such as a topic; "" if a path is one trajectory.
    """

    name: str
    recognized: str
    columns: str
    stamps: str
    axes: str
    matches: Callable[[Path, Start | None], bool]
    read: Callable[[Path, Options], Source]
    part: str = ""


def words(line: str) -> list[str]:
    """Return the parts of a line between commas, semicolons and blanks."""
    return [word for word in re.split(r"[,;\s]+", line) if word]


def is_number(text: str) -> bool:
    """Return whether a text is a number, infinity or NaN."""
    try:
        float(text)
    except ValueError:
        return False
    return True


_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")


def with_decimal_comma(field: str) -> bool:
    """Return whether a field is a number with a comma instead of a decimal point."""
    return bool(_DECIMAL_COMMA.fullmatch(field))


def decimal_commas(row: str) -> bool:
    """Return whether the commas of a row are those of numbers, with other separators between."""
    separator = next((candidate for candidate in ";\t" if candidate in row), None)
    fields = [field.strip() for field in row.split(separator)]
    with_comma = [field for field in fields if "," in field]
    return len(fields) >= 4 and bool(with_comma) and all(map(with_decimal_comma, with_comma))


class Collected:
    """Poses as they are read, in order; makes a `Source` of those that can be compared.

    Args:
        place: Beginning of errors' messages, before the row's own.
    """

    def __init__(self, place: str) -> None:
        self._place = place
        self._stamps: list[int] = []
        self._poses: list[Sequence[float]] = []
        self._rows: list[str] = []
        self._covariances: list[Floats | None] = []
        self._velocities: list[Sequence[float] | None] = []
        self._frames: list[str] = []  # by row
        self._last: int | None = None
        self.not_numbers = self.repeated = self.back = self.restarts = 0
        self.outside = 0  # rows without a pose, such as a receiver's without a fix

    def add(
        self,
        stamp: int | None,
        position: Sequence[float],
        orientation: Sequence[float] | None = None,
        *,
        row: str = "",
        frame_id: str = "",
        covariance: Floats | None = None,
        velocity: Sequence[float] | None = None,
    ) -> None:
        """Add a pose: nanoseconds (`None` for NaN), metres, quaternion w x y z, if there is one."""
        if stamp is None or not all(map(math.isfinite, (*position, *(orientation or ())))):
            self.not_numbers += 1
            return
        if not abs(stamp) < _TOO_LATE:
            raise ValueError(f"{self._place}{row}: expected a stamp in 64 bits, found {stamp} ns")
        if self._last is not None and stamp <= self._last:
            self.repeated += stamp == self._last
            self.back += stamp < self._last
            return
        self._last = stamp
        self.restarts += bool(self._frames) and frame_id not in {self._frames[0], self._frames[-1]}
        self._frames.append(frame_id)
        self._stamps.append(stamp)
        self._poses.append([*position, *(orientation or (0.0,) * 4)])
        self._rows.append(row)
        if covariance is not None and not (covariance.any() and np.isfinite(covariance).all()):
            covariance = None
        if velocity is not None and not all(map(math.isfinite, velocity)):
            velocity = None
        self._covariances.append(covariance)
        self._velocities.append(velocity)

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def frame_id(self) -> str:
        """Frame of most poses, the earliest of equal ones; empty without poses."""
        return max(Counter(self._frames).items(), key=lambda row: row[1], default=("", 0))[0]

    def source(
        self,
        *,
        axes: Axes = UNDECLARED,
        usual: Axes = UNDECLARED,
        counted: bool = False,  # whether the source could count restarts and repeated stamps
    ) -> Source:
        """Return the poses; raises `ValueError` if there are none, or a quaternion is none."""
        if not self._stamps:
            left = "; ".join(self._left_out())
            raise ValueError(f"{self._place}: expected poses, found none{left and f': {left}'}")
        judged = self.frame_id
        inside = [row for row, frame in enumerate(self._frames) if frame == judged]
        poses = np.array(self._poses)[inside]
        lengths = np.linalg.norm(poses[:, 3:], axis=1)
        positions_only = not lengths.any()
        if positions_only:
            poses[:, 3:] = IDENTITY
        elif wrong := np.flatnonzero(~(abs(lengths - 1.0) <= UNIT_LENGTH)).tolist():
            row = self._rows[inside[wrong[0]]]
            raise ValueError(
                f"{self._place}{row}: expected a quaternion of length 1, found "
                f"w x y z = {poses[wrong[0], 3:].tolist()}"
            )
        counts = {"restarts": self.restarts} if counted else {}
        if counted or self.repeated or self.back:
            counts["repeated_stamps"] = self.repeated + self.back
        return Source(
            name="",
            file="",
            poses=Trajectory(np.array(self._stamps, np.int64)[inside], poses[:, :3], poses[:, 3:]),
            frame_id=judged,
            axes=axes,
            usual=usual,
            positions_only=positions_only,
            counts=counts,
            notes=tuple(self._left_out()),
            covariances=_filled([self._covariances[row] for row in inside], (6, 6)),
            velocities=_filled([self._velocities[row] for row in inside], (3,)),
        )

    def _left_out(self) -> list[str]:
        elsewhere = len(self._frames) - self._frames.count(self.frame_id)
        parts = [
            f"{count} {what[0] if count == 1 else what[1]}"
            for count, what in (
                (self.not_numbers, ("pose with NaN", "poses with NaN")),
                (self.repeated, ("repeated stamp", "repeated stamps")),
                (self.back, ("stamp that goes back", "stamps that go back")),
                (elsewhere, ("pose in another frame", "poses in another frame")),
                (self.outside, ("row without a pose", "rows without a pose")),
            )
            if count
        ]
        return [f"left out: {', '.join(parts)}"] if parts else []


def _filled(
    rows: Sequence[Floats | Sequence[float] | None], shape: tuple[int, ...]
) -> Floats | None:
    """Return rows as one array, NaN where there is none; `None` without any, or of zeros only."""
    if all(row is None for row in rows):
        return None
    array = np.array([np.full(shape, np.nan) if row is None else row for row in rows])
    return array if np.nan_to_num(array).any() else None
