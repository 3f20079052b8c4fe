"""Clients take control of vehicles, put them somewhere, and reset them."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from events import Disarmed, Event, Imu, Odometry
from extensions.airsim.tests.scripts import Caller, RefusedError, drone, with_script
from runtime.config.model import NodeSpec
from runtime.errors import NodeError
from runtime.testing import spec
from sims.computer_vision import FreeCamera

NAN = math.nan
QUARTER = {"w_val": 0.5**0.5, "x_val": 0.0, "y_val": 0.0, "z_val": 0.5**0.5}


def vector(x: float, y: float, z: float) -> dict[str, float]:
    return {"x_val": x, "y_val": y, "z_val": z}


def pose(x: float, y: float, z: float, orientation: dict[str, float] = QUARTER) -> dict[str, Any]:
    return {"position": vector(x, y, z), "orientation": orientation}


def numbers(fields: dict[str, float]) -> tuple[float, ...]:
    return tuple(fields.values())


def free_camera(world: str, name: str = "camera", **config: Any) -> NodeSpec:
    camera = {"name": "eye", "width": 16, "height": 16}
    return spec(FreeCamera, name, {"world": world, "cameras": [camera], **config})


@pytest.mark.slow
def test_a_drone_is_put_where_it_is_said_and_held_there_if_it_flies(tiny_world: str) -> None:
    replies: dict[str, Any] = {}

    def script(call: Caller) -> None:
        call("enableApiControl", True, "")
        flying = call.send("takeoff", 20.0, "")
        call("simContinueForTime", 8.0)
        call.join(flying)
        call("simSetVehiclePose", pose(-3.0, 4.0, -10.0), True, "")
        replies["at once"] = call("simGetGroundTruthKinematics", "")
        call("simContinueForTime", 3.0)
        replies["later"] = call("simGetGroundTruthKinematics", "")

    with_script(script, [drone(world=tiny_world)])
    at_once, later = replies["at once"], replies["later"]
    assert numbers(at_once["position"]) == pytest.approx((-3.0, 4.0, -10.0), abs=1e-12)
    assert numbers(at_once["orientation"]) == pytest.approx(numbers(QUARTER), abs=1e-12)
    assert numbers(at_once["linear_velocity"]) == pytest.approx((0.0,) * 3, abs=1e-6)
    assert numbers(later["position"]) == pytest.approx((-3.0, 4.0, -10.0), abs=0.1)
    assert numbers(later["orientation"]) == pytest.approx(numbers(QUARTER), abs=0.02)


def test_what_is_nan_is_kept_and_velocities_can_be_given(tiny_world: str) -> None:
    replies: list[Any] = []
    unknown = dict.fromkeys(QUARTER, NAN)

    def script(call: Caller) -> None:
        call("simSetVehiclePose", pose(1.0, 2.0, -20.0), True, "")
        call("simSetVehiclePose", pose(NAN, 3.0, NAN, unknown), True, "")
        replies.append(call("simGetVehiclePose", ""))
        moving = pose(NAN, NAN, NAN, unknown)
        moving |= {"linear_velocity": vector(1.0, -2.0, 3.0)}
        moving |= {"angular_velocity": vector(0.1, 0.2, NAN)}
        call("simSetKinematics", moving, True, "")
        replies.append(call("simGetGroundTruthKinematics", ""))

    with_script(script, [drone(world=tiny_world)])
    assert numbers(replies[0]["position"]) == pytest.approx((1.0, 3.0, -20.0), abs=1e-12)
    assert numbers(replies[0]["orientation"]) == pytest.approx(numbers(QUARTER), abs=1e-12)
    assert replies[1]["position"] == replies[0]["position"]
    assert numbers(replies[1]["linear_velocity"]) == pytest.approx((1.0, -2.0, 3.0), abs=1e-6)
    assert numbers(replies[1]["angular_velocity"]) == pytest.approx((0.1, 0.2, 0.0), abs=1e-6)


def test_where_no_drone_can_be_is_refused_and_it_stays(tiny_world: str) -> None:
    refused: list[tuple[dict[str, Any], str]] = [
        (pose(math.inf, 0.0, 0.0), "finite"),
        (pose(1e300, 0.0, 0.0), "cannot be put there"),
        (pose(0.0, 0.0, 5000.0), "cannot be put there"),
        (pose(0.0, 0.0, 0.0, dict.fromkeys(QUARTER, 0.0)), "quaternion"),
        (pose(0.0, 0.0, 0.0, dict.fromkeys(QUARTER, 1e308)), "quaternion"),
        ({"position": "here"}, "Expected `object`"),
    ]

    def script(call: Caller) -> None:
        for asked, why in refused:
            before = call("simGetVehiclePose", "")
            call.refuses(why, "simSetVehiclePose", asked, True, "")
            assert call("simGetVehiclePose", "") == before
            call("simContinueForTime", 0.1)
            pose = call("simGetVehiclePose", "")
            assert numbers(pose["position"]) == pytest.approx((0.0, 0.0, 0.0), abs=1e-4)

    with_script(script, [drone(world=tiny_world)])


@pytest.mark.slow
def test_reset_brings_the_start_back_and_the_drone_flies_again(tiny_world: str) -> None:
    replies: dict[str, Any] = {}

    def script(call: Caller) -> None:
        for turn in ("first", "second"):
            call("enableApiControl", True, "")
            flying = call.send("takeoff", 20.0, "")
            call("simContinueForTime", 8.0)
            replies[turn] = call.join(flying), call("simGetVehiclePose", "")
            moving = call.send("moveToPosition", 9.0, 9.0, -9.0, 3.0, 3e38, 0, {}, -1.0, 1.0, "")
            call("simContinueForTime", 1.0)
            call("reset")
            replies["cancelled"] = call.join(moving)
            replies["control"] = call("isApiControlEnabled", "")
            replies["start"] = call("getMultirotorState", "")

    with_script(script, [drone(world=tiny_world, position=[-3.0, 1.0], yaw=30.0)])
    first, second = replies["first"], replies["second"]
    assert first[0]
    assert second[0]
    assert numbers(second[1]["position"]) == pytest.approx(numbers(first[1]["position"]), abs=0.01)
    assert replies["cancelled"] is False
    assert replies["control"] is False
    start = replies["start"]
    assert start["timestamp"] == 18_000_000_000
    assert start["landed_state"] == 0
    kinematics = start["kinematics_estimated"]
    assert numbers(kinematics["position"]) == (0.0, 0.0, 0.0)
    assert numbers(kinematics["linear_velocity"]) == pytest.approx((0.0,) * 3, abs=1e-4)
    yaw = math.radians(30.0) / 2.0
    assert numbers(kinematics["orientation"]) == pytest.approx(
        (math.cos(yaw), 0.0, 0.0, math.sin(yaw)), abs=1e-4
    )


def test_reset_resets_every_vehicle_and_its_sensors(tiny_world: str) -> None:
    def script(call: Caller) -> None:
        call("simContinueForTime", 0.4)
        call("enableApiControl", True, "b")
        call("simSetVehiclePose", pose(1.0, 0.0, -9.0), True, "a")
        call("reset")
        call("simContinueForTime", 0.4)

    nodes = [drone("a", world=tiny_world), drone("b", world=tiny_world, position=[0.0, 3.0])]
    sent = with_script(script, nodes).sent
    for name in ("a", "b"):
        samples = [e for e in sent if isinstance(e, Imu) and e.source == f"{name}/imu"]
        assert len(samples) == 161
        noise = [[s.linear_acceleration[0] for s in part] for part in (samples[:80], samples[81:])]
        assert noise[0] == pytest.approx(noise[1], abs=1e-6)
    assert [e.source for e in sent if isinstance(e, Disarmed)] == ["b"]


@pytest.mark.slow
@pytest.mark.parametrize("between", ["armDisarm", "reset"])
def test_a_script_flies_at_the_instant_at_which_another_one_has_disarmed(
    between: str, tiny_world: str
) -> None:
    replies: list[Any] = []

    def script(call: Caller) -> None:
        for _ in range(2):
            call("enableApiControl", True, "")
            call("armDisarm", True, "")
            replies.append(call("takeoff", 20.0, ""))
            replies.append(call("simGetVehiclePose", "")["position"]["z_val"])
            call("simSetVehiclePose", pose(0.0, 0.0, 0.0), True, "")
            call("armDisarm", False, "")
            if between == "reset":
                call("reset")

    with_script(script, [drone(world=tiny_world)], time="awaited")
    assert replies[::2] == [True, True]
    assert replies[1::2] == pytest.approx([-2.0, -2.0], abs=0.5)


def test_reset_calms_the_wind_of_a_client(tiny_world: str) -> None:
    norths: list[float] = []

    def script(call: Caller) -> None:
        for _ in range(2):
            call("simSetVehiclePose", pose(0.0, 0.0, -30.0), True, "")
            call("simContinueForTime", 0.5)
            norths.append(call("simGetVehiclePose", "")["position"]["x_val"])
            call("simSetWind", vector(30.0, 0.0, 0.0))
            call("simSetWind", vector(40.0, 0.0, 0.0))
            call("simSetVehiclePose", pose(0.0, 0.0, -30.0), True, "")
            call("simContinueForTime", 0.5)
            norths.append(call("simGetVehiclePose", "")["position"]["x_val"])
            call("reset")

    with_script(script, [drone(world=tiny_world)])
    # For one more step of the physics the old wind blows on.
    assert max(map(abs, norths[::2])) < 0.02
    assert min(norths[1::2]) > 1.0


@pytest.mark.slow
def test_a_free_camera_is_where_it_is_put_at_once(tiny_world: str) -> None:
    replies: dict[str, Any] = {}

    def script(call: Caller) -> None:
        replies["vehicles"] = call("listVehicles")
        call("simSetVehiclePose", pose(2.0, 3.0, -1.0), True, "")
        replies["pose"] = call("simGetVehiclePose", "camera")
        replies["truth"] = call("getComputerVisionState", "")
        call.refuses("cannot be put there", "simSetVehiclePose", pose(1e30, 0.0, 0.0), True, "")
        for name in ("", "camera"):
            text = f"Vehicle API for '{name}' is not available"
            call.refuses(text, "getMultirotorState", name)
            call.refuses("'camera' is a free camera", "getLidarData", "Lidar1", name)
        call("simContinueForTime", 0.1)
        replies["later"] = call("simGetVehiclePose", "")
        call("reset")
        replies["start"] = call("simGetVehiclePose", "")

    result = with_script(script, [free_camera(tiny_world, position=[1.0, 1.0, -2.0])])
    assert replies["vehicles"] == ["camera"]
    for name in ("pose", "later"):
        assert numbers(replies[name]["position"]) == (2.0, 3.0, -1.0)
        assert numbers(replies[name]["orientation"]) == pytest.approx(numbers(QUARTER), abs=1e-12)
    assert replies["truth"]["kinematics_estimated"]["position"] == replies["pose"]["position"]
    assert numbers(replies["start"]["position"]) == (0.0, 0.0, 0.0)
    assert result.of(Odometry)[-1].position == (3.0, 4.0, -3.0)


def test_unknown_vehicles_are_errors_with_airsims_texts(tiny_world: str) -> None:
    def script(call: Caller) -> None:
        for method, interface in (
            ("getMultirotorState", "Vehicle API"),
            ("simGetVehiclePose", "Vehicle Sim-API"),
        ):
            with pytest.raises(RefusedError) as refused:
                call(method, "nobody")
            assert str(refused.value) == (
                f"rpclib: function '{method}' (called with 1 arg(s)) threw an exception. The "
                f"exception contained this information: {interface} for 'nobody' is not "
                "available. This could either because this is simulation-only API or this "
                "vehicle does not exist."
            )
        assert call("simAddVehicle", "x", "simpleflight", {}, "") is False

    with_script(script, [drone(world=tiny_world)])


def test_an_empty_name_is_the_default_vehicle_or_the_first_by_name(tiny_world: str) -> None:
    heights: list[float] = []

    def script(call: Caller) -> None:
        call("simSetVehiclePose", pose(0.0, 0.0, -7.0), True, "")
        heights.append(call("simGetVehiclePose", "a")["position"]["z_val"])

    nodes = [drone("b", world=tiny_world, position=[0.0, 3.0]), drone("a", world=tiny_world)]
    with_script(script, nodes)
    with_script(script, nodes, default_vehicle="b")
    assert heights == pytest.approx([-7.0, 0.0], abs=1e-3)


def test_a_default_vehicle_that_is_not_there_is_refused(tiny_world: str) -> None:
    with pytest.raises(NodeError, match='default_vehicle: expected one of drone, found "x"'):
        with_script(lambda _: None, [drone(world=tiny_world)], default_vehicle="x")


@pytest.mark.slow
def test_beside_a_free_camera_an_empty_name_still_flies_the_drone(tiny_world: str) -> None:
    replies: dict[str, Any] = {}

    def script(call: Caller) -> None:
        call("simSetVehiclePose", pose(5.0, 0.0, 0.0), True, "camera")
        replies["camera"] = call("simGetVehiclePose", "")["position"]["x_val"]
        replies["drone"] = call("getMultirotorState", "")["landed_state"]
        call("reset")

    with_script(script, [free_camera(tiny_world), drone(world=tiny_world)])
    assert replies == {"camera": 5.0, "drone": 0}


POSITIONS = st.tuples(*[st.floats(-9e3, 9e3)] * 2, st.floats(-9e3, 50.0))
SPEEDS = st.tuples(*[st.floats(-50.0, 50.0)] * 3)
TURNS = st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: math.hypot(*q) > 0.1)


@pytest.mark.slow
@settings(max_examples=10)
@given(places=st.lists(st.tuples(POSITIONS, TURNS, SPEEDS, SPEEDS), min_size=1, max_size=4))
def test_wherever_a_drone_is_put_it_is_there_and_what_follows_is_the_same_twice(
    places: list[Any], tiny_world: str
) -> None:
    def script(call: Caller) -> None:
        for position, turn, velocity, rates in places:
            state = {
                "position": vector(*position),
                "orientation": dict(zip(QUARTER, turn, strict=True)),
                "linear_velocity": vector(*velocity),
                "angular_velocity": vector(*rates),
            }
            call("simSetKinematics", state, True, "")
            kinematics = call("simGetGroundTruthKinematics", "")
            assert numbers(kinematics["position"]) == pytest.approx(position, abs=1e-11)
            if position[2] < -1.0:  # what it is in pushes it at once
                assert numbers(kinematics["linear_velocity"]) == pytest.approx(velocity, abs=1e-6)
                assert numbers(kinematics["angular_velocity"]) == pytest.approx(rates, abs=1e-6)
            norm = math.hypot(*turn)
            unit = tuple(x / norm for x in turn)
            assert numbers(kinematics["orientation"]) == pytest.approx(unit, abs=1e-12)
            call("simContinueForTime", 0.0123)

    def flown() -> list[Event]:
        return with_script(script, [drone(world=tiny_world)]).sent

    assert flown() == flown()
