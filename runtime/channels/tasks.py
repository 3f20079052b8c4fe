"""Immediate resumption of a waiting coroutine, inside the `send()` of its event.

A stock task is woken through the loop's ready queue, which costs a future, a handle and a turn
of the loop. `ResumableCoroutine` wraps a task's coroutine so that a stream can step it directly:
the task itself stays parked on a future (the *gate*) all the while, and takes over again when the
coroutine waits for anything but a stream, ends, or is cancelled. The task is asyncio's own, so
`asyncio.timeout`, `TaskGroup`, `cancel`, `uncancel`, names and stacks are the stock ones; and the
coroutine is stepped in the task's own context with the task as the current one, so it cannot
tell in which of the two ways it was resumed.

`runtime.run.event_loop` makes every task of a loop such a task. Not here: buffers
(`runtime.channels.streams`).
"""

from __future__ import annotations

import asyncio
import contextvars
import sys
from collections.abc import Callable, Coroutine, Generator
from typing import Any

from runtime.channels.streams import Stream

DEPTH_LIMIT = 32
"""Resumptions nested deeper go through the loop: a relay of hundreds must not overflow the
stack, nor keep the loop to itself."""

Fault = Callable[[Callable[[Any], Any], BaseException], None]
"""Called with a failed listener and its exception; the delivery then continues."""

_NOTHING: Any = object()

if sys.version_info >= (3, 14):
    from asyncio.tasks import _swap_current_task

    class _CurrentTasks:
        """Mapping from loop to running task, as in Python up to 3.13."""

        get = staticmethod(asyncio.current_task)
        __setitem__ = staticmethod(_swap_current_task)

        @staticmethod
        def pop(loop: asyncio.AbstractEventLoop, _: None) -> None:
            _swap_current_task(loop, None)

    current_tasks: Any = _CurrentTasks()
else:
    # One dictionary access is a tenth of `_leave_task` and `_enter_task` together. Where there is
    # no such dictionary, `runtime.run.event_loop` finds that this one does not serve.
    current_tasks = getattr(asyncio.tasks, "_current_tasks", {})


class Nesting:
    """Current depth of nested resumptions on a loop, and a count of tasks."""

    __slots__ = ("depth", "tasks")

    def __init__(self) -> None:
        self.depth = 0
        self.tasks = 0


class _Gate(asyncio.Future[None]):
    """Future of a parked task while streams step its coroutine."""

    steps: ResumableCoroutine

    def cancel(self, msg: Any = None) -> bool:
        """Cancel the wait: from now on an event is kept, not given to the cancelled reader."""
        self.steps.leave_stream()
        return super().cancel(msg)


class ResumableCoroutine(Coroutine[Any, Any, Any]):
    """Coroutine of a task, stepped by streams as well as by the task."""

    __slots__ = (
        "__name__", "_coro", "_gate", "_later", "_loop", "_nesting", "_outcome", "_run", "_step",
        "_stream", "_task",
    )  # fmt: skip

    def __init__(
        self,
        coro: Coroutine[Any, Any, Any],
        loop: asyncio.AbstractEventLoop,
        context: contextvars.Context,
        nesting: Nesting,
    ) -> None:
        self.__name__: str = getattr(coro, "__qualname__", "?")
        self._coro = coro
        self._step = coro.send
        self._run = context.run
        self._loop = loop
        self._nesting = nesting
        self._task: asyncio.Task[Any] | None = None
        self._gate: _Gate | None = None
        self._stream: Stream[Any] | None = None
        self._later: asyncio.Handle | None = None
        self._outcome: Any = _NOTHING  # of a step by a stream, for the task to deal with

    def wrap_step(self, wrap: Callable[[Callable[[Any], Any]], Callable[[Any], Any]]) -> None:
        """Step the coroutine from now on by `wrap` around its own `send`."""
        self._step = wrap(self._coro.send)

    # For streams.

    def resume(self, event: Any) -> None:
        """Step the parked coroutine now; called by its stream."""
        stream = self._stream
        assert stream is not None
        stream.waiter = self
        FanOut((stream,)).send(event)

    def resume_soon(self) -> None:
        """Step the coroutine when the loop next turns."""
        self._later = self._loop.call_soon(self._resume_later)

    def _resume_later(self) -> None:
        self._later = None
        FanOut((_WakeUp(self),)).send(None)  # not the stream: another reader may wait there now

    def leave_stream(self) -> None:
        """Detach from the stream: the task is being cancelled."""
        if self._later is not None:
            self._later.cancel()
            self._later = None
        if self._stream is not None:
            if self._stream.waiter is self:
                self._stream.waiter = None
            self._stream = None

    def _hand_over(self, outcome: Any) -> None:
        """Hand the yielded value or raised error to the task, and open the gate."""
        self._stream = None
        self._outcome = outcome
        if self._gate is not None and not self._gate.done():
            self._gate.set_result(None)

    # For the task.

    def send(self, value: Any) -> Any:
        """Step the coroutine, or hand out the outcome of the last step by a stream."""
        if self._task is None:
            self._task = asyncio.current_task(self._loop)
        self._gate = None
        outcome, self._outcome = self._outcome, _NOTHING
        if outcome is _NOTHING:
            return self._park(self._step(value))
        if isinstance(outcome, BaseException):
            raise outcome
        return outcome

    def throw(self, error: Any, *_: Any) -> Any:
        """Raise an error, most often a cancellation, where the coroutine waits."""
        self.leave_stream()
        self._gate = None
        outcome, self._outcome = self._outcome, _NOTHING
        if isinstance(outcome, BaseException):  # it had ended before the cancellation came
            raise outcome
        # As `Task.cancel` does: what the coroutine waits for is cancelled, and hands that on.
        if isinstance(outcome, asyncio.Future) and outcome.cancel(*error.args):
            return outcome
        return self._park(self._coro.throw(error))

    def _park(self, waits_for: Any) -> Any:
        if type(waits_for) is not Stream:
            return waits_for
        self._stream = waits_for
        waits_for.waiter = self
        self._gate = gate = _Gate(loop=self._loop)
        gate.steps = self
        gate._asyncio_future_blocking = True  # the mark that tells a task to wait on what it got
        return gate

    def close(self) -> None:
        """Close the coroutine."""
        self._coro.close()

    def __await__(self) -> Generator[Any, Any, Any]:
        return self._coro.__await__()

    # What asyncio reads to print a task. (A `__getattr__` would switch off the interpreter's
    # fast attribute access for the whole class.)
    cr_frame = property(lambda self: self._coro.cr_frame)
    cr_code = property(lambda self: self._coro.cr_code)
    cr_running = property(lambda self: self._coro.cr_running)
    cr_await = property(lambda self: self._coro.cr_await)


class _WakeUp:
    """Stands for a stream whose reader is to look into the buffer again."""

    __slots__ = ("waiter",)

    def __init__(self, waiter: ResumableCoroutine) -> None:
        self.waiter: ResumableCoroutine | None = waiter


class FanOut:
    """Fan-out of events to streams, in order; steps the waiting readers.

    Args:
        streams: None of them declared with ``wake="soon"``.
        fault: Called with the stream that could not take an event; without it, that is raised.
        check: Called with an event of another type or source than `expected`; may raise.

    Attributes:
        sent: How many events were offered.
        expected: The type of events that need no check,
        source: and their source.
    """

    __slots__ = ("_check", "_fault", "expected", "sent", "source", "streams")

    def __init__(
        self,
        streams: tuple[Stream[Any] | _WakeUp, ...],
        fault: Fault | None = None,
        check: Callable[[Any], None] | None = None,
    ) -> None:
        self.streams: tuple[Any, ...] = streams
        self.sent = 0
        self.expected: Any = None
        self.source = ""
        self._fault = fault
        self._check = check or _accept

    def send(self, event: Any) -> bool:
        """Offer an event; return False, because a stream never ends a delivery.

        One function does it all: a call or two a receiver would cost as much as the receivers.
        """
        if event.__class__ is not self.expected or event.source is not self.source:
            self._check(event)
        self.sent += 1
        tasks, loop, sender, nesting = current_tasks, None, None, _NOTHING
        try:
            for stream in self.streams:
                steps = stream.waiter
                if type(steps) is not ResumableCoroutine:
                    try:
                        if steps is None:
                            stream.keep(event)
                        else:  # a task that is not ours
                            stream.offer(event)
                    except Exception as error:
                        _set_current_task(loop, sender)
                        self._report(stream, error)
                    continue
                if loop is None:
                    if steps._nesting.depth >= DEPTH_LIMIT:
                        stream.offer_soon(event)
                        continue
                    nesting = steps._nesting
                    nesting.depth += 1
                    loop = steps._loop
                    sender = tasks.get(loop)
                stream.waiter = None
                tasks[loop] = steps._task
                try:
                    waits_for = steps._run(steps._step, event)
                except BaseException as error:
                    steps._hand_over(error)
                    continue
                if type(waits_for) is Stream:
                    steps._stream = waits_for
                    waits_for.waiter = steps
                else:
                    steps._hand_over(waits_for)
        finally:
            if loop is not None:
                nesting.depth -= 1
                _set_current_task(loop, sender)
        return False

    def _report(self, stream: Stream[Any], error: Exception) -> None:
        if self._fault is None:
            raise error
        self._fault(stream.offer, error)


def _accept(_: Any) -> None:
    pass


def _set_current_task(
    loop: asyncio.AbstractEventLoop | None, task: asyncio.Task[Any] | None
) -> None:
    """Restore the running task after a fan-out; without a loop, nothing has changed."""
    if task is not None:
        current_tasks[loop] = task
    elif loop is not None:
        current_tasks.pop(loop, None)
