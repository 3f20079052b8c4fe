"""Objects in processes of their own: calls, answers, and every way in which they can go wrong."""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
import signal
import threading
import time
from collections.abc import AsyncIterator, Callable
from typing import Any

import numpy as np
import pytest

from runtime import Worker
from runtime.errors import UnraisableError, WorkerDiedError, WorkerError, WorkerTimeoutError
from runtime.run import event_loop as task_factory
from runtime.run.node_runner import with_place, wrap
from runtime.testing import run_in_lockstep
from runtime.time.clock import RealClock
from runtime.time.lockstep import LockstepClock, LockstepLoop
from runtime.workers.output import LINES
from tests.runtime.samples_workers import Plant, plain

pytestmark = pytest.mark.timeout(30)


@contextlib.asynccontextmanager
async def worker(*args: Any, **options: Any) -> AsyncIterator[Worker[Plant]]:
    """Return a ready worker on the clock of the running loop, and close it."""
    loop = asyncio.get_running_loop()
    lockstep = isinstance(loop, LockstepLoop)
    clock = LockstepClock(loop) if lockstep else RealClock(loop)  # type: ignore[arg-type]
    task_factory.install(loop)
    made: Worker[Plant] = await asyncio.to_thread(
        Worker, "plant", clock, options.pop("factory", Plant), *args, **options
    )
    try:
        await made.ready()
        yield made
    finally:
        await asyncio.to_thread(made.close)
        clock.close()


@pytest.mark.slow
async def test_calls_of_one_process_are_answered_in_order() -> None:
    async with worker() as plant:
        assert await plant.call(Plant.echo, 1) == 1
        finished: list[float] = []

        async def sleep(seconds: float) -> None:
            finished.append(await plant.call(Plant.sleep, seconds))

        async with asyncio.TaskGroup() as group:
            for seconds in (0.1, 0.05, 0.0):
                group.create_task(sleep(seconds))
            await asyncio.sleep(0)
            assert plant.outstanding() == 3
        assert finished == [0.1, 0.05, 0.0]
        assert plant.outstanding() == 0


@pytest.mark.slow
async def test_two_processes_share_the_calls() -> None:
    async with worker(processes=2) as plant:
        busy = [asyncio.create_task(plant.call(Plant.sleep, 0.2)) for _ in range(2)]
        await asyncio.sleep(0)  # both are on their way, so each process has one
        pids = await asyncio.gather(*(plant.call(Plant.pid) for _ in range(6)), *busy)
        assert len(set(pids[:6])) == 2
        assert os.getpid() not in pids
        assert pids[:6].count(pids[0]) == 3


async def test_a_function_can_make_the_object_too() -> None:
    async with worker(factory=plain) as plant:
        assert await plant.call(Plant.echo, "here") == "here"


@pytest.mark.slow
async def test_an_exception_of_the_object_comes_back_with_the_workers_traceback() -> None:
    async with worker() as plant:
        with pytest.raises(LookupError, match="not here") as caught:
            await plant.call(Plant.fail)
        assert "in the worker:" in caught.value.__notes__[0]
        assert "samples_workers.py" in caught.value.__notes__[0]
        for method in (Plant.fail, Plant.fail_oddly):
            with pytest.raises((LookupError, RuntimeError)) as failed:
                await plant.call(method)
            place = with_place(wrap("vo", failed.value))
            assert re.search(r"\(runtime/samples_workers.py:\d+ in fail(_oddly)?\)$", place)
        assert "UnpicklableError: 1 and 2" in str(failed.value)
        assert await plant.call(Plant.echo, 1) == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("trouble", "error", "text"),
    [
        ("value", ValueError, "no such plant"),
        ("file", FileNotFoundError, "plant.xml"),
        ("exit", UnraisableError, "SystemExit: 3"),
        ("end", WorkerDiedError, "worker plant: ended with exit code 3; .*\nseed not found"),
    ],
)
async def test_an_error_of_the_constructor_comes_back(
    trouble: str, error: type[Exception], text: str
) -> None:
    with pytest.raises(error, match=text):
        async with worker(trouble):
            pass


async def test_a_constructor_that_hangs_is_killed() -> None:
    with pytest.raises(WorkerTimeoutError, match=r"worker plant: no answer in 0.3 s"):
        async with worker("hang", timeout=0.3):
            pass


@pytest.mark.slow
async def test_arguments_that_cannot_be_pickled_are_the_callers_mistake() -> None:
    async with worker() as plant:
        with pytest.raises((TypeError, AttributeError), match="pickle"):
            await plant.call(Plant.echo, threading.Lock())
        assert plant.outstanding() == 0
        assert await plant.call(Plant.echo, 1) == 1


@pytest.mark.slow
async def test_a_result_that_cannot_be_pickled_fails_only_its_call() -> None:
    async with worker() as plant:
        with pytest.raises(TypeError, match="cannot pickle"):
            await plant.call(Plant.lock)
        assert await plant.call(Plant.echo, 1) == 1


def local_to_main(module: str) -> Any:
    """Return a function that claims to be of a module."""

    def claims() -> None: ...

    claims.__module__ = module
    return claims


def test_a_class_of_main_is_refused() -> None:
    async def main() -> None:
        with pytest.raises(WorkerError, match="a class of a module that a worker can import"):
            async with worker(factory=local_to_main("__main__")):
                pass

    run_in_lockstep(main())


@pytest.mark.slow
async def test_environment_variables_reach_the_process() -> None:
    async with worker(env={"PLANT_COLOUR": "green"}) as plant:
        assert await plant.call(Plant.variable, "PLANT_COLOUR") == "green"
        assert await plant.call(Plant.variable, "HOME") == os.environ.get("HOME")


@pytest.mark.slow
async def test_what_a_process_prints_is_passed_on() -> None:
    lines: list[str] = []
    async with worker(printed=lines.append) as plant:
        await plant.call(Plant.say, "hello\nworld")
        await plant.call(Plant.echo, 1)
        await plant.call(Plant.say_in_c, "from a library\n")
        await poll(lambda: len(lines) == 3)  # before the process ends
        await plant.call(Plant.say, "more\n" * 1000)
    assert lines[:3] == ["hello", "world", "from a library"]
    assert lines.count("more") <= 2 * LINES, "of two seconds, at most"
    assert sum(map(int, re.findall(r"\((\d+) more lines\)", "\n".join(lines)))) >= 1000 - 2 * LINES


async def poll(reached: Callable[[], bool]) -> None:
    """Wait, in real time, for what another process does."""
    until = time.monotonic() + 10.0
    while not reached() and time.monotonic() < until:  # noqa: ASYNC110  # a thread tells it
        await asyncio.sleep(0.01)
    assert reached()


@pytest.mark.slow
@pytest.mark.parametrize("work", [0.0, 0.2])
def test_in_lockstep_an_answer_is_due_exactly_after_the_latency(work: float) -> None:
    async def main() -> tuple[int, int]:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, LockstepLoop)
        async with worker(latency=0.08) as plant:
            begin = loop.now
            await plant.call(Plant.sleep, work)
            usual = loop.now - begin
            await plant.call_for(0.5, Plant.sleep, work)
            return usual, loop.now - begin - usual

    assert run_in_lockstep(main()) == (80_000_000, 500_000_000)


@pytest.mark.slow
async def test_in_real_time_an_answer_comes_no_sooner_than_the_latency() -> None:
    async with worker(latency=0.2) as plant:
        clock = plant._clock
        assert isinstance(clock, RealClock)
        clock.start()
        begin = clock.now()
        await plant.call(Plant.echo, 1)
        assert 200_000_000 <= clock.now() - begin < 400_000_000


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fate", "text"),
    [
        (lambda plant: plant.call(Plant.die, 7), "ended with exit code 7; .*\ngoodbye"),
        (lambda plant: plant.call(Plant.fall), "killed by signal 9 .*; it said nothing"),
    ],
)
async def test_a_death_fails_all_calls_with_code_and_last_output(
    fate: Callable[[Worker[Plant]], Any], text: str
) -> None:
    deaths: list[Exception] = []
    async with worker(died=deaths.append) as plant:
        calls = [fate(plant), plant.call(Plant.echo, 1)]
        outcomes = await asyncio.gather(*calls, return_exceptions=True)
        for outcome in outcomes:
            assert isinstance(outcome, WorkerDiedError)
            with pytest.raises(WorkerDiedError, match=text):
                raise outcome
        with pytest.raises(WorkerDiedError, match="worker plant"):
            await plant.call(Plant.echo, 2)
    assert deaths == [outcomes[0]]


@pytest.mark.slow
async def test_a_death_while_idle_is_told() -> None:
    deaths: list[WorkerError] = []
    told = threading.Event()

    def died(error: WorkerError) -> None:
        deaths.append(error)
        told.set()

    async with worker(died=died) as plant:
        os.kill(await plant.call(Plant.pid), signal.SIGTERM)
        assert await asyncio.to_thread(told.wait, 5)
    assert "killed by signal 15" in str(deaths[0])


@pytest.mark.slow
async def test_a_process_that_hangs_is_killed_within_its_limit() -> None:
    async with worker() as plant:
        pid = await plant.call(Plant.pid)
        plant._processes[0]._timeout = 0.3  # its start may take longer
        begin = time.monotonic()
        with pytest.raises(WorkerTimeoutError, match=r"worker plant: no answer in 0.3 s"):
            await plant.call(Plant.sleep, 1000.0)
        assert time.monotonic() - begin < 20
    assert not alive(pid)


@pytest.mark.slow
async def test_ctrl_c_does_not_reach_a_worker() -> None:
    async with worker() as plant:
        pid = await plant.call(Plant.pid)
        os.kill(pid, signal.SIGINT)
        assert await plant.call(Plant.pid) == pid
        assert os.getpgid(pid) != os.getpgid(0)  # nor in its first moments, before it can say so


@pytest.mark.slow
async def test_close_ends_the_processes_and_fails_what_waits() -> None:
    async with worker(processes=2) as plant:
        pids = set(await asyncio.gather(plant.call(Plant.pid), plant.call(Plant.pid)))
        waiting = asyncio.ensure_future(plant.call(Plant.sleep, 0.5))
        await asyncio.sleep(0)
    with pytest.raises(WorkerError):
        await waiting
    assert not any(alive(pid) for pid in pids)


@pytest.mark.slow
async def test_arrays_come_back_as_they_went() -> None:
    async with worker() as plant:
        for size in (1, 100, 5000, 3_000_000):
            array = np.arange(size, dtype=np.uint32)
            answer = await plant.call(Plant.echo, array)
            assert answer.dtype == array.dtype
            assert np.array_equal(answer, array)


def alive(pid: int) -> bool:
    """Tell whether there is a process of this number."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.slow
async def test_in_real_time_a_core_is_left_to_the_loop() -> None:
    """On the real clock a worker keeps off one core; in lockstep it may use them all."""
    cores = os.sched_getaffinity(0)
    if len(cores) < 2:
        pytest.skip("needs two cores")
    async with worker() as plant:
        assert await plant.call(Plant.cores) == set(sorted(cores)[1:])

    async def in_lockstep() -> set[int]:
        async with worker() as plant:
            return await plant.call(Plant.cores)

    assert await asyncio.to_thread(run_in_lockstep, in_lockstep()) == cores
