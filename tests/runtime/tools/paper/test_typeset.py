"""Tables for papers: what is best, what failed, and that names never break LaTeX or CSV."""

from __future__ import annotations

import csv
import io
import re
from pathlib import Path
from typing import Any
from unittest import mock

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runtime.errors import CommandError
from runtime.figures import FIGURES, IN_SWEEPS
from runtime.summary import Verdict
from runtime.tools.comparison import Compared, compare_values
from runtime.tools.paper.typeset import columns_of, combinations_of, figures_table, typeset
from runtime.tools.suite.page import table_of
from runtime.tools.sweep import Job
from runtime.tools.sweep.plan import plan_of
from runtime.tools.sweep.tables import Combination, Row, Spread, combine, crashed
from tests.runtime.tools.samples_cli import command_here
from tests.runtime.tools.sweep.samples import judge_file, pretend

FIGURE, SHARE = "ate_percent", "coverage_percent"
SECRETS = '# $ % & _ { } ~ ^ \\ < > | " [x] * a\nb'


def row(name: str, *runs: dict[str, Any] | str, settings: tuple[str, ...] = ()) -> Combination:
    """Return the row of runs with figures, or of crashes with a reason."""
    group = []
    for run in runs:
        ended = isinstance(run, dict)
        figures = {name: {"passed": True, **run}} if isinstance(run, dict) else {}
        one = {"seed": 1, "error": "" if ended else run, "estimators": figures}
        group.append(one)
    return combine(settings, name, group, (FIGURE, SHARE))  # type: ignore[arg-type]


def latex(*rows: Combination, **options: Any) -> list[str]:
    """Return the lines of rows and notes, below the head."""
    text = typeset(figures_table(rows, (), (FIGURE, SHARE), **options), "latex")
    return text.partition("\\midrule\n")[2].splitlines()


def test_the_best_is_bold_by_the_direction_of_its_figure() -> None:
    rows = row("a", {FIGURE: 2.0, SHARE: 99.0}), row("b", {FIGURE: 0.51234, SHARE: 95.0})
    a, b, *rest = latex(*rows)
    assert a == r"a & 2 & \textbf{99} \\"
    assert b == r"b & \textbf{0.512} & 95 \\"
    assert rest == [r"\bottomrule", r"\end{tabular}"]
    text = typeset(figures_table(rows, (), (FIGURE, SHARE)), "latex")
    assert r"estimator & ATE (\%) $\downarrow$ & coverage (\%) $\uparrow$ \\" in text
    assert r"\begin{tabular}{lrr}" in text
    text = typeset(figures_table(rows, (), (FIGURE, SHARE)), "markdown")
    assert text == (
        "| estimator | ATE (%) ↓ | coverage (%) ↑ |\n| :-- | --: | --: |\n"
        "| a | 2 | **99** |\n| b | **0.512** | 95 |\n"
    )


def test_who_failed_has_a_dagger_and_is_never_the_best() -> None:
    quitter = {FIGURE: 0.1, SHARE: 5.0, "passed": False, "failed": [f"{SHARE}: too few\nposes"]}
    a, b, *_, note, _ = latex(row("a", {FIGURE: 2.0, SHARE: 99.0}), row("b", quitter))
    assert a == r"a & \textbf{2} & \textbf{99} \\"
    assert b == r"b$^\dagger$ & 0.1 & 5$^\dagger$ \\"
    assert note.startswith(r"\multicolumn{3}{l}{\footnotesize $^\dagger$ failed: ")
    text = typeset(figures_table([row("b", quitter)], (), (FIGURE,)), "latex")
    assert f"% b: {SHARE}: too few poses\n" in text


def test_several_runs_have_a_median_a_range_and_their_failures_counted() -> None:
    three = row("a", {FIGURE: 1.0}, {FIGURE: 2.0}, {FIGURE: 4.0}, settings=("5",))
    lost = row("b", {FIGURE: 0.5}, "its worker died", settings=("5",))
    table = figures_table([three, lost], ["rate"], (FIGURE, SHARE))
    (block,) = table.groups
    assert [cell.text for cell in block[0]] == ["5", "a", "3", "2 (1–4)", "–"]
    assert [(cell.text, cell.failed) for cell in block[1]][:2] == [
        ("5", False),
        ("b (1 of 2)", True),
    ]
    assert [cell.best for cell in block[0]] == [False, False, False, True, False]
    assert r"2 (1--4)" in typeset(table, "latex")
    (line, other) = csv.DictReader(io.StringIO(typeset(table, "csv")))
    assert (line["rate"], line["state"], line["runs"]) == ("5", "passed", "3")
    assert (line["ate_percent median [%]"], line["ate_percent most [%]"]) == ("2.0", "4.0")
    assert line["coverage_percent median [%]"] == ""
    assert (other["state"], other["crashed"], other["reasons"]) == (
        "crashed",
        "1",
        "its worker died",
    )


def test_errors_after_different_alignments_are_not_compared() -> None:
    figures = {FIGURE: 1.0, SHARE: 90.0}
    rows = [
        row("a", {**figures, "alignment": "origin"}),
        row("b", {FIGURE: 2.0, SHARE: 95.0, "alignment": "sim3"}),
    ]
    table = figures_table(rows, (), (FIGURE, SHARE))
    assert [column.heading for column in table.columns][1] == "alignment"
    assert [[cell.best for cell in line][2:] for line in table.groups[0]] == [
        [False, False],
        [False, True],
    ]
    assert "alignment: origin" in figures_table(rows[:1], (), (FIGURE,)).notes


def test_equal_values_and_single_rows_have_no_best() -> None:
    equal = [row("a", {FIGURE: 1.0, SHARE: 100.0}), row("b", {FIGURE: 1.0001, SHARE: 100.0})]
    assert "textbf" not in typeset(figures_table(equal, (), (FIGURE, SHARE)), "latex")
    assert "textbf" not in typeset(figures_table(equal[:1], (), (FIGURE,)), "latex")


def test_nees_has_no_better_side_and_every_error_has() -> None:
    assert FIGURES["nees_position"].better == FIGURES["commands"].better == ""
    assert {FIGURES[name].better for name in IN_SWEEPS} == {"less", "more"}
    assert FIGURES["final_ate_rmse_m"].better == FIGURES["latency_p50_ms"].better == "less"
    assert FIGURES["rpe_1m_trans_percent"].column == "RPE, 1 m"
    assert FIGURES["ate_max_m"].column == "ate max"
    assert not FIGURES["ate_sim3_rmse_m"].after_alignment
    assert not FIGURES["coverage_percent"].after_alignment


def cells_of(line: str) -> list[str]:
    return re.split(r"(?<!\\)&", line.removesuffix(r" \\"))


@settings(max_examples=25)
@given(st.text(min_size=1, max_size=20))
def test_no_name_breaks_a_table(name: str) -> None:
    table = figures_table([row(name + SECRETS, {FIGURE: 1.0})], (), (FIGURE,))
    head, line = (typeset(table, "latex").splitlines()[i] for i in (3, 5))
    assert len(cells_of(head)) == len(cells_of(line)) == 2
    without = re.sub(r"\\[{}$&#_%\\]|\\[a-z]+\{\}|\{\[\}|\{\*\}|\$[^$]*\$", "", cells_of(line)[0])
    assert not set(without) & set('\\{}$&#_%^~<>|"[*')
    (record,) = csv.DictReader(io.StringIO(typeset(table, "csv"), newline=""))
    assert record["estimator"] == name + SECRETS
    markdown = typeset(table, "markdown").splitlines()
    assert len(re.findall(r"(?<!\\)\|", re.sub(r"\\\\", "", markdown[2]))) == 3


def test_numbers_have_all_digits_in_csv_and_lines_end_as_its_standard_says() -> None:
    text = typeset(figures_table([row("a, b", {FIGURE: 1 / 3})], (), (FIGURE,)), "csv")
    assert text == (
        "estimator,alignment,state,ate_percent [%],reasons\r\n"
        '"a, b",,passed,0.3333333333333333,\r\n'
    )


def test_negative_numbers_have_a_minus_and_names_their_hyphen() -> None:
    line = latex(row("orb-slam3", {FIGURE: -1.5}))[0]
    assert line == r"orb-slam3 & $-$1.5 & -- \\"


def test_columns_are_those_asked_for_or_the_main_ones_that_are_known() -> None:
    known = [{"ate_percent": 1.0, "ate_max_m": 2.0, "alignment": "se3", "passed": True}]
    assert columns_of((), known) == ["ate_percent"]
    assert columns_of(("ate_max_m", "ate_max_m"), known) == ["ate_max_m"]
    with pytest.raises(
        CommandError, match=r"--figure ate_mox_m: .* \(did you mean 'ate_max_m'\?\)"
    ):
        columns_of(("ate_mox_m",), known)


def test_a_run_that_crashed_has_a_row() -> None:
    (crash,) = combinations_of(None, (FIGURE,), "its worker died")
    assert latex(crash)[0] == r"crashed$^\dagger$ & -- & -- \\"
    with pytest.raises(CommandError, match="expected estimators that were judged"):
        combinations_of(Verdict(None, {}), (FIGURE,))


def test_show_prints_the_table_and_nothing_else(tmp_path: Path) -> None:
    figures = {"passed": False, "ate_percent": 2.5, "failed": ["ate_percent: expected at most 1"]}
    content = {"verdict": {"passed": False, "estimators": {"my_vo": figures}}}
    (tmp_path / "summary.json").write_bytes(msgspec.json.encode(content))
    done = command_here("show", ".", "--csv", folder=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines() == [
        "estimator,alignment,state,ate_percent [%],reasons",
        "my_vo,,failed,2.5,ate_percent: expected at most 1",
    ]
    done = command_here("show", ".", "--latex", "--csv", folder=tmp_path)
    assert (done.returncode, done.stderr) == (
        2,
        "error: expected one format of the table, found --latex and --csv\n",
    )
    done = command_here("show", ".", "--figure", "ate_percent", folder=tmp_path)
    assert "--figure: expected --latex, --markdown or --csv beside it" in done.stderr


def test_a_sweep_prints_a_row_for_each_combination(tmp_path: Path) -> None:
    judge_file(tmp_path)
    with (
        mock.patch(
            "runtime.tools.cli.sweep.carry_out", lambda plan, **_: [*map(pretend, plan.jobs)]
        ),
        mock.patch("runtime.tools.sweep.draw_plots"),
    ):
        words = ["judge.toml", "--vary", "judge.rate=5,60", "--seeds", "2", "--markdown"]
        done = command_here("sweep", *words, folder=tmp_path)
    assert done.returncode == 1
    assert done.stdout.splitlines()[:6] == [
        "| judge.rate | estimator | runs | ATE (%) ↓ |",
        "| :-- | :-- | --: | --: |",
        "| 5 | vo | 2 | 5.04 (5.03–5.04) |",
        "| 5 | slam | 2 | **2.52** |",
        "| 60 | vo (2 of 2)† | 2 | 60 |",
        "| 60 | slam (2 of 2)† | 2 | 30 |",
    ]
    assert "2 of 4 runs failed" in done.stderr


def test_a_suite_has_its_best_by_scenario() -> None:
    jobs = (
        Job(id=f"{scenario}-{name}", text="", folder="", seed=1, out="",
            settings=(("scenario", scenario), ("estimator", name)))
        for scenario in ("slow", "quick")
        for name in ("good", "bad")
    )  # fmt: skip
    plan = plan_of(jobs, Path())
    rows: list[Row] = []
    for index, job in enumerate(plan.jobs):
        name = dict(job.settings)["estimator"]
        figures = {"passed": True, "flight_ate_percent": float(index)}
        costs = {f"{name}.Tracker": {"cpu_p50_ms": 3.0}}
        rows.append(crashed(job, "") | {"estimators": {name: figures}, "workers": costs})  # type: ignore[arg-type]
    table = table_of(plan, rows, ())
    assert [[line[0].text for line in block] for block in table.groups] == [
        ["slow"] * 2,
        ["quick"] * 2,
    ]
    assert [line[2].best for block in table.groups for line in block] == [True, False] * 2
    assert [column.heading for column in table.columns][3:] == ["cpu p50"]
    assert typeset(table, "latex").count("\\midrule") == 2


def test_a_comparison_has_its_better_side_in_bold(tmp_path: Path) -> None:
    pairs = {("tour", n): (2.0 + n, 1.0 + n / 2) for n in range(9)} | {("yard", 0): (None, 2.0)}
    compared = Compared([compare_values("vo", FIGURE, pairs)], 0.0, tmp_path / "compare.html")
    assert compared.rows[0].verdict == "better"
    with mock.patch("runtime.tools.comparison.compare", return_value=compared):
        done = command_here("compare", "a", "b", "--latex", folder=tmp_path)
        other = command_here("compare", "a", "b", "--csv", folder=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    line = done.stdout.partition("\\midrule\n")[2].splitlines()[0]
    assert line.startswith(r"vo & ATE & \% & 6 (1 failed)$^\dagger$ & \textbf{3} & $-$")
    (record,) = csv.DictReader(io.StringIO(other.stdout))
    assert (record["A"], record["failed in A"], record["verdict"]) == ("6.0", "1", "better")


def test_a_spread_of_equal_values_is_one_number() -> None:
    same = msgspec.structs.replace(row("a", {FIGURE: 1.0}), figures={FIGURE: Spread.of([1.0, 1.0])})
    assert latex(same)[0] == r"a & 1 & -- \\"
