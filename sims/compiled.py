"""The simulators' compiled library: the rasteriser, the cameras' noise, rays that meet meshes.

Its sources are in ``sims/cameras/rasteriser``; all of its builds give the same bytes.
"""

from __future__ import annotations

import ctypes
import functools
from pathlib import Path
from typing import Any


@functools.cache
def libraries() -> dict[str, Any]:
    """Return the compiled libraries that run here, by instruction set, the quickest first."""
    builds = {}
    for name in ("avx2", "sse4", "any"):
        for path in (Path(__file__).parent / "cameras").glob(f"_raster_{name}.*"):
            library = ctypes.CDLL(str(path))
            library.raster_new.restype = ctypes.c_void_p
            library.rays_new.restype = ctypes.c_void_p
            library.raster_texel_count.restype = ctypes.c_int64
            if library.raster_runs():
                builds[name] = library
    return builds
