"""Verdicts in the summary and the exit code, and what is called after a run."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import pytest

from runtime import Node, NodeConfig
from runtime.config.model import Config, RunConfig
from runtime.config.reading import parse
from runtime.errors import NodeError, ResultsError
from runtime.run.execute import execute
from runtime.testing import spec
from tests.runtime.samples_logs import Lines


class JudgeConfig(NodeConfig):
    """Whether all is well."""

    passed: bool = True


class Judge(Node[JudgeConfig]):
    """Concludes at the end, and looks at the summary after the run."""

    deterministic = False

    async def on_shutdown(self) -> None:
        self.conclude("est", {"ate_rmse_m": 0.25}, passed=self.config.passed)
        self.conclude("drone", {"collisions": 1}, passed=None, flight=True)
        self.after_run(lambda out: (out / "seen").write_bytes((out / "summary.json").read_bytes()))


def test_a_verdict_stands_in_the_summary_and_is_there_after_the_run(tmp_path: Path) -> None:
    nodes = [{"name": "judge", "type": f"{__name__}:Judge", "passed": False}]
    summary = execute(parse({"run": {"duration": 1}, "nodes": nodes}, "c.toml"), tmp_path)
    assert summary.verdict is not None
    assert not summary.verdict.passed
    seen = json.loads((tmp_path / "seen").read_text())
    assert seen["verdict"] == {
        "passed": False,
        "estimators": {"est": {"passed": False, "ate_rmse_m": 0.25}},
        "flights": {"drone": {"passed": None, "collisions": 1}},
    }
    assert seen["not_deterministic"] == ["judge"]


@pytest.mark.slow
@pytest.mark.parametrize(("passed", "code"), [("true", 0), ("false", 1)])
def test_the_exit_code_tells_whether_thresholds_were_met(
    tmp_path: Path, passed: str, code: int
) -> None:
    file = tmp_path / "c.toml"
    file.write_text(
        f'[run]\nduration = 1\n[[nodes]]\nname = "j"\ntype = "{__name__}:Judge"\npassed = {passed}'
    )
    command = [sys.executable, "-m", "runtime", "run", str(file), "--out", str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30)
    assert done.returncode == code, done.stderr
    assert ("est PASSED" if code == 0 else "est FAILED") in done.stdout
    assert "not promised, because of j" in done.stdout


class Careless(Node):
    """Has functions called after the run, the last of which does not fail."""

    called: ClassVar[list[Path]] = []

    async def run(self) -> None:
        self.after_run(self.called.append)
        self.stop("enough")

    def fail(self, out: Path) -> None:
        raise LookupError(f"nothing in {out.name}")


def fail(out: Path) -> None:
    raise LookupError(f"nothing in {out.name}")


@pytest.mark.parametrize(
    ("make", "error"),
    [
        (lambda node: node.fail, "careless: LookupError: nothing in out"),
        (lambda _: fail, f"{__name__}: LookupError: nothing in out"),
        (lambda _: {}.pop, "runtime: KeyError: "),
    ],
    ids=["method of a node", "function", "builtin"],
)
def test_what_fails_after_a_run_is_named_and_the_others_are_called(
    make: Callable[[Careless], Callable[..., Any]], error: str, tmp_path: Path
) -> None:
    class Makes(Careless):
        async def run(self) -> None:
            self.after_run(make(self))
            self.after_run(fail)
            await super().run()

    Careless.called.clear()
    lines = Lines()
    config = Config(run=RunConfig(), nodes=(spec(Makes, "careless"),))
    with pytest.raises(NodeError) as caught:
        execute(config, tmp_path / "out", handlers=[lines])
    assert str(caught.value).startswith(error)
    assert Careless.called == [tmp_path / "out"]
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["error"] is None
    # The command line prints the run's error itself; the terminal shows the other one.
    first, second = [record for record in lines.records if record.levelname == "ERROR"]
    assert first.getMessage().startswith(error)
    assert second.getMessage().startswith(f"{__name__}: LookupError: nothing in out")
    assert (vars(first)["reported"], vars(second)["reported"]) == (True, False)


def test_a_summary_that_cannot_be_written_is_the_runs_error(tmp_path: Path) -> None:
    class InTheWay(Careless):
        async def on_shutdown(self) -> None:
            assert self.out is not None
            (self.out / "summary.json").mkdir()

    Careless.called.clear()
    lines = Lines()
    config = Config(run=RunConfig(), nodes=(spec(InTheWay, "careless"),))
    with pytest.raises(ResultsError, match=r"summary\.json"):
        execute(config, tmp_path / "out", handlers=[lines])
    assert Careless.called == [tmp_path / "out"]
    (record,) = [record for record in lines.records if record.levelname == "ERROR"]
    assert "summary.json" in record.getMessage()
    assert vars(record)["reported"] is True
