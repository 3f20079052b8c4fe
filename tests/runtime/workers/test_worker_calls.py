"""A worker's calls, limits and ends, with threads for its processes: no Python is started."""

from __future__ import annotations

import asyncio
import contextlib
import os
import subprocess
import sys
import threading
from collections.abc import AsyncIterator, Iterator
from typing import Any

import pytest

from runtime.errors import WorkerDiedError, WorkerError, WorkerTimeoutError
from runtime.testing import run_in_lockstep
from runtime.time.lockstep import LockstepClock, LockstepLoop
from runtime.workers import worker as module
from runtime.workers.costs import Costs
from tests.runtime.workers.pretended import (
    EVENTS,
    SIGKILL,
    PretendedProcess,
    StubbornTree,
    Tree,
    Wall,
    kill_group,
)
from tests.runtime.workers.test_worker import local_to_main, worker

pytestmark = pytest.mark.timeout(20)


@pytest.fixture(autouse=True)
def wall(monkeypatch: pytest.MonkeyPatch) -> Iterator[Wall]:
    PretendedProcess.all.clear()
    for event in EVENTS:
        event.clear()
    wall = Wall()
    monkeypatch.setattr(subprocess, "Popen", PretendedProcess)
    monkeypatch.setattr(os, "killpg", kill_group)
    monkeypatch.setattr(module, "time", wall)
    monkeypatch.setattr(module, "_LOOK", 0.001)
    yield wall
    for event in EVENTS:
        event.set()
    for process in PretendedProcess.all:
        process.dispose()


@contextlib.asynccontextmanager
async def tree(*args: Any, **options: Any) -> AsyncIterator[Any]:
    async with worker(*args, factory=options.pop("factory", Tree), **options) as made:
        yield made


class Deaths:
    """Whom a worker tells of its end, from a thread."""

    def __init__(self) -> None:
        self.errors: list[Exception] = []
        self.told = threading.Event()

    def __call__(self, error: Exception) -> None:
        self.errors.append(error)
        self.told.set()

    async def wait(self) -> None:
        assert await asyncio.to_thread(self.told.wait, 10)


async def test_calls_are_answered_and_fail_one_by_one() -> None:
    async with tree() as plant:
        assert await plant.call(Tree.echo, 3) == 3
        with pytest.raises(LookupError, match="no water") as caught:
            await plant.call(Tree.fail)
        assert vars(caught.value)["place_in_worker"] == "plant.py:7 in grow"
        with pytest.raises(LookupError, match="not here"):
            await plant.call(Tree.misleading)
        with pytest.raises(TypeError, match="pickle"):
            await plant.call(Tree.echo, threading.Lock())
        assert await plant.call_for(0.0, Tree.echo, value=4) == 4
        assert await plant.call_untimed(Tree.echo, 5) == 5
        assert plant.outstanding() == 0


async def test_what_making_the_object_raises_is_raised_by_ready() -> None:
    with pytest.raises(LookupError, match="no seed"):
        async with tree("no seed"):
            pass
    assert [process.code for process in PretendedProcess.all] == [0]


async def test_the_process_with_the_fewest_calls_gets_the_next() -> None:
    called: list[tuple[str, str, Any]] = []
    async with tree(processes=2) as plant:
        plant.called = lambda process, method, work: called.append((process, method, work))
        first, second, third = [asyncio.create_task(plant.call(Tree.wait, n)) for n in range(3)]
        await asyncio.sleep(0)
        assert plant.outstanding() == 3
        EVENTS[1].set()
        assert await second == 1
        fourth = asyncio.create_task(plant.call(Tree.wait, 3))
        await asyncio.sleep(0)
        for event in EVENTS:
            event.set()
        assert [await call for call in (first, third, fourth)] == [0, 2, 3]
    names = [name for name, _, _ in called]
    assert names == ["plant[0]", "plant[1]", "plant[0]", "plant[1]"]
    assert [(method, work.result()) for _, method, work in called] == [
        ("wait", n) for n in range(4)
    ]


async def test_a_single_process_has_the_workers_name() -> None:
    called = []
    async with tree() as plant:
        plant.called = lambda process, *_: called.append(process)
        await plant.call(Tree.echo, 1)
        threads = [thread for thread in threading.enumerate() if thread.name == "plant"]
        assert [thread.daemon for thread in threads] == [True, True]  # no program waits for them
    assert called == ["plant"]
    assert [thread for thread in threads if thread.is_alive()] == []


async def test_a_caller_that_stops_waiting_disturbs_no_other() -> None:
    async with tree() as plant:
        waiting = asyncio.create_task(plant.call(Tree.wait, 0))
        await asyncio.sleep(0)
        waiting.cancel()
        with pytest.raises(asyncio.CancelledError):
            await waiting
        EVENTS[0].set()
        assert await plant.call(Tree.echo, 1) == 1


async def test_a_process_has_our_paths_and_variables_and_those_given(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("PLANT_COLOUR", "red")
    monkeypatch.setenv("PLANT_SIZE", "small")
    async with tree(env={"PLANT_COLOUR": "green"}):
        (process,) = PretendedProcess.all
        assert process.env["PLANT_COLOUR"] == "green"
        assert process.env["PLANT_SIZE"] == "small"
        assert process.env["PYTHONPATH"].split(os.pathsep) == sys.path
        assert process.env["PYTHONUNBUFFERED"]  # what it prints is read as it prints it


@pytest.mark.parametrize(("seconds", "lowest", "highest"), [(5.0, 5.1, 10.0), (1e12, 1e7, 1e9)])
async def test_the_kernels_limit_is_for_a_run_that_is_gone(
    seconds: float, lowest: float, highest: float
) -> None:
    """It comes after the run's own; no limit is too long for the kernel."""
    async with tree(timeout=seconds) as plant:
        (process,) = PretendedProcess.all
        assert lowest < float(process.command[-1]) < highest
        assert await plant.call(Tree.echo, 1) == 1


@pytest.mark.parametrize("clock", ["real", "lockstep"])
async def test_in_real_time_a_process_keeps_off_the_core_of_the_loop(
    clock: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", {0: {3, 1, 2}}.__getitem__)

    async def conditions() -> Any:
        async with tree(niceness=7):
            return PretendedProcess.all[0].conditions

    if clock == "real":
        made = await conditions()
    else:
        made = await asyncio.to_thread(run_in_lockstep, conditions())
    assert made == (sys.path, 7, (2, 3) if clock == "real" else (), Tree.__module__)


def test_no_core_is_spared_where_there_is_one_or_nobody_says(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", {0: {0}}.__getitem__)
    assert module.spare_cores() == ()
    monkeypatch.delattr(os, "sched_getaffinity")
    assert module.spare_cores() == ()


async def test_a_class_without_a_module_is_refused() -> None:
    for factory in (local_to_main("__main__"), mock_without_module()):
        with pytest.raises(WorkerError, match="plant: expected a class of a module that a worker"):
            async with tree(factory=factory):
                pass
    assert PretendedProcess.all == []


def mock_without_module() -> Any:
    """Return something to call that is of no module at all."""

    class Bare:
        def __getattribute__(self, name: str) -> Any:
            if name == "__module__":
                raise AttributeError(name)
            return super().__getattribute__(name)

        def __call__(self) -> Tree:
            return Tree()

    return Bare()


async def test_an_end_fails_all_calls_with_code_and_last_words() -> None:
    deaths = Deaths()
    async with tree(died=deaths) as plant:
        calls = [plant.call(Tree.fall, 7, "no\nwater"), plant.call(Tree.echo, 1)]
        first, second = await asyncio.gather(*calls, return_exceptions=True)
        await deaths.wait()
        with pytest.raises(WorkerDiedError) as third:
            await plant.call(Tree.echo, 2)
    assert first is second is third.value
    assert str(first) == "worker plant: ended with exit code 7; its last output:\nno\nwater"
    assert deaths.errors == [first]


async def test_an_end_while_idle_is_told_even_if_a_fork_holds_the_connection() -> None:
    for leaving_a_fork in (False, True):
        deaths = Deaths()
        async with tree(died=deaths) as plant:
            PretendedProcess.all[-1].exit(-9, leaving_a_fork=leaving_a_fork)
            await deaths.wait()
            with pytest.raises(WorkerDiedError, match=r"killed by signal 9 .*; it said nothing"):
                await plant.call(Tree.echo, 1)


async def test_an_answer_to_nothing_is_an_end() -> None:
    deaths = Deaths()
    async with tree(died=deaths):
        (process,) = PretendedProcess.all
        process.pipe.send((True, "more", 1, 1))
        await deaths.wait()
        assert process.kills == [(SIGKILL, False)]
    assert "worker plant: expected an answer, found IndexError" in str(deaths.errors[0])


async def test_a_closed_connection_of_a_process_that_goes_on_is_an_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "_GRACE", 0.001)
    deaths = Deaths()
    async with tree(died=deaths, factory=StubbornTree):
        PretendedProcess.all[0].pipe.shut_down()
        await deaths.wait()
    assert str(deaths.errors[0]) == "worker plant: closed its connection; it said nothing"


async def test_a_call_beyond_its_limit_is_killed_and_not_before(wall: Wall) -> None:
    deaths = Deaths()
    async with tree(died=deaths) as plant:  # by default, a minute
        wall.now += 1000.0  # nothing is due while nobody calls
        assert await plant.call(Tree.echo, 1) == 1
        waiting = [asyncio.create_task(plant.call(Tree.wait, n)) for n in range(2)]
        await asyncio.sleep(0)
        await asyncio.to_thread(wall.pass_by, 60.0)
        assert not deaths.errors
        await asyncio.to_thread(wall.pass_by, 0.001, 1)
        outcomes = await asyncio.gather(*waiting, return_exceptions=True)
        assert PretendedProcess.all[0].kills == [(SIGKILL, False)]
    text = "worker plant: no answer in 60 s (timeout of self.worker); it said nothing"
    assert [str(outcome) for outcome in outcomes] == [text, text]
    assert all(isinstance(outcome, WorkerTimeoutError) for outcome in outcomes)


async def test_what_a_process_waits_for_a_processor_is_not_its_fault(
    wall: Wall, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Starved:
        """A process that has waited for 30 s since its call."""

        def __init__(self, pid: int | None = None) -> None:
            self._known = pid in [process.pid for process in PretendedProcess.all]

        def look(self) -> float:
            return 30.0 if self._known else 0.0

    monkeypatch.setattr(module, "Starvation", Starved)
    deaths = Deaths()
    async with tree(died=deaths, timeout=60.0) as plant:
        waiting = asyncio.create_task(plant.call(Tree.wait, 0))
        await asyncio.sleep(0)
        await asyncio.to_thread(wall.pass_by, 89.0)
        assert not deaths.errors
        await asyncio.to_thread(wall.pass_by, 2.0, 1)
        with pytest.raises(WorkerTimeoutError, match="no answer in 60 s"):
            await waiting


async def test_closing_ends_processes_in_order_and_what_they_have_started() -> None:
    deaths = Deaths()
    async with tree(processes=2, died=deaths) as plant:
        waiting = asyncio.create_task(plant.call(Tree.wait, 0))
        await asyncio.sleep(0)
        asyncio.get_running_loop().call_later(0, EVENTS[0].set)
    with contextlib.suppress(WorkerDiedError):  # unless its answer was quicker
        await waiting
    assert [process.code for process in PretendedProcess.all] == [0, 0]
    assert [process.kills for process in PretendedProcess.all] == [[(SIGKILL, True)]] * 2
    assert deaths.errors == []
    with pytest.raises(WorkerError, match=r"expected a call from ready\(\) until close\(\)"):
        await plant.call(Tree.echo, 1)


async def test_a_process_that_does_not_end_is_killed_at_the_end_of_its_grace(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "_GRACE", 0.01)
    async with tree(factory=StubbornTree):
        (process,) = PretendedProcess.all
    assert process.code == -SIGKILL
    assert process.kills == [(SIGKILL, False), (SIGKILL, True)]


async def test_what_a_process_prints_is_passed_on_to_its_last_line() -> None:
    lines: list[str] = []
    said = threading.Event()

    def printed(line: str) -> None:
        lines.append(line)
        said.set()

    async with tree(printed=printed):
        (process,) = PretendedProcess.all
        process.print("a leaf\nand ")
        assert await asyncio.to_thread(said.wait, 10)
        assert lines == ["a leaf"]
        process.print("another")
    assert lines == ["a leaf", "and another"]


async def test_lines_left_out_are_counted_at_the_end() -> None:
    lines: list[str] = []
    async with tree(printed=lines.append):
        PretendedProcess.all[0].print("more\n" * 1000)
    assert "more lines)" in lines[-1]


async def test_costs_count_calls_and_look_at_memory_once_a_second(wall: Wall) -> None:
    class Looks(Costs):
        pids: list[int]

        def look_at(self, pid: int) -> None:
            self.pids.append(pid)

    costs = Looks()
    costs.pids = []
    async with tree(costs=costs) as plant:
        (pid,) = [process.pid for process in PretendedProcess.all]
        looks = []
        for seconds in (0.0, 0.5, 0.5, 0.9, 0.2):
            wall.now += seconds
            await plant.call(Tree.echo, 1)
            looks.append(len(costs.pids))
        assert looks == [1, 1, 2, 2, 3]
        with pytest.raises(LookupError, match="no water"):
            await plant.call(Tree.fail)
        with pytest.raises(LookupError, match="not here"):
            await plant.call(Tree.misleading)
    assert set(costs.pids) == {pid}
    assert len(costs.pids) == 4  # the last one at the end
    assert (costs.calls, costs.processes) == (6, 1)
    assert (costs.wall.maximum, costs.cpu.maximum) == (5_000, 3_000)


@pytest.mark.parametrize("call", ["call", "call_for", "call_for another", "call_untimed"])
def test_the_latency_of_the_summary_is_that_of_all_calls(call: str) -> None:
    async def main() -> tuple[float | None, int, int]:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, LockstepLoop)
        async with tree(latency=0.25, processes=3) as plant:
            assert isinstance(plant._clock, LockstepClock)
            begin = loop.now
            if call == "call":
                await plant.call(Tree.echo, 1)
            elif call == "call_untimed":
                await plant.call_untimed(Tree.echo, 1)
            else:
                await plant.call_for(0.5 if "another" in call else 0.25, Tree.echo, 1)
            return plant.costs.latency, plant.costs.processes, loop.now - begin

    latency, processes, passed = run_in_lockstep(main())
    assert processes == 3
    assert latency == (0.25 if call in {"call", "call_for"} else None)
    if call != "call_untimed":
        assert passed == (500_000_000 if "another" in call else 250_000_000)
