"""The IMU on a vehicle: true at its own place, and integrated, it gives the flight back."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import mujoco
import numpy as np
import pytest

from events import Imu, ImuAnnouncement, TransformStamped
from events.frames import multiply, rotate
from runtime.testing import run_node
from sims.multirotor import Multirotor
from sims.sensors import ImuModel, ImuParameters, mount_imu
from sims.sensors.imu import mean_between, motion_at
from sims.vehicle import Physics, State, attach_vehicle
from tests.sims.vehicle.flight import UP, WORLD, Flight, airborne, velocity

Row = tuple[float, State, tuple[float, float, float], tuple[float, float, float]]


def aggressive(flight: Flight, seconds: float) -> list[Row]:
    """Fly at up to 6 m/s with yaw, and return time, state and instant IMU at 200 Hz."""
    rows = []
    for tick in range(round(seconds * 400) + 1):
        stamp, physics = flight.stamp, flight.physics
        physics.advance_to(stamp)
        if tick % 2 == 0:
            rows.append((stamp / 1e9, physics.state(), *physics.imu()))
        t = stamp / 1e9
        x, y = [(6.0, 0.0), (0.0, 6.0), (-6.0, 0.0), (0.0, -6.0), (6.0, 6.0)][int(t) % 5]
        order = velocity(stamp, x, y, math.sin(3 * t), yaw_rate=2 * math.sin(2 * t))
        flight.autopilot.command(order)
        physics.set_motors(*flight.autopilot.update(stamp, physics.state(), False))
        flight.ticks += 1
    return rows


def turned(vector: Any) -> tuple[float, float, float, float]:
    angle = math.hypot(*vector)
    scale = math.sin(angle / 2) / angle if angle else 0.5
    x, y, z = (scale * v for v in vector)
    return (math.cos(angle / 2), x, y, z)


def integrated(rows: list[Row], mean: bool) -> float:
    """Return by how many metres the integral of the samples misses the last true position.

    Samples of their stamps by the trapezoid, means each over its own period.
    """
    start = rows[0][1]
    q, v, p = start.orientation, np.array(start.velocity), np.array(start.position)
    for (t, s, w, f), (t2, s2, w2, f2) in pairwise(rows):
        dt = t2 - t
        if mean:
            parameters = ImuParameters()
            a, b = (motion_at(parameters, x.orientation, x.velocity, (0, 0, 0)) for x in (s, s2))
            w, f = w2, f2 = mean_between(a, b, dt, 9.81)
        half = turned(np.add(w, w2) * dt / 4)
        after = multiply(q, multiply(half, half))
        if mean:
            force = np.array(rotate(multiply(q, half), f))
        else:
            force = np.add(rotate(q, f), rotate(after, f2)) / 2
        acceleration = np.add(force, (0, 0, 9.81))
        p, v, q = p + v * dt + acceleration * dt**2 / 2, v + acceleration * dt, after
    return math.dist(p, rows[-1][1].position)


def test_the_ideal_imu_integrates_to_the_truth_on_an_aggressive_flight() -> None:
    """5 s at 200 Hz, up to 5.4 m/s and 7 rad/s. The mean over each period is good to millimetres;
    instants are not within 1 cm here, since between two they miss what the motors do."""
    rows = aggressive(airborne(), 5.0)
    assert max(math.hypot(*s.velocity) for _, s, _, _ in rows) > 5.0
    assert integrated(rows, mean=True) < 0.005
    assert integrated(rows, mean=False) < 0.03


def test_the_specific_force_at_a_mounted_imu_is_that_of_its_own_place() -> None:
    """MuJoCo's accelerometer there, against the mean over the millisecond that the true velocity of
    the place tells, while it begins to tumble: without the lever it is wrong by metres per s²."""
    parameters = ImuParameters(position=(0.3, -0.2, 0.1), orientation=(20.0, -30.0, 75.0))
    spec = mujoco.MjSpec.from_string(WORLD)
    attach_vehicle(spec, "drone", (0.0, 0.0, -UP), 0.0)
    mount_imu(spec, "drone", parameters)
    physics = Physics(spec.compile(), "drone")
    physics.data.act[:] = (0.5, 0.45, 0.48, 0.52)
    physics.set_motors(0.6, 0.4, 0.3, 0.5)
    for stamp in range(0, 150_000_000, 1_000_000):
        physics.advance_to(stamp)
        rates, force = physics.imu()
        s = physics.state()
        before = motion_at(parameters, s.orientation, s.velocity, s.angular_velocity)
        physics.advance_to(stamp + 1_000_000)
        s = physics.state()
        after = motion_at(parameters, s.orientation, s.velocity, s.angular_velocity)
        mean_rates, mean_force = mean_between(before, after, 1e-3, 9.81)
        assert rates == pytest.approx(mean_rates, abs=0.05)
        assert force == pytest.approx(mean_force, abs=0.2)
    assert math.hypot(*rates) > 2.0


def test_what_is_announced_is_what_is_sent(tmp_path: Any) -> None:
    world = tmp_path / "tiny.xml"
    world.write_text(WORLD)
    imu = {"position": [0.1, 0.0, 0.0], "orientation": [180, 0, 0], "sampling": "mean"}
    config = {"world": str(world), "imu": imu | {"accelerometer_range": 5.0}}
    result = run_node(Multirotor, config=config, duration=0.2, name="drone")
    (announced,) = result.of(ImuAnnouncement)
    assert (announced.frame_id, announced.parent_frame_id) == ("drone/imu", "base_link")
    assert announced.position == (0.1, 0.0, 0.0)
    assert announced.averaged
    (mounted,) = result.of(TransformStamped)
    assert (mounted.child_frame_id, mounted.translation) == ("drone/imu", (0.1, 0.0, 0.0))
    samples = result.of(Imu)
    assert {s.frame_id for s in samples} == {"drone/imu"}
    assert {s.linear_acceleration[2] for s in samples} == {5.0}  # upside down, and cut off


def test_a_model_takes_its_constants_from_a_source_of_their_own() -> None:
    one, other = (
        ImuModel(ImuParameters(), 200.0, np.random.default_rng(1), np.random.default_rng(seed))
        for seed in (2, 3)
    )
    rest = ((0.0, 0.0, 0.0), (0.0, 0.0, -9.81), (0.5,) * 4)
    assert one.measure(*rest) == other.measure(*rest)
