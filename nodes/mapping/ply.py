"""Clouds as PLY files: binary, little-endian, coloured. Reading them is in `nodes.report.ply`.

The format is G. Turk's, "The PLY polygon file format" (1994); it counts what follows the header.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

_VERTEX = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
)
_TYPES = {"<f4": "float", "|u1": "uchar"}


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
    axes = ", x north, y east, z down" if frame_id == "map" else ""
    properties = (f"property {_TYPES[_VERTEX[name].str]} {name}" for name in _VERTEX.names or ())
    header = "\n".join(
        [
            "ply",
            "format binary_little_endian 1.0",
            f"comment frame {frame_id}: metres{axes}",
            f"element vertex {len(rows)}",
            *properties,
            "end_header\n",
        ]
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.name}")
    with unfinished.open("wb") as file:
        file.write(header.encode("ascii"))
        file.write(rows.tobytes())
    unfinished.replace(path)
