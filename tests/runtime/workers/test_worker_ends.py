"""That no process of a worker is left behind, and that the end of one never goes unnoticed."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from runtime import Node, Worker
from runtime.errors import WorkerDiedError, WorkerError
from runtime.testing import spec
from runtime.time.clock import RealClock
from tests.runtime.samples_runs import supervise
from tests.runtime.samples_workers import Plant
from tests.runtime.workers.test_worker import worker

pytestmark = pytest.mark.timeout(30)


class Started(subprocess.Popen[bytes]):
    """Every process that was started."""

    all: list[Started] = []  # noqa: RUF012

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.all.append(self)


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[Started]:
    Started.all.clear()
    monkeypatch.setattr("runtime.workers.worker.subprocess.Popen", Started)
    return Started.all


def open_files() -> int:
    return sum(1 for _ in Path("/proc/self/fd").iterdir())


class Undecided(Node):
    """Ends the run while its worker is being started."""

    async def on_startup(self) -> None:
        asyncio.get_running_loop().call_soon(self.stop, "never mind")
        await self.worker(Plant)


@pytest.mark.slow
@pytest.mark.parametrize("clock", ["real", "lockstep"])
def test_a_start_that_is_cancelled_leaves_no_process(clock: str, started: list[Started]) -> None:
    assert supervise([spec(Undecided, "u")], clock=clock).reason == "never mind"
    assert [process.pid for process in started if process.poll() is None] == []


async def test_a_worker_that_was_closed_before_it_was_ready_starts_nothing(
    started: list[Started],
) -> None:
    clock = RealClock(asyncio.get_running_loop())
    plant = Worker("plant", clock, Plant)
    with pytest.raises(WorkerError, match=r"worker plant: expected a call from ready\(\)"):
        await plant.call(Plant.pid)
    await asyncio.to_thread(plant.close)
    with pytest.raises(WorkerError, match="worker plant: closed before it was ready"):
        await plant.ready()
    assert not started
    clock.close()


async def test_processes_begin_before_the_last_arguments_are_there(started: list[Started]) -> None:
    begun: list[int] = []

    async def more() -> tuple[str, ...]:
        begun.append(len(started))
        return ("value",)

    with pytest.raises(ValueError, match="no such plant"):
        async with worker(more=more, processes=2):
            pass
    assert begun == [2]


async def test_what_a_process_may_not_begin_with_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("runtime.workers.worker.spare_cores", lambda: (4095,))
    with pytest.raises(OSError, match="Invalid argument") as caught:
        async with worker():
            pass
    assert "sched_setaffinity" in caught.value.__notes__[0]


async def test_a_process_that_wakes_does_not_push_others_off_their_core(
    started: list[Started],
) -> None:
    async with worker():
        assert os.sched_getscheduler(started[0].pid) == os.SCHED_BATCH


async def test_no_process_is_left_if_the_last_arguments_fail(started: list[Started]) -> None:
    async def more() -> tuple[str, ...]:
        raise LookupError("no world")

    with pytest.raises(LookupError, match="no world"):
        async with worker(more=more):
            pass
    assert [process.poll() is None for process in started] == [False]


async def test_a_worker_that_is_closed_before_the_last_arguments_are_there_makes_nothing(
    started: list[Started],
) -> None:
    clock = RealClock(asyncio.get_running_loop())

    async def more() -> tuple[str, ...]:
        await asyncio.to_thread(plant.close)
        return ()

    plant = Worker("plant", clock, Plant, more=more)
    with pytest.raises(WorkerError, match="worker plant: closed before it was ready"):
        await plant.ready()
    assert [process.poll() is None for process in started] == [False]
    clock.close()


async def test_of_several_processes_the_first_ends_if_the_second_cannot_start(
    started: list[Started], monkeypatch: pytest.MonkeyPatch
) -> None:
    def one_only(*args: Any, **options: Any) -> Started:
        if started:
            raise OSError(11, "Resource temporarily unavailable")
        return Started(*args, **options)

    monkeypatch.setattr("runtime.workers.worker.subprocess.Popen", one_only)
    files = open_files()
    with pytest.raises(OSError, match="Resource temporarily unavailable"):
        async with worker(processes=2):
            pass
    assert [process.poll() is None for process in started] == [False]
    assert open_files() <= files


def ends(pid: int) -> bool:
    """Tell whether a process ends, now that it was killed, though perhaps nobody asks how."""
    until = time.monotonic() + 10
    while time.monotonic() < until:
        try:
            if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
                return True
        except FileNotFoundError:
            return True
        time.sleep(0.01)  # the kernel is about to do it
    return False


async def test_a_program_that_a_worker_has_started_ends_with_it() -> None:
    async with worker() as plant:
        pid = await plant.call(Plant.start_a_program)
        begin = time.monotonic()
    assert time.monotonic() - begin < 20
    assert ends(pid)


@pytest.mark.slow
async def test_an_end_beside_a_fork_is_noticed() -> None:
    async with worker() as plant:
        with pytest.raises(WorkerDiedError, match="ended with exit code 7") as caught:
            await plant.call(Plant.exit_beside_a_fork, 7)
    assert ends(int(str(caught.value).splitlines()[-1]))


async def test_an_answer_that_nobody_asked_for_is_an_end_and_not_silence() -> None:
    told = threading.Event()
    async with worker(died=lambda _: told.set()) as plant:
        await plant.call(Plant.answer_twice)
        assert await asyncio.to_thread(told.wait, 10)
        with pytest.raises(WorkerDiedError, match="expected an answer, found IndexError"):
            await plant.call(Plant.pid)


class Assassin:
    """Cannot be pickled; while that is tried, the worker dies, and all is told of it."""

    def __init__(self, pid: int, told: threading.Event) -> None:
        self._pid = pid
        self._told = told

    def __reduce__(self) -> tuple[Any, ...]:
        os.kill(self._pid, signal.SIGKILL)
        assert self._told.wait(10)
        raise TypeError("cannot pickle an assassin")


async def test_a_call_that_fails_while_the_process_ends_fails_in_one_way() -> None:
    """The thread that hears of the end and the one that calls share the list of calls."""
    told = threading.Event()
    async with worker(died=lambda _: told.set()) as plant:
        pid = await plant.call(Plant.pid)
        with pytest.raises(TypeError, match="cannot pickle an assassin"):
            await plant.call(Plant.echo, Assassin(pid, told))
        assert plant.outstanding() == 0


class Misleading:
    """Raises, where it arrives, what usually means that the other side is gone."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (open, ("/nowhere/at/all",))


@pytest.mark.slow
async def test_an_argument_that_cannot_be_made_there_fails_only_its_call() -> None:
    async with worker() as plant:
        with pytest.raises(FileNotFoundError, match="/nowhere/at/all"):
            await plant.call(Plant.echo, Misleading())
        assert await plant.call(Plant.echo, 1) == 1


@pytest.mark.slow
async def test_stuck_processes_are_ended_together() -> None:
    """Each has the same two seconds, not one after the other."""
    async with worker(processes=3) as plant:
        calls = [asyncio.ensure_future(plant.call(Plant.sleep, 60.0)) for _ in range(3)]
        await asyncio.sleep(0)
        begin = time.monotonic()
        await asyncio.to_thread(plant.close)
        assert time.monotonic() - begin < 5
        outcomes = await asyncio.gather(*calls, return_exceptions=True)
        assert all(isinstance(outcome, WorkerDiedError) for outcome in outcomes)
