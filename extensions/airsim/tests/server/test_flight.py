"""Moves of vehicles, as scripts see them.

Time runs only while a script waits for a vehicle (``time = "awaited"``), or is stepped.
"""

from __future__ import annotations

import math
from typing import Any

import pytest

from events import Disarmed, Event, Hover, Odometry, Setpoint
from events.frames import yaw_of
from extensions.airsim.tests.scripts import Caller, RefusedError, Script, drone, with_script
from visnav_airsim.server.methods import thrown

NO_TURN = {"is_rate": True, "yaw_or_rate": 0.0}
FOREVER = 3e38


def fly(world: str, script: Script, *names: str, **server: Any) -> list[Event]:
    """Run a script that may command the vehicles, and return all that was sent."""

    def commanding(caller: Caller) -> None:
        for name in names or ("drone",):
            caller("enableApiControl", True, name)
        script(caller)

    drones = [
        drone(name, world=world, position=[0.0, 3.0 * index])
        for index, name in enumerate(names or ("drone",))
    ]
    return with_script(commanding, drones, **{"time": "awaited"} | server).sent


def place(caller: Caller, vehicle: str = "") -> tuple[float, float, float]:
    position = caller("simGetVehiclePose", vehicle)["position"]
    return position["x_val"], position["y_val"], position["z_val"]


def speed(caller: Caller) -> tuple[float, float, float]:
    velocity = caller("simGetGroundTruthKinematics", "")["linear_velocity"]
    return velocity["x_val"], velocity["y_val"], velocity["z_val"]


def heading(caller: Caller) -> float:
    """Return the heading in degrees."""
    orientation = caller("simGetVehiclePose", "")["orientation"]
    w, x, y, z = (orientation[f"{axis}_val"] for axis in "wxyz")
    return math.degrees(yaw_of((w, x, y, z)))


def now(caller: Caller) -> float:
    seconds: float = caller("getMultirotorState", "")["timestamp"] / 1e9
    return seconds


def to(x: float, y: float, z: float, velocity: float, timeout: float = FOREVER) -> tuple[Any, ...]:
    """Return the arguments of `moveToPosition`."""
    return (x, y, z, velocity, timeout, 0, NO_TURN, -1, 1, "")


@pytest.mark.slow
def test_the_usual_flight(tiny_world: str) -> None:
    def script(caller: Caller) -> None:
        assert caller("takeoff", 20, "") is True
        assert place(caller) == pytest.approx((0.0, 0.0, -2.0), abs=0.05)
        assert 4.0 < now(caller) < 5.5
        assert caller("moveToPosition", *to(-4, 3, -3, 3)) is True
        assert math.dist(place(caller), (-4.0, 3.0, -3.0)) < 0.3
        end = place(caller)
        assert caller("hover", "") is True
        caller("rotateByYawRate", 0.0, 2.0, "")
        assert math.dist(place(caller), end) < 0.2
        assert caller("moveToZ", -1.0, 1, FOREVER, NO_TURN, -1, 1, "") is True
        assert place(caller)[2] == pytest.approx(-1.0, abs=0.05)
        assert caller("land", 60, "") is True
        assert place(caller)[2] == pytest.approx(0.0, abs=0.01)
        assert max(map(abs, speed(caller))) < 0.01
        assert caller("takeoff", 20, "") is True, "armed still"
        assert caller("goHome", FOREVER, "") is True

    sent = fly(tiny_world, script)
    assert sum(isinstance(event, Disarmed) for event in sent) == 1


@pytest.mark.slow
def test_moves_by_velocity_last_as_long_as_they_say(tiny_world: str) -> None:
    def script(caller: Caller) -> None:
        caller("takeoff", 20, "")
        for velocity in ((2.0, -1.0, -0.5), (0.0, 0.0, 0.5)):
            begin = now(caller)
            assert caller("moveByVelocity", *velocity, 2.0, 0, NO_TURN, "") is True
            assert now(caller) - begin == pytest.approx(2.0, abs=0.021)
            assert speed(caller) == pytest.approx(velocity, abs=0.2)
        assert caller("moveByVelocityZ", 0, 0, -3, 4.0, 0, NO_TURN, "") is True
        assert place(caller)[2] == pytest.approx(-3.0, abs=0.03)
        before = place(caller)
        assert caller("rotateToYaw", 90.0, 20.0, 1.0, "") is True
        assert heading(caller) == pytest.approx(90.0, abs=1.0)
        assert math.dist(place(caller), before) < 0.1
        assert caller("moveByVelocityBodyFrame", 1, 0, 0, 2.0, 0, NO_TURN, "") is True
        assert speed(caller) == pytest.approx((0.0, 1.0, 0.0), abs=0.1), "forward is east now"
        assert caller("moveByVelocityZBodyFrame", 0, 1, -2, 4.0, 0, NO_TURN, "") is True
        assert speed(caller) == pytest.approx((-1.0, 0.0, 0.0), abs=0.1)
        assert place(caller)[2] == pytest.approx(-2.0, abs=0.03)

    fly(tiny_world, script)


@pytest.mark.slow
def test_yaw_modes_turn_or_look_ahead(tiny_world: str) -> None:
    def script(caller: Caller) -> None:
        caller("takeoff", 20, "")
        fixed, ahead = (
            {"is_rate": False, "yaw_or_rate": 120.0},
            {"is_rate": False, "yaw_or_rate": 0.0},
        )
        caller("moveByVelocity", -1, 0, 0, 4.0, 0, fixed, "")
        assert heading(caller) == pytest.approx(120.0, abs=1.0)
        caller("moveByVelocity", 0, -1, 0, 4.0, 1, ahead, "")
        assert heading(caller) == pytest.approx(-90.0, abs=1.0), "it looks where it goes"
        caller("moveByVelocity", 0.3, 0.3, 0, 2.0, 1, ahead, "")
        assert heading(caller) == pytest.approx(-90.0, abs=1.0), "unless it is slow"
        caller("moveByVelocity", 0, 0, 0, 3.0, 0, {"is_rate": True, "yaw_or_rate": 30.0}, "")
        assert heading(caller) == pytest.approx(0.0, abs=6.0)
        caller("rotateByYawRate", -45.0, 2.0, "")
        caller("rotateByYawRate", 0.0, 1.0, "")
        assert heading(caller) == pytest.approx(-90.0, abs=12.0)
        x, y, _ = place(caller)
        caller("moveToPosition", x - 4, y - 4, -2, 2, FOREVER, 1, ahead, -1, 1, "")
        assert heading(caller) == pytest.approx(-135.0, abs=5.0)

    fly(tiny_world, script)


@pytest.mark.slow
def test_attitudes_rates_and_motors(tiny_world: str) -> None:
    def script(caller: Caller) -> None:
        caller("takeoff", 20, "")
        begin = place(caller)
        assert caller("moveByRollPitchYawZ", 0.0, -0.1, 0.5, -3.0, 2.0, "") is True
        assert place(caller)[2] == pytest.approx(-3.0, abs=0.1)
        assert math.degrees(0.5) == pytest.approx(heading(caller), abs=2.0)
        forward = math.dist(place(caller)[:2], begin[:2])
        assert 1.0 < forward < 3.0, "nose down is forward"
        caller("hover", "")
        caller("rotateByYawRate", 0, 2.0, "")
        hover = 0.5865
        for method, arguments in (
            ("moveByRollPitchYawThrottle", (0, 0, 0, hover)),
            ("moveByRollPitchYawrateThrottle", (0, 0, 0, hover)),
            ("moveByAngleRatesThrottle", (0, 0, 0, hover)),
            ("moveByMotorPWMs", (hover, hover, hover, hover)),
        ):
            assert caller(method, *arguments, 0.5, "") is True
            assert abs(speed(caller)[2]) < 0.15, method
            caller("hover", "")
            caller("rotateByYawRate", 0, 1.0, "")
        before = heading(caller)
        assert caller("moveByRollPitchYawrateZ", 0, 0, 1.0, -3.0, 2.0, "") is True
        assert (heading(caller) - before) % 360.0 == pytest.approx(math.degrees(2.0), abs=25.0)
        before = heading(caller)
        assert caller("moveByAngleRatesZ", 0, 0, -1.0, -3.0, 1.0, "") is True
        assert (before - heading(caller)) % 360.0 == pytest.approx(math.degrees(1.0), abs=25.0)
        caller("rotateByYawRate", 0, 3.0, "")
        assert abs(place(caller)[2] + 3.0) < 0.3
        caller("moveByMotorPWMs", 0.9, 0.9, 0.9, 0.9, 0.5, "")
        assert speed(caller)[2] < -0.5

    fly(tiny_world, script)


@pytest.mark.slow
def test_paths_and_places_on_the_earth(tiny_world: str) -> None:
    def script(caller: Caller) -> None:
        home = caller("getMultirotorState", "")["gps_location"]
        caller("takeoff", 20, "")
        corners = [(-4, 0, -2), (-4, 4, -3), (0, 4, -2)]
        path = [dict(zip(("x_val", "y_val", "z_val"), corner, strict=True)) for corner in corners]
        assert caller("moveOnPath", path, 2, FOREVER, 0, NO_TURN, -1, 1, "") is True
        assert math.dist(place(caller), corners[-1]) < 0.4
        begin = now(caller)
        assert caller("moveOnPath", [], 2, FOREVER, 0, NO_TURN, -1, 1, "") is True
        assert now(caller) == begin
        where = home["latitude"], home["longitude"], home["altitude"] + 2.0
        assert caller("moveToGPS", *where, 2, FOREVER, 0, NO_TURN, -1, 1, "") is True
        assert math.dist(place(caller), (0.0, 0.0, -2.0)) < 0.4

    fly(tiny_world, script)


@pytest.mark.slow
def test_a_move_that_comes_too_late_or_ends_at_a_wall_has_failed(tiny_world: str) -> None:
    def script(caller: Caller) -> None:
        assert caller("takeoff", 1, "") is False
        begin = now(caller)
        assert caller("moveToPosition", *to(-50, 0, -2, 2, 1.5)) is False
        assert now(caller) - begin == pytest.approx(1.5, abs=0.021)
        assert caller("rotateToYaw", 180.0, 0.1, 1.0, "") is False
        assert caller("moveToPosition", *to(0, 0, -2, 2)) is True
        assert caller("moveToPosition", *to(5, 0, -2, 1)) is False, "inside the wall"
        for zero in (0.0, -1.0):
            begin = now(caller)
            assert caller("moveByVelocity", 1, 0, 0, zero, 0, NO_TURN, "") is True
            assert caller("moveByVelocityZ", 1, 0, -2, zero, 0, NO_TURN, "") is False
            assert now(caller) == begin

    fly(tiny_world, script)


def test_a_newer_task_ends_the_older_whose_reply_comes_first(tiny_world: str) -> None:
    def script(caller: Caller) -> None:
        first = caller.send("moveToPosition", *to(-50, 0, -2, 2))
        second = caller.send("moveByVelocity", 0, -1, 0, 1.0, 0, NO_TURN, "")
        third = caller.send("moveByVelocity", 0, 1, 0, 0.0, 0, NO_TURN, "")
        assert caller.join(third) is True
        assert list(caller._replies) == [first, second]
        assert caller.join(first) is caller.join(second) is False
        other = Caller(caller._socket.getpeername()[1])
        mine = caller.send("moveByVelocity", 0, 0, -1, 5.0, 0, NO_TURN, "")
        caller("ping")  # so the server has it before the other's
        others = other.send("moveByVelocity", 0, 0, -1, 0.5, 0, NO_TURN, "")
        assert caller.join(mine) is False
        caller("simContinueForTime", 0.5)
        assert other.join(others) is True
        cancelled = caller.send("moveByVelocity", 1, 0, 0, 5.0, 0, NO_TURN, "")
        caller("cancelLastTask", "")
        assert caller.join(cancelled) is False
        caller("cancelLastTask", "")
        other.close()

    fly(tiny_world, script, time="paused")


@pytest.mark.slow
def test_a_task_goes_on_without_its_client_and_without_api_control(tiny_world: str) -> None:
    def script(caller: Caller) -> None:
        other = Caller(caller._socket.getpeername()[1])
        takeoff = other.send("takeoff", 20, "")
        other("ping")
        other.close()
        caller("enableApiControl", False, "")
        assert takeoff == 0
        caller("simContinueForTime", 6.0)
        assert place(caller)[2] == pytest.approx(-2.0, abs=0.05)

    fly(tiny_world, script, time="paused")


def test_nothing_elapses_while_time_stands(tiny_world: str) -> None:
    def script(caller: Caller) -> None:
        id_ = caller.send("moveByVelocity", 0, 0, -1, 1.0, 0, NO_TURN, "")
        caller("simContinueForTime", 0.5)
        assert id_ not in caller._replies
        caller("simContinueForTime", 0.5)
        assert caller.join(id_) is True
        assert now(caller) == 1.0

    fly(tiny_world, script, time="paused")


@pytest.mark.slow
def test_sixty_milliseconds_after_its_last_order_a_vehicle_hovers(tiny_world: str) -> None:
    def script(caller: Caller) -> None:
        caller("simContinueForTime", 0.51)
        id_ = caller.send("moveByVelocity", 0, 0, -1, 1.0, 0, NO_TURN, "")
        caller("simContinueForTime", 3.0)
        assert caller.join(id_) is True

    sent = fly(tiny_world, script, time="paused")
    setpoints = [event.stamp for event in sent if isinstance(event, Setpoint)]
    assert setpoints == list(range(520_000_000, 1_501_000_000, 20_000_000))
    (hover,) = (event.stamp for event in sent if isinstance(event, Hover))
    assert hover == setpoints[-1] + 60_000_000


@pytest.mark.slow
def test_two_vehicles_fly_at_once(tiny_world: str) -> None:
    def script(caller: Caller) -> None:
        both = [caller.send("takeoff", 20, name) for name in ("a", "b")]
        assert [caller.join(call) for call in both] == [True, True]
        assert now(caller) < 6.0
        for name in ("a", "b"):
            assert place(caller, name) == pytest.approx((0.0, 0.0, -2.0), abs=0.05)
        assert caller("moveByVelocity", -1, 0, 0, 1.0, 0, NO_TURN, "b") is True
        assert place(caller, "a")[0] == pytest.approx(0.0, abs=0.02)
        assert place(caller, "b")[0] < -0.5

    fly(tiny_world, script, "a", "b")


@pytest.mark.slow
def test_a_disarmed_vehicle_ends_its_task_and_falls(tiny_world: str) -> None:
    def script(caller: Caller) -> None:
        caller("takeoff", 20, "")
        id_ = caller.send("moveToPosition", *to(-50, 0, -2, 2))
        caller("armDisarm", False, "")
        assert caller.join(id_) is False
        caller.refuses("'drone' is disarmed: call armDisarm first", "takeoff", 20, "")

    fly(tiny_world, script)


def test_refusals_have_airsims_own_texts(tiny_world: str) -> None:
    path = ([{"x_val": 1}], 2, 9, 1, NO_TURN, -1, 1, "")
    no_lookahead = "lookahead distance cannot be 0"
    nobody = (
        "Vehicle API for 'nobody' is not available. This could either because this is "
        "simulation-only API or this vehicle does not exist"
    )

    def script(caller: Caller) -> None:
        for method, arguments, text in (
            ("moveOnPath", path, "Yaw cannot be specified as rate if drivetrain is ForwardOnly"),
            ("moveToPosition", (1, 0, -2, 2, 9, 0, NO_TURN, 0, 1, ""), no_lookahead),
            ("takeoff", (20, "nobody"), nobody),
        ):
            caller.refuses(thrown(method, len(arguments), text), method, *arguments)

    fly(tiny_world, script)


def test_a_takeoff_of_what_moves_is_refused(tiny_world: str) -> None:
    def script(caller: Caller) -> None:
        caller("moveByVelocity", 0, 0, -1, 1.0, 0, NO_TURN, "")
        with pytest.raises(RefusedError, match=r"vehicle is already moving with velocity \d"):
            caller("takeoff", 20, "")

    fly(tiny_world, script)


def test_a_place_in_another_country_is_refused_with_the_distance(tiny_world: str) -> None:
    zurich = (47.397742, 8.545594, 488.0)

    def script(caller: Caller) -> None:
        caller.refuses(
            "expected a place within 1,000 km, found it 8,4",
            *("moveToGPS", *zurich, 2, FOREVER, 0, NO_TURN, -1, 1, ""),
        )

    fly(tiny_world, script)


NUMBERS = [
    ("takeoff", (20.0, "")),
    ("land", (60.0, "")),
    ("moveToPosition", to(1, 0, -2, 2)),
    ("moveOnPath", ([{"x_val": 1.0}], 2, FOREVER, 0, NO_TURN, -1, 1, "")),
    ("moveToZ", (-2, 1, FOREVER, NO_TURN, -1, 1, "")),
    ("moveToGPS", (47.6, 8.5, 3.0, 2, FOREVER, 0, NO_TURN, -1, 1, "")),
    ("moveByVelocity", (1, 0, 0, 1, 0, NO_TURN, "")),
    ("moveByVelocityZBodyFrame", (1, 0, -2, 1, 0, NO_TURN, "")),
    ("rotateToYaw", (90, 9, 1, "")),
    ("rotateByYawRate", (90, 9, "")),
    ("moveByRollPitchYawrateZ", (0, 0, 0, -2, 1, "")),
    ("moveByAngleRatesThrottle", (0, 0, 0, 0.5, 1, "")),
    ("moveByMotorPWMs", (0, 0, 0, 0.5, 1, "")),
]


@pytest.mark.slow
def test_no_number_that_is_none_reaches_a_vehicle(tiny_world: str) -> None:
    """Nor does one in a structure; and the vehicle flies as before."""

    def wrong(value: Any, number: float) -> Any:
        if isinstance(value, dict):
            return value | {[*value][-1]: number}
        return [{"x_val": number}] if isinstance(value, list) else number

    def script(caller: Caller) -> None:
        for method, arguments in NUMBERS:
            for index, value in enumerate(arguments[:-1]):
                for number in (math.nan, math.inf, -math.inf):
                    if method.startswith("move") and value == 0 and isinstance(value, int):
                        continue  # `drivetrain`, which is no number of this kind
                    bad = [*arguments]
                    bad[index] = wrong(value, number)
                    caller.refuses("Expected `", method, *bad)
        assert caller("takeoff", 20, "") is True

    sent = fly(tiny_world, script)
    assert all(
        math.isfinite(n) for event in sent if isinstance(event, Odometry) for n in event.position
    )


@pytest.mark.slow
def test_a_reset_ends_the_task_and_the_vehicle_takes_off_again(tiny_world: str) -> None:
    def script(caller: Caller) -> None:
        id_ = caller.send("takeoff", 20, "")
        caller("simContinueForTime", 2.0)
        assert place(caller)[2] < -0.5
        caller("reset")
        assert caller.join(id_) is False
        caller.refuses("not under API control", "takeoff", 20, "")
        caller("enableApiControl", True, "")
        id_ = caller.send("takeoff", 20, "")
        caller("simContinueForTime", 6.0)
        assert caller.join(id_) is True
        assert place(caller) == pytest.approx((0.0, 0.0, -2.0), abs=0.05)

    fly(tiny_world, script, time="paused")


def test_without_api_control_a_move_is_refused_instead_of_hanging(tiny_world: str) -> None:
    def script(caller: Caller) -> None:
        for method, arguments in NUMBERS:
            caller.refuses("not under API control: call enableApiControl", method, *arguments)

    with_script(script, [drone(world=tiny_world)])


@pytest.mark.slow
def test_equal_scripts_give_equal_flights(tiny_world: str) -> None:
    def waiting(caller: Caller) -> None:
        caller("takeoff", 1.0, "")
        caller("moveToPosition", *to(-1, 1, -2, 3))
        caller("hover", "")

    def stepping(caller: Caller) -> None:
        caller.send("takeoff", 20, "")
        caller("simContinueForTime", 1.0)
        caller.send("moveByVelocity", 1, 0, 0, 2.0, 0, NO_TURN, "")
        caller("simContinueForTime", 0.503)
        caller.send("hover", "")
        caller("simContinueForTime", 1.0)

    for script, time in ((waiting, "awaited"), (stepping, "paused")):
        first, second = (fly(tiny_world, script, time=time) for _ in range(2))
        assert len(first) > 1000
        assert first == second
