"""Paths and manoeuvres keep their promises, and a real vehicle flies them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from events import PositionSetpoint
from nodes.pilots.waypoint_path import (
    Excitation,
    FigureEight,
    Floats,
    WaypointPath,
    excited,
    headed,
    joined,
    plan,
)
from runtime import Duration
from sims.vehicle.autopilot import Clearance, trouble_on_path
from sims.worlds import TOURS
from tests.sims.vehicle.flight import UP, airborne, compiled

coordinates = st.floats(-8, 8).map(lambda value: round(value, 2))


@st.composite
def waypoints(draw: st.DrawFn) -> Floats:
    """Two to six places, neighbours at least 10 cm apart."""
    points = draw(
        st.lists(st.tuples(coordinates, coordinates, coordinates), min_size=2, max_size=6)
    )
    kept = [np.array(points[0])]
    for point in points[1:]:
        if np.linalg.norm(kept[-1] - point) > 0.1:
            kept.append(np.array(point))
    return np.array(kept if len(kept) > 1 else [kept[0], kept[0] + 1.0])


def planned(points: Any, **changes: Any) -> WaypointPath:
    wanted: dict[str, Any] = {
        "speed": 1.3,
        "acceleration": 1.0,
        "radius": 0.8,
        "yaw": 0.5,
        "turn_time": 0.5,
        "step": 0.02,
    }
    return plan(np.asarray(points, dtype=np.float64), **(wanted | changes))


@pytest.mark.slow
@settings(deadline=None, max_examples=60)
@given(waypoints(), st.floats(0.3, 3.0), st.floats(0.5, 3.0), st.floats(0.1, 2.0))
def test_a_path_keeps_its_promises(
    points: Floats, speed: float, acceleration: float, radius: float
) -> None:
    path = planned(points, speed=speed, acceleration=acceleration, radius=radius)
    for row, place in ((0, points[0]), (-1, points[-1])):
        assert np.linalg.norm(path.position[row] - place) < 0.01 * max(speed, 1.0)
        assert np.linalg.norm(path.velocity[row]) < 0.03 * max(speed, 1.0)
    assert np.linalg.norm(path.velocity, axis=1).max() <= speed * 1.01
    # Along and across are limited each for itself; a turn on the spot needs a bit more yet.
    assert np.linalg.norm(path.acceleration, axis=1).max() <= acceleration * 1.6
    for place in points[1:-1]:
        # Smoothing over 0.3 s, twice, cuts what an acceleration does in that time off a turn.
        assert np.linalg.norm(path.position - place, axis=1).min() <= radius + 0.1 * acceleration
    assert path.yaw[0] == pytest.approx(0.5, abs=0.3)
    assert np.abs(np.diff(path.yaw)).max() < 0.25
    assert np.abs(np.diff(path.position, axis=0)).max() <= speed * path.step * 1.01


def test_a_straight_path_looks_where_it_goes() -> None:
    path = planned([[0, 0, -1], [0, 6, -1]], yaw=0.0)
    assert path.yaw[-1] == pytest.approx(np.pi / 2, abs=1e-3)
    assert np.abs(path.position[:, 0]).max() < 1e-9
    assert path.length == pytest.approx(6, abs=0.01)
    assert path.velocity[:, 1].max() == pytest.approx(1.3, rel=0.01)


def test_going_straight_up_keeps_the_heading() -> None:
    path = planned([[0, 0, -1], [0, 0, -3]], yaw=1.0)
    assert path.yaw == pytest.approx(1.0)
    assert np.abs(path.yaw_rate).max() == pytest.approx(0.0, abs=1e-9)


def test_heading_is_continuous_across_the_south() -> None:
    square = [[0, 0, 0], [-5, 0.5, 0], [-10, -0.5, 0], [-15, 0.5, 0]]
    path = planned(square, yaw=3.0)
    assert np.abs(path.yaw - np.pi).max() < 0.6


def test_rates_are_the_derivatives_of_what_they_go_with() -> None:
    path = planned([[0, 0, 0], [4, 0, 0], [4, 4, -1]])
    moved = np.cumsum(path.velocity, axis=0) * path.step
    assert np.abs(moved + path.position[0] - path.position).max() < 0.03
    assert np.abs(np.cumsum(path.yaw_rate) * path.step + path.yaw[0] - path.yaw).max() < 0.05


@pytest.mark.parametrize("turn_time", [0.0, 2.0])
def test_it_stands_at_the_end_whatever_the_turn_time(turn_time: float) -> None:
    path = planned([[0, 0, 0], [4, 0, 0]], turn_time=turn_time, yaw=0.0)
    assert np.linalg.norm(path.position[-1] - (4, 0, 0)) < 0.01
    assert np.linalg.norm(path.velocity[-1]) < 0.02


def test_time_is_rows_times_step() -> None:
    for step in (0.01, 0.1):
        path = planned([[0, 0, 0], [4, 0, 0]], step=step)
        assert path.seconds == pytest.approx(4 / 1.3 + 1.3 + 2, abs=0.3)
        assert len(path.position) == len(path.yaw) == round(path.seconds / step) + 1


STEP = 0.02


def level(points: Any, speed: float, acceleration: float, radius: float = 0.8) -> WaypointPath:
    return plan(
        np.asarray(points, dtype=np.float64), speed=speed, acceleration=acceleration,
        radius=radius, yaw=0.0, turn_time=0.5, step=STEP,
    )  # fmt: skip


def flown(path: WaypointPath) -> tuple[Floats, Floats, float]:
    """Fly a path in physics; return places, the error at each (m) and the highest speed."""
    flight = airborne(float(path.yaw[0]))
    flight.fly(1.0)
    shift = np.array([0.0, 0.0, -UP]) - path.position[0]
    start = flight.stamp

    def say(stamp: int) -> PositionSetpoint:
        row = min(int((stamp - start) / 1e9 / STEP + 1e-6), len(path.yaw) - 1)
        wanted = path.row(row)
        position = tuple((path.position[row] + shift).tolist())
        return PositionSetpoint(stamp=stamp, source="test", **wanted | {"position": position})

    track = [state for _, state in flight.fly(path.seconds, say)]
    places = np.array([state.position for state in track]) - shift
    times, rows = np.arange(len(track)) / 400, np.arange(len(path.yaw)) * STEP
    wanted = np.stack([np.interp(times, rows, axis) for axis in path.position.T], axis=1)
    speeds = np.linalg.norm([state.velocity for state in track], axis=1)
    return places, np.linalg.norm(places - wanted, axis=1), float(speeds.max())


@settings(deadline=None, max_examples=60)
@given(st.floats(3, 30), st.floats(0.01, 2), st.floats(0.01, 2), st.floats(0, 180))
@example(duration=3.0, amplitude=2.0, frequency=0.0625, yaw=0.0)
def test_an_excitation_stays_within_its_amplitude_and_ends_where_it_began(
    duration: float, amplitude: float, frequency: float, yaw: float
) -> None:
    assume(amplitude * (2 * np.pi * 1.3 * frequency) ** 2 <= 4)
    excitation = Excitation(
        duration=Duration(duration), amplitude=amplitude, frequency=frequency, yaw=yaw
    )
    path = excited(excitation, (1.0, 2.0, -3.0), 0.5, STEP)
    moved = path.position - (1.0, 2.0, -3.0)
    assert np.abs(moved).max() <= amplitude * (1 + 1e-9)
    assert np.abs(np.degrees(path.yaw - 0.5)).max() <= yaw + 1e-9
    for row in (0, -1):
        assert np.linalg.norm(moved[row]) < 1e-9
        assert np.linalg.norm(path.velocity[row]) < 0.02  # of differences over a step; ∝ step²


def test_an_excitation_that_no_vehicle_follows_is_refused() -> None:
    with pytest.raises(ValueError, match=r"amplitude, frequency: expected at most 4 m/s².* 66"):
        Excitation(amplitude=1.0, frequency=1.0)
    with pytest.raises(ValueError, match=r"duration: expected 3 to 60 s, found 1 s"):
        Excitation(duration=Duration(1.0))


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [{}, {"amplitude": 0.36}, {"amplitude": 0.2, "frequency": 0.52},
     {"amplitude": 1.2, "frequency": 0.2}],
    ids=str,
)  # fmt: skip
def test_a_vehicle_is_excited_about_all_axes_within_what_is_announced(
    settings: dict[str, Any],
) -> None:
    excitation = Excitation(**settings)
    places, _, _ = flown(excited(excitation, (0.0, 0.0, -UP), 0.0, STEP))
    moved = np.abs(places - places[0]).max(axis=0)
    assert (moved > 0.6 * excitation.amplitude).all()
    assert moved.max() < excitation.reach


@settings(deadline=None, max_examples=40)
@given(st.floats(0.5, 20), st.floats(0.5, 20), st.floats(-2, 2), st.floats(-360, 360))
def test_an_eight_fills_its_box_and_crosses_itself_in_its_centre(
    length: float, width: float, rise: float, direction: float
) -> None:
    eight = FigureEight(
        centre=(1.0, -2.0, -4.0), length=length, width=width, rise=rise, direction=direction
    )
    places = eight.places() - (1.0, -2.0, -4.0)
    for row in (0, 32, 64):
        assert np.linalg.norm(places[row]) < 1e-9
    axis = np.array([np.cos(np.radians(direction)), np.sin(np.radians(direction))])
    along, across = places[:, :2] @ axis, places[:, :2] @ (-axis[1], axis[0])
    assert (along.max(), -along.min()) == pytest.approx((length / 2,) * 2)
    assert (across.max(), -across.min()) == pytest.approx((width / 2,) * 2)
    assert np.abs(places[:, 2]).max() == pytest.approx(abs(rise))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("length", "width", "speed", "error"), [(4, 2.5, 1.5, 0.1), (8, 4, 3, 0.2), (16, 8, 6, 0.3)]
)
def test_an_eight_is_flown_as_it_is_drawn(
    length: float, width: float, speed: float, error: float
) -> None:
    """At up to 6 m/s the vehicle stays within decimetres of the curve."""
    eight = FigureEight(centre=(0.0, 0.0, -UP), length=length, width=width, rise=0.3)
    _, errors, fastest = flown(level(eight.places(), speed, 1.5 + 0.6 * speed))
    assert errors.max() < error
    assert fastest > 0.85 * speed


@pytest.mark.slow
@pytest.mark.parametrize(("speed", "acceleration", "radius"), [(3, 3.5, 1.0), (6, 5.0, 1.5)])
@pytest.mark.parametrize("heading", ["path", "sweep"])
def test_aggressive_tours_are_really_flown(
    heading: Any, speed: float, acceleration: float, radius: float
) -> None:
    """The vehicle follows the hall's tour at 3 and at up to 6 m/s to less than 0.3 m."""
    tour = level([*TOURS["hall"], TOURS["hall"][0]], speed, acceleration, radius)
    _, errors, fastest = flown(headed(tour, heading, 0.0))
    assert errors.max() < 0.3
    assert np.sqrt(np.mean(errors**2)) < 0.12
    assert fastest > 0.8 * speed


def test_headings() -> None:
    path = level([[0, 0, -1], [6, 0, -1], [6, 6, -1]], 1.0, 1.0)
    assert headed(path, "path", 0.3) is path
    assert headed(path, "fixed", 0.3).yaw == pytest.approx(0.3)
    swing = np.degrees(headed(path, "sweep", 0.3).yaw - path.yaw)
    assert (swing.max(), swing.min()) == pytest.approx((40, -40), abs=0.5)
    assert (swing[0], swing[-1]) == (0, pytest.approx(0))


def test_paths_are_joined_row_by_row() -> None:
    path = level([[0, 0, -1], [2, 0, -1]], 1.0, 1.0)
    both = joined(path, headed(path, "sweep", 0.0))
    assert len(both.yaw) == 2 * len(path.yaw) == len(both.position)
    np.testing.assert_array_equal(both.velocity[: len(path.yaw)], path.velocity)


def test_the_room_for_an_excitation_is_checked() -> None:
    world = Clearance(compiled(), "drone")
    start = (3.5, 0.0, -0.1)
    assert trouble_on_path(world, start, [(3.5, 0.0, -1.5)], 0.1) == ""
    assert trouble_on_path(world, start, [(3.5, 0.0, -1.5)], 0.5) == (
        "excitation: expected 0.5 m of free room about [3.5, 0, -1.5], found wall at [4, 0, -1.5]"
    )
