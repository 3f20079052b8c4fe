"""Verdicts in the summary and the exit code, and what is called after a run."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from runtime import Node, NodeConfig
from runtime.config.reading import parse
from runtime.run.execute import execute


class JudgeConfig(NodeConfig):
    """Whether all is well."""

    passed: bool = True


class Judge(Node[JudgeConfig]):
    """Concludes at the end, and looks at the summary after the run."""

    deterministic = False

    async def on_shutdown(self) -> None:
        self.conclude("est", {"ate_rmse_m": 0.25}, passed=self.config.passed)
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
        "flights": {},
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
