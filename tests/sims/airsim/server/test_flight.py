"""Moves of a vehicle, as a script sees them."""

from __future__ import annotations

import itertools
import math

from events import Odometry, Vector3
from runtime.testing import NodeResult
from tests.sims.airsim.scripts import Caller, drone, with_script

NO_YAW = {"is_rate": True, "yaw_or_rate": 0.0}


def flown(caller: Caller, id_: int, *, step: float = 0.5, at_most: float = 60.0) -> float:
    """Step time until a reply has come, and return the seconds it took."""
    for count in range(round(at_most / step)):
        caller("simContinueForTime", step)
        if id_ in caller._replies:
            return (count + 1) * step
    raise AssertionError("no reply")


def position(result: NodeResult, seconds: float) -> Vector3:
    """Return where the vehicle was, metres from its start."""
    track = result.of(Odometry)
    (found,) = (each for each in track if each.stamp == round(seconds * 1e9))
    x, y, z = (a - b for a, b in zip(found.position, track[0].position, strict=True))
    return x, y, z


def test_a_takeoff_climbs_two_metres_a_move_ends_there_and_a_landing_stops_the_motors(
    tiny_world: str,
) -> None:
    times: list[float] = []

    def script(caller: Caller) -> None:
        caller("enableApiControl", True, "")
        for method, arguments in (
            ("takeoff", (20.0, "")),
            ("moveToPosition", (4, 3, -2, 2, 3e38, 0, NO_YAW, -1, 1, "")),
            ("moveByVelocity", (0, 0, 1, 1, 0, NO_YAW, "")),
            ("hover", ("",)),
            ("land", (60.0, "")),
            ("takeoff", (20.0, "")),
        ):
            id_ = caller.send(method, *arguments)
            times.append(flown(caller, id_))
            assert caller.join(id_) is True

    result = with_script(script, [drone(world=tiny_world)])
    takeoff, move, *_ = times
    x, y, z = position(result, takeoff)
    assert abs(z + 2.0) < 0.05
    assert 4.0 <= takeoff <= 5.5
    x, y, z = position(result, takeoff + move)
    assert math.dist((x, y, z), (4.0, 3.0, -2.0)) < 0.5
    assert 2.5 <= move <= 4.0
    *_, landed, again = itertools.accumulate(times)
    assert abs(position(result, landed)[2]) < 0.01
    assert abs(position(result, again)[2] + 2.0) < 0.05
