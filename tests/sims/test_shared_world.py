"""Several vehicles in one world: they touch and see each other, and each obeys its own pilot."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from events import (
    Collision,
    Event,
    Odometry,
    PathAnnouncement,
    PilotAnnouncement,
    PositionSetpoint,
    SegmentationImage,
    TakenOff,
    Takeoff,
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
    ("vehicle", "found"), [("", "found none"), ("bb", "found \"bb\" (did you mean 'b'?)")]
)
def test_a_check_refuses_pilots_that_name_no_vehicle_that_is_there(
    world: str, vehicle: str, found: str
) -> None:
    pilot = PilotAnnouncement(stamp=0, source="tour", vehicle=vehicle)
    with pytest.raises(RefusedError) as refusal:
        fly(drone("a", 0.0, world), drone("b", 4.0, world), inputs=[pilot], duration=0.01)
    assert f"tour: vehicle: expected one of a, b, {found}" in str(refusal.value)


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

    monkeypatch.setattr("sims.worlds.model.texture", texture)
    lidars = [{"name": "front", "rate": 1, "channels": 1, "columns": 10}] if sees else []
    fly(spec(Multirotor, "a", {"world": "office", "lidars": lidars}), duration=0.01)
    assert bool(asked) == sees


def test_a_check_goes_through_all_of_it(world: str) -> None:
    nodes = (drone("a", 0.0, world), drone("b", 4.0, world))
    found = of_nodes(Config(run=RunConfig(duration=Duration(1.0)), nodes=nodes))
    assert found.errors == []


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
        Sibling(each.name, each.node, each.config, {}, each.name == "a") for each in nodes
    )
    node = make_node(Multirotor, "a", nodes[0].config, host)
    with pytest.raises(ValueError, match="in one process, found b in another one: name them"):
        run_in_lockstep(node.on_startup())
