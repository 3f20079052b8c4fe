"""Clouds as PLY files: binary, little-endian, coloured.

The format is G. Turk's, "The PLY polygon file format" (1994); it counts what follows the header.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from runtime.run.results import replacing

_VERTEX = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
)

_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "<i2",
    "int16": "<i2",
    "ushort": "<u2",
    "uint16": "<u2",
    "int": "<i4",
    "int32": "<i4",
    "uint": "<u4",
    "uint32": "<u4",
    "float": "<f4",
    "float32": "<f4",
    "double": "<f8",
    "float64": "<f8",
}
_LONGEST_HEADER = 1 << 16


class Cloud(msgspec.Struct, frozen=True, eq=False):
    """Coloured points.

    Attributes:
        points: Metres in ``map`` (NED), float32, shape (n, 3).
        colors: Red, green, blue, uint8, shape (n, 3); `None` if the file has none.
        total: How many the file holds.
    """

    points: npt.NDArray[np.float32]
    colors: npt.NDArray[np.uint8] | None
    total: int


def write_ply(
    path: Path,
    points: npt.NDArray[np.float32],
    colours: npt.NDArray[np.uint8],
    frame_id: str,
) -> None:
    """Write a cloud; folders that are missing are made.

    Args:
        path: The file. It appears whole or not at all.
        points: Metres, shape (n, 3).
        colours: Red, green, blue, shape (n, 3).
        frame_id: Frame of the points; named in a comment of the header.

    Raises:
        ValueError: The arrays do not fit each other.
        OSError: It cannot be written.
    """
    if points.ndim != 2 or points.shape[1] != 3 or colours.shape != points.shape:
        raise ValueError(
            f"{path}: expected points and colours of one shape (n, 3), "
            f"found {points.shape} and {colours.shape}"
        )
    rows = np.empty(len(points), _VERTEX)
    rows["x"], rows["y"], rows["z"] = points.T
    rows["red"], rows["green"], rows["blue"] = colours.T
    named = frame_id.encode("unicode_escape").decode("ascii")  # in one line
    axes = ", x north, y east, z down" if frame_id == "map" else ""
    names = {"float32": "float", "uint8": "uchar"}
    properties = (f"property {names[_VERTEX[n].name]} {n}" for n in _VERTEX.names or ())
    header = "\n".join(
        [
            "ply",
            "format binary_little_endian 1.0",
            f"comment frame {named}: metres{axes}",
            f"element vertex {len(rows)}",
            *properties,
            "end_header\n",
        ]
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as new, new.open("wb") as file:
        file.write(header.encode("ascii"))
        file.write(rows.tobytes())


def read_ply(path: Path, most: int) -> Cloud:
    """Read the finite points of a cloud, or a sample of them.

    Args:
        path: The file.
        most: How many points are enough; if there are more, so many are drawn by lot, always the
            same.

    Raises:
        OSError: It cannot be read.
        ValueError: It is no such file.
    """
    with path.open("rb") as file:
        head = file.read(_LONGEST_HEADER)
    end = head.find(b"end_header\n")
    if not head.startswith(b"ply\n") or end < 0:
        raise ValueError(f"expected a PLY file, found {head[:16]!r}")
    count, kind = _vertices(head[:end].decode("ascii", "replace").splitlines())
    start = end + len(b"end_header\n")
    expected, found = start + count * kind.itemsize, path.stat().st_size
    if found < expected:
        raise ValueError(f"expected {count} points in {expected} bytes, found {found} bytes")
    if not count:
        return Cloud(np.zeros((0, 3), np.float32), None, 0)
    rows: np.ndarray[Any, np.dtype[np.void]] = np.memmap(path, kind, "r", start, (count,))
    if count > most:
        chosen = np.random.default_rng(0).choice(count, most, replace=False, shuffle=False)
        rows = rows[np.sort(chosen)]
    points = np.stack([rows[axis].astype(np.float32) for axis in "xyz"], axis=1)
    kept = np.isfinite(points).all(axis=1)
    colors = None
    if {"red", "green", "blue"} <= set(kind.names or ()):
        colors = np.stack([rows[c].astype(np.uint8) for c in ("red", "green", "blue")], axis=1)
        colors = colors[kept]
    return Cloud(points[kept], colors, count)


def _vertices(header: list[str]) -> tuple[int, np.dtype[np.void]]:
    """Return how many vertices there are, and how one is laid out."""
    if "format binary_little_endian 1.0" not in header:
        form = next((line for line in header if line.startswith("format")), "no format")
        raise ValueError(f"expected format binary_little_endian 1.0, found {form!r}")
    count, fields, inside = -1, [], False
    for words in (line.split() for line in header):
        if words[:1] == ["element"]:
            if count < 0 and words[1:2] != ["vertex"]:
                raise ValueError(f"expected the vertices first, found {' '.join(words)!r}")
            inside = words[1:2] == ["vertex"]
            count = int(words[2]) if inside else count
        elif words[:1] == ["property"] and inside:
            if len(words) != 3 or words[1] not in _TYPES:
                raise ValueError(f"expected a property of a number, found {' '.join(words)!r}")
            fields.append((words[2], _TYPES[words[1]]))
    if count < 0 or not {"x", "y", "z"} <= {name for name, _ in fields}:
        raise ValueError(f"expected vertices with x, y and z, found {[n for n, _ in fields]}")
    return count, np.dtype(fields)
