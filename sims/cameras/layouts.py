"""Layouts of the structures of ``rasteriser/types.hpp``, for NumPy's arrays."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import numpy.typing as npt

GEOM = np.dtype(
    [
        ("mesh", "i4"), ("texture", "i4"), ("number", "i4"), ("rgba", "f4", 4), ("emission", "f4"),
        ("specular", "f4"), ("shininess", "f4"), ("repeat", "f4", 2), ("offset", "f4"),
        ("cube", "f4", 3), ("double_sided", "i4"), ("cutoff", "f4"),
    ]
)  # fmt: skip
POSE = np.dtype([("position", "f8", 3), ("turn", "f8", 9)])
LIGHT = np.dtype(
    [
        ("kind", "i4"), ("size", "i4"), ("ambient", "f4", 3), ("diffuse", "f4", 3),
        ("specular", "f4", 3), ("attenuation", "f4", 3), ("cutoff", "f4"), ("exponent", "f4"),
        ("position", "f8", 3), ("direction", "f8", 3), ("map", "u8"), ("changes", "u8"),
        ("step", "f8"), ("eye", POSE),
    ]
)  # fmt: skip
CLUSTER = np.dtype([("middle", "f4", 3), ("reach", "f4", 3), ("axis", "f4", 3), ("sine", "f4")])
VIEW = np.dtype(
    [
        ("width", "i4"), ("height", "i4"), ("first", "i4"), ("last", "i4"), ("sky", "i4"),
        ("fogged", "i4"), ("poses", "i4"), ("threads", "i4"), ("near", "f4"), ("far", "f4"),
        ("fog", "f4", 3), ("fog_start", "f4"), ("fog_end", "f4"), ("unused", "f4"),
    ]
)  # fmt: skip


def address(array: npt.NDArray[Any] | None) -> ctypes.c_void_p:
    """Return where a contiguous array lies, null for none; the caller keeps the array alive."""
    return ctypes.c_void_p(None if array is None else array.ctypes.data)
