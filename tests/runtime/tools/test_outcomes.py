"""Who passed, as continuous integration reads it, and as a terminal shows it."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import pytest

from runtime.node import Node, NodeConfig
from runtime.summary import Verdict
from runtime.tools.cli.commands import NOBODY, Outcome, of_verdict, to_junit, writing
from tests.runtime.tools.samples_cli import command_here


class JudgeConfig(NodeConfig):
    """Which of two estimators fails."""

    error: float = 0.5
    crash: bool = False
    fails_in_start: bool = False


class Judge(Node[JudgeConfig]):
    """Concludes a verdict, or crashes."""

    async def on_startup(self) -> None:
        if self.config.fails_in_start:
            raise RuntimeError("not today")

    async def on_shutdown(self) -> None:
        good = self.config.error < 1
        figures = {
            "ate_percent": self.config.error,
            "failed": [] if good else ["ate_percent: expected at most 1"],
        }
        self.conclude("vo", figures, passed=good)

    async def run(self) -> None:
        if self.config.crash:
            raise RuntimeError("out of order")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "c.toml"
    path.write_text(
        '[run]\nname = "tour"\nduration = 1\n'
        f'[[nodes]]\nname = "judge"\ntype = "{__name__}:Judge"\n'
    )
    return path


def cases(path: Path) -> list[tuple[str, str, str]]:
    """Return run, estimator, and what stands in each test case."""
    suite = ET.parse(path).getroot().find("testsuite")
    assert suite is not None
    results = [
        (case.attrib["classname"], case.attrib["name"], "".join(element.tag for element in case))
        for case in suite
    ]
    tags = [tag for _, _, tag in results]
    counted = {key: int(suite.attrib[key]) for key in ("tests", "failures", "errors", "skipped")}
    assert counted == {
        "tests": len(tags),
        "failures": tags.count("failure"),
        "errors": tags.count("error"),
        "skipped": tags.count("skipped"),
    }
    return results


@pytest.mark.parametrize(
    ("change", "code", "state", "tag"),
    [
        ("judge.error=0.5", 0, "passed", ""),
        ("judge.error=7", 1, "failed", "failure"),
        ("judge.crash=true", 2, "crashed", "error"),
        ("judge.cash=true", 2, "crashed", "error"),
    ],
)
def test_a_run_says_who_passed(
    file: Path, tmp_path: Path, change: str, code: int, state: str, tag: str
) -> None:
    options = ["--set", change, "-q", "--junit", "ci/j.xml", "--json", "ci/j.json"]
    done = command_here("run", file, *options, folder=tmp_path)
    assert done.returncode == code
    (outcome,) = json.loads((tmp_path / "ci/j.json").read_text(encoding="utf-8"))
    assert outcome["state"] == state
    ended = code < 2
    ((run, estimator, element),) = cases(tmp_path / "ci/j.xml")
    assert (run, estimator, element) == (*(("tour", "vo") if ended else ("c", "run")), tag)
    assert outcome.get("figures", {}).get("ate_percent") == ({0: 0.5, 1: 7.0}.get(code))
    # Quiet: nothing, or the reason in one line.
    said = "vo FAILED: ate_percent: expected at most 1\n"
    assert done.stdout == (said if code == 1 else "")


@pytest.mark.slow
def test_a_sweep_fails_where_a_run_does(file: Path, tmp_path: Path) -> None:
    words: list[str | Path] = ["sweep", file, "--vary", "judge.error=0.5,7", "--junit", "j.xml"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(Path(__file__).parents[3]))
        done = command_here(*words, folder=tmp_path)
        assert (done.returncode, done.stderr.splitlines()[-1]) == (
            1,
            "1 of 2 runs failed: thresholds were missed",
        )
        assert cases(tmp_path / "j.xml") == [
            ("judge.error=0.5 seed=0", "vo", ""),
            ("judge.error=7 seed=0", "vo", "failure"),
        ]
        words[3] = "judge.crash=false,true"
        done = command_here(*words, "--out", "other", folder=tmp_path)
    assert done.returncode == 2
    assert [tag for _, _, tag in cases(tmp_path / "j.xml")] == ["", "error"]


def test_nobody_judged_is_skipped_and_nobody_to_judge_has_failed() -> None:
    assert of_verdict("tour", None) == [Outcome(run="tour", state="not judged")]
    (nobody,) = of_verdict("tour", Verdict(False, {}))
    assert (nobody.state, nobody.reasons) == ("failed", [NOBODY])
    unasked = Verdict(None, {"vo": {"passed": None}})
    assert [outcome.state for outcome in of_verdict("tour", unasked)] == ["not judged"]


@pytest.mark.parametrize("text", ["a\x1b[31mb", "\x00", "<&\"'>", "é\ud800", "]]>"])
def test_whatever_an_error_says_the_xml_can_be_read(text: str) -> None:
    element = ET.fromstring(to_junit(text, [Outcome(run=text, state="crashed", reasons=[text])]))
    assert element[0][0][0].tag == "error"


def test_an_interrupted_run_leaves_what_there_is(tmp_path: Path) -> None:
    def interrupted() -> None:
        with writing("x", tmp_path / "j.xml", None) as outcomes:
            outcomes.append(Outcome(run="a", state="passed"))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert [case[0] for case in cases(tmp_path / "j.xml")] == ["a"]


@pytest.mark.slow
def test_a_verdict_is_shown_in_a_few_lines(file: Path, tmp_path: Path) -> None:
    done = command_here("run", file, folder=tmp_path)
    lines = done.stdout.splitlines()
    assert lines[0].startswith("tour: 1.0 s on the lockstep clock, seed 0, in ")
    assert "vo PASSED" in lines
    assert lines[-1].startswith("results in runs/tour/20")
    assert len(lines) <= 6
    tables: Any = command_here("run", file, "-v", folder=tmp_path).stdout
    assert "digest " in tables
    assert len(tables.splitlines()) > 8
    bad = command_here("run", file, "--set", "judge.error=7", folder=tmp_path)
    assert bad.stdout.splitlines()[0] == "vo FAILED: ate_percent: expected at most 1"
    nothing = command_here("show", tmp_path, folder=tmp_path)
    assert nothing.returncode == 2
    assert "expected the folder of a run, with summary.json," in nothing.stderr


@pytest.mark.slow
def test_runs_are_listed_with_their_verdicts_the_newest_last(file: Path, tmp_path: Path) -> None:
    changes = ("error=0.5", "error=7", "crash=true", "fails_in_start=true")
    for change in changes:
        command_here("run", file, "--set", f"judge.{change}", folder=tmp_path)
    for name in ("bad", "torn"):
        command_here("run", file, "--out", f"runs/{name}", folder=tmp_path)
    (tmp_path / "runs" / "bad" / "summary.json").unlink()
    (tmp_path / "runs" / "torn" / "summary.json").write_text("{")
    (tmp_path / "runs" / "notes").mkdir()
    listed = command_here("runs", folder=tmp_path).stdout.splitlines()
    rows = [re.split("  +", line.strip()) for line in listed[1:]]
    assert [row[2:] for row in rows] == [
        ["1.0", "0", "PASSED", "vo 0.5 %"],
        ["1.0", "0", "FAILED", "vo 7 %"],
        ["0.0", "0", "crashed", "vo 0.5 %"],
        ["0.0", "0", "did not start"],
        ["no summary: killed, or not over"],
        ["unreadable"],
    ]
    assert [row[0].partition("/20")[0] for row in rows] == ["runs/tour"] * 4 + [
        "runs/bad",
        "runs/torn",
    ]
    for row in rows[:3]:
        assert f"show {row[0]}\n" in command_here("show", row[0], folder=tmp_path).stdout
    left = command_here("show", "runs/bad", folder=tmp_path)
    assert "expected a run's summary, found: No such file" in left.stderr
    assert command_here("runs", "nowhere", folder=tmp_path).returncode == 2
