"""Fixtures that run a coroutine on every loop and kind of task, or on every clock."""

from __future__ import annotations

import functools

import pytest

from runtime.time import clock as real_clock
from tests.runtime.loops import LOOPS, Run
from tests.runtime.walls import RunClock, Wall, on_clock


@pytest.fixture(params=LOOPS)
def ours(request: pytest.FixtureRequest) -> Run:
    """Run on each loop with tasks that streams can step."""
    return Run(request.param, ours=True)


@pytest.fixture(params=[(loop, ours) for loop in LOOPS for ours in (True, False)], ids=str)
def run(request: pytest.FixtureRequest) -> Run:
    """Run on each loop with both kinds of task."""
    return Run(*request.param)


@pytest.fixture(params=["lockstep", "real", "real at double speed"])
def run_clock(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> RunClock:
    """Run on each clock; the real one's wall clock and alarm are injected."""
    wall = Wall()
    monkeypatch.setattr(real_clock, "time", wall)
    monkeypatch.setattr(real_clock, "TimerFd", wall.alarm)
    speed = 2.0 if request.param == "real at double speed" else 1.0
    return functools.partial(on_clock, request.param == "lockstep", speed)
