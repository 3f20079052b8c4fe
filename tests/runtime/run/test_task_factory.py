"""What happens where the interpreter's asyncio is not what resuming at once relies on."""

from __future__ import annotations

import asyncio
import functools
import logging
import threading
from collections.abc import Iterator
from typing import Any

import pytest

from runtime import interpreter as self_test
from runtime.channels import tasks
from runtime.channels.streams import Stream
from runtime.channels.tasks import Nesting
from runtime.config.model import RunConfig
from runtime.errors import UnsupportedInterpreterError
from runtime.run import event_loop as task_factory
from runtime.run.execute import make_loop
from runtime.testing import run_in_lockstep, spec
from runtime.time import lockstep
from runtime.time.lockstep import LockstepLoop
from tests.runtime.samples_loop import Camera, Estimator, Pilot, look

NODES = [spec(Camera, "drone"), spec(Estimator, "vo"), spec(Pilot, "pilot")]
OURS = functools.partial(task_factory._task_factory, Nesting())


@pytest.fixture
def untested() -> Iterator[None]:
    """Have the self-test decide anew, here and after the test."""
    task_factory.resumable.cache_clear()
    yield
    task_factory.resumable.cache_clear()


def test_this_interpreter_resumes_tasks_at_once(
    untested: None, caplog: pytest.LogCaptureFixture
) -> None:
    assert task_factory.works(None)
    assert task_factory.works(OURS)
    assert task_factory.resumable()
    assert caplog.records == []


def test_without_the_running_task_streams_wake_through_the_loop_and_it_is_said_once(
    untested: None, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    expected = look(NODES, duration=0.5)
    task_factory.resumable.cache_clear()
    monkeypatch.setattr(tasks, "current_tasks", {})  # as where it is kept elsewhere
    loop = asyncio.new_event_loop()
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            task_factory.install(loop)
    assert loop.get_task_factory() is None
    loop.close()
    (record,) = caplog.records
    assert "streams wake tasks through the loop" in record.message
    assert look(NODES, duration=0.5).digest == expected.digest


def test_where_tasks_accept_futures_only_streams_wait_on_futures(
    untested: None, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    expected = look(NODES, duration=0.5)
    task_factory.resumable.cache_clear()
    monkeypatch.setattr(Stream, "__anext__", Stream.__anext__)  # so that it is put back
    monkeypatch.setattr(Stream, "_asyncio_future_blocking", None)
    monkeypatch.setattr(tasks.ResumableCoroutine, "_park", lambda _, waits_for: waits_for)
    with caplog.at_level(logging.WARNING):
        assert not task_factory.resumable()
    assert [r.message.partition(": ")[2] for r in caplog.records] == [
        "streams wait on futures, since its tasks accept nothing else",
        "streams wake tasks through the loop, which is slower",
    ]
    assert task_factory.works(None)  # now
    assert look(NODES, duration=0.5).digest == expected.digest


def test_a_reader_on_a_future_reads_all_and_can_be_cancelled(
    untested: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Stream, "__anext__", Stream._next_by_future)

    async def main() -> None:
        numbers: Stream[int] = Stream("numbers")
        task = asyncio.create_task(_all(numbers))
        for number in range(1000):
            numbers.offer(number)
            if number % 3 == 0:
                await asyncio.sleep(0)
        numbers.close()
        assert await task == list(range(1000))
        left: Stream[int] = Stream("left")
        task = asyncio.create_task(_all(left))
        await asyncio.sleep(0)
        task.cancel()
        left.offer(7)
        with pytest.raises(asyncio.CancelledError):
            await task
        assert left.receive_nowait() == 7
        assert left.waiter is None

    run_in_lockstep(main())


async def _all(numbers: Stream[int]) -> list[Any]:
    return [number async for number in numbers]


def test_a_self_test_that_hangs_or_raises_or_reports_has_failed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ended = threading.Event()

    async def hang(_: asyncio.AbstractEventLoop) -> bool:
        return await asyncio.to_thread(ended.wait)

    async def fail(_: asyncio.AbstractEventLoop) -> bool:
        raise AttributeError("_ready")

    async def report(loop: asyncio.AbstractEventLoop) -> bool:
        loop.call_soon(divmod, 1, 0)
        await asyncio.sleep(0)
        return True

    monkeypatch.setattr(self_test, "LIMIT", 0.05)
    assert not self_test.passes(asyncio.SelectorEventLoop, hang)
    ended.set()
    monkeypatch.undo()
    assert not self_test.passes(asyncio.SelectorEventLoop, fail)
    assert not self_test.passes(asyncio.SelectorEventLoop, report)


def test_simulated_time_is_refused_where_it_would_be_another(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    lockstep.check_interpreter()
    lockstep.check_interpreter.cache_clear()
    monkeypatch.setattr(LockstepLoop, "call_at", asyncio.SelectorEventLoop.call_at)  # no order
    with pytest.raises(UnsupportedInterpreterError, match='clock = "real"'):
        make_loop(RunConfig())
    monkeypatch.undo()
    lockstep.check_interpreter.cache_clear()
    lockstep.check_interpreter()
