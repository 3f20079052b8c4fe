"""Functions of arrays that give the same bits on every processor.

NumPy takes sines, exponentials and convolutions with the widest vectors, and products of matrices
with the kernels, that the processor has; each rounds differently. What moves in a run uses none of
them, so that a flight is the same on another machine.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Reals = npt.NDArray[np.floating[Any]]


def sines(angles: Reals) -> Floats:
    """Return the sines of angles (radians), shape (n,)."""
    return np.array([math.sin(angle) for angle in angles.tolist()])


def directions(ways: Reals) -> Floats:
    """Return the angles of ways from their first axis to their second, radians, shape (n,)."""
    return np.array([math.atan2(second, first) for first, second in ways[:, :2].tolist()])


def gaussian(padded: Reals, width: float, reach: int) -> Floats:
    """Return averages over a Gaussian window, shape (n - 2 reach,).

    Args:
        padded: Values, with `reach` more at either end, shape (n,).
        width: Standard deviation of the window, rows.
        reach: Rows of the window before its middle, and after it.
    """
    weights = [math.exp(-0.5 * (at / width) ** 2) for at in range(-reach, reach + 1)]
    total, count = math.fsum(weights), len(padded) - 2 * reach
    averages: Floats = np.zeros(count)
    for first, weight in enumerate(weights):
        averages += weight / total * padded[first : first + count]
    return averages
