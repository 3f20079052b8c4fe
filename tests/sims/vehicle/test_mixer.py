"""The mixer: what is asked if it can be had, and what is given up first if not."""

from __future__ import annotations

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sims.vehicle import Mixer, read_parameters
from tests.sims.vehicle.flight import compiled

PARAMETERS = read_parameters(compiled(), "drone")
MIXER = Mixer(PARAMETERS)

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
    _, (made_roll, made_pitch, _) = MIXER.wrench(MIXER.mix(thrust, roll, pitch, yaw))
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
    with_yaw, _ = MIXER.wrench(MIXER.mix(thrust, roll, pitch, yaw))
    without, _ = MIXER.wrench(MIXER.mix(thrust, roll, pitch, 0.0))
    assert with_yaw == pytest.approx(without, abs=1e-9)
    upright, _ = MIXER.wrench(MIXER.mix(thrust, 0.0, 0.0, yaw))
    assert upright == pytest.approx(thrust, abs=1e-9)


@given(thrusts, tilts, tilts, yaws)
def test_yaw_is_made_as_far_as_there_is_room_and_never_the_other_way(
    thrust: float, roll: float, pitch: float, yaw: float
) -> None:
    motors = MIXER.mix(thrust, roll, pitch, yaw)
    _, (_, _, made) = MIXER.wrench(motors)
    _, (_, _, before) = MIXER.wrench(MIXER.mix(thrust, roll, pitch, 0.0))
    gained = made - before
    assert gained * yaw >= -1e-12
    if abs(gained - yaw) > 1e-9:  # not all of it: then a motor stands at its end
        assert min(motors) < 1e-9 or max(motors) > 1.0 - 1e-9


@given(st.floats(8.0, 18.0), st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(-0.05, 0.05))
def test_what_can_be_had_is_had_exactly(
    thrust: float, roll: float, pitch: float, yaw: float
) -> None:
    made, torque = MIXER.wrench(MIXER.mix(thrust, roll, pitch, yaw))
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
