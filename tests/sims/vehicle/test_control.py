"""The cascade flown in the physics: steps, legs, turns, hovering, and the lower set-points.

The loops one by one, without physics: signs, short ways, and what they must not remember.
"""

from __future__ import annotations

from math import cos, hypot, pi, radians, sin
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from events import (
    AttitudeSetpoint,
    BodyRateSetpoint,
    Event,
    MotorSetpoint,
    PositionSetpoint,
    Quaternion,
    Vector3,
)
from events import frames as rotations
from events.frames import from_rpy, yaw_of
from sims.vehicle import Autopilot, Controller, Gains, Limits, State
from sims.vehicle.control import AttitudeController
from sims.vehicle.position import PositionController
from tests.sims.vehicle.flight import UP, airborne, place, step_response, velocity
from tests.sims.vehicle.test_autopilot import ARM, DISARM
from tests.sims.vehicle.test_model import PARAMETERS


@pytest.mark.slow
def test_hover_holds_within_five_centimetres() -> None:
    for _, state in airborne().fly(10.0):
        x, y, z = state.position
        assert hypot(x, y, z + UP) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize(
    ("axis", "length"), [(0, 2.0), (1, -2.0), (2, -2.0), (2, 2.0)], ids=["x", "y", "up", "down"]
)
def test_a_step_settles_within_three_seconds(axis: int, length: float) -> None:
    """To 5 %, with less than 10 % of overshoot, and less than 10 cm astray on the other axes."""
    flight = airborne()
    goal = [0.0, 0.0, -UP]
    goal[axis] += length
    flight.autopilot.command(place(*goal))
    track = flight.fly(5.0)
    overshoot, settled = step_response([(t, s.position[axis]) for t, s in track], goal[axis])
    assert overshoot < 0.1
    assert settled < 3.0
    for other in {0, 1, 2} - {axis}:
        assert max(abs(s.position[other] - goal[other]) for _, s in track) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize(("length", "astray"), [(0.2, 0.02), (30.0, 0.15)])
def test_near_and_far_places_are_not_overshot(length: float, astray: float) -> None:
    flight = airborne()
    flight.autopilot.command(place(length, 0.0, -UP))
    places = [state.position[0] for _, state in flight.fly(3.0 + length / 3.0)]
    assert max(places) < length + astray
    assert places[-1] == pytest.approx(length, abs=0.1)


@pytest.mark.slow
def test_a_fast_leg_keeps_its_height() -> None:
    """5 m/s from standing and back to standing: less than 0.3 m of height lost, none gained."""
    flight = airborne()
    track = flight.fly(4.0, lambda stamp: velocity(stamp, 5.0, 0.0))
    assert track[-1][1].velocity == pytest.approx((5.0, 0.0, 0.0), abs=0.1)
    track += flight.fly(3.0, lambda stamp: velocity(stamp, 0.0, 0.0))
    assert track[-1][1].velocity == pytest.approx((0.0, 0.0, 0.0), abs=0.1)
    assert max(abs(s.position[2] + UP) for _, s in track) < 0.3


@pytest.mark.slow
def test_feed_forward_follows_a_circle() -> None:
    """3 m/s on a radius of 3 m, nose along the path: within 15 cm once on it."""

    def on_circle(stamp: int) -> Event:
        a = stamp * 1e-9
        return PositionSetpoint(
            stamp=stamp,
            source="test",
            position=(3.0 * sin(a), 3.0 - 3.0 * cos(a), -UP),
            velocity=(3.0 * cos(a), 3.0 * sin(a), 0.0),
            acceleration=(-3.0 * sin(a), 3.0 * cos(a), 0.0),
            yaw=a,
            yaw_rate=1.0,
        )

    track = airborne().fly(10.0, on_circle)[1600:]
    for t, state in track:
        assert (
            hypot(state.position[0] - 3.0 * sin(t), state.position[1] - 3.0 + 3.0 * cos(t)) < 0.15
        )
        turned = yaw_of(state.orientation) - t
        assert abs((turned + pi) % (2.0 * pi) - pi) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize(("start", "turn"), [(0.0, 1.5), (3.0, 0.5), (0.0, -2.5)])
def test_a_yaw_step_takes_the_short_way_and_does_not_move_the_vehicle(
    start: float, turn: float
) -> None:
    flight = airborne(start)
    flight.autopilot.command(place(0.0, 0.0, -UP, yaw=start + turn))
    track = flight.fly(4.0)
    turned = [(t, (yaw_of(s.orientation) - start + pi) % (2.0 * pi) - pi) for t, s in track]
    overshoot, settled = step_response(turned, turn)
    assert overshoot < 0.1
    assert settled < 3.0
    assert max(hypot(*s.position[:2]) for _, s in track) < 0.05


def test_velocity_along_the_heading_flies_where_the_nose_points() -> None:
    flight = airborne(yaw=pi / 2)
    track = flight.fly(3.0, lambda stamp: velocity(stamp, 2.0, 1.0, -0.5, frame_id="heading"))
    assert track[-1][1].velocity == pytest.approx((-1.0, 2.0, -0.5), abs=0.05)
    assert yaw_of(track[-1][1].orientation) == pytest.approx(pi / 2, abs=0.01)


@pytest.mark.slow
def test_yaw_rate_turns_on_through_renewed_setpoints() -> None:
    flight = airborne()
    track = flight.fly(3.0, lambda stamp: velocity(stamp, 0.0, 0.0, yaw_rate=0.8))
    assert yaw_of(track[-1][1].orientation) == pytest.approx(2.4, abs=0.1)


@pytest.mark.slow
def test_limits_hold_whatever_is_asked() -> None:
    """A place half a kilometre away and deep below: tilt, speed and descent stay bounded."""
    flight = airborne()
    limits = Limits()
    flight.autopilot.command(place(500.0, 0.0, 500.0))
    for _, state in flight.fly(6.0):
        _, x, y, _ = state.orientation
        assert 1.0 - 2.0 * (x * x + y * y) > cos(limits.tilt + radians(6.0))
        assert state.velocity[0] < 1.05 * limits.speed
        assert state.velocity[2] < 1.1 * limits.descent


def test_an_attitude_is_held_at_its_thrust() -> None:
    flight = airborne()
    goal = from_rpy(0.2, -0.1, 0.3)
    track = flight.fly(
        1.0,
        lambda stamp: AttitudeSetpoint(stamp=stamp, source="test", orientation=goal, thrust=0.6),
    )
    assert track[-1][1].orientation == pytest.approx(goal, abs=0.01)
    parameters = flight.physics.parameters
    thrust = -flight.physics.imu()[1][2] * parameters.mass
    assert thrust == pytest.approx(0.6 * parameters.max_thrust, rel=0.05)  # less some drag


def test_body_rates_are_followed_on_all_axes_at_once() -> None:
    flight = airborne()
    goal = (1.0, -0.5, 0.8)
    track = flight.fly(
        1.0,
        lambda stamp: BodyRateSetpoint(
            stamp=stamp, source="test", angular_velocity=goal, thrust=0.5
        ),
    )
    for t, state in track:
        if t > 0.6:
            assert state.angular_velocity == pytest.approx(goal, abs=0.05)


@pytest.mark.slow
def test_it_recovers_from_being_upside_down() -> None:
    flight = airborne()
    flight.physics.data.qpos[10:14] = (0.0, 1.0, 0.0, 0.0)  # after the ball's seven and a position
    track = flight.fly(6.0)
    assert track[-1][1].position == pytest.approx((0.0, 0.0, -UP), abs=0.1)
    assert max(s.position[2] for _, s in track) < -UP + 8.0


def test_a_faulty_setpoint_is_an_error() -> None:
    controller = Controller(airborne().physics.parameters)
    state = State((0.0,) * 3, (1.0, 0.0, 0.0, 0.0), (0.0,) * 3, (0.0,) * 3)
    with pytest.raises(ValueError, match="expected 'map' or 'heading', found 'body'"):
        controller.follow(velocity(0, 1.0, 0.0, frame_id="body"), state)


@pytest.mark.parametrize(
    ("change", "axis", "sign"),
    [((-1, 1, 1, -1), 0, 1), ((1, -1, 1, -1), 1, 1), ((-1, -1, 1, 1), 2, -1)],
    ids=["roll", "pitch", "yaw"],
)
def test_motors_are_front_right_rear_left_front_left_rear_right(
    change: tuple[int, int, int, int], axis: int, sign: int
) -> None:
    """More on the left rolls right, more in front pitches up, clockwise rotors turn it left."""
    flight = airborne()
    flight.fly(0.1)
    share = flight.physics.parameters.hover_thrust
    motors = [share + 0.02 * difference for difference in change]
    values: dict[str, Any] = {f"motor{i + 1}": value for i, value in enumerate(motors)}
    flight.fly(0.2, lambda stamp: MotorSetpoint(stamp=stamp, source="test", **values))
    rates = flight.physics.state().angular_velocity
    assert sign * rates[axis] > 0.05
    assert all(abs(rate) < 0.01 for i, rate in enumerate(rates) if i != axis)
    assert flight.physics.data.ctrl[:4].tolist() == pytest.approx(motors)


@pytest.mark.slow
def test_the_loops_take_over_from_motor_setpoints() -> None:
    flight = airborne()
    flight.fly(0.1)
    flight.fly(
        0.15,
        lambda stamp: MotorSetpoint(
            stamp=stamp, source="test", motor1=0.6, motor2=0.4, motor3=0.6, motor4=0.4
        ),
    )
    flight.autopilot.command(place(0.0, 0.0, -UP))
    state = flight.fly(6.0)[-1][1]
    assert hypot(state.position[0], state.position[1], state.position[2] + UP) < 0.05


STILL = State((0.0, 0.0, -5.0), rotations.IDENTITY, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
angles = st.floats(-3.1, 3.1)
orientations = st.builds(rotations.from_rpy, angles, st.floats(-1.5, 1.5), angles)
attitude = AttitudeController(Gains(), Limits())


@pytest.mark.slow
@given(orientations, orientations)
def test_both_quaternions_of_an_attitude_mean_the_same(a: Quaternion, b: Quaternion) -> None:
    w, x, y, z = b
    one = attitude.update(a, b, 0.3)
    assert attitude.update(a, (-w, -x, -y, -z), 0.3) == pytest.approx(one, abs=1e-9)


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
def test_renewed_velocity_setpoints_keep_the_heading_against_a_kick() -> None:
    flight = airborne()
    flight.fly(0.5, lambda stamp: velocity(stamp, 1.0, 0.0))
    flight.physics.data.qvel[11] = 3.0  # turns about z; the ball has the first six
    track = flight.fly(6.0, lambda stamp: velocity(stamp, 1.0, 0.0))
    assert max(abs(rotations.yaw_of(s.orientation)) for _, s in track) > 0.1
    assert rotations.yaw_of(track[-1][1].orientation) == pytest.approx(0.0, abs=0.02)
