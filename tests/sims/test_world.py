"""The world as a node: what it announces and sends, and that wind and bodies reach the vehicles.

Several vehicles in one world: they touch and see each other, and each obeys its own pilot.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from events import (
    BodyAnnouncement,
    Collision,
    Event,
    Image,
    Imu,
    Odometry,
    PathAnnouncement,
    PilotAnnouncement,
    PoseStamped,
    PositionSetpoint,
    SegmentationImage,
    TakenOff,
    Takeoff,
    Wind,
    WindAnnouncement,
)
from runtime import every
from runtime.config.model import Config, NodeSpec, RunConfig
from runtime.errors import NodeError, RefusedError
from runtime.host import Sibling
from runtime.node import make_node
from runtime.testing import NodeResult, run_in_lockstep, run_nodes, spec
from runtime.tools.preflight import of_nodes
from runtime.units import Duration
from sims.computer_vision import FreeCamera
from sims.multirotor import Multirotor
from sims.world import SharedWorld, World
from tests.runtime.small_events import NoHost
from tests.sims.vehicle.flight import WORLD

SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("world") / "tiny.xml"
    path.write_text(WORLD)
    return str(path)


def drone(name: str, east: float, world: str, **config: Any) -> NodeSpec:
    return spec(Multirotor, name, {"world": world, "position": [0.0, east]} | config)


def takeoff(vehicle: str, stamp: int = 0, altitude: float = 1.0) -> Takeoff:
    return Takeoff(stamp=stamp, source="test", vehicle=vehicle, altitude=altitude)


def place(vehicle: str, stamp: int, east: float, height: float = 1.0) -> PositionSetpoint:
    position = (0.0, east, -height)
    return PositionSetpoint(stamp=stamp, source="test", vehicle=vehicle, position=position)


def fly(*nodes: NodeSpec, inputs: Sequence[Event] = (), duration: float = 1.0) -> NodeResult:
    return run_nodes(nodes, inputs=inputs, duration=duration)


def places(result: NodeResult, name: str) -> np.ndarray[Any, Any]:
    return np.array([e.position for e in result.of(Odometry) if e.source == name])


@pytest.mark.slow
def test_they_collide_and_each_is_told_whom_it_met(world: str) -> None:
    orders = [takeoff("a"), takeoff("b"), place("a", 3 * SECOND, 3.0)]
    result = fly(drone("a", 0.0, world), drone("b", 3.0, world), inputs=orders, duration=7.0)
    met = {(e.source, e.other) for e in result.of(Collision)}
    assert {("a", "b"), ("b", "a")} <= met
    first = next(e for e in result.of(Collision) if e.source == "a" and e.other == "b")
    assert first.normal[1] < -0.5  # from b, which is in the east, towards a
    assert first.speed > 0.3
    gap = np.linalg.norm(places(result, "a") - places(result, "b"), axis=1)
    assert gap.min() > 0.15
    assert abs(places(result, "b")[-1][1] - 3.0) > 0.01  # it was pushed


@pytest.mark.slow
def test_each_obeys_only_what_names_it(world: str) -> None:
    """Sabotage: orders for one, for nobody, and for a vehicle that does not exist."""
    orders = [
        takeoff("a"),
        Takeoff(stamp=0, source="stray"),
        takeoff("c"),
        place("a", 3 * SECOND, 1.0),
        PositionSetpoint(stamp=4 * SECOND, source="stray", position=(9.0, 9.0, -9.0)),
    ]
    result = fly(drone("a", 0.0, world), drone("b", 4.0, world), inputs=orders, duration=7.0)
    assert [e.source for e in result.of(TakenOff)] == ["a"]
    assert places(result, "a")[-1] == pytest.approx((0.0, 1.0, -1.0), abs=0.1)
    assert np.ptp(places(result, "b"), axis=0) == pytest.approx((0, 0, 0), abs=1e-3)


def test_what_is_for_nobody_is_logged_once(world: str, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    orders = [takeoff("", stamp=k * 10_000_000) for k in range(5)]
    orders += [takeoff("abb", stamp=k * 10_000_000) for k in range(5)]
    fly(drone("a", 0.0, world), drone("ab", 4.0, world), inputs=orders, duration=0.1)
    assert [r.getMessage() for r in caplog.records if r.name.startswith("visnav.a")] == [
        "Takeoff of test refused: vehicle: expected one of a, ab, found none",
        "Takeoff of test refused: vehicle: expected one of a, ab, "
        "found \"abb\" (did you mean 'ab'?)",
    ]


@pytest.mark.parametrize(
    ("vehicle", "actual"), [("", "found none"), ("bb", "found \"bb\" (did you mean 'b'?)")]
)
def test_a_check_refuses_pilots_that_name_no_vehicle_that_is_there(
    world: str, vehicle: str, actual: str
) -> None:
    pilot = PilotAnnouncement(stamp=0, source="tour", vehicle=vehicle)
    with pytest.raises(RefusedError) as refusal:
        fly(drone("a", 0.0, world), drone("b", 4.0, world), inputs=[pilot], duration=0.01)
    assert f"tour: vehicle: expected one of a, b, {actual}" in str(refusal.value)


def test_a_path_is_checked_by_the_vehicle_that_is_to_fly_it(world: str) -> None:
    inside = ((5.0, 0.0, -2.0),)  # the wall
    for vehicle in ("a", "b"):
        path = PathAnnouncement(stamp=0, source="tour", vehicle=vehicle, waypoints=inside)
        with pytest.raises(RefusedError, match=f"^{vehicle}: .*in wall"):
            fly(drone("a", 0.0, world), drone("b", 4.0, world), inputs=[path], duration=0.01)
    path = PathAnnouncement(stamp=0, source="tour", vehicle="c", waypoints=inside)
    fly(drone("a", 0.0, world), drone("b", 4.0, world), inputs=[path], duration=0.01)


def test_a_path_may_lead_past_where_another_vehicle_stands(world: str) -> None:
    """It will have flown away; but none starts where another one does."""
    path = PathAnnouncement(
        stamp=0, source="tour", vehicle="a", waypoints=((0.0, 0.0, -0.1), (0.0, 8.0, -0.1))
    )
    fly(drone("a", 0.0, world), drone("b", 4.0, world), inputs=[path], duration=0.01)
    with pytest.raises(RefusedError, match=r"^a: position: expected a free place .* in b$"):
        fly(drone("a", 0.0, world), drone("b", 0.1, world), duration=0.01)


def test_all_are_in_the_world_that_one_of_them_names(world: str) -> None:
    unnamed = spec(Multirotor, "b", {"position": [0.0, 4.0]})
    result = fly(drone("a", 0.0, world), unnamed, inputs=[takeoff("b")], duration=0.1)
    assert {e.source for e in result.of(Odometry)} == {"a", "b"}
    other = spec(Multirotor, "b", {"position": [0.0, 4.0], "world": "yard"})
    with pytest.raises(
        NodeError, match=r'^b: world: expected ".*tiny.xml", in which a is, .*"yard"'
    ):
        fly(drone("a", 0.0, world), other, duration=0.01)


def test_a_world_is_at_one_place_of_the_earth(world: str) -> None:
    there = drone("b", 4.0, world, origin=[48.0, 11.0, 500.0])
    with pytest.raises(NodeError, match=r"^a: origin: expected one for all .*48\.0, 11\.0"):
        fly(drone("a", 0.0, world), there, duration=0.01)


@pytest.mark.parametrize("sees", [False, True])
def test_a_world_in_which_nobody_sees_is_not_painted(
    monkeypatch: pytest.MonkeyPatch, sees: bool
) -> None:
    """Lidars see, too: they are told how bright a surface is."""
    asked = []

    def texture(world: str, seed: int, name: str, *_: Any) -> Any:
        asked.append(name)
        return np.zeros((4, 4, 3), np.uint8)

    monkeypatch.setattr("sims.worlds.builder.texture", texture)
    lidars = [{"name": "front"}] if sees else []
    node = spec(Multirotor, "a", {"world": "office", "lidars": lidars})
    sibling = Sibling(node.name, node.node, node.config, {}, True)
    SharedWorld((sibling,), bare=False, seed=0)._build()
    assert bool(asked) == sees


def test_a_check_goes_through_all_of_it(world: str) -> None:
    nodes = (drone("a", 0.0, world), drone("b", 4.0, world))
    findings = of_nodes(Config(run=RunConfig(duration=Duration(1.0)), nodes=nodes))
    assert findings.errors == []


@pytest.mark.slow
def test_they_see_each_other_and_a_free_camera_sees_them(world: str) -> None:
    camera = {"name": "eye", "images": ["segmentation"], "width": 64, "height": 64, "latency": 0}
    watching = drone("a", 0.0, world, yaw=90, cameras=[camera | {"rate": 5}], camera_processes=1)
    chase = spec(
        FreeCamera,
        "chase",
        {"cameras": [camera], "rate": 5, "position": [-3.0, 1.0, -1.0], "camera_processes": 1},
    )
    orders = [takeoff("b", altitude=2.0)]
    result = fly(watching, drone("b", 2.0, world), chase, inputs=orders, duration=3.0)
    for source in ("a/eye", "chase/eye"):
        images = [e.data for e in result.of(SegmentationImage) if e.source == source]
        before, after = images[0], images[-1]
        assert (before != after).sum() >= 4, source
    assert len({e.stamp for e in result.of(SegmentationImage)}) == 15


@pytest.mark.slow
def test_the_order_of_the_file_changes_nothing_that_any_of_them_does(world: str) -> None:
    """Not bit for bit, since MuJoCo then adds in another order; to a micrometre."""
    orders = [takeoff("a"), takeoff("b", altitude=2.0), place("a", 2 * SECOND, -2.0)]
    one, other = (
        fly(*order, inputs=orders, duration=4.0)
        for order in (
            (drone("a", 0.0, world), drone("b", 3.0, world, control_rate=250)),
            (drone("b", 3.0, world, control_rate=250), drone("a", 0.0, world)),
        )
    )
    for name in ("a", "b"):
        np.testing.assert_allclose(places(one, name), places(other, name), atol=1e-6)


@pytest.mark.slow
def test_a_vehicle_that_is_brought_up_again_is_where_it_was_left(world: str) -> None:
    class Fragile(Multirotor):
        @every(hz="control_rate")
        def control(self, tick: Any) -> None:
            if not self.restarts and tick.stamp > 3 * SECOND:
                raise RuntimeError("broken")
            super().control(tick)

    fragile = spec(Fragile, "a", {"world": world, "position": [0.0, 0.0]}, on_error="restart")
    orders = [takeoff("a", altitude=2.0), takeoff("b"), takeoff("a", stamp=6 * SECOND)]
    result = fly(fragile, drone("b", 4.0, world), inputs=orders, duration=9.0)
    poses = [e for e in result.of(Odometry) if e.source == "a"]
    assert max(-e.position[2] for e in poses if e.stamp < 3.1 * SECOND) > 1.8
    fallen = [-e.position[2] for e in poses if 5 * SECOND < e.stamp < 6 * SECOND]
    assert fallen[-1] == pytest.approx(0.1, abs=0.05)  # its motors were off
    assert [e.source for e in result.of(TakenOff)].count("a") == 2
    assert places(result, "b")[-1] == pytest.approx((0.0, 4.0, -1.1), abs=0.1)


@pytest.mark.slow
def test_physics_that_diverged_are_made_anew_for_all(world: str) -> None:
    class Wild(Multirotor):
        @every(hz="control_rate")
        def control(self, tick: Any) -> None:
            if self.name == "a" and not self.restarts and tick.stamp > SECOND:
                self._physics.data.qpos[:3] = np.nan
                self._physics.simulation.changed()
            super().control(tick)

    nodes = [
        spec(Wild, name, {"world": world, "position": [0.0, east]}, on_error="restart")
        for name, east in (("a", 0.0), ("b", 4.0))
    ]
    orders = [takeoff(name, stamp=stamp) for stamp in (0, 3 * SECOND) for name in ("a", "b")]
    result = fly(*nodes, inputs=orders, duration=6.0)
    for name, east in (("a", 0.0), ("b", 4.0)):
        assert places(result, name)[-1] == pytest.approx((0.0, east, -1.1), abs=0.1)


def test_all_of_one_world_are_in_one_process(world: str) -> None:
    host = NoHost()
    nodes = (drone("a", 0.0, world), drone("b", 4.0, world))
    host.siblings = tuple(
        Sibling(spec.name, spec.node, spec.config, {}, spec.name == "a") for spec in nodes
    )
    node = make_node(Multirotor, "a", nodes[0].config, host)
    with pytest.raises(ValueError, match="in one process, found b in another one: name them"):
        run_in_lockstep(node.on_startup())


STILL = {"name": "crate", "kind": "box", "waypoints": [(2.0, 3.0, 0.0)]}
WIND = {"velocity": [0.0, 4.0, 0.0], "turbulence": "moderate"}


def surroundings(world: str, **config: Any) -> Any:
    return spec(World, "world", {"world": world} | config)


def test_bodies_are_announced_and_their_poses_are_sent(world: str) -> None:
    walker = {"name": "p", "kind": "person", "waypoints": [(2, 0, 0), (2, 4, 0)], "speed": 2.0}
    nodes = (surroundings(world, bodies=[walker, STILL], rate=20), drone("a", 0.0, world))
    result = fly(*nodes, duration=1.0)
    bodies = {body.source: body for body in result.of(BodyAnnouncement)}
    assert {name: body.kind for name, body in bodies.items()} == {
        "world/p": "person",
        "world/crate": "box",
    }
    ids = [number for body in bodies.values() for number in body.object_ids]
    assert len(set(ids)) == len(ids) > 10
    poses = [e for e in result.of(PoseStamped) if e.source == "world/p"]
    assert [e.stamp for e in poses] == [k * SECOND // 20 for k in range(20)]
    assert poses[0].position == pytest.approx((2.0, 0.0, 0.0), abs=1e-6)
    assert poses[-1].position[1] > 1.0
    assert result.of(Wind) == []


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_world_without_wind_and_bodies_changes_no_bit_of_a_flight(world: str) -> None:
    plain, beside = (
        fly(*nodes, inputs=[takeoff("a")], duration=1.5)
        for nodes in ((drone("a", 0.0, world),), (surroundings(world), drone("a", 0.0, world)))
    )
    for event in (Odometry, Imu):
        assert plain.of(event) == beside.of(event)


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_turning_body_is_lit_the_same_by_any_number_of_processes(tmp_path: Path) -> None:
    """Each draws other images, so what it drew before must not matter: two begin with two poses."""
    sun = '<light type="directional" dir="1 0.5 -1" specular="0 0 0"/>'
    matt = f'<visual><headlight specular="0 0 0"/></visual><worldbody>{sun}'  # nothing shines
    (tmp_path / "sunny.xml").write_text(WORLD.replace("<worldbody>", matt))
    sunny = str(tmp_path / "sunny.xml")
    turning = {"times": [0, 0.9, 2.2], "angles": [20, 90, 20]}
    door = {"name": "d", "kind": "door", "waypoints": [(3, -0.4, 0)]} | turning
    camera = {"name": "c", "images": ["rgb"], "width": 160, "height": 120, "latency": "900ms"}
    one, two = (
        fly(
            surroundings(sunny, bodies=[door]),
            spec(
                FreeCamera,
                "eye",
                {"cameras": [camera], "rate": 3, "position": [0, 0, -1], "camera_processes": count},
            ),
            duration=3.0,
        ).of(Image)
        for count in (1, 2)
    )
    assert len({image.data.tobytes() for image in one}) == len(one) > 5
    for alone, shared in zip(one, two, strict=True):
        np.testing.assert_array_equal(alone.data, shared.data)


def test_there_is_one_world_and_it_is_that_of_the_vehicles(world: str) -> None:
    with pytest.raises(NodeError, match=r'^world: expected ".*tiny.xml", in which a is'):
        fly(drone("a", 0.0, world), spec(World, "world", {"world": "yard"}), duration=0.01)
    with pytest.raises(NodeError, match=r"^weather: expected one node of a world, found world"):
        fly(surroundings(world), spec(World, "weather"), drone("a", 0.0, world), duration=0.01)


def test_nobody_starts_in_a_body(world: str) -> None:
    crate = STILL | {"waypoints": [(0.0, 0.3, 0.0)]}
    with pytest.raises(RefusedError, match=r"^a: position: .* in world/crate"):
        fly(surroundings(world, bodies=[crate]), drone("a", 0.0, world), duration=0.01)
