"""A world as the rasteriser draws it, prepared once and shared by all processes that draw it.

Triangles with what is known of them, and textures in all sizes, are arrays that the rasteriser
reads where they are. `pack` puts them into a file in memory, which each process maps to read it;
beside it a model for the places of things, without the vertices and texels that are drawn. The file
has no name: the last process to end, however it ends, leaves nothing behind.
"""

from __future__ import annotations

import contextlib
import math
import mmap
import os
import pickle
import sys
import tempfile
import weakref
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from sims.cameras.layouts import CLUSTER, address
from sims.cameras.meshes import Mesh, mesh_of, shape_of
from sims.cameras.texels import Image, TexturePlace, fill, places_of

_Kind = mujoco.mjtGeom
Array = npt.NDArray[Any]
Empty = Callable[[tuple[int, ...], Any], Array]
"""Makes an array of a shape and type, with whatever is in it."""

DRAWN_GROUPS = 3  # of geoms: the first ones
MOST_TRIANGLES = 1 << 24  # of all geoms: the rasteriser numbers them with 24 bits
_ALIGNED = 64  # bytes between the beginnings of arrays
_SLAB = 1 << 25  # bytes of a file that are mapped at a time, at least, to be written
NONE: Mapping[str, Image] = {}


class PreparedMesh(NamedTuple):
    """Mesh as the rasteriser takes it: as `meshes.Mesh`, and what it has found out about it."""

    points: Array
    normals: Array
    places: Array
    colours: Array | None
    corners: Array
    parts: Array  # of each triangle: number of the surface without a crease, shape (m,)
    part_count: int
    beyond: Array  # of each edge: first corner of the triangle beyond it, or -1, shape (m, 3)
    clusters: Array  # of triangles side by side


class Drawable(NamedTuple):
    """What the rasteriser draws of a model."""

    texels: npt.NDArray[np.uint32]
    textures: list[TexturePlace | None]
    meshes: list[tuple[PreparedMesh, PreparedMesh | None]]  # with a plane its other side
    mesh_of_geom: list[int]  # number of the mesh of each geom that is drawn


def prepare(
    model: Any, library: Any, images: Mapping[str, Image] = NONE, empty: Empty = np.empty
) -> Drawable:
    """Return what the rasteriser draws of a model.

    Args:
        library: The rasteriser.
        images: Images of textures of which the model has the name alone.
        empty: Makes the arrays.

    Raises:
        ValueError: The model has geoms that are not drawn, or more texels or triangles than have
            room.
    """
    textures, count = places_of(model, library, images)
    texels = empty((count,), np.uint32)
    fill(texels, model, library, images, textures)
    meshes: list[tuple[PreparedMesh, PreparedMesh | None]] = []
    numbers: dict[Any, int] = {}
    mesh_of_geom = []
    triangles = 0
    for geom in np.flatnonzero(model.geom_group < DRAWN_GROUPS).tolist():
        shape = shape_of(model, geom)
        if shape not in numbers:
            numbers[shape] = len(meshes)
            mesh = mesh_of(model, *shape)
            behind = None
            if shape[0] == _Kind.mjGEOM_PLANE:
                behind = _prepared(mesh.turned(), library, empty)
            meshes.append((_prepared(mesh, library, empty), behind))
        mesh_of_geom.append(numbers[shape])
        triangles += len(meshes[numbers[shape]][0].corners)
    if triangles >= MOST_TRIANGLES:
        raise ValueError(
            f'renderer = "raster": expected geoms of fewer than {MOST_TRIANGLES} triangles in '
            f'all, found {triangles}; "mujoco" draws them'
        )
    return Drawable(texels, textures, meshes, mesh_of_geom)


def _prepared(mesh: Mesh, library: Any, empty: Empty) -> PreparedMesh:
    def kept(values: Array) -> Array:
        array = empty(values.shape, values.dtype)
        array[...] = values
        return array

    points, normals, corners = kept(mesh.points), kept(mesh.normals), kept(mesh.corners)
    count = len(corners)
    parts, beyond = empty((count,), np.int32), empty((count, 3), np.int32)
    clusters = empty((int(library.raster_cluster_count(count)),), CLUSTER)
    part_count = int(
        library.raster_find(
            len(points), address(points), address(normals), count, address(corners),
            address(parts), address(beyond), address(clusters),
        )
    )  # fmt: skip
    colours = None if mesh.colours is None else kept(mesh.colours)
    return PreparedMesh(
        points, normals, kept(mesh.places), colours, corners, parts, part_count, beyond, clusters
    )


class Packed:
    """World for the renderers of other processes; pickled, it is the way to the shared file.

    Attributes:
        drawable: What the rasteriser draws; None for another renderer.
    """

    def __init__(self, model: Array, drawable: Drawable | None, file: SharedFile | None) -> None:
        self._model, self.drawable, self._file = model, drawable, file

    def model(self) -> Any:
        """Return the model; where `drawable` is, perhaps without vertices and texels."""
        return mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": self._model.tobytes()})

    def __reduce__(self) -> Any:
        """Return the file's path, and where in it the arrays are."""
        assert self._file is not None
        buffers: list[pickle.PickleBuffer] = []
        body = pickle.dumps((self._model, self.drawable), 5, buffer_callback=buffers.append)
        return _opened, (self._file.path, body, [self._file.span(buffer) for buffer in buffers])


def _opened(path: str, body: bytes, spans: list[tuple[int, int]]) -> Packed:
    """Return a world in a file of another process."""
    fd = os.open(path, os.O_RDONLY)
    try:
        memory = memoryview(mmap.mmap(fd, 0, prot=mmap.PROT_READ))
    finally:
        os.close(fd)
    buffers = [memory[offset : offset + size] for offset, size in spans]
    model, drawable = pickle.loads(body, buffers=buffers)  # noqa: S301  # of the run's process
    return Packed(model, drawable, None)


def pack(model: Any, library: Any = None, drawn: Any = None, images: Any = NONE) -> Packed:
    """Return a world for other processes.

    Args:
        model: What the renderers take from it: all, or without vertices and texels.
        library: The rasteriser; without it, another renderer draws.
        drawn: The whole model; `model` by default.
        images: As for `prepare`.

    Raises:
        ValueError: As `prepare`.
    """
    file = SharedFile()
    size = mujoco.mj_sizeModel(model)
    packed = file.empty((size,), np.uint8)
    mujoco.mj_saveModel(model, None, packed)
    drawable = None
    if library is not None:
        drawable = prepare(model if drawn is None else drawn, library, images, file.empty)
    return Packed(packed, drawable, file)


class SharedFile:
    """Memory for arrays, which other processes can open by its path while this object is there.

    On Linux it has no name but this process's descriptor; elsewhere it is a temporary file, deleted
    at the end.
    """

    def __init__(self) -> None:
        if sys.platform == "linux":
            self._fd = os.memfd_create("visnav-world", os.MFD_CLOEXEC)
            self.path = f"/proc/{os.getpid()}/fd/{self._fd}"
        else:
            self._fd, self.path = tempfile.mkstemp(prefix="visnav-world-")
            weakref.finalize(self, Path(self.path).unlink, missing_ok=True)
        weakref.finalize(self, os.close, self._fd)
        self._size = 0  # of the file
        self._slabs: list[tuple[int, int, mmap.mmap]] = []  # address, place in the file, memory
        self._used = 0  # of the last slab

    def empty(self, shape: tuple[int, ...], dtype: Any) -> Array:
        """Return a new array in the file, its elements 0."""
        dtype = np.dtype(dtype)
        size = math.prod(shape) * dtype.itemsize
        start = -(-self._used // _ALIGNED) * _ALIGNED
        if not self._slabs or start + size > len(self._slabs[-1][2]):
            self._grow(size)
            start = 0
        memory = self._slabs[-1][2]
        self._used = start + size
        return np.ndarray(shape, dtype, memory, start)

    def _grow(self, size: int) -> None:
        place, length = self._size, -(-max(size, _SLAB) // mmap.PAGESIZE) * mmap.PAGESIZE
        self._size += length  # pages cost nothing before they are used
        os.ftruncate(self._fd, self._size)
        memory = mmap.mmap(self._fd, length, offset=place)
        self._slabs.append((np.frombuffer(memory, np.uint8).ctypes.data, place, memory))

    def span(self, buffer: pickle.PickleBuffer) -> tuple[int, int]:
        """Return where in the file an array of it is: offset and size in bytes."""
        data = np.frombuffer(buffer.raw(), np.uint8)
        for address_, place, memory in self._slabs if data.size else ():
            if 0 <= data.ctypes.data - address_ < len(memory):
                return data.ctypes.data - address_ + place, data.size
        return 0, 0


_CORNERS = ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))
_FACES = ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))


def without_looks(spec: Any, model: Any) -> Any:
    """Return a model in which all is where it is in another, without vertices and texels.

    Args:
        spec: Made the other model; not to be used afterwards.

    Returns:
        `model` itself where this cannot be done.
    """
    if len(spec.meshes) != model.nmesh or len(spec.textures) != model.ntex:
        return model
    names = [mesh.name for mesh in spec.meshes]
    for mesh in list(spec.meshes):  # MuJoCo does not compile one anew with another number of faces
        spec.delete(mesh)
    for number, name in enumerate(names):
        has_places = int(model.mesh_texcoordadr[number]) >= 0
        places = {"usertexcoord": np.zeros(2 * len(_CORNERS))} if has_places else {}
        spec.add_mesh(name=name, uservert=np.ravel(_CORNERS), userface=np.ravel(_FACES), **places)
    for texture in spec.textures:
        sides = 1 if texture.type == mujoco.mjtTexture.mjTEXTURE_2D else 6
        texture.file, texture.cubefiles = "", [""] * 6
        texture.builtin = mujoco.mjtBuiltin.mjBUILTIN_NONE
        texture.width, texture.height = 1, sides
        texture.data = bytes(sides * texture.nchannel)
    try:
        lean = spec.compile()
    except ValueError:
        return model
    return lean if _copied(model, lean) else model


def _copied(model: Any, lean: Any) -> bool:
    """Copy all but looks to another model, if that has the same names; return whether it has."""
    if bytes(model.names) != bytes(lean.names):
        return False
    for name in dir(model):
        if name.startswith(("_", "mesh_", "tex_")) or "bvh" in name:
            continue
        value, place = getattr(model, name), getattr(lean, name)
        if isinstance(value, np.ndarray) and value.shape == place.shape:
            with contextlib.suppress(ValueError):  # read-only
                place[...] = value
    for name in ("center", "extent", "meaninertia", "meanmass", "meansize"):
        setattr(lean.stat, name, getattr(model.stat, name))
    return True
