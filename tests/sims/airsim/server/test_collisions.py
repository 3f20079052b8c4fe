"""What clients are told of collisions: which count, what is known of them, what clears them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from sims.airsim.server.collisions import Collisions
from sims.airsim.server.segmentation import initial_id
from sims.airsim.server.vehicles import ServedMultirotor
from sims.vehicle.physics import Contact
from tests.sims.airsim.scripts import Caller, drone, with_script

NORTH = {"is_rate": True, "yaw_or_rate": 0.0}


def numbers(found: dict[str, float]) -> tuple[float, ...]:
    return tuple(found.values())


def fly(call: Caller, seconds: float, method: str, *arguments: Any) -> None:
    task = call.send(method, *arguments)
    call("simContinueForTime", seconds)
    call.join(task)


def test_a_wall_is_hit_and_reading_it_clears_it(tiny_world: str) -> None:
    found: list[Any] = []

    def script(call: Caller) -> None:
        call("enableApiControl", True, "")
        found.append(call("simGetCollisionInfo", ""))
        fly(call, 8.0, "takeoff", 20.0, "")
        found.append(call("simGetCollisionInfo", ""))
        fly(call, 4.0, "moveByVelocity", 3.0, 0.0, 0.0, 4.0, 0, NORTH, "")
        found.extend(call("getMultirotorState", "")["collision"] for _ in range(2))
        found.extend(call("simGetCollisionInfo", "") for _ in range(2))

    with_script(script, [drone(world=tiny_world, position=[0.0, 1.0])])
    standing, taken_off, told, told_again, read, read_again = found
    assert not standing["has_collided"]
    assert standing["object_id"] == -1
    assert not taken_off["has_collided"], "taking off is no collision"
    assert told == told_again == read
    assert read["has_collided"]
    assert read["object_name"] == "wall"
    assert read["object_id"] == initial_id("wall")
    assert numbers(read["normal"]) == pytest.approx((-1.0, 0.0, 0.0), abs=0.01)
    assert read["impact_point"]["x_val"] == pytest.approx(4.0, abs=0.05)
    assert read["impact_point"]["y_val"] == pytest.approx(0.0, abs=0.3), "local, not of map"
    assert 3.5 < read["position"]["x_val"] < 4.0
    assert 0.0 < read["penetration_depth"] < 0.05
    assert 8_000_000_000 < read["time_stamp"] <= 12_000_000_000
    assert read_again == read | {"has_collided": False}


def test_landing_counts_since_the_ground_does_with_airsim(tiny_world: str) -> None:
    found: list[Any] = []

    def script(call: Caller) -> None:
        call("enableApiControl", True, "")
        fly(call, 8.0, "takeoff", 20.0, "")
        found.append(call("getMultirotorState", ""))
        fly(call, 20.0, "land", 60.0, "")
        found.append(call("getMultirotorState", ""))
        call("reset")
        found.append(call("getMultirotorState", ""))
        call("simContinueForTime", 1.0)
        found.append(call("getMultirotorState", ""))

    with_script(script, [drone(world=tiny_world)])
    flying, landed, reset, later = found
    assert (flying["landed_state"], flying["collision"]["has_collided"]) == (1, False)
    assert (landed["landed_state"], landed["collision"]["has_collided"]) == (0, True)
    assert landed["collision"]["object_name"] == "floor"
    for state in (reset, later):
        assert (state["landed_state"], state["collision"]["has_collided"]) == (0, False)
        assert state["collision"]["object_name"] == ""


def test_a_fall_without_motors_is_a_collision_and_being_put_down_is_none(tiny_world: str) -> None:
    found: list[Any] = []
    place = {"position": {"x_val": 1.0, "y_val": 2.0, "z_val": -2.0}}

    def script(call: Caller) -> None:
        for down in (-2.0, 0.0):
            place["position"]["z_val"] = down
            call("simSetVehiclePose", place, True, "")
            found.append(call("getMultirotorState", "")["landed_state"])
            call("simContinueForTime", 1.5)
            found.append(call("simGetCollisionInfo", "")["has_collided"])

    with_script(script, [drone(world=tiny_world)])
    assert found == [1, True, 0, False]


def test_each_of_two_drones_names_the_other(tiny_world: str) -> None:
    found: dict[str, Any] = {}

    def script(call: Caller) -> None:
        above = {"position": {"x_val": 0.0, "y_val": 3.0, "z_val": -1.0}}
        call("simSetVehiclePose", above, True, "a")
        call("simContinueForTime", 1.0)
        found.update({name: call("simGetCollisionInfo", name) for name in ("a", "b")})

    nodes = [drone("a", world=tiny_world), drone("b", world=tiny_world, position=[0.0, 3.0])]
    with_script(script, nodes)
    assert found["a"]["has_collided"]
    assert found["a"]["object_name"] in {"b", "floor"}


class Touching(ServedMultirotor):
    """A vehicle that touches what it is told."""

    name = "drone"

    def __init__(self) -> None:
        self.now: set[str] = set()

    @property
    def physics(self) -> Any:
        """What it touches is told here."""
        return self

    def state(self) -> Any:
        """Do nothing."""

    def touching(self) -> bool:
        """Return whether it touches anything."""
        return bool(self.now)

    def contacts(self) -> list[Contact]:
        """Return one contact with each thing."""
        return [Contact(each, (0.0,) * 3, (0.0,) * 3, 0.0) for each in sorted(self.now)]


@pytest.mark.parametrize(
    ("looks", "told"),
    [
        (["floor"] * 30, []),
        (["floor"] * 30 + ["floor wall"] * 30, ["wall"]),  # which the floor hid once
        ([""] * 30 + ["floor"] * 5 + [""] * 5 + ["floor"], ["floor"]),  # a bounce is one
        (["floor"] * 30 + [""] * 30 + ["floor"], ["floor"]),
        ([""] * 5 + ["floor"] * 30, []),  # it is put down
    ],
)
def test_a_contact_that_begins_while_another_lasts_is_told(
    looks: list[str], told: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    found: list[str] = []
    vehicle = Touching()
    collisions = Collisions(SimpleNamespace(vehicles={"drone": vehicle}))  # type: ignore[arg-type]
    monkeypatch.setattr(collisions, "_take", lambda _, new: found.extend(c.other for c in new))
    for look in looks:
        vehicle.now = {*look.split()}
        collisions.watch()
    assert found == told
