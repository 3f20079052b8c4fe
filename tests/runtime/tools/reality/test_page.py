"""The page of a ledger that was made up, and the command with two estimators of the project."""

from __future__ import annotations

import functools
import re
from pathlib import Path
from typing import Any

import msgspec
import pytest
import typer

from runtime.tools.reality.page import reality, write_page
from runtime.tools.reality.results import Ledger, Result
from runtime.tools.reality.study import Run, Study, keys_of, read_published, read_study
from runtime.tools.sweep.plan import Plan
from runtime.tools.sweep.tables import crashed
from tests.runtime.tools.reality.test_study import motion, small
from tests.runtime.tools.samples_cli import command

__all__ = ["small"]  # a fixture
PUBLISHED = read_published().errors()


@functools.cache
def part() -> Study:
    """Return a part of the project's own study, with all systems."""
    sequences, conditions = ["V1_01", "V1_02", "V1_03"], ["real", "steady", "exact"]
    return read_study().only(sequences=sequences, worlds=["poor", "rich"], conditions=conditions)


@pytest.fixture
def study() -> Study:
    return part()


@pytest.fixture(autouse=True)
def _without_a_plot(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing takes a second of processor time."""
    if "slow" not in request.keywords:
        monkeypatch.setattr("runtime.tools.reality.page.draw", lambda *_: False)


@functools.cache
def keys() -> dict[Run, str]:
    """Return the keys of the part's runs, which take some 0.2 s to compute."""
    return keys_of(part())


def made_up(study: Study, **more: Any) -> dict[Run, Result]:
    """Return a result for each run, whose error is the published one."""
    rows = {system.name: PUBLISHED.get(system.published, {}) for system in study.systems}
    return {
        run: Result(
            **run._asdict(),
            verdict="passed",
            ate_m=rows[run.system].get(run.sequence, 0.02),
            final_ate_m=rows[run.system].get(run.sequence, 0.02),
            coverage_percent=99.0,
            final_percent=99.0,
            key=key,
            data="d",
            **more,
        )
        for run, key in keys().items()
    }


def page(study: Study, count: dict[Run, Result], path: Path, old: Any = ()) -> str:
    file = path / "REALITY.md"
    write_page(study, read_published(), keys(), count, [*old], file, "the command")
    text = file.read_text(encoding="utf-8")
    lines = text.splitlines()
    for number, line in enumerate(lines):  # each table is one
        if line.startswith("|---"):
            assert lines[number - 1].count("|") == line.count("|") == lines[number + 1].count("|")
    assert "\n\n\n" not in text
    return text


def test_a_page_without_results_says_so(study: Study, tmp_path: Path) -> None:
    text = page(study, {}, tmp_path)
    assert "**Nothing of the study has been flown yet**" in text.split("\n\n")[2]
    assert "not enough systems" in text
    assert "| passed |" not in text
    assert not (tmp_path / "reality" / "scatter.svg").exists()


def test_a_page_of_all_results_has_each_criterion(study: Study, tmp_path: Path) -> None:
    count = made_up(study, flight="f", commit="c0ffee")
    text = page(study, count, tmp_path)
    assert text.split("\n\n")[2] == f"All {len(count)} runs of the study have been flown."
    assert re.search(
        r"\| ranking of systems \| Spearman 1\.00, median of \d+ rankings of 7 systems: passed \|",
        text,
    )
    assert re.search(r"\| level \| 1 in the median of \d+: passed \|", text)
    assert "Of 7 of the 7 systems that count, over all worlds.\n" in text
    under = r"nder `{}` 154 runs: 7 systems, 3 sequences, 2 worlds, 5 seeds"
    assert all(re.search(under.format(name), text) for name in ("real", "steady"))
    assert "| 0.035 / 0.035 |" in text
    assert "no: it was developed with this simulator" in text
    assert re.search(r"\| dso \| × 1 \(\d+\) \| × 1 \(10\) \|", text)
    assert f"`c0ffee` ({len(count)})" in text
    assert "different bytes" not in text


@pytest.mark.slow
def test_the_plot_is_of_text_and_the_same_each_time(study: Study, tmp_path: Path) -> None:
    plots = []
    for name in ("a", "b"):
        text = page(study, made_up(study), tmp_path / name)
        assert "](reality/scatter.svg)" in text
        plots.append((tmp_path / name / "reality" / "scatter.svg").read_bytes())
    assert plots[0] == plots[1]
    assert b"<text" in plots[0]
    assert plots[0].count(b"V1_03") == 2 * 7


def test_a_page_of_a_part_says_how_large_it_is(study: Study, tmp_path: Path) -> None:
    """In its first paragraph; and its verdicts are not the study's."""
    whole = made_up(study)
    part = {run: r for run, r in whole.items() if run.seed == 1 and run.world == "rich"}
    text = page(study, part, tmp_path)
    expected = f"**This is a part of the study: {len(part)} of {len(whole)} runs have been flown.**"
    assert text.split("\n\n")[2].startswith(expected)
    assert "what has been flown, not on the study" in text
    assert "0 of 11" in text


def test_a_condition_may_be_flown_with_some_systems(study: Study, tmp_path: Path) -> None:
    of_all = made_up(study)
    part = {run: r for run, r in of_all.items() if run.condition == "real" or run.system == "dso"}
    text = page(study, part, tmp_path)
    assert re.search(r"\| dso \| × 1 \(\d+\) \| × 1 \(10\) \|", text)
    assert "| basalt | × " not in text


def test_a_world_that_is_not_counted_is_shown_with_the_reason(study: Study, tmp_path: Path) -> None:
    """Nothing agrees in it; what counts does not change."""
    first, *others = study.worlds
    left_out = msgspec.structs.replace(first, why_not="it is unlike the real rooms")
    apart = msgspec.structs.replace(study, worlds=(left_out, *others))
    count = made_up(study)
    for run, result in count.items():
        if run.world == first.name:
            count[run] = changed(result, ate_m=100.0 / (result.ate_m or 1.0), final_ate_m=None)
    text = page(apart, count, tmp_path)
    by_all = (
        r"\| ranking of systems \| Spearman 1\.00, median of 3 rankings of 7 systems: passed \|"
    )
    assert re.search(by_all, text)
    assert not re.search(by_all, page(study, count, tmp_path / "all"))
    assert "over all worlds that count." in text
    heading = f"## {first.name}: {first.shows}\n\n**Reported, not counted**: it is unlike the real"
    assert heading in text
    assert re.search(r"\| level \| .*: failed \| 1 in the median of \d+: passed \|", text)


def test_each_judged_condition_has_verdicts_and_tables_of_its_own(
    study: Study, tmp_path: Path
) -> None:
    """Nothing agrees under the second; and where the same systems were flown, both are compared."""
    count = made_up(study)
    for run, result in count.items():
        if run.condition == "steady":
            count[run] = changed(result, ate_m=100.0 / (result.ate_m or 1.0), final_ate_m=None)
        if run.condition == "steady" and run.system == "dso":
            count[run] = changed(result, ate_m=0.001, final_ate_m=0.001)
    text = page(study, count, tmp_path)
    assert "| criterion | real | steady | passes | ceiling |" in text
    assert re.search(r"\| ranking of systems \| [^|]*: passed \| [^|]*: \*\*failed\*\* \|", text)
    assert "Inverted under `steady`: " in text
    assert "Inverted under `real`: " not in text
    assert "| criterion | poor, real | rich, real | poor, steady | rich, steady |" in text
    assert re.search(r"\| V1_01 \| poor \| steady \| 7 \| -0\.\d\d \|", text)
    assert re.search(r"\| V1_01 \| poor \| real \| 7 \| 1\.00 \|", text)
    assert re.search(r"\| V1_01 \| poor \| 7 \| 1\.00 \| -0\.\d\d under `steady` \|", text)
    assert text.count("\n\nUnder `steady`:\n\n| system |") == 2
    assert "| 2500.000 / 0.040 |" in text.split("Under `steady`:")[1]


def test_rankings_are_compared_where_the_same_systems_were_flown(
    study: Study, tmp_path: Path
) -> None:
    """Of V1_01 under both: DSO, which has the only wrong error, was flown under the first alone."""
    count = {
        run: changed(result, final_ate_m=1e-4) if run.system == "dso" else result
        for run, result in made_up(study).items()
        if run.condition == "real" or (run.condition == "steady" and run.system != "dso")
    }
    text = page(study, count, tmp_path)
    assert "| V1_01 | poor | 6 | 1.00 | 1.00 under `steady` |" in text
    assert not re.search(r"\| V1_01 \| poor \| real \| 7 \| 1\.00", text)


def test_failures_by_a_system_s_own_median_are_marked(study: Study, tmp_path: Path) -> None:
    """Six times its own; DSO's published failure is V1_03."""
    count = made_up(study)
    for run, result in count.items():
        if (run.system, run.sequence, run.condition) == ("basalt", "V1_02", "real"):
            count[run] = changed(result, ate_m=0.6)
    real, steady = page(study, count, tmp_path).split("## poor:")[1].split("Under `steady`:")[:2]
    assert "| basalt | 0.040 / 0.040 | 0.600* / 0.050 | 0.100 / 0.100 |" in real
    assert "| basalt | 0.040 / 0.040 | 0.050 / 0.050 | 0.100 / 0.100 |" in steady
    assert re.search(r"\| dso \| .* 0\.903\* / 0\.903\* \|", real)


def test_a_condition_is_compared_with_the_one_that_it_names(study: Study, tmp_path: Path) -> None:
    count = made_up(study)
    for run, result in count.items():
        if run.condition == "steady":
            count[run] = changed(result, ate_m=2.0, final_ate_m=2.0)
        if run.condition == "exact":
            count[run] = changed(result, ate_m=1.0, final_ate_m=1.0)
    text = page(study, count, tmp_path)
    assert "| system | steady / real | exact / steady |" in text
    assert re.search(r"\| dso \| × [^|]* \| × 0\.5 \(10\) \|", text)


def test_what_went_wrong_is_on_the_page(study: Study, tmp_path: Path) -> None:
    """Crashes, silence, stale results, and flights of different bytes."""
    count = made_up(study, flight="f")
    runs = [run for run in count if (run.system, run.condition) == ("basalt", "real")][:3]
    count[runs[0]] = changed(count[runs[0]], verdict="crashed", error="its program died")
    count[runs[1]] = changed(count[runs[1]], coverage_percent=12.0)
    count[runs[2]] = changed(count[runs[2]], flight="g")
    gone = count.pop(runs[2])
    text = page(study, count | {runs[2]: gone}, tmp_path, old=[gone])
    assert "seed 1, basalt: crashed: its program died" in text
    assert "seed 1, basalt: poses for 12 % of the images" in text
    assert (
        f"different bytes count**, as by different versions or machines: {runs[2].sequence} "
        in text
    )
    assert "**1 results that count here are stale**" in text
    text = page(study, count, tmp_path, old=[gone])
    assert f"- not counted: {gone.sequence}, {gone.world}, real, seed 1, basalt" in text


def changed(result: Result, **more: Any) -> Result:
    return msgspec.structs.replace(result, **more)


def test_inverted_pairs_are_named(study: Study, tmp_path: Path) -> None:
    count = made_up(study)
    for run, result in count.items():
        if run.system == "orb_slam3_stereo_inertial":
            count[run] = changed(result, final_ate_m=3.0)
    text = page(study, count, tmp_path)
    assert re.search(
        r"Inverted under `real`: .*openvins errs [\d.]+ × as much as orb_slam3_stereo_inertial",
        text,
    )
    assert re.search(r"pairs in the right order \| [^|]*: \*\*failed\*\* \|", text)


def test_the_page_alone_needs_no_truth(tmp_path: Path) -> None:
    done = command("reality", "--results", "r.csv", "--page", "R.md", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Nothing of the study" in (tmp_path / "R.md").read_text(encoding="utf-8")
    assert not (tmp_path / "sweeps").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--plan"], "--plan: expected --truth, the folder of the ground truth, found none"),
        (
            ["--truth", ".", "--conditions", "half_rate", "--worlds", "poor"],
            "expected --sequences, --worlds and --conditions that the study flies together",
        ),
    ],
)
def test_what_plans_no_run_is_refused(words: list[str], message: str, tmp_path: Path) -> None:
    done = command("reality", *words, "--results", "r.csv", "--page", "R.md", folder=tmp_path)
    assert done.returncode == 2
    assert message in done.stderr
    assert not (tmp_path / "R.md").exists()


def test_a_row_that_was_not_published_is_refused_before_a_flight(
    small: Path, tmp_path: Path
) -> None:
    small.write_text(small.read_text().replace('"DSO, mono"', '"DSO, monoo"'))
    words = "--file", small, "--results", "r.csv", "--page", "R.md"
    done = command("reality", *words, folder=tmp_path)
    assert done.returncode == 2
    assert "good: published: expected a row of published.toml, found DSO, monoo" in done.stderr


def test_an_interruption_loses_nothing(
    small: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What has ended is in the ledger; what was ended, crashed or edited is flown as is due."""
    flown: list[list[str]] = []

    def carry_out(plan: Plan, *, jobs: int | None, finished: Any) -> None:
        flown.append(
            [dict(job.settings)["seed"] + dict(job.settings)["system"] for job in plan.jobs]
        )
        plan.out.mkdir(exist_ok=True)
        ends = {
            "1good": "",
            "1other": "",
            "2good": "its worker died",
            "2other": "interrupted by us",
        }
        with (plan.out / "rows.jsonl").open("ab") as file:
            for job in plan.jobs:
                name = dict(job.settings)["system"]
                run = job.settings[3][1] + name
                row = crashed(job, ends[run])
                row["estimators"] = {name: {"ate_rmse_m": 0.1, "coverage_percent": 90.0}}
                if run == "1other":
                    row["edited"] = ["x.py changed"]
                file.write(msgspec.json.encode(row) + b"\n")
                if run == "1good":  # the others end during the interruption
                    finished(job, row)
        raise typer.Exit(130)

    monkeypatch.setattr("runtime.tools.cli.sweep.carry_out", carry_out)
    monkeypatch.chdir(tmp_path)
    words: dict[str, Any] = {
        "truth": tmp_path / "truth",
        "file": small,
        "results": Path("r.csv"),
        "out": Path("o"),
    }
    words |= {"worlds": "wall", "conditions": "real", "sequences": "S1", "page": Path("R.md")}
    for more in ({}, {}, {"retry": True}):
        with pytest.raises(typer.Exit):
            reality(**{"systems": "good,other", **words, **more})
    assert flown == [
        ["1good", "1other", "2good", "2other"],
        ["1other", "2other"],
        ["1other", "2good", "2other"],
    ]
    results = Ledger(tmp_path / "r.csv").results.values()
    assert {(r.seed, r.system): r.verdict for r in results} == {
        (1, "good"): "passed", (2, "good"): "crashed"
    }  # fmt: skip
    assert "2 of " in (tmp_path / "R.md").read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_command_flies_once_and_remembers_it(tmp_path: Path) -> None:
    """Three seconds of a made-up motion, two estimators, one flight; nothing is flown again."""
    motion(tmp_path / "truth" / "V1_02_made_up.csv", radius=0.5)
    words = ["reality", "--truth", "truth", "--worlds", "rich", "--conditions", "real"]
    words += ["--seeds", "1", "--systems", "stereo,stereo_inertial", "--results", "r.csv"]
    words += ["--page", "R.md", "--out", "out"]
    planned = command(*words, "--plan", folder=tmp_path, limit=300)
    assert "2 runs on 1 flights to do" in planned.stdout
    assert not (tmp_path / "r.csv").exists()
    done = command(*words, folder=tmp_path, limit=800)
    assert done.returncode == 0, done.stderr
    results = Ledger(tmp_path / "r.csv").results.values()
    assert {result.system for result in results} == {"stereo", "stereo_inertial"}
    assert all(r.verdict == "passed" and r.ate_m and r.ate_m < 0.05 for r in results)
    assert len({result.flight for result in results}) == 1
    text = (tmp_path / "R.md").read_text(encoding="utf-8")
    assert "**This is a part of the study: 2 of " in text
    ledger = (tmp_path / "r.csv").read_bytes()
    again = command(*words, "--out", "elsewhere", folder=tmp_path, limit=300)
    assert (
        "0 runs on 0 flights to do, some 0.0 processor hours; 2 are in the ledger" in again.stdout
    )
    assert (tmp_path / "r.csv").read_bytes() == ledger
