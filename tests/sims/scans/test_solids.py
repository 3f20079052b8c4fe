"""Voxels of meshes against brute force, their boxes, the floor, and what a vehicle meets."""

from __future__ import annotations

from itertools import product
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sims.scans import solids
from sims.scans.mesh_file import MeshError
from sims.scans.solids import (
    Voxels,
    add_solids,
    find_floor,
    merged,
    voxel_boxes,
    voxelise,
)
from sims.vehicle import Physics, attach_vehicle
from tests.sims.scans.shapes import Mesh, block, ground, room, together

Floats = npt.NDArray[np.float64]
MS = 1_000_000


def overlaps(triangle: Floats, cells: Floats, *, closed: bool) -> npt.NDArray[np.bool_]:
    """Return whether a triangle meets unit cubes about points: with their faces, or their inside.

    No axis of the 13 separates them (Akenine-Möller).
    """
    sides = np.roll(triangle, -1, axis=0) - triangle
    units = np.eye(3)
    axes = [*units, np.cross(sides[0], sides[1]), *(np.cross(u, s) for u in units for s in sides)]
    meets = np.ones(len(cells), np.bool_)
    for axis in (axis for axis in axes if axis.any()):
        reach = abs(axis).sum() / 2.0
        along = triangle @ axis
        low, high = cells @ axis - reach, cells @ axis + reach
        if closed:
            meets &= (along.min() <= high) & (along.max() >= low)
        else:
            meets &= (along.min() < high) & (along.max() > low)
    return meets


# Eighths of a voxel: all that is computed of them is exact.
EIGHTHS = st.integers(-20, 20).map(lambda number: number / 8.0)
TRIANGLES = st.lists(st.tuples(*[EIGHTHS] * 9), min_size=1, max_size=3)


HALL = room(6.25, 5.3, 3.1, block((2.0, 2.0, 0.0), (3.2, 2.7, 0.6)))


@settings(max_examples=25)
@given(numbers=TRIANGLES, voxel=st.sampled_from([1.0, 0.25]))
def test_voxels_are_those_that_triangles_touch(
    numbers: list[tuple[float, ...]], voxel: float
) -> None:
    """All whose inside they meet, and none that they do not even touch."""
    triangles = np.array(numbers).reshape(-1, 3, 3)
    corners = np.arange(triangles.size // 3, dtype=np.int32).reshape(-1, 3)
    voxels = voxelise(triangles.reshape(-1, 3) * voxel, corners, voxel)
    result = {tuple(cell) for cell in voxels.cells.tolist()}
    assert len(result) == len(voxels.cells)
    cells = np.array(list(product(range(-4, 5), repeat=3)))
    flat = [not np.cross(t[1] - t[0], t[2] - t[0]).any() for t in triangles]
    inside, touched = (
        np.any(
            [
                overlaps(t, cells, closed=closed)
                for t, empty in zip(triangles, flat, strict=True)
                if not empty
            ]
            or [np.zeros(len(cells), np.bool_)],
            axis=0,
        )
        for closed in (False, True)
    )
    assert {tuple(cell) for cell in cells[inside].tolist()} <= result
    assert result <= {tuple(cell) for cell in cells[touched].tolist()}
    # What lies between layers belongs to one: every point of a surface is in a box.
    boxes = voxels.boxes() / voxel
    for triangle, empty in zip(triangles, flat, strict=True):
        for a, b in ((0.2, 0.3), (0.0, 0.0), (1.0, 0.0), (0.5, 0.5)):
            point = triangle[0] + a * (triangle[1] - triangle[0]) + b * (triangle[2] - triangle[0])
            within = ((boxes[:, :3] <= point + 1e-9) & (boxes[:, 3:] >= point - 1e-9)).all(axis=1)
            assert empty or within.any()


def test_far_from_the_origin_all_is_the_same() -> None:
    """As at coordinates of a map's grid."""
    points, corners = HALL
    far = np.array((400_000.0, 5_800_000.0, 300.0))
    boxes = voxel_boxes(points, corners, 0.5)
    np.testing.assert_allclose(voxel_boxes(points + far, corners, 0.5), boxes + np.tile(far, 2))


def test_a_large_triangle_is_as_its_halves() -> None:
    """Of 800 cells a side, tilted; and of a sliver along it."""
    points = np.array([(0.0, 0.0, 0.0), (80.1, 7.2, 33.3), (11.4, 70.7, -20.6), (80.15, 7.2, 33.3)])
    middle = (points[1] + points[2]) / 2.0
    whole = voxelise(points, np.array([[0, 1, 2], [0, 1, 3]], np.int32), 0.5).cells
    halves = np.array([[0, 1, 4], [0, 4, 2], [0, 1, 3]], np.int32)
    parts = voxelise(np.vstack([points, middle]), halves, 0.5).cells
    assert 20_000 < len(whole) < 60_000
    np.testing.assert_array_equal(whole, parts)


@settings(max_examples=25)
@given(cells=st.sets(st.tuples(*[st.integers(-3, 2)] * 3), max_size=60))
def test_boxes_are_disjoint_and_fill_the_cells(cells: set[tuple[int, int, int]]) -> None:
    boxes = merged(np.array(sorted(cells), np.int64).reshape(-1, 3))
    filled = [cell for box in boxes.tolist() for cell in product(*map(range, box[:3], box[3:]))]
    assert len(filled) == len(set(filled))
    assert set(filled) == cells


@settings(max_examples=15)
@given(
    cells=st.sets(st.tuples(*[st.integers(0, 7)] * 3), max_size=60),
    gap=st.sampled_from([0.0, 0.05, 0.1, 0.2, 0.3]),
    dense=st.sampled_from([1, 500, 10**6]),
)
def test_what_is_filled_is_where_no_cube_fits(
    cells: set[tuple[int, int, int]], gap: float, dense: int
) -> None:
    """By trying all cubes that are a voxel wider than the gap; in slices, too."""
    array = np.array(sorted(cells), np.int64).reshape(-1, 3)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(solids, "_DENSE", dense)
        filled = Voxels(array, 0.1).filled(gap)
    width = 1 + round(gap / 0.1 - 0.1)
    solid = np.zeros((20, 20, 20), np.bool_)
    solid[tuple((array + 6).T)] = True
    windows = np.lib.stride_tricks.sliding_window_view(solid, (width,) * 3)
    cubes = np.asarray(~windows.any(axis=(3, 4, 5)))
    free, count = np.zeros_like(solid), len(cubes)
    for x, y, z in product(range(width), repeat=3):
        free[x : x + count, y : y + count, z : z + count] |= cubes
    np.testing.assert_array_equal(filled.cells, np.argwhere(~free) - 6)


def test_shelves_are_filled_and_doors_are_not() -> None:
    boards = [block((0.0, 0.0, z), (2.0, 0.4, z + 0.02)) for z in (0.2, 0.5, 0.8, 1.1)]
    assert len(voxel_boxes(*together(*boards), 0.1)) == 1
    boxes = voxel_boxes(*together(*boards), 0.1, gap=0.0)
    assert len(boxes) == 4


def test_a_block_is_six_boxes_at_most_and_the_order_of_triangles_does_not_matter() -> None:
    points, corners = block((0.0, 0.0, 0.0), (4.0, 3.0, 2.0))
    boxes = voxel_boxes(points, corners, 0.1)
    assert len(boxes) == 6
    np.testing.assert_allclose(boxes[:, :3].min(axis=0), (-0.05, -0.05, -0.05))
    np.testing.assert_allclose(boxes[:, 3:].max(axis=0), (4.05, 3.05, 2.05))
    np.testing.assert_array_equal(voxel_boxes(points, corners[::-1], 0.1), boxes)
    assert voxel_boxes(points, corners[:0], 0.1).shape == (0, 6)


@pytest.mark.parametrize("shift", [0.0, 0.013, 0.05, 0.099])
def test_a_door_stays_open(shift: float) -> None:
    """Of 0.9 m, between two ends of a wall: at least 0.7 m."""
    left, right = (
        block((-3.0, 0.0, 0.0), (shift, 0.1, 2.0)),
        block((shift + 0.9, 0.0, 0.0), (4.0, 0.1, 2.0)),
    )
    boxes = voxel_boxes(*together(left, right), 0.1)
    west = boxes[boxes[:, 3] < shift + 0.45, 3].max()
    east = boxes[boxes[:, 0] > shift + 0.45, 0].min()
    assert 0.7 - 1e-9 <= east - west <= 0.9


def test_nothing_stands_above_the_floor_that_is_seen() -> None:
    """Noise of 3 cm of the floor has no boxes, a step of 10 cm has; nothing is below."""
    points, corners = room(4.0, 3.0, 2.5, block((1.0, 1.0, -0.5), (2.0, 2.0, 0.1)))
    bumps, faces = ground(2.0, 30, lambda x, y: 0.03 * np.sin(40.0 * x) * np.cos(30.0 * y))
    points, corners = together((points, corners), (np.add(bumps, (0.5, 0.5, 0.0)), faces))
    boxes = voxel_boxes(np.add(points, (0.0, 0.0, 0.523)), corners, 0.1, floor=0.523)
    assert boxes[:, 2].min() == pytest.approx(0.523 + 0.05)
    inside = (boxes[:, :2] > 0.1).all(axis=1) & (boxes[:, 3:] < (3.9, 2.9, 1.0)).all(axis=1)
    assert boxes[inside, 5] == pytest.approx(0.523 + 0.15)
    np.testing.assert_allclose(boxes[inside, :2].min(axis=0), (0.95, 0.95))


def test_too_many_voxels_are_refused_with_a_size_that_will_do() -> None:
    points, corners = ground(6000.0, 1, lambda x, y: 0.2 * x)
    with pytest.raises(MeshError, match=r"at most 4,000,000 voxels, found 0.1 m.*: try 3 m$"):
        voxel_boxes(points, corners, 0.1)
    with pytest.raises(MeshError, match="voxel: expected a size above 0 m, found 0 m"):
        voxel_boxes(points, corners, 0.0)
    with pytest.raises(MeshError, match="points: expected finite coordinates"):
        voxel_boxes(points * np.nan, corners, 0.1)
    with pytest.raises(MeshError, match="up to 10⁶ voxels a side"):
        voxel_boxes(
            np.vstack([np.eye(3), np.eye(3) + 1e7]), np.array([[0, 1, 2], [3, 4, 5]], np.int32), 0.1
        )


TABLE = block((1.0, 1.0, 0.7), (3.0, 2.0, 0.75))
UPSTAIRS = block((0.0, 0.0, 2.7), (6.0, 5.0, 5.5), inward=True)
HOLE = block((5.0, 4.0, -3.0), (5.5, 4.5, -2.0))


@pytest.mark.parametrize(
    ("mesh", "height"),
    [
        (room(6.0, 5.0, 2.5), 0.0),
        (room(6.0, 5.0, 2.5, TABLE), 0.0),
        (room(6.0, 5.0, 2.5, TABLE, HOLE), 0.0),  # some triangles below
        (room(6.0, 5.0, 2.5, UPSTAIRS), 0.0),
        (ground(20.0, 40, lambda x, y: np.where(x > 14.0, 0.4 * (x - 14.0), 0.0)), 0.0),
        (ground(20.0, 40, lambda x, y: 0.03 * np.sin(31.0 * x + 17.0 * y)), 0.0),
    ],
    ids=["room", "table", "hole", "storeys", "slope beside", "noise"],
)  # fmt: skip
def test_the_floor_is_the_lowest_level_ground(mesh: Mesh, height: float) -> None:
    points, corners = mesh
    assert find_floor(np.add(points, (0.0, 0.0, 1.37)), corners).height == pytest.approx(
        1.37 + height, abs=0.01
    )


@pytest.mark.parametrize(
    ("mesh", "reason"),
    [
        (block((0.0, 0.0, 0.0), (6.0, 5.0, 2.5), "top bottom", inward=True), "no surface faces up"),
        (ground(30.0, 40, lambda x, y: 2.0 * np.sin(x / 4.0) * np.cos(y / 5.0)), "nowhere level"),
        (ground(30.0, 1, lambda x, y: 0.1 * x), "nowhere level"),
        (ground(20.0, 40, lambda x, y: np.minimum(0.3 * (x - 4.0), 0.0)), "below its lowest level"),
    ],
    ids=["walls", "hills", "slope", "down beside"],
)  # fmt: skip
def test_where_no_plane_can_stand_there_is_no_floor(mesh: Mesh, reason: str) -> None:
    floor = find_floor(*mesh)
    assert floor.height is None
    assert reason in floor.reason


def world(place: tuple[float, float, float]) -> Physics:
    """Return a vehicle in a room of voxels, 6 × 5 × 3 m, with a block of 1 × 1 × 0.6 m."""
    mesh = room(6.0, 5.0, 3.0, block((2.0, 2.0, 0.0), (3.0, 3.0, 0.6)))
    spec: Any = mujoco.MjSpec()
    add_solids(spec, voxel_boxes(*mesh, 0.1, floor=0.0), 0.0)
    x, y, z = place
    attach_vehicle(spec, "drone", (x, -y, -z), 0.0)
    return Physics(spec.compile(), "drone")


@pytest.mark.parametrize(
    ("place", "height", "other"),
    [((2.5, 2.5, 0.85), 0.65, "solid"), ((1.0, 1.0, 0.2), 0.0, "floor")],
    ids=["block", "floor"],
)  # fmt: skip
def test_a_vehicle_stands_on_boxes_and_floor(
    place: tuple[float, float, float], height: float, other: str
) -> None:
    physics = world(place)
    physics.advance_to(600 * MS)
    assert -physics.state().position[2] == pytest.approx(height + 0.1, abs=0.003)
    assert {contact.other.rstrip("0123456789") for contact in physics.contacts()} == {other}


def test_a_vehicle_that_flies_against_a_wall_collides() -> None:
    physics = world((4.5, 1.0, 1.5))
    physics.data.qvel[0] = 5.0
    while not (contacts := physics.contacts()):
        assert physics.time_ns < 500 * MS
        physics.advance_to(physics.time_ns + MS)
    assert all(contact.other.startswith("solid") for contact in contacts)
    assert contacts[0].normal == pytest.approx((-1.0, 0.0, 0.0), abs=0.02)
    assert contacts[0].position[0] == pytest.approx(5.95, abs=0.02)
