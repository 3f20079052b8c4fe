"""Places on the earth: known ones, and there and back again from anywhere."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from events.frames import Geodetic, from_ecef, from_geodetic, to_ecef, to_geodetic

HOME = (47.641468, -122.140165, 122.0)

places = st.tuples(st.floats(-90, 90), st.floats(-180, 180), st.floats(-5e3, 1e5))
metres = st.floats(-1e5, 1e5)


@pytest.mark.parametrize(
    ("place", "point"),
    [
        ((0.0, 0.0, 0.0), (6378137.0, 0.0, 0.0)),
        ((0.0, 90.0, 10.0), (0.0, 6378147.0, 0.0)),
        ((90.0, 0.0, 0.0), (0.0, 0.0, 6356752.314245)),
        ((-90.0, 0.0, 100.0), (0.0, 0.0, -6356852.314245)),
        # PROJ 9: +proj=cart +ellps=WGS84
        ((45.0, 45.0, 1000.0), (3194919.145061, 3194919.145061, 4488055.515647)),
    ],
)
def test_known_places(place: Geodetic, point: Geodetic) -> None:
    assert to_ecef(place) == pytest.approx(point, abs=1e-5)
    assert to_ecef(from_ecef(point)) == pytest.approx(point, abs=1e-6)


@given(place=places)
def test_there_and_back_is_a_micrometre_at_most(place: Geodetic) -> None:
    assert math.dist(to_ecef(from_ecef(to_ecef(place))), to_ecef(place)) < 1e-6
    assert from_ecef(to_ecef(place))[2] == pytest.approx(place[2], abs=1e-6)


@pytest.mark.slow
@given(position=st.tuples(metres, metres, metres), origin=places)
def test_a_position_survives_the_earth(position: Geodetic, origin: Geodetic) -> None:
    again = from_geodetic(to_geodetic(position, origin), origin)
    assert again == pytest.approx(position, abs=1e-5)


def test_north_east_and_down_are_so() -> None:
    assert to_geodetic((0.0, 0.0, 0.0), HOME) == pytest.approx(HOME, abs=1e-9)
    north = to_geodetic((100.0, 0.0, 0.0), HOME)
    east = to_geodetic((0.0, 100.0, 0.0), HOME)
    # A degree of latitude is 111.19 km at 47.6°, of longitude 75.16 km.
    assert north[0] - HOME[0] == pytest.approx(100.0 / 111_190.0, rel=1e-3)
    assert north[1] == pytest.approx(HOME[1], abs=1e-9)
    assert east[1] - HOME[1] == pytest.approx(100.0 / 75_160.0, rel=2e-3)
    assert to_geodetic((0.0, 0.0, -50.0), HOME)[2] == pytest.approx(172.0)


def test_the_plane_leaves_the_earth_far_away() -> None:
    """10 km away a plane is 7.8 m above a sphere of 6378 km."""
    assert to_geodetic((10_000.0, 0.0, 0.0), HOME)[2] - HOME[2] == pytest.approx(7.84, abs=0.05)
