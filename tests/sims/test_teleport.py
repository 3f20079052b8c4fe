"""A multirotor that is teleported and reset: what it, its sensors and its autopilot make of it."""

from __future__ import annotations

import logging
from math import hypot
from typing import Any

import numpy as np
import pytest

from events import (
    Arm,
    Command,
    Disarmed,
    Event,
    Image,
    Imu,
    Land,
    LidarScan,
    Odometry,
    PositionSetpoint,
    Reset,
    TakenOff,
    Takeoff,
    Teleport,
    Vector3,
    VelocitySetpoint,
)
from events import frames as rotations
from runtime.testing import NodeResult, run_node
from sims.multirotor import Multirotor
from tests.sims.vehicle.flight import WORLD

SECOND = 1_000_000_000
TURNED = rotations.from_rpy(0.0, 0.0, 1.0)


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("world") / "tiny.xml"
    path.write_text(WORLD)
    return str(path)


def fly(world: str, *inputs: Event, duration: float, **config: Any) -> NodeResult:
    config = {"world": world} | config
    return run_node(Multirotor, inputs=inputs, config=config, duration=duration, name="drone")


def say(kind: type[Command], seconds: float, **fields: Any) -> Command:
    return kind(stamp=round(seconds * SECOND), source="test", **fields)


def teleport(seconds: float, *position: float, **fields: Any) -> Command:
    return say(Teleport, seconds, position=position, orientation=TURNED, **fields)


def apart(a: Vector3, b: Vector3) -> float:
    return hypot(*(x - y for x, y in zip(a, b, strict=True)))


@pytest.mark.parametrize("before", [0.5, 4.0, 5.5], ids=["taking off", "flying", "landing"])
def test_whoever_is_teleported_in_the_air_holds_the_new_place(before: float, world: str) -> None:
    orders = [say(Takeoff, 0.0), say(Land, 5.0)]
    place = (-3.0, 2.0, -7.0)
    at = before + 0.0004  # between two steps of the physics
    result = fly(
        world,
        *(order for order in orders if order.stamp < at * SECOND),
        teleport(at, *place),
        duration=before + 3.0,
    )
    poses = [each for each in result.of(Odometry) if each.stamp > at * SECOND]
    assert apart(poses[0].position, place) < 1e-3
    assert apart(poses[-1].position, place) < 0.1
    assert max(apart(each.position, place) for each in poses) < 0.5
    assert rotations.yaw_of(poses[-1].orientation) == pytest.approx(1.0, abs=0.02)


def test_one_that_does_not_fly_falls_from_where_it_is_put(world: str) -> None:
    last = fly(world, teleport(0.1, 0.0, 0.0, -1.0), duration=1.5).of(Odometry)[-1]
    assert -0.2 < last.position[2] < 0.0


@pytest.mark.parametrize("sampling", ["instant", "mean"])
def test_an_imu_feels_no_jump(sampling: str, world: str) -> None:
    result = fly(
        world,
        say(Takeoff, 0.0),
        PositionSetpoint(stamp=3 * SECOND, source="test", position=(0.0, 0.0, -1.5)),
        teleport(4.0026, 3.0, 0.0, -9.0, linear_velocity=(0.0, 0.0, 0.0)),
        duration=4.5,
        imu={"ideal": True, "sampling": sampling, "position": [0.1, 0.0, 0.0]},
    )
    late = [sample for sample in result.of(Imu) if sample.stamp > 3.8 * SECOND]
    assert len(late) == 139
    assert max(abs(s.linear_acceleration[2] + 9.81) for s in late) < 3.0
    assert max(hypot(*s.angular_velocity) for s in late) < 1.0


@pytest.mark.slow
def test_exposures_and_scans_in_progress_survive_a_jump(world: str) -> None:
    camera = {
        "name": "rolling", "width": 32, "height": 24, "rate": 20, "readout": "40ms",
        "exposure": "5ms",
    }  # fmt: skip
    lidar = {"name": "lidar", "channels": 2, "columns": 64}
    result = fly(
        world,
        say(Takeoff, 0.0),
        teleport(2.5053, -3.0, 2.0, -7.0),
        say(Reset, 3.0113),
        duration=3.5,
        cameras=[camera],
        lidars=[lidar],
    )
    images, scans = result.of(Image), result.of(LidarScan)
    assert np.diff([image.stamp for image in images]).tolist() == [SECOND // 20] * (len(images) - 1)
    assert images[-1].stamp >= 3.35 * SECOND
    assert np.diff([s.stamp for s in scans]).tolist() == [SECOND // 10] * (len(scans) - 1)


def test_where_physics_would_break_it_refuses_to_be(
    world: str, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        result = fly(
            world,
            teleport(0.1, 0.0, 0.0, -1e6),
            teleport(0.2, 0.0, 0.0, 5000.0),
            teleport(0.3, 0.0, 0.0, -1.0, linear_velocity=(1e4, 0.0, 0.0)),
            teleport(0.4, 0.0, 0.0, -1.0, angular_velocity=(0.0, 1e4, 0.0)),
            duration=0.5,
        )
    assert sum("Teleport refused" in each.message for each in caplog.records) == 4
    assert apart(result.of(Odometry)[-1].position, (0.0, 0.0, -0.1)) < 1e-3


def test_a_reset_in_the_air_brings_it_to_the_start_and_it_takes_off_as_before(world: str) -> None:
    result = fly(
        world,
        say(Takeoff, 0.0),
        VelocitySetpoint(stamp=4 * SECOND, source="test", velocity=(2.0, 1.0, 0.0), yaw_rate=2.0),
        say(Reset, 4.4),
        say(Takeoff, 5.0),
        duration=9.0,
        position=[1.0, 2.0],
    )
    poses = {each.stamp: each for each in result.of(Odometry)}
    first = result.of(Odometry)[0]
    for seconds in (4.405, 4.9):
        rested = poses[round(seconds * SECOND)]
        assert apart(rested.position, first.position) < 1e-6
        assert apart(rested.linear_velocity, (0.0, 0.0, 0.0)) < 1e-4
    (disarmed,) = result.of(Disarmed)
    assert disarmed.stamp == 4_400_000_000
    once, again = result.of(TakenOff)
    assert again.stamp - once.stamp == pytest.approx(5 * SECOND, abs=5_000_000)
    assert poses[9 * SECOND - 5_000_000].position == pytest.approx(
        poses[4 * SECOND].position, abs=0.01
    )


def test_a_reset_forgets_the_heading_of_the_last_velocity(world: str) -> None:
    turning = VelocitySetpoint(
        stamp=4 * SECOND, source="test", velocity=(2.0, 1.0, 0.0), yaw_rate=2.0
    )
    result = fly(
        world,
        say(Takeoff, 0.0),
        turning,
        say(Reset, 4.4),
        say(Arm, 4.5),
        VelocitySetpoint(stamp=round(4.6 * SECOND), source="test", velocity=(0.0, 0.0, -1.0)),
        duration=5.5,
    )
    yaws = {each.stamp: rotations.yaw_of(each.orientation) for each in result.of(Odometry)}
    assert yaws[round(4.395 * SECOND)] > 0.4
    assert max(abs(yaw) for stamp, yaw in yaws.items() if stamp > 4.4 * SECOND) < 0.02
