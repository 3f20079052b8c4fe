"""Microseconds a ray in a room of triangles, and seconds to build its trees, on one core.

The trees of `sims.ray_casting` beside MuJoCo and, if ``embreex`` is installed, Embree (float32, one
ray at a time as here), in turns: a turn of a lidar of 16 x 1024 rays from places in a bumpy room
with four bodies in it, in 250 meshes, as an imported scan is. Times are of the processor, medians.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from functools import partial
from statistics import median
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from bench.benchmarks import Progress, Row
from bench.harness import paired, silent
from sims.ray_casting import MeshRays, RayHits
from sims.sensors.lidar import LidarSpec, pattern_of

Array = npt.NDArray[Any]

SIZE = np.array([8.0, 6.0, 3.0])  # of the room, metres
PATCHES = 5  # along each side of a surface; a mesh each
CELLS = {100_000: 14, 1_000_000: 45}
"""Squares along a patch's side, by about how many triangles there are then."""
PLACES = np.array([[3.7, 2.9, 1.2], [1.5, 4.5, 1.8], [6.6, 1.2, 0.9]])


def measure(*, rounds: int = 9, progress: Progress = silent) -> list[Row]:
    """Measure rooms of 100,000 and of a million triangles, a number of times from each place."""
    return [_measure_room(cells, rounds, progress) for cells in CELLS.values()]


def _measure_room(cells: int, rounds: int, progress: Progress) -> Row:
    patches = room(cells)
    triangles = sum(len(corners) for _, corners in patches)
    progress(f"{triangles:,} triangles")
    spec = mujoco.MjSpec()
    for number, (points, corners) in enumerate(patches):
        spec.add_mesh(
            name=f"{number}",
            uservert=points.ravel().tolist(),
            userface=corners.ravel().tolist(),
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
        )
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"{number}")
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    ways = np.ascontiguousarray(pattern_of(LidarSpec(name="l"), 0.0).directions.reshape(-1, 3))
    rays, count = MeshRays(model), len(ways)
    wanted = rays.wanted(model, None, -1)
    hits = RayHits(np.empty(count), np.empty(count, np.int32), np.empty((count, 3)))

    def ours(origin: Array) -> None:
        hits.geoms.fill(-1)
        rays.cast(model, data, origin, ways, wanted, hits)

    def mujocos(origin: Array) -> None:
        mujoco.mj_multiRay(
            model, data, origin, ways.ravel(), None, 1, -1, hits.geoms, hits.distances,
            hits.normals.reshape(-1), count, mujoco.mjMAXVAL,
        )  # fmt: skip

    built = {"seconds": _processor(ours, PLACES[0]) / 1e9}
    sides: dict[str, Callable[[Array], object]] = {"ours": ours, "mujoco": mujocos}
    with contextlib.suppress(ImportError):
        sides["embree"], built["embree_seconds"] = _embree(patches, ways)
    taken: dict[str, list[int]] = {name: [] for name in sides}
    for place in PLACES:
        calls = {name: partial(_processor, cast, place) for name, cast in sides.items()}
        for name, times in paired(calls, rounds).items():
            taken[name] += times
    per_ray = {f"{name}_us": median(times) / count / 1e3 for name, times in taken.items()}
    ratio = per_ray["ours_us"] / per_ray["embree_us"] if "embree_us" in per_ray else None
    return {"triangles": triangles, **built, **per_ray, "ratio": ratio}


def _processor(cast: Callable[[Array], object], origin: Array) -> int:
    """Return the processor time of a cast, nanoseconds."""
    begin = time.process_time_ns()
    cast(origin)
    return time.process_time_ns() - begin


def _embree(
    patches: list[tuple[Array, Array]], ways: Array
) -> tuple[Callable[[Array], object], float]:
    """Return a function that casts the rays with Embree, and the seconds of its build."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    begins = np.cumsum([0, *(len(points) for points, _ in patches)])
    points = np.concatenate([points for points, _ in patches])
    corners = np.concatenate(
        [corners + begin for (_, corners), begin in zip(patches, begins[:-1], strict=True)]
    ).astype(np.int32)
    narrow, scene = ways.astype(np.float32), EmbreeScene()

    def cast(origin: Array) -> object:
        origins = np.tile(origin.astype(np.float32), (len(narrow), 1))
        return scene.run(origins, narrow, query="INTERSECT", output=1)

    def build(origin: Array) -> None:
        TriangleMesh(scene, points, corners)
        cast(origin)

    return cast, _processor(build, PLACES[0]) / 1e9


def room(cells: int) -> list[tuple[Array, Array]]:
    """Return points (n, 3) and corners (m, 3) of the patches of six bumpy walls and four bodies."""
    patches = []
    for surface in range(10):
        for i in range(PATCHES):
            for j in range(PATCHES):
                u, v = np.mgrid[: cells + 1, : cells + 1] / cells
                u, v = (u + i) / PATCHES, (v + j) / PATCHES
                shape = _wall(surface, u, v) if surface < 6 else _body(surface - 6, u, v)
                points = np.stack(shape, axis=-1).reshape(-1, 3).astype(np.float32)
                first = np.add.outer(np.arange(cells) * (cells + 1), np.arange(cells)).ravel()
                right, above = first + 1, first + cells + 1
                corners = np.concatenate(
                    [np.stack([first, above, above + 1]).T, np.stack([first, above + 1, right]).T]
                )
                patches.append((points, corners.astype(np.int32)))
    return patches


def _wall(number: int, u: Array, v: Array) -> list[Array]:
    axis, far = divmod(number, 2)
    bump = 0.05 * np.sin(40 * u + axis) * np.sin(37 * v) + 0.01 * np.sin(300 * u) * np.sin(280 * v)
    place = [u, u, u]
    place[axis] = abs(far - abs(bump))
    place[(axis + 2) % 3] = v
    return [part * size for part, size in zip(place, SIZE, strict=True)]


def _body(number: int, u: Array, v: Array) -> list[Array]:
    middle = (
        SIZE * ((0.25, 0.3, 0.5), (0.75, 0.7, 0.3), (0.3, 0.75, 0.2), (0.65, 0.35, 0.6))[number]
    )
    around, down = 2.0 * np.pi * u, np.pi * v
    reach = (0.3 + 0.07 * number) * (1.0 + 0.1 * np.sin(9 * around) * np.sin(7 * down))
    across = reach * np.sin(down)
    return [
        middle[0] + across * np.cos(around),
        middle[1] + across * np.sin(around),
        middle[2] + reach * np.cos(down),
    ]
