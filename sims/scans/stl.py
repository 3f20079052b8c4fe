"""Reader of STL, binary and as text. Each triangle has vertices of its own, and no colour."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import numpy as np

from sims.scans.mesh_file import Floats, Material, MeshError, MeshFile, Piece
from sims.scans.parsing import check_size, parse_numbers

_TRIANGLE = np.dtype([("normal", "<f4", 3), ("points", "<f4", (3, 3)), ("attribute", "<u2")])


def read_stl(path: Path) -> MeshFile:
    """Read an ``.stl``; its normals are those of its triangles, and are not taken from it."""
    data = path.read_bytes()
    points = _binary(data)
    if points is None:
        points = _text(path, data)
    check_size(path, len(points) // 3)
    corners = np.arange(len(points), dtype=np.int32).reshape(-1, 3)
    return MeshFile((Piece(path.stem, 0, points, corners),), (Material(),))


def _binary(data: bytes) -> Floats | None:
    """Return the points, or None if the size is not that of a binary file."""
    if len(data) < 84:
        return None
    (count,) = struct.unpack("<I", data[80:84])
    size = 84 + count * _TRIANGLE.itemsize
    # A few programs write the word "solid" into binary files, too, so the size decides.
    if size > len(data) or (size != len(data) and data[:5].lower() == b"solid"):
        return None
    return np.frombuffer(data, _TRIANGLE, count, 84)["points"].reshape(-1, 3).astype(np.float64)


def _text(path: Path, data: bytes) -> Floats:
    vertices = re.findall(rb"\bvertex\s+(\S+\s+\S+\s+\S+)", data, re.IGNORECASE)
    if data[:5].lower() != b"solid":
        found = f"a binary file of {len(data)} bytes" if len(data) >= 84 else repr(data[:20])
        raise MeshError(
            f"{path}: expected STL: 84 bytes and 50 for each triangle, or text that begins with "
            f"solid; found {found}"
        )
    where = f"{path}: behind vertex"
    points = parse_numbers(b" ".join(vertices), np.float64, 3 * len(vertices), where)
    if len(vertices) % 3:
        raise MeshError(f"{path}: expected triangles, found {len(vertices)} vertices")
    return points.reshape(-1, 3)
