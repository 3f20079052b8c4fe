"""A verdict says why an estimator has failed, and how the run ended; a row for each rule."""

from __future__ import annotations

from typing import Any

import pytest

from nodes.judging.evaluation.thresholds import Thresholds
from nodes.judging.evaluation.verdict import conclude, node_of, planned_end
from runtime.host import RunEnd
from tests.nodes.judging.evaluation.flights import MS, SECOND
from tests.nodes.judging.evaluation.zoo import ended

FINE: dict[str, Any] = {"ate_rmse_m": 0.1, "coverage_percent": 100.0, "compared_percent": 100.0}
NO_ROTATIONS = {"orientations": "inverse", "why_no_rotations": "they are inverted"}
BY_USER = ended(by="user", reason="Ctrl-C", planned=False, stamp=3 * SECOND)
STOPPED = "the user ended the run before its plan was flown: Ctrl-C"


@pytest.mark.parametrize(
    ("figures", "given", "row"),
    [
        ({}, {}, {"passed": False, "failed": ["expected estimates, found none"]}),
        ({"why": "dark"}, {}, {"passed": False, "failed": ["dark"]}),
        (FINE, {}, {"passed": None, "failed": [], "ended_by": None, "early_end_seconds": None}),
        (FINE, {"faults": ["restarted"]}, {"passed": False, "failed": ["restarted"]}),
        (
            FINE,
            {"ended_flights": {"est": "land at 2 s"}},
            {"failed": ["commands: expected it not to end the flight, found land at 2 s"]},
        ),
        (
            FINE | NO_ROTATIONS | {"coverage_percent": 50.0},
            {},
            {
                "failed": [
                    "coverage_percent: expected at least 90, found 50",
                    "rot_rmse_deg: expected at most 15, found none: they are inverted",
                ]
            },
        ),
        (FINE, {"end": ended()}, {"early_end_seconds": 0.0, "ended_by": "duration"}),
        (
            FINE,
            {"end": ended(by="est", reason="dark", planned=False, stamp=11_900 * MS)},
            {
                "early_end_seconds": pytest.approx(0.2),
                "ended_by": "est",
                "failed": [
                    "early_end_seconds: expected at most 0, found 0.2 (est ended the run: dark)"
                ],
            },
        ),
        (
            FINE,
            {"end": ended(by="pilot", planned=False, stamp=13 * SECOND)},
            {"early_end_seconds": 0.0, "ended_by": "pilot", "failed": []},
        ),
        # Who restarts as a node and in a new frame has it in both: it counts once.
        (FINE, {"end": ended()}, {"restarts": None}),
        (FINE | {"restarts": 0}, {"end": ended()}, {"restarts": 0}),
        (FINE, {"end": ended(restarts={"est": 2})}, {"restarts": 2}),
        (FINE | {"restarts": 3}, {"end": ended(restarts={"est": 2})}, {"restarts": 3}),
        (FINE, {"end": ended(restarts={"other": 2})}, {"restarts": None}),
        (
            FINE,
            {"end": ended(truth_readers=frozenset({"est"})), "declared": ["est"]},
            {"reads_truth": "declared", "failed": []},
        ),
        (FINE, {"end": ended(), "declared": ["est"]}, {"reads_truth": "declared"}),
        ({}, {"end": BY_USER}, {"passed": None, "failed": [], "why": STOPPED}),
    ],
)
def test_a_row_of_a_verdict(
    figures: dict[str, Any], given: dict[str, Any], row: dict[str, Any]
) -> None:
    verdict = conclude({"est": figures}, Thresholds(), **given)
    judged = verdict["estimators"]["est"]
    assert {name: judged.get(name) for name in row} == row
    assert {name: judged[name] for name in figures if name not in row} == {
        name: value for name, value in figures.items() if name not in row
    }
    assert verdict["passed"] is judged["passed"]
    assert verdict["thresholds"]["coverage_percent"] == 90.0


def test_who_is_asked_for_something_and_is_not_there_has_a_row_that_says_so() -> None:
    asked = {"mono": Thresholds(ate_percent=5.0)}
    row = conclude({}, Thresholds(), by_estimator=asked)["estimators"]["mono"]
    why = "expected estimates, found none"
    assert row == {"passed": False, "why": why, "failed": [why]}


def test_what_the_user_ended_fails_no_flight() -> None:
    limits = Thresholds(plan_rmse_m=0.2, ate_percent=1.0)
    flown = {"drone": {"plan_rmse_m": 0.3}}
    verdict = conclude({}, limits, ["late"], BY_USER, flights=flown)
    assert verdict["flights"]["drone"] == {"passed": None, "plan_rmse_m": 0.3, "failed": []}
    assert (verdict["passed"], verdict["failed"]) == (None, [STOPPED, "late"])


@pytest.mark.parametrize(
    ("end", "planned"),
    [
        (None, None),
        (ended(), None),
        (BY_USER, None),
        (ended(by="est", planned=False, duration=None), None),
        (ended(by="est", planned=False), 12_100 * MS),
    ],
)
def test_the_plan_goes_on_after_an_early_end_unless_the_user_ended_it(
    end: RunEnd | None, planned: int | None
) -> None:
    assert planned_end(end) == planned


@pytest.mark.parametrize(
    ("source", "nodes", "node"),
    [
        ("a", ["a", "b"], "a"), ("a/b", ["a"], "a"), ("ab", ["a"], ""),
        ("a/b/c", ["a", "a/b"], "a/b"), ("a/b/c", ["a/b", "a"], "a/b"),
        ("a", ["a/b"], ""), ("a", [""], ""), ("", ["", "a"], ""),
    ],
)  # fmt: skip
def test_a_source_is_of_the_longest_name_above_it(source: str, nodes: list[str], node: str) -> None:
    assert node_of(source, nodes) == node
