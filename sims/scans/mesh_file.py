"""Meshes of a file as a world needs them: triangles by material, with what colours them."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from runtime import VisnavError

Floats = npt.NDArray[np.float64]
Colour = tuple[float, float, float, float]


class MeshError(VisnavError, ValueError):
    """A mesh file that cannot be read; the message says what was expected and found, and where."""


class Material(NamedTuple):
    """Appearance of triangles. Colours are sRGB values from 0 to 1, alpha from 0 to 1."""

    name: str = ""
    colour: Colour = (1.0, 1.0, 1.0, 1.0)  # a factor on the image and on vertices' colours
    image: npt.NDArray[np.uint8] | None = None  # sRGB, rows from the top, shape (h, w, 3) or (…, 4)
    cutoff: float = 0.0  # least alpha that is drawn, if above 0; else alpha is opacity if `blend`
    blend: bool = False
    double_sided: bool = False
    unlit: bool = False  # the image is what is seen: light is baked into it


class Piece(NamedTuple):
    """Triangles of one object and one material, in the axes and unit of the file."""

    object: str  # name of the object it belongs to, for a reader
    material: int  # its place in `MeshFile.materials`
    points: Floats  # shape (n, 3)
    corners: npt.NDArray[np.int32]  # counter-clockwise from outside, shape (m, 3)
    normals: npt.NDArray[np.float32] | None = None  # unit vectors, shape (n, 3)
    places: npt.NDArray[np.float32] | None = None  # u, and v from the image's top, shape (n, 2)
    colours: npt.NDArray[np.uint8] | None = None  # sRGB and alpha of vertices, shape (n, 4)


class MeshFile(NamedTuple):
    """All that is drawn of a file, with what is solid of it and what was left out."""

    pieces: tuple[Piece, ...]
    materials: tuple[Material, ...]
    up: str = ""  # axis that points up: "y", "z" or "x"; empty if the file does not say
    unit: float = 0.0  # metres of its unit; 0 if the file does not say
    lit: bool = False  # whether the file has lights of its own
    solids: tuple[Piece, ...] = ()  # the file's collision meshes; empty if it has none
    sources: tuple[Path, ...] = ()  # all files that it was read from; the first is the file itself
    left_out: tuple[str, ...] = ()  # sentences: what is not drawn, how often, and what to do
