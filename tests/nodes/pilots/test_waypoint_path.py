"""Paths keep their promises: where they begin, pass and end, and how fast they are at most."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nodes.pilots.waypoint_path import Floats, WaypointPath, plan

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
