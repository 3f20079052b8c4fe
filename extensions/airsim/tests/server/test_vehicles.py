"""The handshake, and what clients are told of vehicles: state, control, and collisions."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from extensions.airsim.tests.scripts import Caller, drone, with_script
from sims.vehicle import STANDING_HEIGHT
from sims.vehicle.physics import Contact
from visnav_airsim.server.objects import initial_id
from visnav_airsim.server.vehicles import Collisions, ServedMultirotor


def test_a_client_shakes_hands_and_steps_time(tiny_world: str) -> None:
    def script(airsim: Caller) -> None:
        assert airsim("ping") is True
        assert airsim("getServerVersion") >= 4
        assert airsim("listVehicles") == ["a", "b"]
        assert airsim("simIsPaused") is True
        airsim("simContinueForTime", 0.25)
        assert airsim("simIsPaused") is True

    result = with_script(
        script, [drone("b", world=tiny_world), drone("a", world=tiny_world, position=(2.0, 0.0))]
    )
    assert result.seconds == 0.25


def test_what_cannot_be_served_is_refused(tiny_world: str) -> None:
    def script(airsim: Caller) -> None:
        unknown = "rpclib: server could not find function 'nonsense' with argument count 1."
        airsim.refuses(unknown, "nonsense", 1)
        arity = "rpclib: Function 'simPause' was called with an invalid number of arguments."
        airsim.refuses(f"{arity} Expected: 1, got: 2", "simPause", True, 1)
        airsim.refuses("Expected `bool`, got `str`", "simPause", "yes")
        assert airsim("ping")

    with_script(script, [drone(world=tiny_world)])


@pytest.mark.slow
def test_settings_are_handed_out_as_given_or_say_what_runs(tiny_world: str, tmp_path: Path) -> None:
    camera = {"name": "eye", "width": 320, "height": 200, "fov": 60.0}

    def described(airsim: Caller) -> None:
        settings = json.loads(airsim("getSettingsString"))
        assert settings["SimMode"] == "Multirotor"
        vehicle = settings["Vehicles"]["drone"]
        assert (vehicle["VehicleType"], vehicle["X"]) == ("SimpleFlight", 2.0)
        scene = vehicle["Cameras"]["eye"]["CaptureSettings"][0]
        assert (scene["ImageType"], scene["Width"]) == (0, 320)
        assert scene["FOV_Degrees"] == pytest.approx(60.0)

    def given(airsim: Caller) -> None:
        assert airsim("getSettingsString") == ' {"a": 1.5}'

    def missing(airsim: Caller) -> None:
        airsim.refuses("settings: expected a readable file", "getSettingsString")

    path = tmp_path / "settings.json"
    path.write_text(' {"a": 1.5}')
    vehicle = drone(world=tiny_world, position=(2.0, 0.0), cameras=[camera])
    with_script(described, [vehicle])
    with_script(given, [drone(world=tiny_world)], settings=' {"a": 1.5}')
    with_script(given, [drone(world=tiny_world)], settings=str(path))
    with_script(missing, [drone(world=tiny_world)], settings=str(tmp_path / "other.json"))


def vector(fields: dict[str, float]) -> tuple[float, float, float]:
    return fields["x_val"], fields["y_val"], fields["z_val"]


def test_at_rest_a_drone_is_at_the_origin_of_its_local_frame(tiny_world: str) -> None:
    state: dict[str, Any] = {}

    def script(call: Caller) -> None:
        state.update(call("getMultirotorState", ""))
        state["truth"] = call("simGetGroundTruthKinematics", "drone")
        state["pose"] = call("simGetVehiclePose", "")

    with_script(script, [drone(world=tiny_world, position=[-3.0, 4.0], yaw=90.0)])
    kinematics = state["kinematics_estimated"]
    assert kinematics == state["truth"]
    assert state["pose"]["position"] == kinematics["position"]
    assert vector(kinematics["position"]) == pytest.approx((0, 0, 0), abs=1e-5)
    assert kinematics["orientation"]["w_val"] == pytest.approx(0.5**0.5)
    assert kinematics["orientation"]["z_val"] == pytest.approx(0.5**0.5)
    for name in ("linear_velocity", "linear_acceleration", "angular_acceleration"):
        assert vector(kinematics[name]) == pytest.approx((0, 0, 0), abs=1e-2), name
    assert state["timestamp"] == 0
    assert state["landed_state"] == 0
    assert state["gps_location"]["latitude"] == pytest.approx(47.641468 - 3 / 111_200, abs=1e-6)
    assert state["gps_location"]["altitude"] == pytest.approx(122.0 + STANDING_HEIGHT, abs=1e-3)


def test_control_is_taken_and_given_back(tiny_world: str) -> None:
    replies: list[Any] = []

    def script(call: Caller) -> None:
        replies.append(call("isApiControlEnabled", ""))
        replies.append(call("armDisarm", True, ""))
        call("enableApiControl", True, "")
        replies.append(call("isApiControlEnabled", ""))
        replies.append(call("armDisarm", False, ""))
        call("enableApiControl", False, "")
        replies.append(call("armDisarm", True, ""))

    with_script(script, [drone(world=tiny_world)])
    assert replies == [False, False, True, True, False]


def test_the_air_is_that_of_the_standard_atmosphere_at_its_altitude(tiny_world: str) -> None:
    air: dict[str, Any] = {}

    def script(call: Caller) -> None:
        air.update(call("simGetGroundTruthEnvironment", ""))
        air["home"] = call("getHomeGeoPoint", "")

    origin = (47.641468, -122.140165, 122.0 - STANDING_HEIGHT)
    with_script(script, [drone(world=tiny_world, origin=origin)])
    assert air["temperature"] == pytest.approx(287.357, abs=1e-3)
    assert air["air_pressure"] == pytest.approx(99867.98, abs=0.05)
    assert air["air_density"] == pytest.approx(99867.98 / (287.053 * 287.357), rel=1e-5)
    assert vector(air["gravity"]) == pytest.approx((0.0, 0.0, 9.81))
    assert air["geo_point"] == air["home"]
    assert air["home"]["altitude"] == pytest.approx(122.0, abs=1e-3)


@pytest.mark.slow
def test_rotors_carry_the_weight_of_what_hovers(tiny_world: str) -> None:
    states: dict[str, Any] = {}

    def script(call: Caller) -> None:
        states["still"] = call("getRotorStates", "")["rotors"]
        call("enableApiControl", True, "")
        task = call.send("takeoff", 20.0, "")
        call("simContinueForTime", 8.0)
        call.join(task)
        states.update(call("getRotorStates", ""))

    with_script(script, [drone(world=tiny_world)])
    assert states["timestamp"] == 8_000_000_000
    assert [rotor["thrust"] for rotor in states["still"]] == [0.0] * 4
    assert sum(rotor["thrust"] for rotor in states["rotors"]) == pytest.approx(1.2 * 9.81, rel=0.02)
    turns = [rotor["torque_scaler"] > 0.0 for rotor in states["rotors"]]
    assert turns == [True, True, False, False], "front right and rear left turn the same way"


def test_acceleration_is_that_of_the_physics(tiny_world: str) -> None:
    kinematics: list[Any] = []

    def script(call: Caller) -> None:
        high = {"position": {"x_val": 0.0, "y_val": 0.0, "z_val": -30.0}}
        call("simSetVehiclePose", high, True, "")
        kinematics.append(call("simGetGroundTruthKinematics", ""))
        call("simContinueForTime", 0.5)
        kinematics.append(call("simGetGroundTruthKinematics", ""))

    with_script(script, [drone(world=tiny_world)])
    assert vector(kinematics[0]["linear_acceleration"]) == pytest.approx((0.0, 0.0, 9.81), abs=1e-5)
    assert 4.5 < kinematics[1]["linear_velocity"]["z_val"] < 4.905
    assert 8.5 < kinematics[1]["linear_acceleration"]["z_val"] < 9.81, "air slows it down"


NORTH = {"is_rate": True, "yaw_or_rate": 0.0}


def numbers(fields: dict[str, float]) -> tuple[float, ...]:
    return tuple(fields.values())


def fly(call: Caller, seconds: float, method: str, *arguments: Any) -> None:
    task = call.send(method, *arguments)
    call("simContinueForTime", seconds)
    call.join(task)


@pytest.mark.slow
def test_a_wall_is_hit_and_reading_it_clears_it(tiny_world: str) -> None:
    collisions: list[Any] = []

    def script(call: Caller) -> None:
        call("enableApiControl", True, "")
        collisions.append(call("simGetCollisionInfo", ""))
        fly(call, 8.0, "takeoff", 20.0, "")
        collisions.append(call("simGetCollisionInfo", ""))
        fly(call, 4.0, "moveByVelocity", 3.0, 0.0, 0.0, 4.0, 0, NORTH, "")
        collisions.extend(call("getMultirotorState", "")["collision"] for _ in range(2))
        collisions.extend(call("simGetCollisionInfo", "") for _ in range(2))

    with_script(script, [drone(world=tiny_world, position=[0.0, 1.0])])
    standing, taken_off, told, told_again, read, read_again = collisions
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


@pytest.mark.slow
def test_landing_counts_since_the_ground_does_with_airsim(tiny_world: str) -> None:
    states: list[Any] = []

    def script(call: Caller) -> None:
        call("enableApiControl", True, "")
        fly(call, 8.0, "takeoff", 20.0, "")
        states.append(call("getMultirotorState", ""))
        fly(call, 20.0, "land", 60.0, "")
        states.append(call("getMultirotorState", ""))
        call("reset")
        states.append(call("getMultirotorState", ""))
        call("simContinueForTime", 1.0)
        states.append(call("getMultirotorState", ""))

    with_script(script, [drone(world=tiny_world)])
    flying, landed, reset, later = states
    assert (flying["landed_state"], flying["collision"]["has_collided"]) == (1, False)
    assert (landed["landed_state"], landed["collision"]["has_collided"]) == (0, True)
    assert landed["collision"]["object_name"] == "floor"
    for state in (reset, later):
        assert (state["landed_state"], state["collision"]["has_collided"]) == (0, False)
        assert state["collision"]["object_name"] == ""


def test_a_fall_without_motors_is_a_collision_and_being_put_down_is_none(tiny_world: str) -> None:
    replies: list[Any] = []
    place = {"position": {"x_val": 1.0, "y_val": 2.0, "z_val": -2.0}}

    def script(call: Caller) -> None:
        for down in (-2.0, 0.0):
            place["position"]["z_val"] = down
            call("simSetVehiclePose", place, True, "")
            replies.append(call("getMultirotorState", "")["landed_state"])
            call("simContinueForTime", 1.5)
            replies.append(call("simGetCollisionInfo", "")["has_collided"])

    with_script(script, [drone(world=tiny_world)])
    assert replies == [1, True, 0, False]


def test_each_of_two_drones_names_the_other(tiny_world: str) -> None:
    collisions: dict[str, Any] = {}

    def script(call: Caller) -> None:
        above = {"position": {"x_val": 0.0, "y_val": 3.0, "z_val": -1.0}}
        call("simSetVehiclePose", above, True, "a")
        call("simContinueForTime", 1.0)
        collisions.update({name: call("simGetCollisionInfo", name) for name in ("a", "b")})

    nodes = [drone("a", world=tiny_world), drone("b", world=tiny_world, position=[0.0, 3.0])]
    with_script(script, nodes)
    assert collisions["a"]["has_collided"]
    assert collisions["a"]["object_name"] in {"b", "floor"}


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
        return [Contact(other, (0.0,) * 3, (0.0,) * 3, 0.0) for other in sorted(self.now)]


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
    others: list[str] = []
    vehicle = Touching()
    collisions = Collisions({"drone": vehicle}, lambda name: (name, 0))
    monkeypatch.setattr(
        collisions, "_handle_contacts", lambda _, new: others.extend(c.other for c in new)
    )
    for look in looks:
        vehicle.now = {*look.split()}
        collisions.watch()
    assert others == told
