"""The tasks of moves, flown in physics without a server, and by points that go as they are told."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Sequence

import msgspec
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from events import Command, Hover, Setpoint, Vector3, VelocitySetpoint
from events.frames import from_yaw
from sims.vehicle import State
from tests.sims.vehicle.flight import UP, airborne
from visnav_airsim.server import moves
from visnav_airsim.server.moves import (
    CLOSE,
    RATE,
    Heading,
    PathFollower,
    Task,
    braked,
    lookahead_of,
)

STEP = 1 / RATE
METRES = st.floats(-20.0, 20.0, width=32)
POINTS = st.tuples(METRES, METRES, METRES)
PATHS = st.lists(POINTS, min_size=1, max_size=8)


def at(position: Vector3, velocity: Vector3 = (0.0, 0.0, 0.0), yaw: float = 0.0) -> State:
    return State(position, from_yaw(yaw), velocity, (0.0, 0.0, 0.0))


def steered(task: Task, seconds: float, state: State) -> Setpoint | Command | bool | None:
    order = task.steer(seconds, state)
    return order if order is None or isinstance(order, bool) else order(stamp=0, source="test")


def moved(task: Task, begin: Vector3, *, lag: float, most: int) -> tuple[bool | None, Vector3]:
    """Let a point follow a task with a first-order lag; return the result, and where it ends."""
    position, velocity = begin, (0.0, 0.0, 0.0)
    for count in range(most):
        order = steered(task, count * STEP, at(position, velocity))
        if isinstance(order, bool):
            return order, position
        assert isinstance(order, VelocitySetpoint)  # which is finite, or could not be made
        share = STEP / (lag + STEP)
        vx, vy, vz = (v + share * (w - v) for v, w in zip(velocity, order.velocity, strict=True))
        velocity = (vx, vy, vz)
        x, y, z = (p + v * STEP for p, v in zip(position, velocity, strict=True))
        position = (x, y, z)
    return None, position


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(
    path=PATHS,
    speed=st.floats(1.0, 20.0),
    lookahead=st.one_of(st.just(-1.0), st.floats(0.01, 50.0)),
    adaptive=st.sampled_from([0.0, 1.0]),
    lag=st.floats(0.0, 0.3),
)
@example(
    path=[(0.0, 0.0, 0.0), (5.0, 0.0, 0.0), (0.0, 0.0, 0.0)],
    speed=2.0,
    lookahead=-1.0,
    adaptive=1.0,
    lag=0.1,
)  # back on itself
@example(path=[(1.0, 2.0, 3.0)] * 4, speed=1.0, lookahead=-1.0, adaptive=1.0, lag=0.1)
def test_each_path_ends_near_its_last_point(
    path: Sequence[Vector3], speed: float, lookahead: float, adaptive: float, lag: float
) -> None:
    """Whatever it is, and whatever the vehicle's lag."""
    whole = [path[0], *path]
    ahead = lookahead_of(lookahead, adaptive, speed)
    task = moves.along_path(whole, speed, ahead, Heading(), math.inf)
    length = sum(map(math.dist, whole, whole[1:]))
    result, end = moved(task, path[0], lag=lag, most=round((length / speed * 2 + 20) * RATE))
    assert result is True
    assert math.dist(end, path[-1]) < 2.0 * CLOSE


@pytest.mark.slow
@given(path=PATHS, positions=st.lists(POINTS, max_size=20), lookahead=st.floats(0.01, 1e6))
def test_progress_never_goes_back_and_the_follower_is_on_the_path(
    path: Sequence[Vector3], positions: list[Vector3], lookahead: float
) -> None:
    follower = PathFollower(path, lookahead)
    length = sum(map(math.dist, path, path[1:]))
    assert follower.length <= length + 1e-6
    for position in positions:
        before = follower.progress
        target = follower.advance(position)
        assert before <= follower.progress <= follower.length
        apart = min(
            (on_segment(a, b, target) for a, b in itertools.pairwise(path)),
            default=math.dist(target, path[0]),
        )
        assert apart < 0.11, "corners closer than 0.05 m are cut"
        if follower.is_last:
            assert target == pytest.approx(path[-1], abs=1e-4)


def on_segment(a: Vector3, b: Vector3, point: Vector3) -> float:
    """Return how far a point is from a segment."""
    square = math.dist(a, b) ** 2
    inner = sum((q - p) * (r - p) for p, q, r in zip(a, b, point, strict=True))
    share = min(max(inner / square, 0.0), 1.0) if square else 0.0
    return math.dist(point, [p + share * (q - p) for p, q in zip(a, b, strict=True)])


def test_a_knot_of_a_path_takes_little_time_and_never_a_division_by_nothing() -> None:
    """However many corners lie where the vehicle is."""
    knot = [(0.1 * (i % 2), 0.05 * (i % 3), 0.0) for i in range(100_000)]
    task = moves.along_path(knot, 1.0, 0.75, Heading(), math.inf)
    begin = time.process_time()
    for count in range(100):
        assert not isinstance(steered(task, count * STEP, at(knot[count])), bool)
    assert time.process_time() - begin < 1.0


@given(st.floats(0.01, 100.0), st.floats(0.0, 1e4))
def test_brakes_never_speed_up_nor_stop(velocity: float, remaining: float) -> None:
    speed = braked(velocity, remaining)
    assert min(velocity, 1.0) <= speed <= velocity


@pytest.mark.parametrize(
    ("lookahead", "adaptive", "velocity", "metres"),
    [(-1, 1, 5, 3.0), (-1, 0, 5, 4.0), (-1, 1, 0.5, 0.75), (20, 1, 5, 20.0), (0.1, 0, 9, 0.1)],
)
def test_lookaheads_are_airsims(
    lookahead: float, adaptive: float, velocity: float, metres: float
) -> None:
    assert lookahead_of(lookahead, adaptive, velocity) == pytest.approx(metres)


@pytest.mark.parametrize(
    ("follows", "is_rate", "angle", "course", "expected"),
    [
        (False, True, 0.0, (1.0, 1.0), 0.0),
        (False, True, 0.3, (1.0, 1.0), 0.3),
        (True, True, 0.3, (1.0, 1.0), 0.3),  # is ignored but in paths, which refuse it
        (False, False, 0.0, (1.0, 1.0), -0.3),
        (False, False, 0.2, (1.0, 1.0), -0.1),
        (True, False, 0.0, (0.0, 1.0), math.pi / 2 - 0.1),
        (True, False, -0.2, (0.0, 1.0), math.pi / 2 - 0.3),
        (True, False, 0.0, (0.3, 0.3), 0.0),  # too short to tell where it goes
        (True, False, 0.0, (-1.0, -0.5), -2.6779450445889870 - 0.1),
    ],
)
def test_yaw_rates_of_all_modes(
    follows: bool, is_rate: bool, angle: float, course: tuple[float, float], expected: float
) -> None:
    """The vehicle's heading is 0.1; angles are gone to three times a second's share."""
    rate = Heading(follows, is_rate, angle).rate(at((0.0, 0.0, 0.0), yaw=0.1), *course)
    gain = 1.0 if is_rate or expected in (0.0, -0.3, -0.1) else 3.0
    if not is_rate and not follows:
        expected, gain = angle - 0.1, 3.0
    assert rate == pytest.approx(gain * expected)


@pytest.mark.slow
@given(st.floats(-1e6, 1e6))
def test_angles_are_wrapped(angle: float) -> None:
    wrapped = moves.wrapped(angle)
    assert -math.pi <= wrapped <= math.pi
    assert math.cos(wrapped - angle) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("speed", [3.0, 5.0, 12.0])
@pytest.mark.parametrize("goal", [(20.0, 20.0, -UP - 5.0), (0.0, 0.0, -UP + 4.0)])
def test_moves_end_where_they_should_and_stay_there(speed: float, goal: Vector3) -> None:
    flight = airborne()
    flight.fly(0.1)
    path = [flight.physics.state().position, goal]
    task = moves.along_path(path, speed, lookahead_of(-1, 1, speed), Heading(), 100.0)
    for count in range(100 * RATE):
        order = steered(task, count * STEP, flight.physics.state())
        if isinstance(order, bool):
            break
        assert isinstance(order, Setpoint)
        flight.autopilot.command(msgspec.structs.replace(order, stamp=flight.stamp))
        flight.fly(STEP)
    assert order is True
    assert math.dist(flight.physics.state().position, goal) < CLOSE
    flight.fly(0.06)
    flight.autopilot.command(Hover(stamp=flight.stamp, source="test"))
    flight.fly(3.0)
    assert math.dist(flight.physics.state().position, goal) < CLOSE


def test_what_is_stuck_has_failed_after_five_seconds() -> None:
    task = moves.along_path([(0.0, 0.0, 0.0), (9.0, 0.0, 0.0)], 1.0, 1.0, Heading(), math.inf)
    results = [steered(task, count * STEP, at((0.0, 0.0, 0.0))) for count in range(5 * RATE + 1)]
    assert [result for result in results if isinstance(result, bool)] == [False]


def test_a_landing_waits_until_nothing_moves_for_more_than_ten_updates() -> None:
    task = moves.landing(60.0)
    falling, lying = at((0.0, 0.0, 0.0), (0.0, 0.0, 0.2)), at((0.0, 0.0, 0.0))
    states = [lying] * 10 + [falling] + [lying] * 12
    names = [type(steered(task, 0.0, state)).__name__ for state in states]
    assert names == ["VelocitySetpoint"] * 21 + ["Land", "NoneType"]


@pytest.mark.parametrize(("speed", "ends"), [(3.0, None), (0.1, True)])
def test_a_place_is_reached_when_the_vehicle_is_slow_too(speed: float, ends: bool | None) -> None:
    """Else a landing that follows would coast on for a metre first."""
    task = moves.along_path([(0.0, 0.0, -2.0), (9.0, 0.0, -2.0)], 12.0, -1.0, Heading(), 60.0)
    there = at((9.0, 0.0, -2.0), (speed, 0.0, 0.0))
    orders = [steered(task, count * STEP, there) for count in range(20)]
    outcome = next((order for order in orders if isinstance(order, bool)), None)
    assert outcome is ends
