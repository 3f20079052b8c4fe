"""A coloured cloud from the images of a camera with depth, put together by its true poses.

A voxel holds the point measured from nearest, never a mean, which at edges lies on no surface;
errors (depth noise, angle, pixel size) grow with the distance. Files are PLY, binary,
little-endian, coloured: G. Turk, "The PLY polygon file format" (1994).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from events import (
    Announcement,
    CameraAnnouncement,
    CameraInfo,
    DepthImage,
    Image,
    Odometry,
    PointCloud,
    PoseStamped,
)
from events.geometry import pose_matrix
from nodes.estimators import WORKER_ENVIRONMENT
from nodes.trajectory_files import part_name
from runtime import Bundle, Duration, Node, NodeConfig, Output, on
from runtime.paths import OutputPath
from runtime.run.results import replacing
from runtime.units import Latency

__all__ = ["Mapping", "MappingConfig"]


class ColourDepthPose(NamedTuple):
    """Image, depth image and camera pose of the same exposure."""

    image: Image
    depth: DepthImage
    pose: PoseStamped


class MappingConfig(NodeConfig):
    """Settings of a cloud.

    Attributes:
        pose: ``matched``: the camera's pose of the depth image's own stamp. ``latest``: the
            vehicle's newest odometry, and the camera's mounting on it: later than the image, so the
            cloud smears.
        voxel: Edge of a voxel, metres: no two points of the cloud share one.
        stride: Take every n-th pixel of every n-th row.
        max_depth: Metres, beyond which points are left out.
        every: Least time between two frames.
        latency: Run-clock seconds of a frame's mapping; others meanwhile are skipped.
        rate: Clouds to send a second, at most; 0: only the one at the end.
        file: In the run's folder; empty for ``clouds/<name>.ply``.
    """

    pose: Literal["matched", "latest"] = "matched"
    voxel: Annotated[float, msgspec.Meta(ge=0.001)] = 0.05
    stride: Annotated[int, msgspec.Meta(ge=1)] = 2
    max_depth: Annotated[float, msgspec.Meta(gt=0)] = 10.0
    every: Duration = Duration(0.1)  # immutable
    latency: Latency = Latency(0.03)
    rate: Annotated[float, msgspec.Meta(ge=0)] = 0.0
    file: OutputPath = ""


class Mapping(Node[MappingConfig]):
    """A coloured cloud of the world, from depth images and the true poses."""

    reads_truth = "mapping"
    frames = Bundle(ColourDepthPose, keep="latest")
    clouds = Output(PointCloud)

    def __init__(self) -> None:
        self._camera: CameraAnnouncement | None = None
        self._vehicle: Odometry | None = None  # the newest
        self._frame_id = "map"
        self._stamp = 0
        self._used = 0

    async def on_startup(self) -> None:
        """Start the worker process of the cloud; a thread would hold Python's lock too often."""
        config = self.config
        self._mapper = await self.worker(
            Mapper,
            config.stride,
            config.voxel,
            config.max_depth,
            latency=config.latency,
            env=WORKER_ENVIRONMENT,
        )

    def on_announcement(self, announcement: Announcement) -> None:
        """Take the first camera with depth and colours, or the camera named in the file."""
        if not isinstance(announcement, CameraAnnouncement) or self._camera is not None:
            return
        named, gives = self.sources.get("frames"), {*announcement.images}
        if named not in (None, announcement.source):
            return
        if not ("depth" in gives and gives & {"rgb", "grey"}):
            if named is None:
                return
            raise ValueError(
                f"expected a camera with depth and rgb (or grey) images, found one with "
                f"{', '.join(announcement.images)}"
            )
        self._camera = announcement
        self.narrow("frames", announcement.source)

    def check(self) -> Iterable[str]:
        """Yield an error if no camera gives depth and colours."""
        if self._camera is None:
            yield self._lacking()

    @on(Odometry)
    def odometry(self, event: Odometry) -> None:
        """Keep the newest odometry of the camera's vehicle."""
        camera, before = self._camera, self._vehicle
        if camera is not None and camera.source.startswith(f"{event.source}/"):
            self._frame_id = event.frame_id
            if event.child_frame_id == camera.parent_frame_id and (
                before is None or event.stamp >= before.stamp
            ):
                self._vehicle = event

    async def run(self) -> None:
        """Add frames to the cloud."""
        config, camera, mapper = self.config, self._the_camera(), self._mapper
        every, between = round(config.every * 1e9), 1e9 / config.rate if config.rate else math.inf
        due, cloud_due = 0, 0.0 if config.rate else math.inf
        pixels = slice(None, None, config.stride)
        async for image, depth, pose in self.frames:
            placed = self._placed(camera, pose)
            if image.stamp < due or placed is None:
                continue
            due = image.stamp + every
            await mapper.call(
                Mapper.add,
                camera.info,
                np.ascontiguousarray(depth.data[pixels, pixels]),
                np.ascontiguousarray(image.data[pixels, pixels]),
                placed,
            )
            self._stamp = image.stamp
            self._used += 1
            if image.stamp >= cloud_due:
                cloud_due = image.stamp + between
                await self._send()

    def _lacking(self) -> str:
        named = self.sources.get("frames")
        return (
            "expected a camera with depth and rgb (or grey) images"
            f"{f' called {named}' if named else ''}, found none announced"
        )

    def _the_camera(self) -> CameraAnnouncement:
        if self._camera is None:
            self.log.fatal("%s", self._lacking())
        return self._camera

    def _placed(
        self, camera: CameraAnnouncement, pose: PoseStamped
    ) -> npt.NDArray[np.float64] | None:
        """Return where the settings take the camera to be, shape (4, 4); `None` if not known."""
        if self.config.pose == "matched":
            self._frame_id = pose.frame_id
            return pose_matrix(pose.position, pose.orientation)
        if (vehicle := self._vehicle) is None:  # it has not said where it is
            return None
        mounting = pose_matrix(camera.position, camera.orientation)
        return pose_matrix(vehicle.position, vehicle.orientation) @ mounting

    async def _send(self) -> int:
        points, colours = await self._mapper.call_for(0.0, Mapper.cloud)
        self.clouds.send(
            PointCloud(
                stamp=self._stamp,
                source=self.name,
                frame_id=self._frame_id,
                points=points,
                colors=colours,
            )
        )
        return len(points)

    async def on_shutdown(self) -> None:
        """Write and send the final cloud."""
        if not self._used:
            self.log.warning("no frame came: there is no cloud")
            return
        if self.out is not None:
            path = self.out / part_name(self, self.config.file or f"clouds/{self.name}.ply")
            await self._mapper.call_for(0.0, Mapper.write, path, self._frame_id)
        self.log.info("%d points from %d frames", await self._send(), self._used)


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
    expected, size = start + count * kind.itemsize, path.stat().st_size
    if size < expected:
        raise ValueError(f"expected {count} points in {expected} bytes, found {size} bytes")
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
