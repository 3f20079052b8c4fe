"""The autopilot: who is obeyed when, what is told, and that a lost link stops the vehicle."""

from __future__ import annotations

from math import hypot

import pytest

from events import (
    Arm,
    Armed,
    AttitudeSetpoint,
    BodyRateSetpoint,
    Disarm,
    Disarmed,
    Event,
    Hover,
    Land,
    Landed,
    MotorSetpoint,
    Shutdown,
    TakenOff,
    Takeoff,
)
from sims.vehicle import STANDING_HEIGHT, Phase, Physics
from tests.sims.vehicle.flight import UP, Flight, airborne, compiled, place, velocity

ARM = Arm(stamp=0, source="test")
DISARM = Disarm(stamp=0, source="test")
TAKEOFF = Takeoff(stamp=0, source="test", altitude=1.5)
LAND = Land(stamp=0, source="test")
HOVER = Hover(stamp=0, source="test")


def grounded() -> Flight:
    return Flight(Physics(compiled(), "drone"))


def taken_off() -> Flight:
    flight = grounded()
    assert flight.autopilot.command(TAKEOFF) is None
    flight.fly(5.0)
    assert flight.autopilot.phase is Phase.FLYING
    return flight


def test_take_off_hover_land_disarm() -> None:
    """Happenings in order; up smoothly, still in the hover, down at half a metre per second."""
    flight = grounded()
    assert flight.autopilot.command(TAKEOFF) is None
    climb = flight.fly(5.0)
    assert flight.events == [Armed, TakenOff]
    assert -1.2 < min(s.velocity[2] for _, s in climb) < -0.8
    hover = flight.fly(2.0)
    for _, state in hover:
        assert state.position == pytest.approx((0.0, 0.0, -1.5 - STANDING_HEIGHT), abs=0.05)
    assert flight.autopilot.command(LAND) is None
    descent = flight.fly(5.0)
    assert flight.events == [Armed, TakenOff, Landed, Disarmed]
    assert flight.autopilot.phase is Phase.DISARMED
    assert max(s.velocity[2] for _, s in descent) < 0.6
    assert descent[-1][1].position == pytest.approx((0.0, 0.0, -STANDING_HEIGHT), abs=0.02)
    assert flight.physics.data.ctrl.tolist() == [0.0] * 4


def test_taken_off_is_told_near_the_altitude_and_slow() -> None:
    flight = grounded()
    flight.autopilot.command(TAKEOFF)
    while TakenOff not in flight.events:
        ((_, state),) = flight.fly(1 / 400)
        assert flight.ticks < 2400
    assert state.position[2] == pytest.approx(-1.5 - STANDING_HEIGHT, abs=0.1)
    assert hypot(*state.velocity) < 0.2


@pytest.mark.slow
def test_it_flies_again_after_landing() -> None:
    flight = taken_off()
    flight.autopilot.command(LAND)
    flight.fly(5.0)
    flight.autopilot.command(TAKEOFF)
    flight.fly(5.0)
    assert flight.events == [Armed, TakenOff, Landed, Disarmed, Armed, TakenOff]


@pytest.mark.slow
def test_landing_out_of_fast_flight_stops_first() -> None:
    flight = airborne()
    flight.fly(3.0, lambda stamp: velocity(stamp, 5.0, 0.0))
    flight.autopilot.command(LAND)
    track = flight.fly(6.0)
    for _, state in track:
        if state.velocity[2] > 0.3:
            assert hypot(*state.velocity[:2]) < 0.3
    assert track[-1][1].velocity[2] == pytest.approx(0.5, abs=0.05)


def test_disarmed_motors_stand_still_and_armed_ones_idle() -> None:
    flight = grounded()
    flight.fly(0.1)
    assert flight.physics.data.ctrl.tolist() == [0.0] * 4
    flight.autopilot.command(ARM)
    track = flight.fly(1.0)
    assert all(0.0 < motor < 0.1 for motor in flight.physics.data.ctrl.tolist())
    assert track[-1][1].position[2] == pytest.approx(-STANDING_HEIGHT, abs=1e-3)
    flight.autopilot.command(DISARM)
    flight.fly(0.1)
    assert flight.physics.data.ctrl.tolist() == [0.0] * 4
    assert flight.events == [Armed, Disarmed]


def test_disarming_in_the_air_stops_the_motors() -> None:
    flight = taken_off()
    assert flight.autopilot.command(DISARM) is None
    flight.fly(1 / 400)
    assert flight.physics.data.ctrl.tolist() == [0.0] * 4
    assert flight.events[-1] is Disarmed


@pytest.mark.slow
def test_armed_on_the_ground_a_setpoint_starts_the_flight() -> None:
    flight = grounded()
    flight.autopilot.command(ARM)
    flight.fly(0.5)
    assert flight.autopilot.command(place(1.0, 0.0, -2.0)) is None
    track = flight.fly(5.0)
    assert track[-1][1].position == pytest.approx((1.0, 0.0, -2.0), abs=0.05)
    assert flight.events == [Armed]


@pytest.mark.parametrize(
    ("before", "command", "reason"),
    [
        ([], place(0.0, 0.0, -1.0), "disarmed"),
        ([], HOVER, "not in the air"),
        ([], LAND, "not in the air"),
        ([], DISARM, "already disarmed"),
        ([ARM], ARM, "already armed"),
        ([ARM], HOVER, "not in the air"),
        ([TAKEOFF], velocity(0, 1.0, 0.0), "taking off"),
        ([TAKEOFF], TAKEOFF, "already in the air"),
        ([TAKEOFF, LAND], velocity(0, 1.0, 0.0), "landing"),
        ([TAKEOFF, LAND], LAND, "already landing"),
        ([], Takeoff(stamp=0, source="test", altitude=-1.0), "expected a number > 0, found -1.0"),
        ([ARM], place(1e200, 0.0, 0.0), "expected numbers up to 1e+06"),
        ([ARM], velocity(0, 1e7, 0.0), "expected numbers up to 1e+06"),
        ([ARM], velocity(0, 1.0, 0.0, frame_id="body"), "found 'body'"),
        (
            [ARM],
            AttitudeSetpoint(stamp=0, source="test", orientation=(1.0, 0.0, 0.0, 0.0), thrust=1e7),
            "expected numbers up to 1e+06",
        ),
        (
            [ARM],
            BodyRateSetpoint(stamp=0, source="test", angular_velocity=(0.0, 0.0, 1e7), thrust=0.5),
            "expected numbers up to 1e+06",
        ),
        ([ARM], Shutdown(stamp=0, source="test"), "Shutdown is no command"),
    ],
)
def test_what_cannot_be_obeyed_is_refused_with_a_reason(
    before: list[Event], command: Event, reason: str
) -> None:
    """And the phase stays what it was."""
    autopilot = grounded().autopilot
    for event in before:
        assert autopilot.command(event) is None
    phase = autopilot.phase
    refusal = autopilot.command(command)
    assert refusal is not None
    assert reason in refusal
    assert autopilot.phase is phase


@pytest.mark.slow
@pytest.mark.parametrize("order", [TAKEOFF, LAND])
def test_hover_ends_a_take_off_and_a_landing(order: Event) -> None:
    flight = grounded() if order is TAKEOFF else taken_off()
    flight.autopilot.command(order)
    flight.fly(1.5)
    assert flight.autopilot.command(HOVER) is None
    track = flight.fly(4.0)
    assert flight.autopilot.phase is Phase.FLYING
    assert hypot(*track[-1][1].velocity) < 0.02
    assert track[-1][1].position[2] < -0.3
    assert flight.autopilot.command(place(0.0, 0.0, -1.0)) is None


@pytest.mark.slow
def test_hover_stops_and_stays_where_it_stopped() -> None:
    """It does not fly back to where it was told to."""
    flight = airborne()
    flight.fly(3.0, lambda stamp: velocity(stamp, 5.0, 0.0))
    flight.autopilot.command(HOVER)
    track = flight.fly(5.0)
    places = [s.position[0] for _, s in track]
    assert max(places) - places[-1] < 0.2
    assert track[-1][1].velocity == pytest.approx((0.0, 0.0, 0.0), abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(
    "setpoint",
    [
        velocity(2_500_000, 3.0, 0.0, -1.0),
        AttitudeSetpoint(
            stamp=2_500_000, source="test", orientation=(0.995, 0.0, -0.0998, 0.0), thrust=0.5
        ),
        BodyRateSetpoint(
            stamp=2_500_000, source="test", angular_velocity=(0.0, -0.5, 0.0), thrust=0.5
        ),
        MotorSetpoint(
            stamp=2_500_000, source="test", motor1=0.6, motor2=0.6, motor3=0.6, motor4=0.6
        ),
    ],
    ids=lambda setpoint: type(setpoint).__name__,
)
def test_a_setpoint_that_is_not_renewed_becomes_a_hover(setpoint: Event) -> None:
    """It counts for half a second and no longer."""
    flight = airborne()
    flight.fly(0.005)
    flight.autopilot.command(setpoint)
    moving = flight.fly(0.5)
    assert hypot(*moving[-1][1].velocity) > 0.2
    track = flight.fly(5.0)
    assert hypot(*track[-1][1].velocity) < 0.02
    assert hypot(*(track[-1][1].position[i] - track[-400][1].position[i] for i in range(3))) < 0.05


@pytest.mark.slow
def test_a_position_setpoint_needs_no_renewal() -> None:
    flight = airborne()
    flight.autopilot.command(place(20.0, 0.0, -UP))
    assert flight.fly(10.0)[-1][1].position[0] == pytest.approx(20.0, abs=0.1)


@pytest.mark.slow
def test_the_same_commands_give_the_same_bits() -> None:
    def run() -> list[object]:
        flight = grounded()
        flight.autopilot.command(TAKEOFF)
        track = flight.fly(4.0)
        track += flight.fly(2.0, lambda stamp: velocity(stamp, 2.0, 1.0, yaw_rate=0.5))
        flight.autopilot.command(LAND)
        return [*track, *flight.fly(4.0)]

    assert run() == run()
