"""Start and tour in the free space of meshes, measured against their boxes by brute force."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
import pytest

from sims.carried.clearance import Clearance
from sims.scans.solids import add_solids, find_floor, voxelise
from sims.survey.free_space import LENGTH, FreeSpace, find_free_space
from sims.vehicle import STANDING_HEIGHT, attach_vehicle
from sims.vehicle import autopilot as vehicles
from sims.worlds import CLEARANCE
from tests.sims.scans.shapes import Mesh, block, ground, room, together

PILLARS = [
    block((x, y, 0.0), (x + 0.4, y + 0.4, 3.0)) for x, y in ((3.0, 2.0), (7.0, 5.0), (6.0, 1.0))
]
HALL = room(10.0, 8.0, 3.0, *PILLARS)


def explored(mesh: Mesh, voxel: float = 0.2) -> FreeSpace:
    """Return the free space of a mesh, whose tour is what it says, and free for a vehicle."""
    floor = find_floor(*mesh).height
    voxels = voxelise(*mesh, voxel, floor or 0.0)
    space = find_free_space(voxels, floor)
    assert space is not None
    boxes = voxels.boxes() if floor is None else voxels.above_floor().boxes()
    spec: Any = mujoco.MjSpec()
    add_solids(spec, boxes, floor)
    x, y, z = space.start
    start = (x, -y, -z - STANDING_HEIGHT)
    waypoints = [(x, -y, -z) for x, y, z in space.tour.waypoints]
    assert waypoints[0][:2] == start[:2]
    attach_vehicle(spec, "drone", start, 0.0)
    model = spec.compile()
    world = vehicles.Clearance(model, "drone")
    assert vehicles.trouble_at_start(world, start) == ""
    assert vehicles.trouble_on_path(world, start, [*waypoints, waypoints[0]]) == ""
    solids, points = Clearance(model), np.array(waypoints)
    nearest, length = math.inf, 0.0
    for a, b in zip(points, np.roll(points, -1, axis=0), strict=True):
        share = np.linspace(0.0, 1.0, 2 + int(np.linalg.norm(b - a) / 0.02))[:, None]
        nearest = min(nearest, float(solids.distances(a + share * (b - a)).min()))
        length += float(np.linalg.norm(b - a))
    assert space.tour.length == pytest.approx(length)
    assert space.tour.clearance <= nearest <= space.tour.clearance + 0.04
    return space


@pytest.mark.parametrize("height", [0.0, 12.34])
def test_a_room_has_a_tour_of_the_length_and_the_clearance(height: float) -> None:
    points, corners = HALL
    space = explored((np.add(points, (0.0, 0.0, height)), corners))
    assert 0.75 * LENGTH < space.tour.length < 1.1 * LENGTH
    assert space.tour.clearance >= CLEARANCE
    assert space.start[2] == pytest.approx(height, abs=1e-3)
    assert [z for _, _, z in space.tour.waypoints] == pytest.approx(
        [height + 1.5] * len(space.tour.waypoints), abs=0.11
    )
    assert space.volume == pytest.approx(9.8 * 7.8 * 2.8, rel=0.1)  # voxels are inside walls


def test_a_closed_wall_ends_the_space_and_a_door_does_not() -> None:
    left, right = block((4.0, 0.0, 0.0), (4.1, 1.5, 2.5)), block((4.0, 2.7, 0.0), (4.1, 4.0, 2.5))
    shut = block((4.0, 1.5, 0.0), (4.1, 2.7, 2.5))
    door = explored(room(8.0, 4.0, 2.5, left, right), 0.1)
    closed = explored(room(8.0, 4.0, 2.5, left, right, shut), 0.1)
    assert door.volume == pytest.approx(7.9 * 3.9 * 2.4, rel=0.1)
    assert closed.volume == pytest.approx(3.9 * 3.9 * 2.4, rel=0.1)


def test_a_low_room_is_flown_lower() -> None:
    space = explored(room(7.0, 7.0, 2.2), 0.1)
    assert space.tour.clearance >= CLEARANCE
    assert {z for _, _, z in space.tour.waypoints} == {1.2}


def test_a_small_room_has_a_shorter_tour_with_less_clearance() -> None:
    tour = explored(room(4.0, 2.4, 2.4), 0.1).tour
    assert 2.0 < tour.length < LENGTH / 2.0
    assert 0.3 <= tour.clearance < CLEARANCE


def test_where_no_vehicle_fits_there_is_no_start() -> None:
    points, corners = room(0.8, 0.8, 2.0)
    assert find_free_space(voxelise(points, corners, 0.1), 0.0) is None
    assert find_free_space(voxelise(points, corners[:0], 0.1), 0.0) is None
    walls = block((0.0, 0.0, 0.0), (5.0, 5.0, 3.0), "top bottom", inward=True)
    assert find_free_space(voxelise(*walls, 0.1)) is None


def test_walls_on_a_plane_are_a_room() -> None:
    walls = block((0.0, 0.0, 0.0), (6.0, 5.0, 3.0), "top bottom", inward=True)
    space = find_free_space(voxelise(*walls, 0.1), 0.0)
    assert space is not None
    np.testing.assert_allclose(space.start, (3.0, 2.5, 0.0), atol=0.2)


def test_outside_of_a_house_nothing_is_to_be_seen() -> None:
    """A corridor round a corner; the rest of the box around it is not of the mesh."""
    first = block((0.0, 0.0, 0.0), (30.0, 2.6, 2.6), "west", inward=True)
    second = block((-2.6, 0.0, 0.0), (0.0, 20.0, 2.6), "east", inward=True)
    space = explored(together(first, second))
    x, y, _ = np.array([space.start, *space.tour.waypoints]).T
    assert ((y < 2.6) | (x < 0.0)).all()


def test_a_floor_that_is_rough_is_stood_on() -> None:
    """All over it are voxels above the plane, some of two layers."""
    points, corners = ground(8.0, 160, lambda x, y: 0.0)
    noise = np.random.default_rng(1).normal(0.0, 0.03, len(points))
    mesh = together((points + noise[:, None] * (0.0, 0.0, 1.0), corners), room(8.0, 8.0, 3.0))
    space = explored(mesh, 0.1)
    assert space.start[2] in (0.15, 0.25)


def test_hills_are_flown_over_at_one_height() -> None:
    space = explored(ground(40.0, 30, lambda x, y: 1.5 * np.sin(x / 6.0) * np.cos(y / 7.0)), 0.3)
    assert space.tour.length > 0.75 * LENGTH
    assert space.tour.clearance >= CLEARANCE
    assert len({z for _, _, z in space.tour.waypoints}) == 1
