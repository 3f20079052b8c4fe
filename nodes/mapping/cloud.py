"""Coloured points from depth images, thinned to a point per voxel. Pure numpy.

A voxel holds the point measured from nearest, never a mean, which at edges lies on no surface;
errors (depth noise, angle, pixel size) grow with the distance. Files are PLY, binary,
little-endian, coloured: G. Turk, "The PLY polygon file format" (1994).
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from events import CameraInfo
from runtime.run.results import replacing

_VERTEX = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
)

_NAMES = {
    "i1": "char int8", "u1": "uchar uint8", "i2": "short int16", "u2": "ushort uint16",
    "i4": "int int32", "u4": "uint uint32", "f4": "float float32", "f8": "double float64",
}  # fmt: skip
_TYPES = {name: f"<{kind}" for kind, names in _NAMES.items() for name in names.split()}
_LONGEST_HEADER = 1 << 16


class Cloud(msgspec.Struct, frozen=True, eq=False):
    """Coloured points."""

    points: npt.NDArray[np.float32]  # metres in ``map`` (NED), float32, shape (n, 3)
    # Red, green, blue, uint8, shape (n, 3); `None` if the file has none.
    colors: npt.NDArray[np.uint8] | None
    total: int  # points in the file


def write_ply(
    path: Path,
    points: npt.NDArray[np.float32],  # metres, shape (n, 3)
    colours: npt.NDArray[np.uint8],  # red, green, blue, shape (n, 3)
    frame_id: str,  # named in a comment of the header
) -> None:
    """Write a whole PLY file or none, with its folders; a `ValueError` if arrays do not fit."""
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
    header = (
        f"ply\nformat binary_little_endian 1.0\ncomment frame {named}: metres{axes}\n"
        f"element vertex {len(rows)}\nproperty float x\nproperty float y\nproperty float z\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as new, new.open("wb") as file:
        file.write(header.encode("ascii"))
        file.write(rows.tobytes())


def read_ply(path: Path, most: int) -> Cloud:
    """Read the finite points of a cloud, or a sample of them.

    Args:
        most: Greatest number of points, by a reproducible draw.

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


Floats = npt.NDArray[np.float64]
Points = npt.NDArray[np.float32]
Colours = npt.NDArray[np.uint8]

_BITS = 21  # bits of a voxel's index along an axis; three indices make a key of 63 bits


def rays_of(info: CameraInfo, stride: int) -> Points:
    """Return where the rays of every n-th (`stride`) pixel meet the plane at depth 1.

    Returns:
        x and y in the optical frame, shape (ceil(height / n), ceil(width / n), 2); NaN where the
        ray misses, as in the corners of a fisheye.
    """
    rows, columns = np.mgrid[0 : info.height : stride, 0 : info.width : stride]
    rays = info.unproject(np.stack([columns, rows], axis=-1).reshape(-1, 2))
    with np.errstate(divide="ignore", invalid="ignore"):
        met = np.where(rays[:, 2:] > 0.0, rays[:, :2] / rays[:, 2:], np.nan)
    return met.astype(np.float32).reshape(*rows.shape, 2)


def back_project(
    depth: Points,  # metres along the optical z axis, shape (h, w)
    rays: Points,  # from `rays_of`, shape (h, w, 2)
    max_depth: float,  # metres, beyond which pixels are left out
) -> tuple[Points, npt.NDArray[np.bool_]]:
    """Return a depth image's points (optical frame, m, (n, 3)), and their mask (h, w)."""
    if rays.shape != (*depth.shape, 2):
        raise ValueError(f"depth: expected shape {rays.shape[:2]}, found {depth.shape}")
    seen = (depth > 0.0) & (depth <= max_depth) & np.isfinite(rays[..., 0])
    z = depth[seen]
    return np.column_stack([rays[seen] * z[:, None], z]), seen


class VoxelCloud:
    """Cloud with a single point per occupied voxel.

    Args:
        voxel: Edge of a voxel, metres.

    Raises:
        ValueError: The edge is not above zero.
    """

    def __init__(self, voxel: float) -> None:
        if not voxel > 0.0:
            raise ValueError(f"voxel: expected an edge above 0 m, found {voxel}")
        self.voxel = voxel
        # Numbers of the voxels with a point, int64, rising, shape (n,).
        self.keys = np.empty(0, np.int64)
        self._slots = np.empty(0, np.int64)
        self._points = np.empty((0, 3), np.float32)
        self._colours = np.empty((0, 3), np.uint8)
        self._distances = np.empty(0, np.float32)

    def __len__(self) -> int:
        return len(self.keys)

    @property
    def points(self) -> Points:
        """Points, metres, shape (n, 3), in the order of their voxels' discovery. Not a copy."""
        return self._points[: len(self)]

    @property
    def colours(self) -> Colours:
        """Of the points: red, green, blue, shape (n, 3). Not a copy."""
        return self._colours[: len(self)]

    def add(self, points: Floats, colours: Colours, distances: Points) -> None:
        """Take in measured points.

        Args:
            points: Metres, shape (n, 3).
            colours: Shape (n, 3).
            distances: To the camera, metres, shape (n,).

        Raises:
            ValueError: A point is too far from the origin for voxel numbers.
        """
        keys = self._keys_of(points)
        order = np.lexsort((distances, keys))
        keys = keys[order]
        first = np.flatnonzero(np.diff(keys, prepend=-1))  # the nearest of each voxel
        keys, chosen = keys[first], order[first]
        places = np.searchsorted(self.keys, keys)
        known = np.zeros(len(keys), bool)
        inside = places < len(self)
        known[inside] = self.keys[places[inside]] == keys[inside]

        slots, candidates = self._slots[places[known]], chosen[known]
        nearer = distances[candidates] < self._distances[slots]
        self._put(slots[nearer], candidates[nearer], points, colours, distances)

        fresh = ~known
        slots = np.arange(len(self), len(self) + int(fresh.sum()))
        self._make_room(len(self) + len(slots))
        self._put(slots, chosen[fresh], points, colours, distances)
        self.keys = np.insert(self.keys, places[fresh], keys[fresh])
        self._slots = np.insert(self._slots, places[fresh], slots)

    def _keys_of(self, points: Floats) -> npt.NDArray[np.int64]:
        cells = np.floor(points / self.voxel)
        limit = 1 << (_BITS - 1)
        if not (np.abs(cells) < limit).all():
            raise ValueError(
                f"points: expected them within {limit * self.voxel:g} m of the origin, "
                f"found {points[np.abs(cells).max(axis=1).argmax()]}"
            )
        x, y, z = (cells.astype(np.int64) + limit).T
        return np.asarray(x << 2 * _BITS | y << _BITS | z)

    def _put(
        self,
        slots: npt.NDArray[np.int64],
        chosen: npt.NDArray[np.intp],
        points: Floats,
        colours: Colours,
        distances: Points,
    ) -> None:
        self._points[slots] = points[chosen]
        self._colours[slots] = colours[chosen]
        self._distances[slots] = distances[chosen]

    def _make_room(self, count: int) -> None:
        if count > len(self._points):
            room = max(count, 2 * len(self._points), 4096)
            for name in ("_points", "_colours", "_distances"):
                old = getattr(self, name)
                new = np.empty((room, *old.shape[1:]), old.dtype)
                new[: len(self)] = old[: len(self)]
                setattr(self, name, new)


class Mapper:
    """Builder of a cloud from depth images."""

    def __init__(
        self,
        stride: int,  # given images are every n-th pixel of the camera's
        voxel: float,  # edge of a voxel, metres
        max_depth: float,  # metres, beyond which points are left out
    ) -> None:
        self._rays = functools.lru_cache(maxsize=4)(lambda info: rays_of(info, stride))
        self._max_depth = max_depth
        self._cloud = VoxelCloud(voxel)

    def add(
        self,
        info: CameraInfo,
        depth: npt.NDArray[np.float32],  # metres along the optical z axis, shape (h, w)
        image: npt.NDArray[np.uint8],  # its colours, shape (h, w, 3), or greys, shape (h, w)
        pose: npt.NDArray[np.float64],  # the optical frame in the cloud's, shape (4, 4)
    ) -> int:
        """Add an exposure's points; return the cloud's number of points. May raise `ValueError`."""
        if image.shape[:2] != depth.shape:
            raise ValueError(
                f"image: expected {depth.shape} pixels as of the depth, found {image.shape[:2]}"
            )
        points, seen = back_project(depth, self._rays(info), self._max_depth)
        colours = image[seen] if image.ndim == 3 else np.repeat(image[seen][:, None], 3, axis=1)
        placed = points @ pose[:3, :3].T + pose[:3, 3]
        self._cloud.add(placed, colours, points[:, 2])
        return len(self._cloud)

    def cloud(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint8]]:
        """Return points (metres) and colours, each of shape (n, 3)."""
        return self._cloud.points, self._cloud.colours

    def write(self, path: Path, frame_id: str) -> None:
        """Write the cloud as a PLY file."""
        write_ply(path, self._cloud.points, self._cloud.colours, frame_id)
