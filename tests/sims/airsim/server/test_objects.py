"""Objects of the world: their names and poses."""

from __future__ import annotations

import contextlib
import math
import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sims.airsim.server.objects import geoms_by_object
from sims.airsim.server.regex import whole_matches
from sims.worlds import load_world
from tests.sims.airsim.scripts import Caller, RefusedError, drone, with_script


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
