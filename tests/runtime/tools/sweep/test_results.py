"""Rows as tables, plots and a page."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
from matplotlib.image import imread
from msgspec.structs import astuple

from runtime.tools.sweep import Row, draw_plots, summarise, write_page, write_tables
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
    found = [float(line[f"ate_percent_{what}"]) for what in ("median", "q1", "q3", "min", "max")]
    assert found == pytest.approx([1.05, 1.04, 1.055, 1.03, 1.06])
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
        '<td class="n">1.035<br><span class="soft">1.032 to 1.038<br>1.03 to 1.04</span></td>'
        in page
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
    assert (flow.label, depth.label) == ("judge.method=flow", "judge.method=depth")
    assert (flow.texts, depth.texts) == (("20", "10"), ("10",))
    assert flow.spreads == (Spread(36, 32.5, 40.5, 29, 45), Spread(26, 22.5, 30.5, 19, 35))
    assert lines(plan, rows, plan.parameters[0], "lost_seconds") == []
    labels = [line.label for line in lines(plan, rows, plan.parameters[1], "ate_percent")]
    assert labels == ["judge.rate=20", "judge.rate=10"]


def test_many_combinations_become_one_line_with_quartiles(tmp_path: Path) -> None:
    many = ",".join(map(str, range(1, 6)))
    plan = plan_in(tmp_path, "judge.method=flow,depth", f"judge.rate={many}")
    rows = [with_ate(pretend(j), vo=float(dict(j.settings)["judge.rate"]), b=1) for j in plan.jobs]
    vo, other = lines(plan, rows, plan.parameters[0], "ate_percent")
    assert (vo.label, other.label) == ("vo, all others", "b, all others")
    assert (vo.texts, vo.spreads) == (("flow", "depth"), (Spread(3, 2, 4, 1, 5),) * 2)
    assert len(lines(plan, rows, plan.parameters[1], "ate_percent")) == 4


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
    ("digests", "found"),
    [
        (["a", "a", "a"], "3 of 3 equal"),
        (["a", "b", "a"], "differs: 1 to 1.2 %"),
        (["a", None, "a"], "2 of 2 equal"),
        (["a", None, None], ""),
    ],
)
def test_what_is_said_of_an_estimator_that_is_run_again(
    tmp_path: Path, digests: list[str | None], found: str
) -> None:
    plan = plan_in(tmp_path, repeats=3)
    rows = []
    for job, digest, error in zip(plan.jobs, digests, (1.0, 1.2, 1.1), strict=True):
        row = with_ate(pretend(job), vo=error)
        row["digests"] = {"vo": digest} if digest else {}
        rows.append(row if digest else crashed(job, "out of order"))
    (vo,) = summarise(plan, rows)
    assert (vo.repeatable, vo.runs) == (found, 3)
    write_tables(plan, rows)
    assert [line["repeat"] for line in read(plan.out / "table.csv")] == ["1", "2", "3"]
    assert read(plan.out / "summary.csv")[0]["repeatable"] == found
    page = write_page(plan, rows).read_text(encoding="utf-8")
    assert f"<td>{found}</td>" in page


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
    assert not (plan.out / "plots").exists()


@pytest.mark.parametrize("name", ["table.csv", "timing.csv", "summary.csv"])
def test_a_sweep_without_verdicts_has_tables_too(tmp_path: Path, name: str) -> None:
    plan = plan_in(tmp_path, seeds=2)
    rows = [with_ate(pretend(job)) for job in plan.jobs]
    write_tables(plan, rows)
    assert len(read(plan.out / name)) == (1 if name == "summary.csv" else 2)
