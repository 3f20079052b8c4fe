"""Rows as tables, plots and a page."""

from __future__ import annotations

import csv
import io
import re
from pathlib import Path

import pytest
from matplotlib.image import imread
from msgspec.structs import astuple
from rich.console import Console

from runtime.figures import IN_SWEEPS
from runtime.tools.sweep import Plan, Row, draw_plots, summarise, write_page, write_tables
from runtime.tools.sweep.console import print_summary
from runtime.tools.sweep.plots import lines
from runtime.tools.sweep.tables import Spread, crashed
from tests.runtime.tools.sweep.samples import plan_in, pretend


def read(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_a_table_has_a_line_for_each_run_and_estimator(tmp_path: Path) -> None:
    plan = plan_in(tmp_path, "judge.rate=5,60", seeds=2)
    rows = [pretend(job) for job in plan.jobs]
    rows[0] = crashed(plan.jobs[0], "out of order")
    write_tables(
        plan, [*reversed(rows), crashed(plan_in(tmp_path, seeds=9).jobs[-1], "of another")]
    )
    table = read(plan.out / "table.csv")
    assert [(line["judge.rate"], line["seed"], line["estimator"]) for line in table] == [
        ("5", "3", ""),
        *[(rate, seed, name) for rate, seed in [("5", "4"), ("60", "3"), ("60", "4")]
          for name in ("vo", "slam")],
    ]  # fmt: skip
    assert (table[0]["exit_code"], table[0]["error"]) == ("", "out of order")
    assert [table[0][key] for key in ("passed", "ate_percent", "estimator_passed")] == [""] * 3
    assert table[1] == {
        "run": plan.jobs[1].id, "judge.rate": "5", "seed": "4", "exit_code": "0", "error": "",
        "passed": "true", "sim_seconds": "", "digest": "", "estimator": "vo",
        "ate_percent": "5.04", "note": "made up", "estimator_passed": "true",
    }  # fmt: skip
    assert table[-1]["passed"] == table[-1]["estimator_passed"] == "false"
    times = read(plan.out / "timing.csv")
    assert [line["run"] for line in times] == [job.id for job in plan.jobs]
    assert [line["wall_seconds"] for line in times] == ["", "0.5", "0.5", "0.5"]


def test_a_summary_has_the_spread_over_the_seeds_and_counts_what_failed(tmp_path: Path) -> None:
    plan = plan_in(tmp_path, "judge.rate=1,2", seeds=4)
    rows = [pretend(job) for job in plan.jobs]
    rows[1] = crashed(plan.jobs[1], "out of order")
    for index in range(4, 8):
        rows[index] = crashed(plan.jobs[index], "out of order")
    first, second, last = summarise(plan, rows)
    assert (first.settings, first.estimator, second.estimator) == (("1",), "vo", "slam")
    assert (first.runs, first.crashed, first.passed) == (4, 1, 3)
    expected = Spread(1.05, 1.04, 1.055, 1.03, 1.06)
    assert astuple(first.figures["ate_percent"]) == pytest.approx(astuple(expected))
    expected = Spread(0.525, 0.52, 0.5275, 0.515, 0.53)
    assert astuple(second.figures["ate_percent"]) == pytest.approx(astuple(expected))
    assert (last.settings, last.estimator, last.crashed) == (("2",), "", 4)
    assert (last.passed, last.figures) == (None, {})
    write_tables(plan, rows)
    line = read(plan.out / "summary.csv")[0]
    values = [float(line[f"ate_percent_{what}"]) for what in ("median", "q1", "q3", "min", "max")]
    assert values == pytest.approx([1.05, 1.04, 1.055, 1.03, 1.06])
    assert line["ate_rmse_m_median"] == ""


def test_a_page_shows_figures_plots_and_runs_with_their_reports(tmp_path: Path) -> None:
    plan = plan_in(tmp_path, "judge.rate=1,2", seeds=2)
    rows = [pretend(job) for job in plan.jobs]
    rows[3] = crashed(plan.jobs[3], "out <of> order")
    folder = Path(plan.jobs[0].out)
    folder.mkdir(parents=True)
    (folder / "report.html").touch()
    draw_plots(plan, rows)
    page = write_page(plan, rows).read_text(encoding="utf-8")
    assert "<th>judge.rate</th>" in page
    assert (
        '<td class="n">1.04<br><span class="soft">1.03 to 1.04<br>1.03 to 1.04</span></td>' in page
    )
    assert '<img src="plots/judge.rate.png"' in page
    assert page.count(">open</a>") == 1
    assert f'<a href="runs/{plan.jobs[0].id}/report.html">open</a>' in page
    assert '<td class="bad">out &lt;of&gt; order</td>' in page


def with_ate(row: Row, **ate: float | None) -> Row:
    row["estimators"] = {name: {"ate_percent": value} for name, value in ate.items()}
    return row


def test_a_line_for_each_combination_of_the_others(tmp_path: Path) -> None:
    plan = plan_in(tmp_path, "judge.rate=20,10", "judge.method=flow,depth", seeds=3)
    rows = [pretend(job) for job in plan.jobs]
    for job, row in zip(plan.jobs, rows, strict=True):
        rate, method = (text for _, text in job.settings)
        ate = None if (rate, method) == ("20", "depth") else float(rate) + job.seed**2
        with_ate(row, vo=ate)
    flow, depth = lines(plan, rows, plan.parameters[0], "ate_percent")
    assert (flow.label, depth.label) == ("method=flow", "method=depth")
    assert (flow.texts, depth.texts) == (("20", "10"), ("10",))
    assert flow.spreads == (Spread(36, 32.5, 40.5, 29, 45), Spread(26, 22.5, 30.5, 19, 35))
    assert lines(plan, rows, plan.parameters[0], "lost_seconds") == []
    labels = [line.label for line in lines(plan, rows, plan.parameters[1], "ate_percent")]
    assert labels == ["rate=20", "rate=10"]


def test_many_combinations_become_one_line_with_quartiles(tmp_path: Path) -> None:
    many = ",".join(map(str, range(1, 6)))
    plan = plan_in(tmp_path, "judge.method=flow,depth", f"judge.rate={many}")
    rows = [with_ate(pretend(j), vo=float(dict(j.settings)["judge.rate"]), b=1) for j in plan.jobs]
    vo, other = lines(plan, rows, plan.parameters[0], "ate_percent")
    assert (vo.label, other.label) == ("vo, all others", "b, all others")
    assert (vo.texts, vo.spreads) == (("flow", "depth"), (Spread(3, 2, 4, 1, 5),) * 2)
    assert len(lines(plan, rows, plan.parameters[1], "ate_percent")) == 4


def aligned(plan: Plan) -> list[Row]:
    """Return rows of two estimators, of which one loses its scale to the alignment."""
    rows = [pretend(job) for job in plan.jobs]
    for row in rows:
        row["estimators"]["vo"] |= {"alignment": "origin", "coverage_percent": 100}
        row["estimators"]["slam"] |= {"alignment": "sim3", "coverage_percent": 100}
    return rows


def test_errors_after_different_alignments_are_marked_and_never_in_one_line(tmp_path: Path) -> None:
    plan = plan_in(tmp_path, "judge.rate=1,2", seeds=2)
    rows = aligned(plan)
    curves = lines(plan, rows, plan.parameters[0], "ate_percent")
    assert [line.label for line in curves] == ["vo (origin)", "slam (sim3)"]
    assert "different alignments" in summary_text(plan, rows)
    write_tables(plan, rows)
    page = write_page(plan, rows).read_text(encoding="utf-8")
    assert "<b>Errors after different alignments" in page
    assert page.count('<td class="doubt">sim3</td>') == 2
    assert page.count("<td>origin</td>") == 2
    rows[0]["estimators"]["vo"]["alignment"] = "se3"  # of one seed of two
    vo, *_ = summarise(plan, rows)
    assert vo.alignment == "origin or se3"
    curves = lines(plan, rows, plan.parameters[0], "ate_percent")
    assert [len(line.texts) for line in curves] == [1, 2, 2]
    write_tables(plan, rows)
    table = read(plan.out / "table.csv")
    assert list(table[0]).index("alignment") == list(table[0]).index("ate_percent") - 1
    assert read(plan.out / "summary.csv")[0]["alignment"] == "origin or se3"
    for row in rows:
        del row["estimators"]["slam"]
    rows[0]["estimators"]["vo"]["alignment"] = "origin"
    assert "different alignments" not in write_page(plan, rows).read_text(encoding="utf-8")
    assert "different alignments" not in summary_text(plan, rows)


def summary_text(plan: Plan, rows: list[Row], width: int = 200) -> str:
    """Return what a terminal shows."""
    out = io.StringIO()
    console = Console(file=out, width=width, force_terminal=True, no_color=True)
    print_summary(console, plan, summarise(plan, rows))
    return re.sub(r"\x1b\[[0-9;]*m", "", out.getvalue())


@pytest.mark.parametrize("width", [60, 80, 200])
def test_a_terminal_shows_whole_numbers_in_at_most_100_columns(tmp_path: Path, width: int) -> None:
    plan = plan_in(tmp_path, "judge.rate=1,2,3", "judge.method=flow,depth", seeds=3)
    rows = aligned(plan)
    for index, row in enumerate(rows):
        for figures in row["estimators"].values():
            figures |= dict.fromkeys(IN_SWEEPS[3:], 1.23456789e-7 * (index + 1))
            figures["coverage_percent"] = 100
    text = summary_text(plan, rows, width)
    assert max(map(len, text.splitlines())) <= min(width, 100)
    assert " ".join(text.split()).startswith(
        "all: runs 3, crashed 0, passed 3 of 3, coverage_percent 100 % median"
    )
    assert "also in table.csv and the page: " in text
    assert "latency_p50_ms" in text
    line = next(line for line in text.splitlines() if "flow" in line)
    assert re.search(r" 1\.04 \(1\.03–1\.05\)( |$)", line) or width < 80
    one = plan_in(tmp_path)
    assert "all:" not in summary_text(one, [pretend(job) for job in one.jobs][:0])


@pytest.mark.slow
def test_missed_and_failed_runs_are_two_counts(tmp_path: Path) -> None:
    plan = plan_in(tmp_path, "judge.rate=60,5", seeds=4)
    rows = [pretend(job) for job in plan.jobs]
    rows[0] = crashed(plan.jobs[0], "out of order")
    vo, *_ = summarise(plan, rows)
    assert (vo.runs, vo.crashed, vo.failed, vo.passed) == (4, 1, 3, 0)
    draw_plots(plan, rows)
    page = write_page(plan, rows).read_text(encoding="utf-8")
    assert '<td class="n">1 (25%)</td>' in page
    assert '<td class="n">3 (75%)</td>' in page
    write_tables(plan, rows)
    assert read(plan.out / "summary.csv")[0]["failed"] == "3"


@pytest.mark.parametrize(
    ("digests", "repeatable"),
    [
        (["a", "a", "a"], "3 of 3 equal"),
        (["a", "b", "a"], "differs: 1 to 1.2 %"),
        (["a", None, "a"], "2 of 2 equal"),
        (["a", None, None], ""),
    ],
)
def test_what_is_said_of_an_estimator_that_is_run_again(
    tmp_path: Path, digests: list[str | None], repeatable: str
) -> None:
    plan = plan_in(tmp_path, repeats=3)
    rows = []
    for job, digest, error in zip(plan.jobs, digests, (1.0, 1.2, 1.1), strict=True):
        row = with_ate(pretend(job), vo=error)
        row["digests"] = {"vo": digest} if digest else {}
        rows.append(row if digest else crashed(job, "out of order"))
    (vo,) = summarise(plan, rows)
    assert (vo.repeatable, vo.runs) == (repeatable, 3)
    write_tables(plan, rows)
    assert [line["repeat"] for line in read(plan.out / "table.csv")] == ["1", "2", "3"]
    assert read(plan.out / "summary.csv")[0]["repeatable"] == repeatable
    page = write_page(plan, rows).read_text(encoding="utf-8")
    assert f"<td>{repeatable}</td>" in page


def test_other_seeds_are_not_expected_to_be_equal(tmp_path: Path) -> None:
    plan = plan_in(tmp_path, seeds=2, repeats=2)
    rows = [with_ate(pretend(job), vo=1.0) for job in plan.jobs]
    for row in rows:
        row["digests"] = {"vo": f"{row['seed']}"}
    assert summarise(plan, rows)[0].repeatable == "4 of 4 equal"


@pytest.mark.slow
def test_a_plot_for_each_parameter(tmp_path: Path) -> None:
    plan = plan_in(tmp_path, "judge.latency=0ms,80ms", "judge.method=flow,depth", seeds=2)
    rows = [pretend(job) for job in plan.jobs]
    drawn = draw_plots(plan, rows)
    assert [path.name for path in drawn] == ["judge.latency.png", "judge.method.png"]
    for path in drawn:
        image = imread(path)
        assert image.shape[0] > 300
        assert image.std() > 0.05


def test_nothing_is_drawn_of_runs_without_figures(tmp_path: Path) -> None:
    plan = plan_in(tmp_path, "judge.latency=0ms,80ms")
    assert draw_plots(plan, [crashed(job, "out of order") for job in plan.jobs]) == []
    assert draw_plots(plan, [with_ate(pretend(job), vo=0.0) for job in plan.jobs]) == []
    single = plan_in(tmp_path, "judge.latency=0ms")
    assert draw_plots(single, [pretend(job) for job in single.jobs]) == []
    assert not (plan.out / "plots").exists()


@pytest.mark.parametrize("name", ["table.csv", "timing.csv", "summary.csv"])
def test_a_sweep_without_verdicts_has_tables_too(tmp_path: Path, name: str) -> None:
    plan = plan_in(tmp_path, seeds=2)
    rows = [with_ate(pretend(job)) for job in plan.jobs]
    write_tables(plan, rows)
    assert len(read(plan.out / name)) == (1 if name == "summary.csv" else 2)
