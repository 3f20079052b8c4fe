"""The vehicle's model: its numbers are sane and its names are its own.

The mixer: what is asked if it can be had, and what is given up first if not.
"""

from __future__ import annotations

import re
from math import radians, tan

import msgspec
import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sims.vehicle import Mixer, Physics, attach_vehicle, read_parameters
from sims.worlds import WorldError
from tests.sims.vehicle.flight import WORLD, compiled


def test_parameters_are_those_of_a_450_class_quadrotor() -> None:
    parameters = read_parameters(compiled(), "drone")
    assert parameters.mass == pytest.approx(1.2)
    assert parameters.max_thrust / (parameters.mass * parameters.gravity) == pytest.approx(
        2.2, abs=0.05
    )
    x, y, _ = parameters.motors[0].position
    assert 2.0 * (x * x + y * y) ** 0.5 == pytest.approx(0.45, abs=0.005)
    assert parameters.motor_time_constant == 0.04
    a, b, c = sorted(parameters.inertia)
    assert a + b > c  # or no body of matter could have it


def test_two_vehicles_share_a_world() -> None:
    spec = mujoco.MjSpec.from_string(WORLD)
    attach_vehicle(spec, "one", (1.0, 2.0, -3.0), 0.5)
    attach_vehicle(spec, "two", (-1.0, 2.0, -3.0), 0.0)
    state = Physics(spec.compile(), "one").state()
    assert state.position == pytest.approx((1.0, 2.0, -3.0))
    assert state.orientation == pytest.approx((0.9689, 0.0, 0.0, 0.2474), abs=1e-4)


@pytest.mark.parametrize("name", ["", "a/b", "drone"])
def test_a_bad_or_taken_name_is_refused(name: str) -> None:
    spec = mujoco.MjSpec.from_string(WORLD)
    attach_vehicle(spec, "drone", (0.0, 0.0, -1.0), 0.0)
    with pytest.raises(ValueError, match="name"):
        attach_vehicle(spec, name, (0.0, 0.0, -2.0), 0.0)


def test_a_missing_vehicle_is_named() -> None:
    with pytest.raises(ValueError, match="'plane'"):
        Physics(compiled(), "plane")


def test_another_time_step_is_refused() -> None:
    spec = mujoco.MjSpec.from_string(WORLD)
    attach_vehicle(spec, "drone", (0.0, 0.0, -1.0), 0.0)
    spec.option.timestep = 0.002
    with pytest.raises(ValueError, match=re.escape("found 0.002 s")):
        Physics(spec.compile(), "drone")


def test_a_forward_camera_does_not_see_the_airframe() -> None:
    """No visible geom meets the rays of a 100° image taken 0.1 m ahead of the origin."""
    spec = mujoco.MjSpec()
    attach_vehicle(spec, "drone", (0.0, 0.0, -1.0), 0.0)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    visible = [1, 1, 1, 0, 0, 0]
    hit = np.zeros(1, dtype=np.int32)
    for column in range(-20, 21):
        for row in range(-20, 21):
            ray = [1.0, tan(radians(50.0)) * column / 20.0, row / 20.0]
            distance = mujoco.mj_ray(model, data, [0.1, 0.0, 1.0], ray, visible, 1, -1, hit)
            assert distance == -1.0, f"ray {ray} meets geom {hit[0]} at {distance}"


@pytest.mark.parametrize(
    "option", ['gravity="0 0 -1.62"', 'timestep="0.005"', 'wind="3 0 0"', 'integrator="RK4"']
)
def test_options_of_a_world_that_would_be_ignored_are_refused(option: str) -> None:
    key, _, value = option.partition("=")
    attach_vehicle(mujoco.MjSpec.from_string(WORLD), "drone", (0.0, 0.0, -1.0), 0.0)
    world = WORLD.replace("<mujoco>", f"<mujoco><option {option}/>")
    with pytest.raises(WorldError, match=f"<option>: expected {key}=.*found {key}=") as caught:
        attach_vehicle(mujoco.MjSpec.from_string(world), "drone", (0.0, 0.0, -1.0), 0.0)
    assert value in str(caught.value) or key == "integrator"


PARAMETERS = read_parameters(compiled(), "drone")
MIXER = Mixer(PARAMETERS)


def wrench(motors: tuple[float, ...]) -> tuple[float, tuple[float, float, float]]:
    """Return thrust (N) and torque (N m, FRD): a thrust F along -z at (x, y) has (-y F, x F)."""
    pairs = list(zip(motors, PARAMETERS.motors, strict=True))
    thrusts = [(share * motor.max_thrust, motor.position) for share, motor in pairs]
    roll, pitch = sum(-y * f for f, (_, y, _) in thrusts), sum(x * f for f, (x, _, _) in thrusts)
    yaw = sum(share * motor.max_torque for share, motor in pairs)
    return sum(f for f, _ in thrusts), (roll, pitch, yaw)


thrusts = st.floats(-10.0, 40.0)
tilts = st.floats(-4.0, 4.0)
yaws = st.floats(-1.0, 1.0)


@given(thrusts, tilts, tilts, yaws)
def test_motors_stay_in_their_range(thrust: float, roll: float, pitch: float, yaw: float) -> None:
    assert all(0.0 <= motor <= 1.0 for motor in MIXER.mix(thrust, roll, pitch, yaw))


@given(thrusts, tilts, tilts, yaws)
def test_roll_and_pitch_are_kept_whenever_some_thrust_allows_them(
    thrust: float, roll: float, pitch: float, yaw: float
) -> None:
    """And beyond that their direction is."""
    _, (made_roll, made_pitch, _) = wrench(MIXER.mix(thrust, roll, pitch, yaw))
    arm_x, arm_y, _ = (abs(c) for c in PARAMETERS.motors[0].position)
    # At most: two motors full, two off.
    need = abs(roll) / (2 * 6.5 * arm_y) + abs(pitch) / (2 * 6.5 * arm_x)
    share = min(1.0, 1.0 / need) if need else 1.0
    assert (made_roll, made_pitch) == pytest.approx((share * roll, share * pitch), abs=1e-9)


@given(st.floats(2.0, 24.0), tilts, tilts, yaws)
def test_thrust_is_kept_unless_roll_and_pitch_need_it(
    thrust: float, roll: float, pitch: float, yaw: float
) -> None:
    """Yaw, in particular, never costs thrust."""
    with_yaw, _ = wrench(MIXER.mix(thrust, roll, pitch, yaw))
    without, _ = wrench(MIXER.mix(thrust, roll, pitch, 0.0))
    assert with_yaw == pytest.approx(without, abs=1e-9)
    upright, _ = wrench(MIXER.mix(thrust, 0.0, 0.0, yaw))
    assert upright == pytest.approx(thrust, abs=1e-9)


@given(thrusts, tilts, tilts, yaws)
def test_yaw_is_made_as_far_as_there_is_room_and_never_the_other_way(
    thrust: float, roll: float, pitch: float, yaw: float
) -> None:
    motors = MIXER.mix(thrust, roll, pitch, yaw)
    _, (_, _, made) = wrench(motors)
    _, (_, _, before) = wrench(MIXER.mix(thrust, roll, pitch, 0.0))
    gained = made - before
    assert gained * yaw >= -1e-12
    if abs(gained - yaw) > 1e-9:  # not all of it: then a motor stands at its end
        assert min(motors) < 1e-9 or max(motors) > 1.0 - 1e-9


@given(st.floats(8.0, 18.0), st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(-0.05, 0.05))
def test_what_can_be_had_is_had_exactly(
    thrust: float, roll: float, pitch: float, yaw: float
) -> None:
    made, torque = wrench(MIXER.mix(thrust, roll, pitch, yaw))
    assert made == pytest.approx(thrust)
    assert torque == pytest.approx((roll, pitch, yaw), abs=1e-9)


def test_motors_that_cannot_yaw_are_refused() -> None:
    motors = [msgspec.structs.replace(motor, max_torque=0.0) for motor in PARAMETERS.motors]
    parameters = msgspec.structs.replace(PARAMETERS, motors=tuple(motors))
    with pytest.raises(ValueError, match="yaw"):
        Mixer(parameters)


def test_motors_that_turn_the_vehicle_at_equal_thrust_are_refused() -> None:
    first, *others = PARAMETERS.motors
    stronger = msgspec.structs.replace(first, max_thrust=2.0 * first.max_thrust)
    parameters = msgspec.structs.replace(PARAMETERS, motors=(stronger, *others))
    with pytest.raises(ValueError, match="equal thrust"):
        Mixer(parameters)
