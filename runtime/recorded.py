"""Recorded motions for nodes that follow one, read by whoever knows the formats.

The reader is the entry point of the group ``visnav.motions``, a function as `ReadMotion`.
"""

from __future__ import annotations

from typing import Literal, Protocol, cast

import msgspec
import numpy as np
import numpy.typing as npt

from runtime.errors import VisnavError
from runtime.extras import offers

GROUP = "visnav.motions"

WorldAxes = Literal["auto", "ned", "nwu", "enu", "optical"]
"""Axes of a recording's world, and of its body unless named: what it declares itself, as a rule;
``ned``, with a body in FRD; ``nwu``, z up; ``enu``, with a body in FLU; ``optical``, those of a
camera that looks ahead, with such a body."""


class MotionError(VisnavError, ValueError):
    """Recorded motion that cannot be read, placed or followed."""


class MotionFile(msgspec.Struct, frozen=True, kw_only=True):
    """Where a recorded motion is, and what is known of it.

    Attributes:
        path: A file, a bag, or the folder of a run, whose ground truth is meant.
        part: A bag's topic, or a table's vehicle; empty for what is one trajectory.
        times: File of the stamps of poses without any, such as KITTI's.
        columns: Meaning of a text file's columns, a word each.
        axes: Axes of the poses.
    """

    path: str
    part: str = ""
    times: str = ""
    columns: str = ""
    axes: WorldAxes = "auto"


class RecordedMotion(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """Poses of a body in NED.

    Attributes:
        stamps: Nanoseconds, rising, shape (n,).
        positions: Metres, shape (n, 3).
        orientations: Unit quaternions w x y z, from the body's axes to NED, shape (n, 4).
        body: The body's axes: ``frd``, ``flu`` or ``optical``; empty if nobody says them.
        notes: What was left out, in words.
    """

    stamps: npt.NDArray[np.int64]
    positions: npt.NDArray[np.float64]
    orientations: npt.NDArray[np.float64]
    body: Literal["", "frd", "flu", "optical"]
    notes: tuple[str, ...] = ()


class ReadMotion(Protocol):
    """Reader of recorded motions."""

    def __call__(self, file: MotionFile) -> RecordedMotion:
        """Read a motion; `ValueError` or `OSError` for one that cannot be read or followed."""


def read_motion(file: MotionFile) -> RecordedMotion:
    """Read a recorded motion, or raise `MotionError`."""
    offer, *_ = offers(GROUP)
    try:
        return cast("ReadMotion", offer.load())(file)
    except OSError as error:
        text = f"{error.filename or file.path}: expected a file, found: {error.strerror or error}"
        raise MotionError(text) from None
    except ValueError as error:
        raise MotionError(str(error)) from None
