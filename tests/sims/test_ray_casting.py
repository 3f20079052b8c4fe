"""Rays that meet meshes: as all triangles tried in turn, as MuJoCo, the same bits everywhere."""

from __future__ import annotations

import gc
import itertools
import weakref
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from events import Vector3
from sims.cameras.renderer import model_to_bytes
from sims.carried.clearance import Clearance as CarriedClearance
from sims.compiled import libraries
from sims.ray_casting import MeshRays, RayHits, cast_ray, cast_rays
from sims.sensors.lidar import LidarSpec, Scanner
from sims.sensors.rays import DRAWN, Rays
from sims.vehicle import attach_vehicle
from sims.vehicle.autopilot import Clearance
from sims.worlds import Dynamics
from tests.sims.triangles import Met, meet

Floats = npt.NDArray[np.float64]
Points = npt.NDArray[np.float32]
Corners = npt.NDArray[np.int32]

MESH = mujoco.mjtGeom.mjGEOM_MESH
pytestmark = pytest.mark.skipif(not libraries(), reason="needs the compiled library")


def torus(around: int, across: int, thick: float = 0.4) -> tuple[Points, Corners]:
    """Return points (n, 3) and corners (m, 3) of a closed surface, of radius 1."""
    i, j = (part.ravel() for part in np.mgrid[:around, :across])
    a, b = 2.0 * np.pi * i / around, 2.0 * np.pi * j / across
    reach = 1.0 + thick * np.cos(b)
    points = np.stack([reach * np.cos(a), reach * np.sin(a), thick * np.sin(b)], axis=1)
    right, up = (i + 1) % around, (j + 1) % across
    corners = np.concatenate(
        [
            np.stack([i * across + j, right * across + j, right * across + up], axis=1),
            np.stack([i * across + j, right * across + up, i * across + up], axis=1),
        ]
    )
    return points.astype(np.float32), corners.astype(np.int32)


def tried(points: Floats, corners: Corners, origin: Floats, ways: Floats, wider: float) -> Floats:
    """Return distances from a point to the nearest of all triangles, grown by a share of each.

    Made smaller, they are only those that are not seen from their edges.
    """
    nearest, lengths = np.full(len(ways), np.inf), np.linalg.norm(ways, axis=1)
    for a, b, c in points[corners]:
        along, over, away = b - a, c - a, origin - a
        across = np.cross(ways, over)
        with np.errstate(divide="ignore", invalid="ignore"):
            volume = across @ along
            scale = 1.0 / volume
            u = (across @ away) * scale
            v = (ways @ np.cross(away, along)) * scale
            t = (over @ np.cross(away, along)) * scale
            inside = (u >= -wider) & (v >= -wider) & (u + v <= 1.0 + wider) & (t >= -wider)
            if wider < 0.0:
                inside &= abs(volume) > 1e-5 * lengths * area(along, over)
        nearest = np.where(inside & (t < nearest), t, nearest)
    return nearest


def area(along: Floats, over: Floats) -> float:
    return float(np.linalg.norm(np.cross(along, over)))


def directions(
    random: np.random.Generator, points: Points, corners: Corners, origin: Floats, count: int
) -> Floats:
    """Return a fifth each: in all directions, along axes or planes, to corners, edges, surfaces."""
    everywhere = random.standard_normal((count // 5, 3))
    along = np.where(random.random((count // 5, 3)) < 0.5, 0.0, random.standard_normal((1, 3)))
    along[~along.any(axis=1)] = (0.0, 0.0, -1.0)
    triangles = points.astype(np.float64)[corners[random.integers(0, len(corners), count // 5)]]
    share = random.random((count // 5, 1))
    aimed = [
        triangles[:, 0],
        triangles[:, 0] * share + triangles[:, 1] * (1.0 - share),
        triangles[:, 0] * 0.5 + (triangles[:, 1] * share + triangles[:, 2] * (1.0 - share)) * 0.5,
    ]
    ways = np.concatenate([everywhere, along, *(to - origin for to in aimed)])
    return np.asarray(ways * random.uniform(0.1, 10.0, (len(ways), 1)))


def test_the_nearest_of_all_triangles_is_met() -> None:
    """100,000 rays from outside, inside, on a surface, in a corner; also to edges and corners."""
    random = np.random.default_rng(51)
    points, corners = torus(6, 4)
    # Triangles without an area, and needles, beside them.
    corners = np.concatenate([corners, [[0, 0, 1], [3, 3, 3], [0, 1, 2]], corners[::-7, [1, 0, 2]]])
    corners = corners.astype(np.int32)
    exact = points.astype(np.float64)
    surface = exact[corners[4]].mean(axis=0)
    library = next(iter(libraries().values()))
    inside, outside, before = [1.0, 0.0, 0.0], [-50.0, 0.0, 0.0], surface * (1.0 + 1e-9)
    somewhere = random.uniform(-2.0, 2.0, (3, 3))
    for origin in (*somewhere, np.array(inside), surface, before, exact[0], np.array(outside)):
        ways = directions(random, points, corners, origin, 12_500)
        met = meet(library, points, corners, origin, ways)
        distances = np.where(met.triangles < 0, np.inf, met.distances)
        # A share of 2e-6 is more than the rounding of corners by which edges count wider.
        assert (distances >= tried(exact, corners, origin, ways, 3e-6) - 1e-6).all()
        assert (distances <= tried(exact, corners, origin, ways, -1e-12) + 1e-9).all()
        there = met.triangles >= 0
        assert there.mean() > 0.5
        plane = exact[corners[met.triangles[there]]]
        normals = np.cross(plane[:, 1] - plane[:, 0], plane[:, 2] - plane[:, 0])
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        np.testing.assert_allclose(met.normals[there], normals, atol=1e-12)


@pytest.mark.parametrize("middle", [(0.0, 0.0, 0.0), (5000.0, -3000.0, 100.0)])
def test_far_from_the_middle_of_the_world_rounding_leaves_nothing_out(middle: Vector3) -> None:
    """Triangles of a millimetre, or the eye, at kilometres: there, floats are half of one apart."""
    random = np.random.default_rng(9)
    points, corners = torus(6, 4)
    points = points * np.float32(0.004)
    turns = np.linalg.qr(random.standard_normal((3, 3, 3)))[0]
    places = np.array(middle) + random.uniform(-0.01, 0.01, (3, 3))
    exact = np.concatenate(
        [points.astype(np.float64) @ turn.T + at for turn, at in zip(turns, places, strict=True)]
    )
    everything = np.concatenate([corners + len(points) * k for k in range(len(places))])
    for origin in (places[0], places[0] + (0.05, 0.02, 0.01), np.array([5000.0003, 20.0, 5.0])):
        ways = directions(random, exact, everything, origin, 500)
        distances = tried(exact, everything, origin, ways, -1e-9)
        for moves, library in itertools.product((0, 2), libraries().values()):
            met = meet(library, points, corners, origin, ways, places, turns, moves=moves)
            there = np.where(met.geoms < 0, np.inf, met.distances)
            assert (there <= distances * (1.0 + 1e-6)).all()


def test_beside_a_needle_its_plane_is_not_met() -> None:
    """It rises a metre in a nanometre, and the ray passes by 50 of them: it is met at its edge, at
    1.25 m, or not at all."""
    points = np.array([[0, 0, 1], [1, 0, 2], [0.5, 1e-9, 2.5]], np.float32)
    corners = np.array([[0, 1, 2]], np.int32)
    origin, ways = np.array([0.25, 5e-8, 0.0]), np.array([[0.0, 0.0, 1.0]])
    for library in libraries().values():
        met = meet(library, points, corners, origin, ways)
        assert met.geoms[0] == -1 or met.distances[0] == pytest.approx(1.25, abs=0.01)


def test_all_builds_give_the_same_bits() -> None:
    random = np.random.default_rng(1)
    points, corners = torus(40, 20)
    turns = np.linalg.qr(random.standard_normal((30, 3, 3)))[0]
    places = random.uniform(-4.0, 4.0, (30, 3))
    ways = directions(random, points, corners, places[0], 2000)
    for moves in (0, 20):
        bits = {
            b"".join(
                part.tobytes()
                for part in meet(
                    library, points, corners, np.zeros(3), ways, places, turns, moves=moves
                )
            )
            for library in libraries().values()
        }
        assert len(bits) == 1
    # What moves is met where it would be met if it stood there.
    library = next(iter(libraries().values()))
    still, moved = (
        meet(library, points, corners, np.zeros(3), ways, places, turns, moves=moves)
        for moves in (0, 30)
    )
    for one, other in zip(still, moved, strict=True):
        np.testing.assert_array_equal(one, other)


def test_no_ray_slips_between_meshes_that_share_an_edge() -> None:
    """Of a closed surface in 12 pieces: MuJoCo turns and rounds the corners of each on its own."""
    random = np.random.default_rng(7)
    points = random.standard_normal((200, 3))
    points = (points / np.linalg.norm(points, axis=1)[:, None] + 30.0).astype(np.float32)
    corners = ConvexHull(points).simplices
    spec = mujoco.MjSpec()
    for number, piece in enumerate(np.array_split(corners, 12)):
        own, mapped = np.unique(piece, return_inverse=True)
        add_mesh(spec, f"m{number}", points[own], mapped)
        spec.worldbody.add_geom(type=MESH, meshname=f"m{number}")
    model, data = compiled(spec)
    origin = np.full(3, 30.0)
    ends = points[corners[random.integers(0, len(corners), 20_000)]].astype(np.float64)
    share = random.random((len(ends), 1))
    aimed = ends[:, 0] * share + ends[:, 1] * (1.0 - share)
    hits = cast_rays(model, data, origin, aimed - origin)
    assert hits.distances == pytest.approx(np.ones(len(aimed)), abs=1e-5)


def add_mesh(spec: Any, name: str, points: Points, corners: Any) -> None:
    spec.add_mesh(
        name=name,
        uservert=points.ravel().tolist(),
        userface=np.asarray(corners).ravel().tolist(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )


def compiled(spec: Any) -> tuple[Any, Any]:
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return model, data


BODY: dict[str, Any] = {"mass": 1.0, "inertia": [1.0, 1.0, 1.0], "explicitinertial": True}


def crowded(seed: int) -> Any:
    """Return a world of meshes, of all groups, still and moving, some not visible, and a box."""
    random = np.random.default_rng(seed)
    spec = mujoco.MjSpec()
    add_mesh(spec, "ring", *torus(16, 8))
    add_mesh(spec, "knot", *torus(7, 3, 0.7))
    spec.add_material(name="clear", rgba=[1.0, 1.0, 1.0, 0.0])
    spec.add_material(name="solid", rgba=[1.0, 1.0, 1.0, 1.0])
    for number in range(24):
        turn = random.standard_normal(4)
        place = {"pos": random.uniform(-3.0, 3.0, 3), "quat": turn / np.linalg.norm(turn)}
        parent = spec.worldbody
        if number % 2:
            parent, place = parent.add_body(name=f"b{number}", **BODY, **place), {}
            parent.add_freejoint()
        geom = parent.add_geom(
            type=MESH, meshname=("ring", "knot")[number % 3 == 0], group=number % 7, **place
        )
        geom.rgba[3] = float(number % 5 != 0)
        geom.material = ("", "clear", "solid", "")[number // 3 % 4]
    size = {"size": [1.0, 1.0, 1.0], "pos": [3.0, 0.0, 0.0]}
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, **size)
    return spec


GROUPS = (None, DRAWN, np.array([0, 1, 0, 0, 0, 1], np.uint8), np.zeros(6, np.uint8))


@pytest.mark.parametrize("seed", range(4))
def test_it_is_as_mujoco_has_it(seed: int) -> None:
    """Also for each set of groups, and an excluded body; what moves is met where it is."""
    random = np.random.default_rng(seed)
    model, data = compiled(crowded(seed))
    count, groups, body = 200, GROUPS[seed], 5 if seed % 2 else -1
    for _ in range(2):
        data.qpos[:] = random.uniform(-2.0, 2.0, model.nq)
        mujoco.mj_normalizeQuat(model, data.qpos)
        mujoco.mj_kinematics(model, data)
        origin, ways = random.uniform(-2.0, 2.0, 3), random.standard_normal((count, 3))
        hits = cast_rays(model, data, origin, ways, groups, body)
        geoms, distances, normals = np.empty((count, 1), np.int32), [], np.empty((count, 3))
        for way, geom, normal in zip(ways, geoms, normals, strict=True):
            distances.append(mujoco.mj_ray(model, data, origin, way, groups, 1, body, geom, normal))
        np.testing.assert_array_equal(hits.geoms, geoms[:, 0])
        np.testing.assert_allclose(hits.distances, distances, rtol=1e-9)
        np.testing.assert_allclose(hits.normals, normals, atol=1e-9)
        single = cast_ray(model, data, origin, ways[0], groups, body)
        assert single == (hits.distances[0], hits.geoms[0])
        assert len(set(hits.geoms.tolist())) > 3 or groups is GROUPS[3]


def test_of_surfaces_at_one_place_the_lowest_number_is_met() -> None:
    points, corners = torus(9, 5)
    both = np.concatenate([corners, corners])
    ways = np.random.default_rng(3).standard_normal((500, 3))
    places = np.zeros((3, 3))
    for moves in range(4):
        for library in libraries().values():
            met = meet(library, points, both, np.zeros(3), ways, places, moves=moves)
            assert (met.triangles < len(corners)).all()
            assert (met.geoms[met.triangles >= 0] == 0).all()


def test_numbers_that_are_none_are_met_by_nothing() -> None:
    points, corners = torus(9, 5)
    fine = meet(next(iter(libraries().values())), points, corners, np.zeros(3), np.eye(3))
    spoilt = np.concatenate([points, np.array([[np.nan] * 3, [np.inf] * 3, [3e38] * 3])])
    spoilt = spoilt.astype(np.float32)
    more = np.concatenate([corners, [[45, 0, 1], [0, 46, 1], [47, 0, 1]]]).astype(np.int32)
    odd = [(np.nan, 0.0, 1.0), (0.0, 0.0, 0.0), (np.inf, 0.0, 0.0), (1e300, 0.0, 0.0)]
    for library in libraries().values():
        met = meet(library, spoilt, more, np.zeros(3), np.concatenate([np.eye(3), odd]))
        np.testing.assert_array_equal(met.triangles[:3], fine.triangles)
        assert (met.triangles[3:] == -1).all()
        assert (met.distances[3:] == -1.0).all()
        assert (meet(library, points, corners, np.full(3, np.nan), np.eye(3)).geoms == -1).all()
        none = meet(library, points, corners[:0], np.zeros(3), np.eye(3))
        assert (none.geoms == -1).all()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 1 << 20), st.integers(1, 40), st.sampled_from([1e-3, 1.0, 1e4]))
def test_the_hit_depends_on_no_tree(seed: int, count: int, scale: float) -> None:
    """Triangles in another order are in another tree: they are met at the same places, all turned
    by their numbers."""
    random = np.random.default_rng(seed)
    points = (random.integers(-4, 5, (3 * count, 3)) * scale).astype(np.float32)
    corners = random.integers(0, len(points), (count, 3)).astype(np.int32)
    order = random.permutation(count)
    origin = (random.integers(-4, 5, 3) * scale).astype(np.float64)
    ways = random.integers(-2, 3, (200, 3)).astype(np.float64)
    mets: list[Met] = []
    for library in libraries().values():
        mets += [meet(library, points, part, origin, ways) for part in (corners, corners[order])]
    for met in mets[1:]:
        np.testing.assert_array_equal(met.distances, mets[0].distances)


def test_without_wanted_meshes_or_the_library_all_is_mujocos(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model, data = compiled(crowded(0))
    asked: list[Any] = []
    monkeypatch.setattr("sims.ray_casting._cast_by_mujoco", lambda *given: asked.append(given[4:6]))
    cast_rays(model, data, np.zeros(3), np.eye(3), GROUPS[3], 2)
    assert asked[0][0] is GROUPS[3]
    assert asked[0][1] == 2
    assert MeshRays.of(model).geoms.size
    monkeypatch.setattr("sims.ray_casting.libraries", dict)
    other, _ = compiled(crowded(0))
    cast_rays(other, data, np.zeros(3), np.eye(3), None, 3)
    assert asked[1:] == [(None, 3)]


def test_groups_are_restored_whatever_goes_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    model, data = compiled(crowded(0))
    before = model.geom_group.copy()
    during: list[Any] = []

    def fail(model: Any, *_: Any) -> None:
        during.append(model.geom_group.copy())
        raise RuntimeError("expected")

    monkeypatch.setattr("sims.ray_casting._cast_by_mujoco", fail)
    with pytest.raises(RuntimeError, match="expected"):
        cast_rays(model, data, np.zeros(3), np.eye(3))
    np.testing.assert_array_equal(model.geom_group, before)
    assert (during[0] == (model.geom_type == MESH)).all()


def test_trees_are_built_once_and_end_with_their_model() -> None:
    model, data = compiled(crowded(0))
    cast_rays(model, data, np.zeros(3), np.eye(3))
    rays = MeshRays.of(model)
    assert MeshRays.of(model) is rays
    end = weakref.ref(rays)
    del rays, model, data
    gc.collect()
    assert end() is None


WALL = np.array([[0, -3, 0], [0, 3, 0], [0, 3, 6], [0, -3, 6], [-3, 0, 6]], np.float32)
ROOF = [[0, 1, 2], [0, 2, 3], [2, 3, 4]]


@pytest.fixture
def walled() -> Any:
    """A wall that faces north at 5 m to the south, with a roof over what is south of it."""
    spec = mujoco.MjSpec()
    add_mesh(spec, "wall", WALL, ROOF)
    spec.worldbody.add_geom(name="wall", type=MESH, meshname="wall", pos=[-5.0, 0.0, 0.0])
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0], pos=[0.0, 0.0, -1.0]
    )
    attach_vehicle(spec, "drone", (0.0, 0.0, -1.0), 0.0)
    return spec.compile()


def test_paths_range_finders_and_roofs_meet_meshes_through_trees(
    walled: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    casts: list[int] = []
    real = MeshRays.cast

    def cast(self: MeshRays, model: Any, data: Any, *rest: Any) -> None:
        casts.append(len(rest[1]))
        real(self, model, data, *rest)

    monkeypatch.setattr(MeshRays, "cast", cast)
    clearance = Clearance(walled, "drone")
    start: Vector3 = (0.0, 0.0, -1.0)
    assert clearance.between(start, (-6.0, 0.0, -1.0)) == "wall"
    assert clearance.between(start, (-4.9, 0.0, -1.0)) == ""
    assert CarriedClearance(walled).covered((-5.5, 0.0, -1.0))
    assert not CarriedClearance(walled).covered((-4.5, 0.0, -1.0))
    assert casts == [1, 1, 1, 1]
    rays = Rays(walled, Dynamics(), "drone/base_link")
    rays.look(walled.qpos0, 0.0)
    hits = rays.cast(np.array([0.0, 0.0, 1.0]), np.array([[-1.0, 0.0, 0.0]]), 40.0)
    assert hits.distances == pytest.approx([5.0])
    assert hits.normals[0] == pytest.approx([1.0, 0.0, 0.0], abs=1e-7)
    assert RayHits(*hits).geoms.tolist() == [walled.geom("wall").id]
    assert casts[4:] == [1]


def test_a_lidar_has_the_points_that_it_has_without_trees(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a ring of meshes, with a box before it, a solid that is not seen, and one that moves."""
    spec = mujoco.MjSpec()
    for number, piece in enumerate(np.array_split(torus(24, 8)[1], 3)):
        add_mesh(spec, f"m{number}", torus(24, 8)[0] * np.float32(4.0), piece)
        spec.worldbody.add_geom(type=MESH, meshname=f"m{number}", group=number)
    for group, place in ((3, [1.0, 0.0, 0.0]), (0, [0.0, 2.0, 0.0])):
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.1, 0.5, 0.5], pos=place, group=group
        )
    body = spec.worldbody.add_body(name="b", pos=[0.0, -2.0, 0.0])
    body.add_freejoint()
    add_mesh(spec, "knot", *torus(7, 3))
    body.add_geom(type=MESH, meshname="knot", rgba=[0.9, 0.1, 0.1, 1.0])
    attach_vehicle(spec, "drone", (0.0, 0.0, 0.0), 0.0)
    model = spec.compile()
    states = np.tile(model.qpos0, (101, 1))
    states[:, 1] += np.linspace(0.0, 0.3, 101)
    lidar = LidarSpec(name="lidar", columns=90, min_intensity=0.01)
    scans = []
    for _ in range(2):
        scanner = Scanner(model_to_bytes(model), Dynamics(), (lidar,), "drone", 0)
        scans.append(scanner.scan("lidar", 0, states))
        monkeypatch.setattr("sims.ray_casting.libraries", dict)
    ours, mujocos = scans
    assert len(ours.points) > 1000
    np.testing.assert_allclose(ours.points, mujocos.points, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(ours.intensities, mujocos.intensities, rtol=1e-4)
    distances = np.linalg.norm(ours.points, axis=1)
    assert (distances < 2.5).sum() > 100
