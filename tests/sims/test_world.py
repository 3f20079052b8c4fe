"""The world as a node: what it announces and sends, and that wind and bodies reach the vehicles."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from events import (
    BodyAnnouncement,
    Collision,
    Imu,
    Odometry,
    PoseStamped,
    SegmentationImage,
    Wind,
    WindAnnouncement,
)
from runtime.errors import NodeError, RefusedError
from runtime.testing import spec
from sims.computer_vision import FreeCamera
from sims.world import World
from tests.sims.test_shared_world import SECOND, drone, fly, place, places, takeoff
from tests.sims.test_shared_world import world as world

STILL = {"name": "crate", "kind": "box", "waypoints": [(2.0, 3.0, 0.0)]}
WIND = {"velocity": [0.0, 4.0, 0.0], "turbulence": "moderate"}


def surroundings(world: str, **config: Any) -> Any:
    return spec(World, "world", {"world": world} | config)


def test_bodies_are_announced_and_their_poses_are_sent(world: str) -> None:
    walker = {"name": "p", "kind": "person", "waypoints": [(2, 0, 0), (2, 4, 0)], "speed": 2.0}
    nodes = (surroundings(world, bodies=[walker, STILL], rate=20), drone("a", 0.0, world))
    result = fly(*nodes, duration=1.0)
    bodies = {each.source: each for each in result.of(BodyAnnouncement)}
    assert {name: each.kind for name, each in bodies.items()} == {
        "world/p": "person",
        "world/crate": "box",
    }
    ids = [number for each in bodies.values() for number in each.object_ids]
    assert len(set(ids)) == len(ids) > 10
    poses = [e for e in result.of(PoseStamped) if e.source == "world/p"]
    assert [e.stamp for e in poses] == [k * SECOND // 20 for k in range(20)]
    assert poses[0].position == pytest.approx((2.0, 0.0, 0.0), abs=1e-6)
    assert poses[-1].position[1] > 1.0
    assert result.of(Wind) == []


def test_wind_is_announced_sent_and_felt_alike_by_all(world: str) -> None:
    orders = [takeoff("a"), takeoff("b"), place("b", 3 * SECOND, 4.0)]
    nodes = (drone("a", 0.0, world), drone("b", 3.0, world), surroundings(world, wind=WIND))
    result = fly(*nodes, inputs=orders, duration=4.0)
    assert {(e.source, e.velocity) for e in result.of(WindAnnouncement)} == {
        ("world/a", (0.0, 4.0, 0.0)),
        ("world/b", (0.0, 4.0, 0.0)),
    }
    felt = {
        name: np.array([e.velocity for e in result.of(Wind) if e.source == f"world/{name}"])
        for name in "ab"
    }
    assert len(felt["a"]) == len(felt["b"]) == 200
    assert felt["a"].std(axis=0).min() > 0.05
    # As high and as fast as one another, they feel the same.
    np.testing.assert_allclose(felt["a"][:40], felt["b"][:40], atol=1e-9)
    np.testing.assert_allclose(felt["a"], felt["b"], atol=0.5)
    again = fly(*nodes, inputs=orders, duration=4.0)
    assert [e.velocity for e in again.of(Wind)] == [e.velocity for e in result.of(Wind)]
    assert [e.position for e in again.of(Odometry)] == [e.position for e in result.of(Odometry)]


def test_a_world_without_wind_and_bodies_changes_no_bit_of_a_flight(world: str) -> None:
    plain, beside = (
        fly(*nodes, inputs=[takeoff("a")], duration=1.5)
        for nodes in ((drone("a", 0.0, world),), (surroundings(world), drone("a", 0.0, world)))
    )
    for event in (Odometry, Imu):
        assert plain.of(event) == beside.of(event)


def test_a_body_that_comes_along_pushes_a_vehicle(world: str) -> None:
    crate = {
        "name": "crate",
        "kind": "box",
        "waypoints": [(0.0, -8.0, 0.0), (0.0, 8.0, 0.0)],
        "times": [0, 8],
        "loop": False,
        "size": [1.0, 1.0, 1.5],
    }
    result = fly(
        surroundings(world, bodies=[crate]),
        drone("a", 0.0, world),
        inputs=[takeoff("a", altitude=0.6)],
        duration=6.0,
    )
    hit = next(e for e in result.of(Collision) if e.other == "world/crate")
    assert hit.speed > 1.0
    assert hit.normal[1] > 0.5  # it came from the west
    assert places(result, "a")[-1][1] > 0.3
    steps = [abs(b - a) for a, b in pairwise(places(result, "a")[:, 1])]
    assert max(steps) < 0.1  # pushed, not thrown through the wall


@pytest.mark.slow
def test_a_mask_is_where_its_body_is(world: str) -> None:
    walker = {"name": "p", "kind": "person", "waypoints": [(4, -1, 0), (4, 1, 0)], "speed": 1.0}
    camera = {"name": "c", "images": ["segmentation"], "width": 160, "height": 120, "latency": 0}
    eye = spec(
        FreeCamera,
        "eye",
        {"cameras": [camera], "rate": 5, "position": [0, 0, -1], "camera_processes": 1},
    )
    result = fly(surroundings(world, bodies=[walker], rate=5), eye, duration=2.0)
    ids = result.of(BodyAnnouncement)[0].object_ids
    poses = {e.stamp: e.position for e in result.of(PoseStamped) if e.source == "world/p"}
    seen = 0
    for image in result.of(SegmentationImage):
        columns = np.flatnonzero(np.isin(image.data, ids).any(axis=0))
        east = poses[image.stamp][1]
        assert columns.mean() == pytest.approx(79.5 + 80 * east / 4.0, abs=4.0)
        seen += 1
    assert seen == 10


def test_there_is_one_world_and_it_is_that_of_the_vehicles(world: str) -> None:
    with pytest.raises(NodeError, match=r'^world: expected ".*tiny.xml", in which a is'):
        fly(drone("a", 0.0, world), spec(World, "world", {"world": "yard"}), duration=0.01)
    with pytest.raises(NodeError, match=r"^weather: expected one node of a world, found world"):
        fly(surroundings(world), spec(World, "weather"), drone("a", 0.0, world), duration=0.01)


def test_nobody_starts_in_a_body(world: str) -> None:
    crate = STILL | {"waypoints": [(0.0, 0.3, 0.0)]}
    with pytest.raises(RefusedError, match=r"^a: position: .* in world/crate"):
        fly(surroundings(world, bodies=[crate]), drone("a", 0.0, world), duration=0.01)
