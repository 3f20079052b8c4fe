"""Time that clients pause and step, and time that runs only while they wait."""

from __future__ import annotations

import asyncio
import random
import time
from collections.abc import Awaitable
from typing import Any

import pytest

from runtime.schedule import SECOND, Once
from sims.airsim.server import AirsimServer
from sims.airsim.server.methods import Table, rpc
from tests.sims.airsim.scripts import Caller, drone, with_script


class Tasks:
    """A vehicle's tasks, which end after so many simulated seconds, or are superseded."""

    def __init__(self, server: AirsimServer) -> None:
        self._server = server
        self._tasks: dict[str, asyncio.Future[float]] = {}

    @rpc("task")
    def task(self, seconds: float, vehicle: str) -> Awaitable[float]:
        """Return the time at which it ended."""
        clock, task = self._server.clock, asyncio.get_running_loop().create_future()
        self._end(vehicle)
        self._tasks[vehicle] = task

        def end() -> None:
            if not task.done():
                task.set_result(clock.now() / SECOND)

        clock.schedule.add(clock.now() + round(seconds * SECOND), Once(end))
        return self._server.time.owed(task)

    @rpc("now")
    def now(self) -> float:
        """Return the time."""
        return self._server.clock.now() / SECOND

    def _end(self, vehicle: str) -> None:
        before = self._tasks.get(vehicle)
        if before is not None and not before.done():
            before.set_result(-1.0)


@pytest.fixture(autouse=True)
def _with_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    def with_tasks(groups: Any) -> Table:
        return Table([*groups, Tasks(groups[0]._server)])

    monkeypatch.setattr("sims.airsim.server.node.Table", with_tasks)


def test_awaited_time_runs_while_a_task_is_owed_and_stands_when_it_ends(tiny_world: str) -> None:
    def script(airsim: Caller) -> None:
        for index in range(1, 4):
            assert airsim("task", 0.1, "a") == pytest.approx(0.1 * index)
            time.sleep(random.uniform(0, 0.02))  # real time, which must not matter
            assert airsim("now") == pytest.approx(0.1 * index)
            assert airsim("simIsPaused") is False
        airsim("simContinueForTime", 0.2)
        assert airsim("now") == pytest.approx(0.5)
        superseded = airsim.send("task", 1e6, "a")
        other = airsim.send("task", 0.1, "b")  # begins when it is read: time runs
        ended = airsim("task", 0.3, "a")
        assert ended > 0.8
        assert airsim.join(superseded) == -1.0
        last = max(ended, airsim.join(other))
        assert airsim("now") == last

    with_script(script, [drone(world=tiny_world)], time="awaited")
