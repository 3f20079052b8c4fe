"""Is B better than A: found where it is, not found where it is not, failures never left out."""

from __future__ import annotations

import itertools
import json
import math
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import visnav
from runtime.errors import ConfigError
from runtime.node import Node, NodeConfig
from runtime.tools.cli.sweep import of_comparison
from runtime.tools.comparison import Comparison, Key, compare_rows, compare_values, read_folder
from runtime.tools.comparison.flying import check_flights
from runtime.tools.comparison.statistics import compare_until_sure, signed_rank
from runtime.tools.sweep import Row
from tests.nodes.outside.process.rig import STUB
from tests.runtime.tools.samples_cli import ROOT, command_here

Pairs = Mapping[Key, tuple[float | None, float | None]]


def flights(count: int, factor: float, seed: int = 0, noise: float = 0.1) -> Pairs:
    """Return errors whose size depends on the flight much more than on the side."""
    rng = np.random.default_rng(seed)
    hard = np.exp(rng.normal(0, 1.0, count))
    a, b = np.exp(rng.normal(0, noise, (2, count)))
    return {("tour", n): (hard[n] * a[n], hard[n] * b[n] * factor) for n in range(count)}


def ate(pairs: Pairs, **options: Any) -> Comparison:
    return compare_values("vo", "ate_percent", pairs, **options)


@pytest.mark.slow
def test_equal_sides_differ_in_at_most_one_of_twenty_comparisons() -> None:
    verdicts = [ate(flights(12, 1.0, seed)).verdict for seed in range(400)]
    wrong = sum(verdict in {"better", "worse"} for verdict in verdicts)
    assert wrong <= 400 * 0.05 + 2 * math.sqrt(400 * 0.05 * 0.95)
    assert wrong > 0  # as many as asked for: it is not blind either


@pytest.mark.slow
def test_several_figures_together_err_no_more_often() -> None:
    def rows(values: np.ndarray) -> dict[Key, list[Row]]:
        names = ("flight_ate_percent", "rpe_1m_trans_percent", "rot_rmse_deg")
        return {
            ("tour", n): [row(seed=n, **dict(zip(names, figures, strict=True)))]
            for n, figures in enumerate(values.tolist())
        }

    rng = np.random.default_rng(1)
    wrong = 0
    for _ in range(200):
        a, b = np.exp(rng.normal(0, 0.1, (2, 12, 3)))
        comparisons = compare_rows(rows(a), rows(b))
        assert len(comparisons) == 3
        wrong += any(comparison.verdict in {"better", "worse"} for comparison in comparisons)
    assert wrong <= 200 * 0.05 + 2 * math.sqrt(200 * 0.05 * 0.95)


def sequential(seed: int, calls: list[int], shares: bool = True) -> bool:
    """Return whether calls with more and more equal flights find a difference, sooner or later."""
    whole = flights(max(calls), 1.0, seed)
    looked: list[int] = []

    def compare(count: int, error: float) -> list[Comparison]:
        pairs = {key: pair for key, pair in whole.items() if key[1] < count}
        return [ate(pairs, error=error if shares else 0.05)]

    verdicts = [compare_until_sure(compare, most, looked)[0].verdict for most in calls]
    assert looked == sorted(set(looked))
    return any(verdict in {"better", "worse"} for verdict in verdicts)


@pytest.mark.slow
def test_whoever_adds_flights_until_there_is_a_difference_finds_none_more_often() -> None:
    calls, trials = [8, 12, 16, 24, 40, 64], 300
    wrong = sum(sequential(seed, calls) for seed in range(trials))
    naive = sum(sequential(seed, calls, shares=False) for seed in range(trials))
    limit = trials * 0.05 + 2 * math.sqrt(trials * 0.05 * 0.95)
    assert 0 < wrong <= limit < naive  # which proves that these calls could


def test_a_look_has_half_the_error_of_the_one_before_and_keeps_it() -> None:
    asked: list[tuple[int, float]] = []

    def compare(count: int, error: float) -> list[Comparison]:
        asked.append((count, error))
        return [ate(flights(count, 1.0), error=error)]

    looked: list[int] = []
    for most in (12, 24, 24, 30):
        compare_until_sure(compare, most, looked)
    # Six flights cannot tell, whatever they show, and so take nothing from the others.
    assert asked == [
        *((6, 0.025), (12, 0.025)),
        *((12, 0.025), (24, 0.0125)),
        *((12, 0.025), (24, 0.0125)),
        (30, 0.00625),
    ]
    assert looked == [12, 24, 30]
    asked.clear()
    clear = flights(40, 3.0)

    def decided(count: int, error: float) -> list[Comparison]:
        asked.append((count, error))
        return [ate({key: pair for key, pair in clear.items() if key[1] < count}, error=error)]

    compare_until_sure(decided, 40, [])
    assert asked == [(20, 0.025)]


def test_a_small_worsening_is_found_with_enough_flights_and_asked_for_with_few() -> None:
    few = ate(flights(6, 1.1, noise=0.15))
    assert (few.verdict, few.relative) == ("not enough runs", True)
    assert few.more > 0
    many = ate(flights(60, 1.1, noise=0.15))
    assert many.verdict == "worse"
    assert many.low < 10 < many.high
    assert many.low > 0
    assert ate(flights(60, 1 / 1.1, noise=0.15)).verdict == "better"


def test_fewer_flights_than_can_tell_are_said_so_however_clear_it_looks() -> None:
    clear = ate({("tour", n): (1.0, 2.0 + n / 10) for n in range(4)})
    assert (clear.verdict, clear.low) == ("not enough runs", -math.inf)
    assert clear.more == 2  # of 6 flights, equal signs have p = 2 / 2^6 < 0.05
    assert ate({("tour", n): (1.0, 2.0 + n / 10) for n in range(6)}).verdict == "worse"


def test_within_the_margin_there_is_no_difference() -> None:
    pairs = flights(60, 1.01, noise=0.02)
    assert ate(pairs, margin=5).verdict == "no difference"
    assert ate(flights(60, 1.0, noise=0.5), margin=5).verdict == "not enough runs"
    assert ate(flights(60, 1.0, noise=0.5), margin=5).inferior(5)
    assert not ate(pairs, margin=5).inferior(5)


def test_a_margin_forgives_what_is_within_it_however_sure() -> None:
    pairs = {("tour", n): (1.0, 1.02 + n / 1e4) for n in range(20)}
    assert (ate(pairs).verdict, ate(pairs).fails(0)) == ("worse", True)
    comparison = ate(pairs, margin=5)
    assert (comparison.verdict, comparison.fails(5), comparison.fails(1)) == (
        "no difference",
        False,
        True,
    )


def test_errors_after_different_alignments_are_not_comparable() -> None:
    def rows(factor: float, alignment: str) -> dict[Key, list[Row]]:
        flown = {("t", n): [row(n, ate_percent=factor + n / 100)] for n in range(12)}
        for (judged,) in flown.values():
            judged["estimators"]["vo"] |= {
                "alignment": alignment,
                "frame_coverage_percent": 90 + factor,
            }
        return flown

    names = ["ate_percent", "frame_coverage_percent"]
    error, share = compare_rows(rows(2, "origin"), rows(1, "sim3"), figures=names)
    assert (error.verdict, share.verdict) == ("not comparable", "worse")
    assert error.words == "not comparable: after origin and sim3"
    assert (error.fails(0), error.fails(5)) == (False, True)
    assert [outcome.state for outcome in of_comparison(error, 0)] == ["not judged"]
    error, _ = compare_rows(rows(2, "origin"), rows(1, "origin"), figures=names)
    assert error.verdict == "better"


def test_a_scenario_fails_where_the_figure_does_and_most_of_its_flights_are_worse() -> None:
    pairs: dict[Key, tuple[float | None, float | None]] = {}
    for n in range(12):
        pairs["hall", n], pairs["yard", n] = (1.0, 2.0 + n / 10), (1.0, 0.99)
    pairs["hall", 3] = (1.0, None)
    comparison = ate(pairs)
    assert (comparison.verdict, comparison.by_scenario()) == (
        "worse",
        {"hall": (12, 0, 12), "yard": (0, 12, 12)},
    )
    hall, yard = of_comparison(comparison, 0)
    assert (hall.run, hall.estimator, hall.state) == ("hall", "vo ate_percent", "failed")
    assert (yard.state, yard.reasons) == ("passed", [])
    assert hall.reasons[0].endswith("in all; worse in 12 of 12 flights here")
    doubtful = ate({("hall", n): (1.0, 1.0) for n in range(3)}, margin=5)
    assert [case.state for case in of_comparison(doubtful, 5)] == ["failed"]  # as the command does
    assert [case.state for case in of_comparison(doubtful, 0)] == ["not judged"]


def test_a_failure_is_worse_than_any_error_and_never_left_out() -> None:
    pairs = dict(flights(12, 0.5))  # B is twice as good, where it does not fail
    assert ate(pairs).verdict == "better"
    for n in range(9):
        pairs["tour", n] = (pairs["tour", n][0], None)
    comparison = ate(pairs)
    assert (comparison.failures, comparison.change, comparison.pairs) == ((0, 9), math.inf, 12)
    assert comparison.verdict != "better"
    assert ate({("tour", n): (1.0, None) for n in range(8)}).verdict == "worse"
    assert ate({("tour", n): (None, 1.0) for n in range(8)}).verdict == "better"
    both = ate({("tour", n): (None, None) for n in range(8)})
    assert (both.verdict, both.change, both.p) == ("not enough runs", 0.0, 1.0)


def test_where_more_is_better_less_is_worse() -> None:
    pairs = {("tour", n): (99.0 - n, 90.0 - n) for n in range(10)}
    comparison = compare_values("vo", "frame_coverage_percent", pairs)
    assert (comparison.verdict, comparison.inferior(1.0)) == ("worse", True)
    lost: Pairs = {("tour", n): (99.0, None) for n in range(10)}
    assert compare_values("vo", "frame_coverage_percent", lost).verdict == "worse"


def test_zeros_are_compared_by_difference() -> None:
    comparison = compare_values("vo", "lost_seconds", {("t", n): (0.0, n / 2) for n in range(10)})
    assert (comparison.relative, comparison.unit, comparison.verdict) == (False, "s", "worse")
    same = compare_values("vo", "lost_seconds", {("t", n): (0.0, 0.0) for n in range(10)}, margin=1)
    assert (same.verdict, same.p) == ("no difference", 1.0)


VALUES = st.floats(-100, 100).filter(lambda x: abs(x) > 1e-6)


@pytest.mark.slow
@given(st.lists(VALUES, min_size=6, max_size=25, unique_by=abs))
def test_the_test_is_scipys_where_that_is_exact(values: list[float]) -> None:
    from scipy.stats import wilcoxon

    p, _, low, high = signed_rank(np.array(values), 0.05)
    assert p == pytest.approx(wilcoxon(values, method="exact").pvalue, rel=1e-9)
    assert (p <= 0.05) == (low > 0 or high < 0)


@pytest.mark.slow
@given(st.lists(st.integers(-3, 3), min_size=1, max_size=12))
def test_with_ties_it_is_the_share_of_random_signs(values: list[int]) -> None:
    differences = np.array(values, float)
    p, change, low, high = signed_rank(differences, 0.05)
    ranks = wilcoxon_ranks(differences)
    signs = np.array([*itertools.product([0, 1], repeat=len(ranks))])
    sums = signs @ ranks
    statistic = ranks[differences[differences != 0] > 0].sum()
    expected = min(2 * min((sums <= statistic).mean(), (sums >= statistic).mean()), 1.0)
    assert p == pytest.approx(expected)
    assert low <= change <= high


def wilcoxon_ranks(differences: np.ndarray) -> np.ndarray:
    from scipy.stats import rankdata

    return np.array(rankdata(abs(differences))[differences != 0], float)


def row(seed: int, error: str = "", name: str = "vo", **figures: float) -> Row:
    return Row(
        id=f"{seed}{name}",
        parameters={},
        seed=seed,
        exit_code=0,
        error=error,
        passed=None,
        digest=None,
        sim_seconds=1.0,
        run_seconds=1.0,
        wall_seconds=1.0,
        estimators={} if error else {name: figures},
    )


def test_crashed_runs_repeats_and_other_names() -> None:
    a = {("t", n): [row(n, ate_percent=1.0), row(n, ate_percent=3.0)] for n in range(8)}
    b = {("t", n): [row(n, name="other", ate_percent=1.0)] for n in range(8)}
    b["t", 3] = [row(3, "out of order")]
    (comparison,) = compare_rows(a, b, figures=["ate_percent"])
    assert (comparison.estimator, comparison.a, comparison.b) == ("vo / other", 2.0, 1.0)
    assert (comparison.failures, comparison.pairs) == ((0, 1), 8)
    with pytest.raises(ConfigError, match="found none in common: t 0; u 0"):
        compare_rows({("t", 0): [row(0)]}, {("u", 0): [row(0)]})
    with pytest.raises(ConfigError, match="expected ate_max_m, found none of them in any run"):
        compare_rows(a, b, figures=["ate_max_m"])
    with pytest.raises(ConfigError, match=r"an estimator in both, found \[\] and \[\]"):
        compare_rows({("t", 0): [row(0, "crashed")]}, {("t", 0): [row(0, "crashed")]})


def test_an_estimator_that_one_side_lacks_is_a_row_and_worse_there() -> None:
    def both(n: int) -> Row:
        line = row(n, ate_percent=1.0 + n)
        line["estimators"]["slam"] = {"ate_percent": 2.0 + n}
        return line

    a = {("t", n): [both(n)] for n in range(3)}
    b = {("t", n): [row(n, ate_percent=1.0)] for n in range(3)}
    vo, slam = compare_rows(a, b, figures=["rot_rmse_deg", "ate_percent"])
    assert (vo.estimator, vo.missing, slam.estimator, slam.figure) == (
        "vo", "", "slam", "ate_percent"
    )  # fmt: skip
    assert (slam.verdict, slam.words, slam.missing) == ("worse", "worse: not there in B", "B")
    assert (slam.medians, slam.failures) == (["3 %", "– (3 failed)"], (0, 3))
    assert (slam.fails(0), slam.fails(5)) == (True, True)
    assert [outcome.state for outcome in of_comparison(slam, 0)] == ["failed"]
    _, slam = compare_rows(b, a, figures=["ate_percent"])
    assert (slam.words, slam.fails(0), slam.fails(5)) == ("better: not there in A", False, False)
    (vo,) = compare_rows(b, {key: [row(0, "crashed")] for key in b}, figures=["ate_percent"])
    assert vo.words == "worse: not there in B"


def test_identical_values_are_said_to_be_identical() -> None:
    same = {("t", n): (1.0 + n, 1.0 + n) for n in range(12)}
    for margin, words in ((0.0, "identical"), (5.0, "no difference: identical")):
        comparison = ate(same, margin=margin)
        assert (comparison.words, comparison.fails(margin)) == (words, False)
        assert [outcome.state for outcome in of_comparison(comparison, margin)] == ["passed"]
    few = ate({key: pair for key, pair in same.items() if key[1] < 2}, margin=5)
    assert few.words == "identical so far: 4 more may tell"
    assert (few.fails(0), few.fails(5)) == (False, True)  # with a margin it has to be shown
    assert ate(same | {("t", 0): (1.0, 1.0 + 1e-12)}).verdict == "not enough runs"
    assert ate(same | {("t", 0): (None, None)}).verdict == "not enough runs"


def test_what_is_identical_in_half_of_the_flights_is_looked_at_in_all() -> None:
    """A change that has an effect in few flights is not overlooked."""
    asked: list[int] = []

    def compare(count: int, error: float) -> list[Comparison]:
        asked.append(count)
        return [ate({("t", n): (1.0, 1.0) for n in range(count)}, error=error)]

    (comparison,) = compare_until_sure(compare, 24, [])
    assert (asked, comparison.words) == ([12, 24], "identical")


def fed(key: Key, name: str = "tour", **inputs: str) -> Row:
    return row(key[1], ate_percent=1.0) | {"name": name, "inputs": inputs}


def test_different_flights_are_not_taken_for_equal_ones() -> None:
    keys: list[Key] = [("run", n) for n in range(3)]
    a = {key: [fed(key, odometry="1", images="2")] for key in keys}
    assert check_flights(a, {key: [fed(key, odometry="1", images="2")] for key in keys}) == []
    same = {key: [fed(key, "other", odometry="1", images="2")] for key in keys}
    assert check_flights(a, same) == []  # of another name: the same flight
    b = a | {keys[1]: [fed(keys[1], odometry="1", images="3", lidar="4")]}
    (note,) = check_flights(a, b)
    assert note == (
        "1 of 3 flights are not the same for A and B: images, lidar differ; what is compared is of "
        "different flights"
    )
    with pytest.raises(ConfigError, match='same flights, found "tour" and "yard" with seed 1, in'):
        check_flights(a, b | {keys[1]: [fed(keys[1], "yard", odometry="9")]})
    without = a | {keys[0]: [row(0)], keys[2]: [row(2, "crashed")]}
    assert check_flights(a, without) == []
    (note,) = check_flights(a, without, whole=False)
    assert note.startswith("whether 1 of 3 flights are the same for A and B is not known")


def test_runs_during_which_files_were_edited_are_told(tmp_path: Path) -> None:
    for side in "ab":
        rows = [fed(("run", n), odometry="1") for n in range(2)]
        if side == "b":
            rows[0]["edited"] = ["vo.py changed"]
        (tmp_path / side).mkdir()
        lines = b"\n".join(msgspec.json.encode(row) for row in rows)
        (tmp_path / side / "rows.jsonl").write_bytes(lines)
    with pytest.warns(UserWarning, match="1 runs of B are of a mixture: vo.py changed while they"):
        compared = visnav.compare(
            tmp_path / "a", tmp_path / "b", figures=["ate_percent"], out=tmp_path / "out"
        )
    assert compared.notes[0] in (tmp_path / "out" / "compare.html").read_text(encoding="utf-8")
    assert compared.notes[0] in repr(compared)


def test_a_row_cut_short_by_a_full_disk_is_left_out(tmp_path: Path) -> None:
    line = msgspec.json.encode(row(3, ate_percent=1.0))
    (tmp_path / "rows.jsonl").write_bytes(line + b"\n" + line[:40])
    assert read_folder(tmp_path) == {("run", 3): [row(3, ate_percent=1.0)]}


class JudgeConfig(NodeConfig):
    """How well an estimator does: its error, times a number of the seed."""

    error: float = 1.0
    spread: float = 0.1
    crash: bool = False


class Judge(Node[JudgeConfig]):
    """Concludes a verdict, or crashes."""

    async def run(self) -> None:
        if self.config.crash:
            raise RuntimeError("out of order")

    async def on_shutdown(self) -> None:
        error = self.config.error * float(np.exp(self.rng.normal(0, self.config.spread)))
        self.conclude("vo", {"ate_percent": error, "frame_coverage_percent": 100.0})


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    path = tmp_path / "c.toml"
    path.write_text(
        '[run]\nname = "tour"\nduration = 1\n'
        f'[[nodes]]\nname = "judge"\ntype = "{__name__}:Judge"\n'
    )
    return path


@pytest.mark.slow
@pytest.mark.timeout(240)
def test_settings_are_flown_and_compared(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = ["--seeds", "8", "--figure", "ate_percent", "--json", "c.json", "--junit", "c.xml"]
    change = ["--b", "judge.error=2"]
    done = command_here("compare", file, *change, *options, folder=tmp_path)
    assert (done.returncode, "worse" in done.stdout) == (1, True), done.stderr
    (comparison,) = json.loads((tmp_path / "c.json").read_bytes())
    assert (comparison["verdict"], comparison["pairs"], comparison["figure"]) == (
        "worse",
        8,
        "ate_percent",
    )
    assert comparison["change"] == pytest.approx(100, abs=40)
    (case,) = ET.parse(tmp_path / "c.xml").getroot().iter("testcase")
    assert (case.attrib["classname"], case.attrib["name"]) == ("c", "vo ate_percent")
    assert [element.tag for element in case] == ["failure"]
    page = (tmp_path / "compared" / "compare.html").read_text(encoding="utf-8")
    assert '<td class="bad"><b>worse</b></td>' in page
    assert "judge.error=2" in page
    # The other way around it is better; and what was flown is not flown again.
    done = command_here("compare", file, "--a", "judge.error=2", *options, folder=tmp_path)
    assert (done.returncode, "better" in done.stdout) == (0, True), done.stderr
    assert "16 runs are finished already, 0 to do" in done.stderr
    # From Python it is the same.
    monkeypatch.chdir(tmp_path)
    compared = visnav.compare(
        file, b={"judge.error": 2}, seeds=8, figures=["ate_percent"], margin=5
    )
    (one,) = compared.rows
    assert (one.words, one.pairs) == ("worse", 8)
    assert one.change == pytest.approx(comparison["change"])
    assert 5 < one.low <= one.change <= one.high
    assert compared.worse
    assert compared.page.samefile(tmp_path / "compared" / "compare.html")
    assert repr(compared).startswith("vo ate_percent: +")
    with pytest.raises(ConfigError, match="unknown key 'eror'"):
        visnav.compare(file, b={"judge.eror": 2})


OWN = f"""
from {__name__} import Judge, JudgeConfig
import edited_tracker


class OwnJudge(Judge):
    async def on_shutdown(self) -> None:
        error = edited_tracker.FACTOR * self.config.error
        self.conclude("vo", {{"ate_percent": error, "frame_coverage_percent": 100.0}})
"""


@pytest.mark.slow
@pytest.mark.timeout(240)
def test_after_an_edit_of_an_estimator_its_figures_are_new(file: Path, tmp_path: Path) -> None:
    """The loop of everybody: compare, edit a file, compare again."""
    (tmp_path / "edited_judge.py").write_text(OWN, encoding="utf-8")
    (tmp_path / "edited_tracker.py").write_text("FACTOR = 1.0\n", encoding="utf-8")
    file.write_text(file.read_text().replace(f"{__name__}:Judge", "edited_judge:OwnJudge"))
    options = ["--b", "judge.error=2", "--seeds", "2", "--figure", "ate_percent"]

    def compared() -> tuple[dict[str, Any], str]:
        done = command_here("compare", file, *options, "--json", "c.json", folder=tmp_path)
        assert done.returncode == 0, done.stderr
        (comparison,) = json.loads((tmp_path / "c.json").read_bytes())
        return comparison, done.stderr

    row, _ = compared()
    assert (row["a"], row["b"]) == (1.0, 2.0)
    _, said = compared()
    assert said == "2 runs are finished already, 0 to do\n4 runs are finished already, 0 to do\n"
    (tmp_path / "edited_tracker.py").write_text("FACTOR = 3.0\n", encoding="utf-8")
    row, said = compared()
    assert (row["a"], row["b"]) == (3.0, 6.0)
    assert "0 runs are finished already, 2 are run again: edited_tracker.py changed\n" in said
    assert "2 runs are finished already, 2 are run again: edited_tracker.py changed\n" in said


PROGRAM = """
[run]
name = "rig"
duration = 1
[[nodes]]
name = "eyes"
type = "tests.nodes.outside.process.rig:Eyes"
truth = true
[[nodes]]
name = "slam"
type = "Process"
folder = "builds"
command = []
images = ["rgb", "depth"]
environment = {PYTHONPATH = "FOLDER"}
[[nodes]]
name = "evaluation"
type = "Evaluation"
"""


@pytest.mark.slow
@pytest.mark.timeout(240)
def test_two_builds_of_a_program_are_compared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of them is lost in a quarter of the images; both lie beside the file.

    A new one behind the same command is flown again, and the other is kept.
    """
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    file = tmp_path / "rig.toml"
    client = str(ROOT / "nodes" / "outside" / "native")
    file.write_text(PROGRAM.replace("FOLDER", client), encoding="utf-8")
    (tmp_path / "builds").mkdir()
    shutil.copy(STUB, tmp_path / "builds" / "new")
    text = Path(STUB).read_text(encoding="utf-8")
    old = text.replace('"loses" in modes', "True")
    assert old != text
    (tmp_path / "builds" / "old").write_text(old, encoding="utf-8")
    sides = {
        f"--{side}": f'slam.command=["$VISNAV_PYTHON", "{name}"]'
        for side, name in (("a", "old"), ("b", "new"))
    }
    options = ["--seeds", "1", "--figure", "frame_coverage_percent", "--json", "c.json"]
    words = [word for pair in sides.items() for word in pair]
    done = command_here("compare", file, *words, *options, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    (comparison,) = json.loads((tmp_path / "c.json").read_bytes())
    assert (comparison["failures"], comparison["b"]) == ([0, 0], 100)
    assert comparison["a"] == pytest.approx(75, abs=5)
    shutil.copy(tmp_path / "builds" / "old", tmp_path / "builds" / "new")
    done = command_here("compare", file, *words, *options, folder=tmp_path)
    assert "1 runs are finished already, 1 is run again: new changed\n" in done.stderr
    (comparison,) = json.loads((tmp_path / "c.json").read_bytes())
    assert comparison["b"] == comparison["a"]


@pytest.mark.slow
@pytest.mark.timeout(240)
def test_finished_sweeps_are_compared(file: Path, tmp_path: Path) -> None:
    for name, change in (("old", "judge.error=1"), ("new", "judge.error=0.3")):
        options = ["--seeds", "7", "--set", change, "--out", name]
        assert command_here("sweep", file, *options, folder=tmp_path).returncode == 0
    done = command_here("compare", "old", "new", "--figure", "ate_percent", folder=tmp_path)
    assert (done.returncode, "better" in done.stdout) == (0, True), done.stdout
    runs = sorted((tmp_path / "old" / "runs").iterdir())
    assert len(read_folder(runs[0])) == 1
    done = command_here("compare", runs[0], runs[0], "--margin", "5", folder=tmp_path)
    assert "identical so far: 5 more may tell" in done.stdout
    assert done.returncode == 1  # with a margin, what is not shown counts as inferior


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["c.toml"], "expected --a or --b: in what the two sides differ"),
        (["c.toml", "--b", "judge.eror=1"], "found unknown key 'eror'"),
        (["c.toml", "--b", "judge.error=1", "--figure", "ate"], "--figure ate: expected one of"),
        (["."], "expected two folders, without --a and --b"),
        ([".", "."], "expected the folder of a sweep (rows.jsonl) or of a run, found: "),
    ],
)
def test_nonsense_is_a_sentence(file: Path, tmp_path: Path, words: list[str], message: str) -> None:
    done = command_here("compare", *words, folder=file.parent)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert message in done.stderr
