"""Ray casting in a model: meshes by trees of the compiled library, all other geoms by MuJoCo.

MuJoCo's own time for a ray grows with the triangles of a mesh; that of a tree hardly does. Without
meshes among the wanted geoms, or without the library, all is MuJoCo's. Both obey the same rules
(`mujoco.mj_multiRay`): geoms of alpha 0 are passed through, triangles are met from both sides, and
a normal is that of the triangle's winding. Texels are not looked at: what a texture's alpha masks
out, and what is see-through, is met as if it were solid.
"""

from __future__ import annotations

import ctypes
import weakref
from typing import Any, ClassVar, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from sims.compiled import libraries

Floats = npt.NDArray[np.float64]
Groups = npt.NDArray[np.uint8]

_MESH = mujoco.mjtGeom.mjGEOM_MESH
_FIRST = np.array([1, 0, 0, 0, 0, 0], np.uint8)


class RayHits(NamedTuple):
    """What rays from a common origin meet first.

    Attributes:
        distances: In lengths of the directions; -1 for those that meet nothing. Shape (n,).
        geoms: Numbers of the geoms, or -1. Shape (n,).
        normals: Unit vectors of the surfaces, shape (n, 3); zeros where nothing is met.
    """

    distances: Floats
    geoms: npt.NDArray[np.int32]
    normals: Floats


def cast_rays(
    model: Any,
    data: Any,
    origin: Floats,
    directions: Floats,
    groups: Groups | None = None,
    body: int = -1,
) -> RayHits:
    """Cast rays from a point, shape (3,), along vectors, (n, 3), in the world's axes (metres).

    Args:
        data: With the positions of the geoms computed.
        groups: For each of MuJoCo's six groups of geoms, 1 if rays meet it; `None`: all.
        body: Number of a body whose geoms rays pass through.
    """
    count = len(directions)
    hits = RayHits(np.full(count, -1.0), np.full(count, -1, np.int32), np.zeros((count, 3)))
    origin = np.ascontiguousarray(origin, np.float64)
    directions = np.ascontiguousarray(directions, np.float64)
    meshes = MeshRays.of(model)
    wanted = meshes.wanted(model, groups, body)
    if not wanted.any():
        _cast_by_mujoco(model, data, origin, directions, groups, body, hits)
        return hits
    shown = _in_groups(model.geom_group, groups)
    shown[meshes.geoms] = False
    if shown.any():
        before = model.geom_group.copy()
        model.geom_group[:] = ~shown
        try:
            _cast_by_mujoco(model, data, origin, directions, _FIRST, body, hits)
        finally:
            model.geom_group[:] = before
    meshes.cast(model, data, origin, directions, wanted, hits)
    return hits


def cast_ray(
    model: Any,
    data: Any,
    origin: Floats,
    direction: Floats,
    groups: Groups | None = None,
    body: int = -1,
) -> tuple[float, int]:
    """Return distance and geom of what a single ray meets, both -1 for nothing (`cast_rays`)."""
    meshes = MeshRays.of(model)
    if not meshes.wanted(model, groups, body).any():
        hit = np.zeros(1, np.int32)
        distance = mujoco.mj_ray(model, data, origin, direction, groups, 1, body, hit)
        return float(distance), int(hit[0])
    hits = cast_rays(model, data, origin, direction[None], groups, body)
    return float(hits.distances[0]), int(hits.geoms[0])


def _cast_by_mujoco(
    model: Any,
    data: Any,
    origin: Floats,
    directions: Floats,
    groups: Groups | None,
    body: int,
    hits: RayHits,
) -> None:
    mujoco.mj_multiRay(
        model,
        data,
        origin,
        directions.ravel(),
        groups,
        1,
        body,
        hits.geoms,
        hits.distances,
        hits.normals.reshape(-1),
        len(directions),
        mujoco.mjMAXVAL,  # nothing less: a plane whose middle is farther would not be met
    )


def _in_groups(group: npt.NDArray[np.int32], groups: Groups | None) -> npt.NDArray[np.bool_]:
    if groups is None:
        return np.ones(len(group), np.bool_)
    return np.asarray(groups[np.clip(group, 0, len(groups) - 1)] != 0)


def met_by_trees(model: Any) -> npt.NDArray[np.bool_]:
    """Return a mask of the geoms that are not left to MuJoCo, shape (ngeom,)."""
    return np.asarray((model.geom_type == _MESH) & bool(libraries()))


class MeshRays:
    """Trees over the triangles of a model's mesh geoms, built at the first cast that wants them.

    Geoms that are fixed to the world share one tree, in which they are where they stand at first;
    each mesh of those that move has a tree of its own. The hit does not depend on the trees, and is
    the same to the bit for every instruction set: computed in double, and of hits at the same
    distance that of the lowest geom and triangle. Triangles that share an edge leave no gap, also
    if they are of two meshes whose corners were rounded apart. Left out are triangles without an
    area, or with a corner beyond 1e10 m.

    Args:
        instructions: One of `libraries`; the quickest by default.
    """

    _of_models: ClassVar[weakref.WeakKeyDictionary[Any, MeshRays]] = weakref.WeakKeyDictionary()

    def __init__(self, model: Any, instructions: str = "") -> None:
        self._library: Any = libraries().get(instructions or next(iter(libraries()), ""))
        self.geoms = np.flatnonzero(met_by_trees(model))
        self._trees: ctypes.c_void_p | None = None

    @classmethod
    def of(cls, model: Any) -> MeshRays:
        """Return those of a model, the same ones each time."""
        rays = cls._of_models.get(model)
        if rays is None:
            rays = cls._of_models[model] = cls(model)
        return rays

    def wanted(self, model: Any, groups: Groups | None, body: int) -> npt.NDArray[np.bool_]:
        """Return a mask of `geoms`: those that rays meet now by MuJoCo's rules."""
        geoms = self.geoms
        if not geoms.size:
            return np.zeros(0, np.bool_)
        opaque = model.geom_rgba[geoms, 3] != 0.0
        if model.nmat:
            material = model.geom_matid[geoms]
            opaque = np.where(material >= 0, model.mat_rgba[material, 3] != 0.0, opaque)
        in_groups = _in_groups(model.geom_group[geoms], groups)
        return np.asarray(opaque & in_groups & (model.geom_bodyid[geoms] != body))

    def cast(
        self,
        model: Any,
        data: Any,
        origin: Floats,
        directions: Floats,
        wanted: npt.NDArray[np.bool_],
        hits: RayHits,
        triangles: npt.NDArray[np.int32] | None = None,
    ) -> None:
        """Replace hits by those of wanted geoms that are nearer; arrays are contiguous.

        Args:
            triangles: Filled in with numbers in the meshes, -1 where no mesh is met; shape (n,).
        """
        if self._trees is None:
            self.build(model)
        self._library.rays_cast(
            self._trees, _at(data.geom_xpos), _at(data.geom_xmat), _at(wanted), _at(origin),
            len(directions), _at(directions), _at(hits.distances), _at(hits.geoms),
            _at(hits.normals), _at(triangles),
        )  # fmt: skip

    def build(self, model: Any) -> None:
        """Build the trees with all geoms where they are at first; the first cast does it, too."""
        if not self.geoms.size:
            return
        library = self._library
        trees = ctypes.c_void_p(library.rays_new())
        weakref.finalize(self, library.rays_free, trees)
        meshes = model.geom_dataid[self.geoms]
        numbers = {}
        for mesh in np.unique(meshes).tolist():
            vertices, faces = (
                getattr(model, f"mesh_{name}")[begin : begin + count]
                for name, begin, count in (
                    ("vert", model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]),
                    ("face", model.mesh_faceadr[mesh], model.mesh_facenum[mesh]),
                )
            )
            numbers[mesh] = library.rays_mesh(
                trees, len(vertices), _at(vertices), len(faces), _at(faces)
            )
        data: Any = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        geoms = self.geoms.astype(np.int32)
        shapes = np.array([numbers[mesh] for mesh in meshes.tolist()], np.int32)
        moves = model.body_weldid[model.geom_bodyid[geoms]] != 0
        library.rays_build(
            trees, len(geoms), _at(geoms), _at(shapes), _at(moves),
            _at(data.geom_xpos), _at(data.geom_xmat),
        )  # fmt: skip
        self._trees = trees


def _at(array: npt.NDArray[Any] | None) -> ctypes.c_void_p:
    return ctypes.c_void_p(None if array is None else array.ctypes.data)
