"""Child processes answer, tell why they fail, and never outlive the process that measures."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from bench.system import Case
from bench.systems import children
from tests.bench.systems import echo

ROOT = Path(__file__).parents[3]


@pytest.mark.slow
def test_the_last_node_answers_once_all_have_answered_the_roll() -> None:
    samples = echo.measure(Case(nodes=3, samples=20, warm_up=5))
    assert samples.shape == (20,)
    assert (samples > 0).all()


@pytest.mark.slow
def test_a_child_that_fails_says_why() -> None:
    with pytest.raises(children.PeerError, match="no bananas"):
        echo.measure(Case(nodes=2), "fail")


@pytest.mark.slow
def test_silence_ends_in_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(children, "TIMEOUT", 1.5)
    with pytest.raises(children.PeerError, match=r"answers of nodes \[2\]: nothing came"):
        echo.measure(Case(nodes=2), "silent")


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_children_end_with_the_measuring_process(how: signal.Signals) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.bench.systems.echo", ""],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    assert process.stdout is not None
    with process, process.stdout:
        assert process.stdout.readline() == b"running\n"
        before = _children(process.pid)
        process.send_signal(how)
        process.wait(10)
    assert len(before) == 2
    until = time.monotonic() + 30
    # Processes end when the kernel says so.
    while any(Path(f"/proc/{child}").exists() for child in before):
        assert time.monotonic() < until
        time.sleep(0.05)


def _children(process: int) -> list[int]:
    listed = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    return [int(child) for child in listed]
