"""Reading of mesh files by their suffix: a `MeshFile`, or an error that names what is wrong."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np

from sims.scans.collada import read_collada
from sims.scans.gazebo import read_world
from sims.scans.gltf import read_gltf
from sims.scans.mesh_file import MeshError, MeshFile, Piece
from sims.scans.obj import read_obj
from sims.scans.ply import read_ply
from sims.scans.stl import read_stl

SUFFIXES: dict[str, Callable[[Path], MeshFile]] = {
    ".dae": read_collada,
    ".glb": read_gltf,
    ".gltf": read_gltf,
    ".obj": read_obj,
    ".ply": read_ply,
    ".sdf": lambda path: read_world(path, read),
    ".stl": read_stl,
    ".world": lambda path: read_world(path, read),
}

_MALFORMED = (
    ArithmeticError,
    AttributeError,
    LookupError,
    MemoryError,
    RecursionError,
    TypeError,
    ValueError,
    struct.error,
)
"""What a reader meets where a file has another kind of value than its format says."""


def read(path: Path) -> MeshFile:
    """Read a file of triangles; its points are finite, and its corners within its points.

    Raises:
        MeshError: There is no such file, it cannot be read, or it has no triangles.
        MissingDependencyError: Its format needs a library that is not installed.
    """
    reader = SUFFIXES.get(path.suffix.lower())
    if reader is None:
        suffix = repr(path.suffix) if path.suffix else "no suffix"
        raise MeshError(f"{path}: expected a mesh file ({', '.join(SUFFIXES)}), found {suffix}")
    try:
        with np.errstate(all="ignore"):  # points that overflow are refused below
            mesh = reader(path)
    except MeshError:
        raise
    except OSError as error:
        name = error.filename or path
        raise MeshError(f"{name}: expected a file to read, found: {error.strerror}") from error
    except _MALFORMED as error:
        raise MeshError(
            f"{path}: expected a file as its format says, found something else inside: "
            f"{type(error).__name__}: {error}"
        ) from error
    if not sum(len(piece.corners) for piece in mesh.pieces):
        left_out = f"; left out: {'; '.join(mesh.left_out)}" if mesh.left_out else ""
        raise MeshError(f"{path}: expected triangles, found none{left_out}")
    for piece in (*mesh.pieces, *mesh.solids):
        _check(path, piece)
    return mesh._replace(sources=(path, *mesh.sources))


def _check(path: Path, piece: Piece) -> None:
    bad = np.flatnonzero(~np.isfinite(piece.points).all(axis=1))
    if len(bad):
        raise MeshError(
            f"{path}: {piece.object}: expected finite points, found {len(bad)} others, the first "
            f"at {bad[0]}: {piece.points[bad[0]].tolist()}"
        )
    if not len(piece.corners):
        return
    least, most = int(piece.corners.min()), int(piece.corners.max())
    if least < 0 or most >= len(piece.points):
        raise MeshError(
            f"{path}: {piece.object}: expected corners from 0 to {len(piece.points) - 1}, found "
            f"{least} to {most}"
        )
