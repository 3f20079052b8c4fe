"""The loops one by one, without physics: signs, short ways, and what they must not remember."""

from __future__ import annotations

from math import pi

import pytest
from hypothesis import given
from hypothesis import strategies as st

from events import AttitudeSetpoint, Quaternion, Vector3
from events import frames as rotations
from sims.vehicle import Autopilot, Controller, Gains, Limits, State
from sims.vehicle.attitude import AttitudeController
from sims.vehicle.position import PositionController
from tests.sims.vehicle.flight import airborne, place, velocity
from tests.sims.vehicle.test_autopilot import ARM, DISARM
from tests.sims.vehicle.test_mixer import PARAMETERS

STILL = State((0.0, 0.0, -5.0), rotations.IDENTITY, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
angles = st.floats(-3.1, 3.1)
orientations = st.builds(rotations.from_rpy, angles, st.floats(-1.5, 1.5), angles)
attitude = AttitudeController(Gains(), Limits())


@given(orientations, orientations)
def test_both_quaternions_of_an_attitude_mean_the_same(a: Quaternion, b: Quaternion) -> None:
    w, x, y, z = b
    one = attitude.update(a, b, 0.3)
    assert attitude.update(a, (-w, -x, -y, -z), 0.3) == pytest.approx(one, abs=1e-9)


@given(orientations, st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))
def test_small_errors_are_turned_back_about_their_own_axis(
    target: Quaternion, x: float, y: float, z: float
) -> None:
    """The rates asked for are gain times angle, for tilt and yaw each with its own gain."""
    error = rotations.normalize((1.0, 0.5 * x, 0.5 * y, 0.5 * z))
    orientation = rotations.multiply(target, rotations.inverse(error))
    gains = Gains()
    expected = (gains.tilt * x, gains.tilt * y, gains.yaw * z)
    assert attitude.update(orientation, target, 0.0) == pytest.approx(expected, abs=0.06)


@pytest.mark.parametrize(("now", "goal", "sign"), [(3.0, -3.0, 1.0), (-3.0, 3.0, -1.0)])
def test_yaw_takes_the_short_way_through_south(now: float, goal: float, sign: float) -> None:
    rates = attitude.update(
        rotations.from_rpy(0.0, 0.0, now), rotations.from_rpy(0.0, 0.0, goal), 0.0
    )
    assert rates == pytest.approx((0.0, 0.0, sign * Gains().yaw * (2.0 * pi - 6.0)), abs=1e-9)


@given(orientations, st.floats(-2.0, 2.0))
def test_yaw_rate_is_about_the_vertical_however_tilted(
    orientation: Quaternion, yaw_rate: float
) -> None:
    expected = rotations.rotate_inverse(orientation, (0.0, 0.0, yaw_rate))
    assert attitude.update(orientation, orientation, yaw_rate) == pytest.approx(expected, abs=1e-6)


@given(st.floats(-3.0, 3.0), st.floats(-4.0, 4.0), st.floats(-4.0, 4.0), st.floats(-2.0, 2.0))
def test_the_attitude_points_the_thrust_along_the_acceleration_and_the_nose_along_the_yaw(
    yaw: float, north: float, east: float, down: float
) -> None:
    """For any acceleration within the limits, by feed-forward at the place itself."""
    gains = Gains(velocity_xy_d=0.0)
    controller = PositionController(PARAMETERS, gains, Limits())
    controller.to_position(STILL.position, acceleration=(north, east, down), yaw=yaw)
    target, _, _ = controller.update(STILL, 0.0025)
    force: Vector3 = (north, east, down - PARAMETERS.gravity)
    norm = sum(c * c for c in force) ** 0.5
    down_axis = rotations.rotate(target, (0.0, 0.0, 1.0))
    assert down_axis == pytest.approx(tuple(-c / norm for c in force), abs=1e-6)
    assert rotations.yaw_of(target) == pytest.approx(yaw, abs=1e-6)


def test_integrators_learn_nothing_while_the_tilt_is_at_its_limit() -> None:
    """Ten seconds against a stop, and the vehicle is level as soon as it flies as told."""
    controller = PositionController(PARAMETERS, Gains(), Limits())
    controller.to_velocity((2.5, 0.0, 0.0), yaw=0.0)
    for _ in range(4000):
        controller.update(STILL, 0.0025)
    controller.to_velocity((0.0, 0.0, 0.0), yaw=0.0)
    assert controller.update(STILL, 0.0025)[0] == pytest.approx(rotations.IDENTITY, abs=1e-3)


def test_integrators_learn_a_steady_wind() -> None:
    """A small error that stays is met with more and more tilt, up to the integral's bound."""
    controller = PositionController(PARAMETERS, Gains(), Limits())
    controller.to_velocity((0.3, 0.0, 0.0), yaw=0.0)
    first = controller.update(STILL, 0.0025)[0]
    for _ in range(20_000):
        last = controller.update(STILL, 0.0025)[0]
    assert first[2] < 0.0
    assert last[2] < 3.0 * first[2]
    assert -last[2] / last[0] < Limits().integral / PARAMETERS.gravity


def test_coming_back_from_attitude_flight_starts_afresh() -> None:
    """The speed gained meanwhile is no acceleration of the last 2.5 ms."""
    used, fresh = Controller(PARAMETERS), Controller(PARAMETERS)
    used.follow(place(0.0, 0.0, -5.0), STILL)
    for _ in range(10):
        used.update(STILL, 0.0025)
    level = AttitudeSetpoint(stamp=0, source="test", orientation=rotations.IDENTITY, thrust=0.5)
    used.follow(level, STILL)
    moving = State((0.0, 0.0, -5.0), rotations.IDENTITY, (0.5, 0.0, 0.0), (0.0, 0.0, 0.0))
    for controller in (used, fresh):
        controller.follow(place(0.5, 0.0, -5.0), moving)
    assert used.position.update(moving, 0.0025) == fresh.position.update(moving, 0.0025)


def test_arming_starts_afresh() -> None:
    """What was learnt in one flight is not in the first command of the next."""
    flight = airborne()
    flight.fly(2.0, lambda stamp: velocity(stamp, 5.0, 1.0))
    state = flight.physics.state()
    fresh = Autopilot(PARAMETERS)
    flight.autopilot.command(DISARM)
    for autopilot in (flight.autopilot, fresh):
        autopilot.command(ARM)
        autopilot.command(place(0.0, 0.0, -5.0))
    again = flight.autopilot.update(flight.stamp, state, False)
    assert again == pytest.approx(fresh.update(flight.stamp, state, False), abs=1e-9)


def test_renewed_velocity_setpoints_keep_the_heading_against_a_kick() -> None:
    flight = airborne()
    flight.fly(0.5, lambda stamp: velocity(stamp, 1.0, 0.0))
    flight.physics.data.qvel[11] = 3.0  # turns about z; the ball has the first six
    track = flight.fly(6.0, lambda stamp: velocity(stamp, 1.0, 0.0))
    assert max(abs(rotations.yaw_of(s.orientation)) for _, s in track) > 0.1
    assert rotations.yaw_of(track[-1][1].orientation) == pytest.approx(0.0, abs=0.02)
