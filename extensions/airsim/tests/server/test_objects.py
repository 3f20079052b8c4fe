"""Objects of the world, wind, lines of sight, messages, and what is accepted without effect."""

from __future__ import annotations

import contextlib
import logging
import math
import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from events.frames import to_geodetic
from extensions.airsim.tests.scripts import Caller, RefusedError, drone, with_script
from sims.worlds import load_world
from visnav_airsim.server.methods import WITHOUT_EFFECT
from visnav_airsim.server.movables import whole_matches
from visnav_airsim.server.objects import geoms_by_object


def test_objects_have_names_and_poses(tiny_world: str) -> None:
    def script(airsim: Caller) -> None:
        assert airsim("simListSceneObjects", ".*") == ["ball", "drone", "floor", "wall"]
        assert airsim("simListSceneObjects", "(?:w|b)al{2}") == ["ball", "wall"]
        assert airsim("simListSceneObjects", "Wall") == airsim("simListSceneObjects", "wal") == []
        with pytest.raises(RefusedError, match="missing \\)"):
            airsim("simListSceneObjects", "(wall")
        wall = airsim("simGetObjectPose", "wall")
        assert wall["position"] == {"x_val": 5.0, "y_val": 0.0, "z_val": -3.0}
        assert wall["orientation"]["w_val"] == 1.0
        assert airsim("simGetObjectPose", "wall", True) == wall
        assert airsim("simGetObjectPose", "drone")["position"]["y_val"] == pytest.approx(2.0)
        unknown = airsim("simGetObjectPose", "nobody")
        assert all(math.isnan(number) for part in unknown.values() for number in part.values())

    with_script(script, [drone(world=tiny_world, position=(0.0, 2.0))])


def test_an_object_has_its_look() -> None:
    model = load_world("hall", bare=True).compile()
    geoms = geoms_by_object(model)
    assert list(geoms) == sorted(geoms)
    assert not any(name.endswith(".look") for name in geoms)
    assert [model.geom(geom).name for geom in geoms["crate_0"]] == ["crate_0.look", "crate_0"]


_pieces = st.sampled_from(["a", "b", ".", "[ab]", "[^]a*]", r"\w", r"\.", r"\*", "(a|b)", "(?:ab)"])
_repeated = st.tuples(
    st.sampled_from(["a", ".", "[^]a*]", r"\*"]),
    st.sampled_from(["*", "+", "?", "*?", "{2}", "{1,3}", "{0}", "{2,}", "{,2}"]),
).map("".join)
_expressions = st.tuples(st.lists(_pieces, max_size=3), st.lists(_repeated, max_size=1)).map(
    lambda parts: "".join(parts[0] + parts[1] + parts[0])
)


@given(_expressions, st.lists(st.text("abcA._*", max_size=9)), st.booleans())
def test_expressions_match_as_those_of_python_do(
    expression: str, texts: list[str], ignore: bool
) -> None:
    flags = re.IGNORECASE if ignore else re.NOFLAG
    expected = [text for text in texts if re.fullmatch(expression, text, flags)]
    assert whole_matches(expression, texts, ignore_case=ignore) == expected


@given(st.text("ab()[]{}|*+?^$\\.,-19:=!<P", max_size=210))
@settings(deadline=1000)  # milliseconds; that of the worst is a tenth
def test_any_expression_is_matched_or_refused_in_bounded_time(expression: str) -> None:
    with contextlib.suppress(ValueError):
        whole_matches(expression, ["a" * 60 + str(number) for number in range(100)])


@pytest.mark.parametrize(
    "expression",
    [
        "((a*)*)*b",
        "(a|a)*b",
        "(?:aa?)+b",
        "a*a*a*a*b",
        "((a{99}){99}){99}",
        "a" * 201,
        "(a|.)" * 33 + "b",
    ],
)
def test_expressions_that_would_take_python_for_ever_are_refused(expression: str) -> None:
    with pytest.raises(ValueError, match="regular expression: expected"):
        whole_matches(expression, ["a" * 60])


ORIGIN = (47.641468, -122.140165, 122.0)


def geo(x: float, y: float, z: float) -> dict[str, float]:
    latitude, longitude, altitude = to_geodetic((x, y, z), ORIGIN)
    return {"latitude": latitude, "longitude": longitude, "altitude": altitude}


def vector(x: float, y: float, z: float) -> dict[str, float]:
    return {"x_val": x, "y_val": y, "z_val": z}


def test_wind_moves_what_flies_and_can_be_taken_back(tiny_world: str) -> None:
    def script(airsim: Caller) -> None:
        def north() -> float:
            place = airsim("simGetObjectPose", "drone")["position"]
            return float(place["x_val"])

        def drift() -> float:
            start = north()
            airsim("simContinueForTime", 0.25)
            return north() - start

        assert abs(drift()) < 1e-6
        airsim("simSetWind", vector(20.0, 0.0, 0.0))
        gentle, strong = drift(), drift()
        assert strong > 2.0 * gentle > 0.01
        airsim("simSetWind", vector(0.0, 0.0, 0.0))
        assert drift() > drift() > strong  # it flies on, and the air brakes it
        for wrong in (math.nan, math.inf, 1e30):
            airsim.refuses("velocity: expected up to 50 m/s", "simSetWind", vector(0.0, wrong, 0.0))

    with_script(script, [drone(world=tiny_world, height=20.0)])


def test_lines_of_sight_end_at_walls(tiny_world: str) -> None:
    def script(airsim: Caller) -> None:
        for place, is_seen in (((3.0, 0.0, -1.0), True), ((9.0, 0.0, -1.0), False)):
            assert airsim("simTestLineOfSightToPoint", geo(*place), "") is is_seen
            assert airsim("simTestLineOfSightBetweenPoints", geo(0, 0, -1), geo(*place)) is is_seen
        assert airsim("simTestLineOfSightBetweenPoints", geo(9, 9, -9), geo(9, 9, -9)) is True
        airsim.refuses(
            "place: expected up to",
            "simTestLineOfSightToPoint",
            geo(0, 0, -1) | {"altitude": math.nan},
            "",
        )
        low, high = airsim("simGetWorldExtents")
        assert low["latitude"] < ORIGIN[0] < high["latitude"]
        assert high["altitude"] == pytest.approx(ORIGIN[2] + 6.0, abs=0.01)  # the wall's top
        assert low["altitude"] == pytest.approx(ORIGIN[2], abs=0.01)

    with_script(script, [drone(world=tiny_world)])


def test_the_level_is_the_world(tiny_world: str) -> None:
    def script(airsim: Caller) -> None:
        assert airsim("simLoadLevel", tiny_world) is True
        assert airsim("simLoadLevel", "Neighborhood") is False
        airsim.refuses(
            "writes no files", "simCreateVoxelGrid", vector(0, 0, 0), 1, 1, 1, 0.1, "/tmp/x"
        )

    with_script(script, [drone(world=tiny_world)])


def test_messages_are_logged_by_their_severity(
    tiny_world: str, caplog: pytest.LogCaptureFixture
) -> None:
    def script(airsim: Caller) -> None:
        airsim("simPrintLogMessage", "hello ", "all", 0)
        airsim("simPrintLogMessage", "be\ncareful", "", 1)
        airsim("simPrintLogMessage", "x" * 9999, "", 2)
        airsim("simPrintLogMessage", "odd", "", 255)

    with caplog.at_level(logging.INFO, "visnav.airsim"):
        with_script(script, [drone(world=tiny_world)])
    records = [(record.levelno, record.getMessage()) for record in caplog.records]
    said = [record for record in records if "a client says" in record[1]]
    assert said[:2] == [
        (logging.INFO, "a client says: hello all"),
        (logging.WARNING, r"a client says: 'be\ncareful'"),
    ]
    assert said[2:] == [
        (logging.ERROR, f"a client says: {'x' * 500}"),
        (logging.INFO, "a client says: odd"),
    ]


def test_what_has_no_effect_is_accepted_and_logged_once(
    tiny_world: str, caplog: pytest.LogCaptureFixture
) -> None:
    def script(airsim: Caller) -> None:
        for _ in range(2):
            for method, (description, arguments) in WITHOUT_EFFECT.items():
                expected = False if description.startswith("Return") else None
                assert airsim(method, *arguments.split()) is expected
        airsim.refuses("Expected: 2, got: 1", "simSetWeatherParameter", 0)

    with_script(script, [drone(world=tiny_world)])
    logged = [r.getMessage() for r in caplog.records if "has no effect here" in r.getMessage()]
    assert sorted(logged) == sorted(f"{method} has no effect here" for method in WITHOUT_EFFECT)
