"""Errors of calibrations, as all sensors have them: what is announced differs from what is true."""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from typing import Annotated, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt

from events import Quaternion, Vector3
from events.frames import multiply

Error = Annotated[float, msgspec.Meta(ge=0.0)] | tuple[float, ...]
"""A standard deviation, or the errors themselves."""


class MountingError(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the errors of a sensor's announced mounting.

    A number is a standard deviation: each error is drawn once a run, from the run's seed and the
    sensor's name. A list has the errors themselves. An error is what is announced less what is
    true.

    Attributes:
        rotation: Of the mounting, about each axis of the sensor's frame, degrees.
        position: Of the mounting, along each axis of the body, metres.
    """

    rotation: Error = 0.0
    position: Error = 0.0

    @property
    def of_mounting(self) -> bool:
        """Whether the announced mounting errs."""
        return bool(np.any(self.rotation) or np.any(self.position))


E = TypeVar("E", bound=MountingError)


def chosen(setting: E | bool, usual: E) -> E | None:
    """Return the errors that a setting asks for: ``true`` means the usual ones, ``false`` none."""
    if isinstance(setting, bool):
        return usual if setting else None
    return setting


def check_lists(error: MountingError, sizes: Mapping[str, int]) -> None:
    """Check the lengths of lists; raise a `ValueError` that names the setting."""
    for name, size in sizes.items():
        values = getattr(error, name)
        if isinstance(values, tuple) and len(values) != size:
            raise ValueError(
                f"calibration_error.{name}: expected a standard deviation, or a list of "
                f"{size} errors, found a list of {len(values)}"
            )


def generator_of(parent: np.random.Generator, name: str) -> np.random.Generator:
    """Return a generator seeded by node and sensor name; the parent's state stays."""
    entropy = parent.bit_generator.seed_seq.entropy  # type: ignore[attr-defined]
    return np.random.default_rng([*entropy, zlib.crc32(name.encode())])


def errors_of(given: Error, draws: npt.NDArray[np.float64]) -> list[float]:
    """Return the errors of a setting: as given, or of normal numbers, shape (n,)."""
    if isinstance(given, tuple):
        return list(given)
    values: list[float] = (given * draws).tolist()
    return values


def mounting_off(
    position: Vector3,
    orientation: Quaternion,
    error: MountingError,
    turns: npt.NDArray[np.float64],
    shifts: npt.NDArray[np.float64],
) -> tuple[Vector3, Quaternion]:
    """Return an announced mounting.

    Args:
        turns: Normal numbers for the rotation, shape (3,).
        shifts: Normal numbers for the position, shape (3,).
    """
    turn = np.radians(errors_of(error.rotation, turns))
    shift = errors_of(error.position, shifts)
    x, y, z = (p + e for p, e in zip(position, shift, strict=True))
    return (x, y, z), multiply(orientation, _quaternion(turn)) if any(turn) else orientation


def _quaternion(turn: npt.NDArray[np.float64]) -> Quaternion:
    """Return the rotation of a rotation vector (radians) as w, x, y, z."""
    angle = float(np.linalg.norm(turn))
    x, y, z = (turn * (math.sin(angle / 2.0) / angle)).tolist()
    return math.cos(angle / 2.0), x, y, z
