"""What clients are told of a vehicle: where it is, how it moves, and whether it is theirs."""

from __future__ import annotations

from typing import Any

import pytest

from sims.vehicle import STANDING_HEIGHT
from tests.sims.airsim.scripts import Caller, drone, with_script


def vector(found: dict[str, float]) -> tuple[float, float, float]:
    return found["x_val"], found["y_val"], found["z_val"]


def test_at_rest_a_drone_is_at_the_origin_of_its_local_frame(tiny_world: str) -> None:
    found: dict[str, Any] = {}

    def script(call: Caller) -> None:
        found.update(call("getMultirotorState", ""))
        found["truth"] = call("simGetGroundTruthKinematics", "drone")
        found["pose"] = call("simGetVehiclePose", "")

    with_script(script, [drone(world=tiny_world, position=[-3.0, 4.0], yaw=90.0)])
    kinematics = found["kinematics_estimated"]
    assert kinematics == found["truth"]
    assert found["pose"]["position"] == kinematics["position"]
    assert vector(kinematics["position"]) == pytest.approx((0, 0, 0), abs=1e-5)
    assert kinematics["orientation"]["w_val"] == pytest.approx(0.5**0.5)
    assert kinematics["orientation"]["z_val"] == pytest.approx(0.5**0.5)
    for name in ("linear_velocity", "linear_acceleration", "angular_acceleration"):
        assert vector(kinematics[name]) == pytest.approx((0, 0, 0), abs=1e-2), name
    assert found["timestamp"] == 0
    assert found["landed_state"] == 0
    assert found["gps_location"]["latitude"] == pytest.approx(47.641468 - 3 / 111_200, abs=1e-6)
    assert found["gps_location"]["altitude"] == pytest.approx(122.0 + STANDING_HEIGHT, abs=1e-3)


def test_control_is_taken_and_given_back(tiny_world: str) -> None:
    found: list[Any] = []

    def script(call: Caller) -> None:
        found.append(call("isApiControlEnabled", ""))
        found.append(call("armDisarm", True, ""))
        call("enableApiControl", True, "")
        found.append(call("isApiControlEnabled", ""))
        found.append(call("armDisarm", False, ""))
        call("enableApiControl", False, "")
        found.append(call("armDisarm", True, ""))

    with_script(script, [drone(world=tiny_world)])
    assert found == [False, False, True, True, False]


def test_the_air_is_that_of_the_standard_atmosphere_at_its_altitude(tiny_world: str) -> None:
    found: dict[str, Any] = {}

    def script(call: Caller) -> None:
        found.update(call("simGetGroundTruthEnvironment", ""))
        found["home"] = call("getHomeGeoPoint", "")

    origin = (47.641468, -122.140165, 122.0 - STANDING_HEIGHT)
    with_script(script, [drone(world=tiny_world, origin=origin)])
    assert found["temperature"] == pytest.approx(287.357, abs=1e-3)
    assert found["air_pressure"] == pytest.approx(99867.98, abs=0.05)
    assert found["air_density"] == pytest.approx(99867.98 / (287.053 * 287.357), rel=1e-5)
    assert vector(found["gravity"]) == pytest.approx((0.0, 0.0, 9.81))
    assert found["geo_point"] == found["home"]
    assert found["home"]["altitude"] == pytest.approx(122.0, abs=1e-3)


def test_rotors_carry_the_weight_of_what_hovers(tiny_world: str) -> None:
    found: dict[str, Any] = {}

    def script(call: Caller) -> None:
        found["still"] = call("getRotorStates", "")["rotors"]
        call("enableApiControl", True, "")
        task = call.send("takeoff", 20.0, "")
        call("simContinueForTime", 8.0)
        call.join(task)
        found.update(call("getRotorStates", ""))

    with_script(script, [drone(world=tiny_world)])
    assert found["timestamp"] == 8_000_000_000
    assert [rotor["thrust"] for rotor in found["still"]] == [0.0] * 4
    assert sum(rotor["thrust"] for rotor in found["rotors"]) == pytest.approx(1.2 * 9.81, rel=0.02)
    turns = [rotor["torque_scaler"] > 0.0 for rotor in found["rotors"]]
    assert turns == [True, True, False, False], "front right and rear left turn the same way"


def test_acceleration_is_that_of_the_physics(tiny_world: str) -> None:
    found: list[Any] = []

    def script(call: Caller) -> None:
        high = {"position": {"x_val": 0.0, "y_val": 0.0, "z_val": -30.0}}
        call("simSetVehiclePose", high, True, "")
        found.append(call("simGetGroundTruthKinematics", ""))
        call("simContinueForTime", 0.5)
        found.append(call("simGetGroundTruthKinematics", ""))

    with_script(script, [drone(world=tiny_world)])
    assert vector(found[0]["linear_acceleration"]) == pytest.approx((0.0, 0.0, 9.81), abs=1e-5)
    assert 4.5 < found[1]["linear_velocity"]["z_val"] < 4.905
    assert 8.5 < found[1]["linear_acceleration"]["z_val"] < 9.81, "air slows it down"
