"""Agreement with published figures: rankings, inversions, levels and failures by hand."""

from __future__ import annotations

import itertools
import math
from collections.abc import Hashable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.tools.reality.agreement import (
    Cell,
    Failures,
    ablation,
    criteria,
    difficulty,
    exact_p,
    failing,
    failing_cells,
    failures,
    inversions,
    levels,
    rankings,
    ranks,
    spearman,
)

Errors = dict[str, dict[Hashable, float]]

NAMES = "abcdef"
SEQUENCES = "1234"
REAL = {n: {s: 0.01 * 3**i * (1 + 0.1 * int(s)) for s in SEQUENCES} for i, n in enumerate(NAMES)}
ERRORS = st.lists(st.floats(0.001, 10.0), min_size=3, max_size=6, unique=True)


def simulated(factor: float = 1.0) -> dict[str, dict[Cell, float]]:
    """Return errors that are the published ones times a factor, in one world."""
    return {n: {Cell(s, "w"): factor * e for s, e in row.items()} for n, row in REAL.items()}


def verdicts(sim: dict[str, dict[Cell, float]]) -> dict[str, str]:
    return {criterion.name: criterion.verdict for criterion in criteria(sim, REAL)}


def test_ranks_share_their_mean_also_among_failures() -> None:
    assert ranks([0.2, 0.1, 0.2]).tolist() == [2.5, 1.0, 2.5]
    assert ranks([math.inf, 1.0, math.inf, 0.5]).tolist() == [3.5, 2.0, 3.5, 1.0]


def test_spearman_by_hand() -> None:
    """d² of (1 2 3 4) and (2 1 3 4) is 2: 1 - 6 · 2 / (4 · 15) = 0.8."""
    assert spearman([1, 2, 3, 4], [0.2, 0.1, 0.3, 0.4]) == pytest.approx(0.8)
    assert spearman([1, 2, 3], [3, 2, 1]) == pytest.approx(-1.0)
    assert math.isnan(spearman([1, 1, 1], [1, 2, 3]))


def test_p_is_the_share_of_orders_that_agree_as_well() -> None:
    """Of 24 orders of four one is equal, and three more differ by one exchange of neighbours."""
    assert exact_p([1, 2, 3, 4], [1, 2, 3, 4]) == pytest.approx(1 / 24)
    assert exact_p([1, 2, 3, 4], [2, 1, 3, 4]) == pytest.approx(4 / 24)
    assert exact_p([1, 2, 3], [3, 2, 1]) == 1.0
    assert exact_p([1, 1, 1], [1, 2, 3]) is None
    assert exact_p(range(9), range(9)) is None


@given(ERRORS, st.randoms())
def test_a_ranking_depends_on_the_order_alone(errors: list[float], random: object) -> None:
    other = sorted(errors, key=lambda _: random.random())  # type: ignore[attr-defined]
    value = spearman(errors, other)
    assert -1.0 - 1e-9 <= value <= 1.0 + 1e-9
    assert spearman(other, errors) == pytest.approx(value)
    assert spearman([math.log(e) for e in errors], other) == pytest.approx(value)
    assert spearman(errors, errors) == pytest.approx(1.0)
    assert spearman(errors, [-e for e in other]) == pytest.approx(-value)


@pytest.mark.parametrize("size", [3, 4, 5])
def test_over_all_orders_p_is_uniform(size: int) -> None:
    """The share of orders with p of at most some p is at most that p: it is a p value."""
    orders = itertools.permutations(range(size))
    values = sorted(exact_p(range(size), order) or 0.0 for order in orders)
    for index, value in enumerate(values, 1):
        assert index / len(values) <= value + 1e-9


def test_equal_order_passes_and_its_reverse_fails() -> None:
    assert verdicts(simulated())["ranking of systems"] == "passed"
    assert set(verdicts(simulated()).values()) == {"passed", "nothing to compare"}
    turned = {n: {c: 1e-4 / e for c, e in row.items()} for n, row in simulated().items()}
    failed = verdicts(turned)
    assert failed["ranking of systems"] == failed["pairs in the right order"] == "failed"
    assert [r.spearman for r in rankings(turned, REAL)] == pytest.approx([-1.0] * 4)


def test_fewer_than_six_systems_are_not_enough() -> None:
    few = {n: row for n, row in simulated().items() if n != "f"}
    assert verdicts(few)["ranking of systems"] == "not enough systems"
    assert verdicts(few)["pairs in the right order"] == "not enough systems"
    assert verdicts({}) == dict.fromkeys(verdicts({}), "nothing to compare") | {
        "ranking of systems": "not enough systems"
    }


def test_fewer_than_three_rankings_are_not_enough() -> None:
    """Smaller ones are left out of the median, and counted."""
    two = {
        n: {c: e for c, e in row.items() if c.sequence in "12" or n not in "ef"}
        for n, row in simulated().items()
    }
    ranking = criteria(two, REAL)[0]
    assert ranking.verdict == "not enough sequences"
    assert (
        ranking.figure == "Spearman 1.00, median of 2 rankings of 6 systems (2 of fewer left out)"
    )


def test_a_system_fails_by_its_own_median_in_each_world() -> None:
    errors = {Cell(s, "w"): e for s, e in zip("12345", (1, 1, 1, 6, math.inf), strict=True)}
    errors |= {Cell("1", "v"): 9.0, Cell("2", "v"): math.inf}
    failed = [cell for cell, is_failure in failing_cells(errors).items() if is_failure]
    assert failed == [Cell("4", "w"), Cell("5", "w"), Cell("2", "v")]


def test_only_what_both_know_is_ranked() -> None:
    sim = simulated()
    sim["stranger"] = {Cell("1", "w"): 0.001}
    del sim["a"][Cell("2", "w")]
    assert [(r.cell.sequence, r.systems) for r in rankings(sim, REAL)] == [
        ("1", 6), ("2", 5), ("3", 6), ("4", 6)
    ]  # fmt: skip


def test_who_fails_is_ranked_last() -> None:
    real = {"a": {"1": 0.1}, "b": {"1": 0.2}, "c": {"1": math.inf}}
    cell = Cell("1", "w")
    (right,) = rankings({"a": {cell: 1.0}, "b": {cell: 2.0}, "c": {cell: math.inf}}, real)
    (wrong,) = rankings({"a": {cell: math.inf}, "b": {cell: 2.0}, "c": {cell: 1.0}}, real)
    assert (right.spearman, wrong.spearman) == pytest.approx((1.0, -1.0))


def test_inversions_count_pairs_that_are_far_apart() -> None:
    """Three times apart and inverted counts; 1.5 times does not; each pair once."""
    real = {"a": {"1": 0.1, "2": 0.1}, "b": {"1": 0.3, "2": 0.3}, "c": {"1": 0.15, "2": 0.15}}
    cells = Cell("1", "w"), Cell("2", "w")
    sim = {name: dict.fromkeys(cells, e) for name, e in {"a": 0.4, "b": 0.2, "c": 0.1}.items()}
    (pair,), far = inversions(sim, real)
    assert (pair.better, pair.worse, far) == ("a", "b", 1)
    assert (pair.real, pair.sim) == pytest.approx((3.0, 0.5))
    sim["a"] = dict.fromkeys(cells, 0.1)
    assert inversions(sim, real) == ([], 1)


def test_a_failure_is_worse_than_any_error() -> None:
    real = {"a": {"1": 0.1}, "b": {"1": 0.3}}
    cell = Cell("1", "w")
    assert inversions({"a": {cell: 1.0}, "b": {cell: math.inf}}, real) == ([], 1)
    (pair,), _ = inversions({"a": {cell: math.inf}, "b": {cell: 1.0}}, real)
    assert pair.sim == 0.0
    assert inversions({"a": {cell: math.inf}, "b": {cell: math.inf}}, real) == ([], 0)


@pytest.mark.parametrize(
    ("factor", "level", "near"),
    [(1.0, "passed", "passed"), (0.4, "failed", "passed"), (4.0, "failed", "failed")],
)
def test_levels(factor: float, level: str, near: str) -> None:
    sim = simulated(factor)
    assert [*levels(sim, REAL).values()] == pytest.approx([factor] * 24)
    words = verdicts(sim)
    assert (words["level"], words["level, each system and sequence"]) == (level, near)
    assert words["ranking of systems"] == "passed"


def test_failures_have_no_level() -> None:
    sim = simulated()
    sim["a"][Cell("1", "w")] = math.inf
    assert ("a", Cell("1", "w")) not in levels(sim, REAL)
    assert len(levels(sim, REAL)) == 23


def test_a_failure_is_none_or_far_beyond_the_systems_own_median() -> None:
    assert failing({"1": 0.1, "2": 0.1, "3": 0.51, "4": math.inf, "5": 0.1}) == {
        "1": False, "2": False, "3": True, "4": True, "5": False
    }  # fmt: skip
    assert failing({"1": 0.1, "2": math.inf}) == {"1": False, "2": True}
    assert failing({"1": 0.1, "2": 9.0}) == {"1": False, "2": False}


def test_failures_of_both_sides_by_hand() -> None:
    real = {"a": {"1": 0.1, "2": 0.1, "3": 0.1, "4": math.inf, "5": 1.0}}
    sim = {"a": {Cell(s, "w"): e for s, e in zip("12345", (1, 9, 1, 1, math.inf), strict=True)}}
    counts = failures(sim, real)
    assert counts == Failures(both=1, sim_only=1, real_only=1, neither=2)
    assert (counts.recall, counts.precision) == (0.5, 0.5)
    assert counts.false == pytest.approx(1 / 3)
    none = Failures(both=0, sim_only=0, real_only=0, neither=0)
    assert all(map(math.isnan, (none.recall, none.precision, none.false)))


def test_published_failures_that_go_well_fail_the_criterion() -> None:
    real = REAL | {"f": REAL["f"] | {"4": math.inf}}
    by_name = {c.name: c for c in criteria(simulated(), real)}
    assert by_name["published failures fail"].verdict == "failed"
    assert by_name["published failures fail"].figure == "0 of 1"
    assert by_name["false failures"].verdict == "passed"


def test_difficulty_is_ranked_over_the_sequences_of_each_world() -> None:
    sim = simulated()
    turned = {c: 1.0 / e for c, e in sim["a"].items()}
    sim = {"a": sim["a"], "b": {Cell(c.sequence, "v"): e for c, e in turned.items()}}
    assert difficulty(sim, REAL) == pytest.approx({"a, w": 1.0, "b, v": -1.0})


def test_an_ablation_is_over_the_runs_that_both_have() -> None:
    real: Errors = {"a": {1: 0.2, 2: 0.4, 3: 0.6, 4: 99.0}, "b": {1: 0.1}}
    condition: Errors = {"a": {1: 0.1, 2: 0.2, 3: 0.3, 5: 99.0}, "b": {1: math.inf}, "c": {1: 1.0}}
    ((name, (ratio, runs)),) = ablation(condition, real).items()
    assert (name, runs) == ("a", 3)
    assert ratio == pytest.approx(0.5)


@given(st.floats(0.01, 100.0), st.integers(0, 1000))
def test_a_common_factor_changes_the_level_alone(factor: float, seed: int) -> None:
    noise = np.random.default_rng(seed).lognormal(0.0, 1.0, (6, 4))
    one = {
        n: {Cell(s, "w"): REAL[n][s] * noise[i, j] for j, s in enumerate(SEQUENCES)}
        for i, n in enumerate(NAMES)
    }
    other = {n: {c: factor * e for c, e in row.items()} for n, row in one.items()}
    assert rankings(other, REAL) == rankings(one, REAL)
    assert failures(other, REAL) == failures(one, REAL)
    assert len(inversions(other, REAL)[0]) == len(inversions(one, REAL)[0])
    ratios = [b / a for a, b in zip(*(levels(e, REAL).values() for e in (one, other)), strict=True)]
    assert ratios == pytest.approx([factor] * 24)
