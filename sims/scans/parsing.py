"""What readers of mesh files share: counts of what they leave out, polygons, numbers in text."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from sims.scans.mesh_file import MeshError


class LeftOut:
    """Count of what a reader leaves out, by what it is and what that means for the image."""

    def __init__(self) -> None:
        self._counts: dict[tuple[str, str], int] = {}

    def note(self, what: str, then: str = "not drawn", count: int = 1) -> None:
        """Count it, as in ``("normal maps", "not drawn", 3)``; a count of 0 is none."""
        if count:
            self._counts[what, then] = self._counts.get((what, then), 0) + count

    def sentences(self) -> tuple[str, ...]:
        """Return ``normal maps (3): not drawn`` and so on, in order."""
        counts = sorted(self._counts.items())
        return tuple(f"{what} ({count}): {then}" for (what, then), count in counts)


MOST_TRIANGLES = 50_000_000


def check_size(path: Path, triangles: int) -> None:
    """Raise a `MeshError` if a file has more triangles than memory bears, as a damaged one may."""
    if triangles > MOST_TRIANGLES:
        raise MeshError(
            f"{path}: expected at most {MOST_TRIANGLES:,} triangles, found more: simplify the mesh"
        )


def refuse_cloud(path: Path, points: int) -> NoReturn:
    """Raise a `MeshError` for points without triangles."""
    raise MeshError(
        f"{path}: expected triangles, found a cloud of {points} points without any: make a mesh of "
        "it first (Poisson's reconstruction in MeshLab, CloudCompare or Open3D)"
    )


def unique_name(name: str, taken: set[str]) -> str:
    """Return a name, with a number behind it if it is taken, and add it to `taken`."""
    unique, number = name, 1
    while unique in taken:
        number += 1
        unique = f"{name}_{number}"
    taken.add(unique)
    return unique


def fan(counts: npt.NDArray[np.integer]) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Cut polygons into triangles around their first corner.

    Args:
        counts: Number of corners of each polygon; those below 3 give no triangles.

    Returns:
        Corners of the triangles as places in the polygons' corners, one after the other, shape
        (m, 3); and the polygon of each triangle, shape (m,).
    """
    triangles = np.maximum(counts.astype(np.intp) - 2, 0)
    polygon = np.repeat(np.arange(len(counts)), triangles)
    first = (np.cumsum(counts, dtype=np.intp) - counts)[polygon]
    along = np.arange(len(polygon)) - (np.cumsum(triangles) - triangles)[polygon]
    return np.stack([first, first + along + 1, first + along + 2], axis=1), polygon


def join(*numbers: npt.NDArray[np.integer]) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.int32]]:
    """Make vertices of corners that name their point, their normal and so on apart.

    Args:
        numbers: Of each corner, at least -1, each of shape (n,).

    Returns:
        A corner of each vertex, shape (v,), and the vertex of each corner, shape (n,).
    """
    keys = numbers[0].astype(np.int64)
    for column in numbers[1:]:
        keys = np.unique(keys, return_inverse=True)[1]
        keys = keys * (int(column.max(initial=0)) + 2) + column + 1
    _, first, vertex = np.unique(keys, return_index=True, return_inverse=True)
    return first, vertex.astype(np.int32)


def parse_numbers(text: bytes, dtype: type[Any], count: int, where: str) -> npt.NDArray[Any]:
    """Return the numbers of a text, which are separated by white space.

    Args:
        count: How many there are, as its words.
        where: The file and what is parsed, for the message.

    Raises:
        MeshError: A word is no number.
    """
    if not count:
        return np.zeros(0, dtype)
    try:
        values = np.fromstring(text, dtype, sep=" ")
    except (ValueError, DeprecationWarning):  # which of them depends on NumPy's version
        values = np.zeros(0, dtype)
    if len(values) == count:
        return values
    converter = float if dtype is np.float64 else int
    for word in text.split():
        try:
            converter(word)
        except ValueError:
            raise MeshError(f"{where}: expected numbers, found {word[:40]!r}") from None
    raise MeshError(f"{where}: expected {count} numbers, found others")
