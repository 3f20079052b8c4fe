"""Axes of worlds and bodies, and their names in options."""

from __future__ import annotations

from typing import Literal

import msgspec
import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
World = Literal["ned", "nwu", "enu", "optical"]
Body = Literal["frd", "flu", "optical"]
AxesName = Literal["ned", "nwu", "enu", "optical"]

_HALF_TURN, _OPTICAL = np.diag([1.0, -1.0, -1.0]), np.eye(3)[[2, 0, 1]]
WORLDS: dict[World, Floats] = {
    "ned": np.eye(3),
    "nwu": _HALF_TURN,
    "enu": np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
    "optical": _OPTICAL,
}
"""Rotations from a world's axes to NED, shape (3, 3)."""
BODIES: dict[Body, Floats] = {"frd": np.eye(3), "flu": _HALF_TURN, "optical": _OPTICAL}
"""Rotations from a body's axes to FRD, shape (3, 3)."""


class Axes(msgspec.Struct, frozen=True):
    """Declared axes; `None` for what is not declared."""

    world: World | None = None
    body: Body | None = None


UNDECLARED = Axes()

AXES: dict[AxesName, Axes] = {
    "ned": Axes("ned", "frd"),
    "nwu": Axes("nwu"),
    "enu": Axes("enu", "flu"),
    "optical": Axes("optical", "optical"),
}
"""Axes by the names of the options: ``ned``, a run's own; ``nwu``, z up and the body as it is, as
EuRoC; ``enu``, REP 103's; ``optical``, both of a camera that looks ahead, as KITTI."""
