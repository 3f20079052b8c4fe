"""A coroutine resumed inside `offer` cannot tell: its task, context, errors and results are its."""

from __future__ import annotations

import asyncio
import contextvars
import gc
import io
import traceback
from collections.abc import Awaitable, Callable
from typing import Any

import pytest

from runtime.channels.streams import Stream
from tests.runtime.loops import Run, turns

who = contextvars.ContextVar("who", default="nobody")


def running() -> str:
    """Return the name of the current task, or ``none``."""
    task = asyncio.current_task()
    return task.get_name() if task else "none"


async def parked(
    stream: Stream[int], then: Callable[[int], Awaitable[Any]], name: str | None = None
) -> asyncio.Task[Any]:
    """Return a task that waits for an event and then does something with it."""

    async def reader() -> Any:
        return await then(await stream.receive())

    task = asyncio.create_task(reader(), name=name)
    await turns()
    return task


async def give_back(event: int) -> int:
    return event


def test_the_current_task_is_the_receivers_and_then_the_senders_again(run: Run) -> None:
    async def main() -> list[str]:
        stream, seen = Stream[int]("s"), list[str]()

        async def note(_: int) -> None:
            seen.append(running())

        task = await parked(stream, note, "receiver")
        stream.offer(1)
        after = running()
        await task
        return [*seen, after]

    names = run(main())
    assert names[0] == "receiver"
    assert names[1] not in {"receiver", "none"}


def test_a_plain_callback_that_sends_has_no_task_afterwards(run: Run) -> None:
    async def main() -> list[str]:
        stream, seen = Stream[int]("s"), list[str]()

        async def note(_: int) -> None:
            seen.append(running())

        def send() -> None:
            stream.offer(1)
            after.append(running())

        after: list[str] = []
        task = await parked(stream, note, "receiver")
        asyncio.get_running_loop().call_soon(send)
        await task
        return seen + after

    assert run(main()) == ["receiver", "none"]


def test_context_variables_are_each_tasks_own(run: Run) -> None:
    async def main() -> tuple[str, str, str]:
        stream = Stream[int]("s")
        who.set("creator")

        async def set_who(_: int) -> tuple[str, str]:
            before = who.get()
            who.set("receiver")
            await asyncio.sleep(0)
            return before, who.get()

        task = await parked(stream, set_who)
        who.set("sender")
        stream.offer(1)
        mine = who.get()
        return *(await task), mine

    assert run(main()) == ("creator", "receiver", "sender")


def test_a_coroutine_that_ends_in_a_send_gives_its_result_to_whoever_awaits_it(run: Run) -> None:
    async def main() -> int:
        stream = Stream[int]("s")
        task = await parked(stream, give_back)
        stream.offer(7)
        return int(await task)

    assert run(main()) == 7


def test_an_error_reaches_the_tasks_awaiter_and_not_the_sender(run: Run) -> None:
    """Its traceback names the line that raised."""

    async def main() -> str:
        stream = Stream[int]("s")

        async def divide(event: int) -> float:
            return 1 / event

        task = await parked(stream, divide)
        stream.offer(0)
        with pytest.raises(ZeroDivisionError) as caught:
            await task
        return "".join(traceback.format_exception(caught.value))

    assert "return 1 / event" in run(main())


def test_names_coroutines_and_stacks_of_tasks_can_be_printed(run: Run) -> None:
    async def main() -> tuple[str, str]:
        stream = Stream[int]("s")
        task = await parked(stream, give_back, "receiver")
        stack = io.StringIO()
        task.print_stack(file=stack)
        coro = task.get_coro()
        assert coro is not None
        text = f"{task!r} {coro.__name__}"  # type: ignore[union-attr]
        stream.close()
        with pytest.raises(Exception, match="closed"):
            await task
        return text, stack.getvalue()

    text, stack = run(main())
    assert "name='receiver'" in text
    assert "parked.<locals>.reader" in text
    assert "in reader" in stack


def test_a_task_with_a_given_context_runs_in_it_and_reads(ours: Run) -> None:
    async def main() -> int:
        stream, context = Stream[int]("s"), contextvars.copy_context()

        async def reader() -> int:
            who.set("reader")
            return await stream.receive()

        task = asyncio.get_running_loop().create_task(reader(), context=context)
        await turns()
        stream.offer(1)
        result = await task
        assert context[who] == "reader"
        return result

    assert ours(main()) == 1


def test_tasks_left_over_or_never_started_leave_no_warning(ours: Run) -> None:
    """The loop is closed under one that waits, and one is cancelled before its first step."""

    async def main() -> None:
        stream = Stream[int]("s")
        asyncio.create_task(stream.receive())  # noqa: RUF006
        never = asyncio.create_task(stream.receive())
        never.cancel()

    ours(main())
    gc.collect()  # what is destroyed would warn here, and warnings are errors
