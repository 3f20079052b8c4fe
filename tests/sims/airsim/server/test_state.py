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
