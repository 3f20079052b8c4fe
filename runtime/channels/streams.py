"""Awaitable buffer behind an input read by a coroutine.

A stream has one reader. An event that finds the reader waiting goes straight to it; any other
is kept up to a bound, beyond which the input's declared policy decides. A reader in a task of
ours is resumed inside `offer` (`runtime.channels.tasks`); a reader in any other task is woken
through the loop, for which a stream looks enough like a future.
"""

from __future__ import annotations

import asyncio
import contextvars
import types
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Generator
from typing import Any, Generic, Literal, Protocol, TypeVar

import msgspec

from runtime.errors import ChannelBusyError, ChannelClosedError, ChannelFullError

T = TypeVar("T")

Overflow = Literal["error", "drop_oldest", "wait"]

TURN = 256  # events read in a row without waiting until the loop gets a turn
_WOKEN: Any = None  # sent into a reader instead of an event: look again at the buffer


class StreamStatistics(msgspec.Struct, frozen=True):
    """How full a stream is and was: waiting now, the most that ever waited, and dropped.

    Dropped are events discarded to make room (``latest``: replaced before anyone saw them).
    """

    buffered: int
    peak: int
    dropped: int


class Waiter(Protocol):
    """A suspended reader."""

    def resume(self, event: Any) -> None:
        """Continue now, with this event."""

    def resume_soon(self) -> None:
        """Continue at the loop's next turn, with the stream's events by then."""


class Stream(Generic[T]):
    """Buffer of events on their way to a single coroutine.

    Args:
        overflow: What happens to one more: ``error`` raises `ChannelFullError`, ``drop_oldest``
            discards the oldest and counts it, ``wait`` is for senders that await `Sender.send_wait`
            (a plain `send` raises).
        soon: Resume the reader when the loop next turns instead of inside `offer`.

    Attributes:
        before: Awaited before an event is taken, so that those arriving meanwhile may replace it.
        prepare: Awaited with an event that was taken; the reader gets its result. Both, `None` for
            nothing, hold for ``async for`` and `receive`.
    """

    __slots__ = (
        "_buffer", "_closed", "_read", "_room", "_seen", "before", "bound", "dropped", "merge",
        "name", "offer", "overflow", "peak", "prepare", "soon", "waiter",
    )  # fmt: skip

    def __init__(
        self, name: str, bound: int = 1024, overflow: Overflow = "error", soon: bool = False
    ) -> None:
        self.name = name
        self.bound = bound
        self.overflow = overflow
        self.soon = soon
        self.peak = 0
        self.dropped = 0
        self.offer: Callable[[T], None] = self.offer_soon if soon else self._offer_now
        self._buffer: deque[T] = deque()
        self.merge: Callable[[T, T], T] | None = None
        """Merges a dropped item into its successor; the result replaces both."""
        self.before: Callable[[], Awaitable[object]] | None = None
        self.prepare: Callable[[T], Awaitable[T]] | None = None
        self.waiter: Waiter | None = None  # set by the task that a reader yielded this stream to
        self._read = 0
        self._seen: T | None = None
        self._room: asyncio.Event | None = None
        self._closed = False

    # Reading.

    def __aiter__(self) -> AsyncIterator[T]:
        return self if self.before is None and self.prepare is None else _Preparing(self)

    @types.coroutine
    def __anext__(self) -> Generator[Any, Any, T]:
        """Return the next event, waiting if necessary; stop when closed and empty."""
        buffer = self._buffer
        if buffer:
            self._read += 1
            if self._read == TURN:  # a reader that never runs dry must not keep the loop
                self._read = 0
                yield
        while not buffer:
            if self._closed:
                raise StopAsyncIteration
            if self.waiter is not None:
                raise ChannelBusyError(f"{self.name}: another coroutine waits here already")
            event = yield self  # the reader's driver becomes our `waiter`
            if event is not _WOKEN:
                return event  # type: ignore[no-any-return]
        event = buffer.popleft()
        if self._room is not None:
            self._room.set()
        return event

    @types.coroutine
    def _next_by_future(self) -> Generator[Any, Any, T]:
        """Wait as `__anext__` does, but on a future: for tasks accepting nothing else."""
        if self._buffer:
            self._read += 1
            if self._read == TURN:
                self._read = 0
                yield
        while not self._buffer:
            if self._closed:
                raise StopAsyncIteration
            if self.waiter is not None:
                raise ChannelBusyError(f"{self.name}: another coroutine waits here already")
            self.waiter = waiter = _FutureWaiter(self)
            try:
                yield from waiter.future
            finally:
                if self.waiter is waiter:
                    self.waiter = None
        return self.receive_nowait()

    @classmethod
    def use_futures(cls) -> None:
        """Have all streams wait on asyncio's own futures from now on."""
        cls.__anext__ = cls._next_by_future  # type: ignore[method-assign]

    async def receive(self) -> T:
        """Return the next event, waiting if necessary.

        ``await anext(stream)`` does the same, a little quicker and without `before` and `prepare`,
        and ends as an iterator does.
        Cancelling loses nothing: an event that comes afterwards is kept for the next call.

        Raises:
            ChannelClosedError: The stream is closed and has been read.
            ChannelBusyError: Another coroutine waits here already.
        """
        try:
            return await anext(aiter(self))
        except StopAsyncIteration:
            raise ChannelClosedError(f"{self.name} is closed") from None

    def receive_nowait(self) -> T:
        """Return the next event, neither waiting nor preparing.

        Raises:
            LookupError: Nothing waits.
            ChannelClosedError: The stream is closed and has been read.
        """
        if not self._buffer:
            if self._closed:
                raise ChannelClosedError(f"{self.name} is closed")
            raise LookupError(f"{self.name} holds nothing")
        event = self._buffer.popleft()
        if self._room is not None:
            self._room.set()
        return event

    def peek(self) -> T | None:
        """Return the newest event, left in the buffer; `None` if there is none.

        With ``keep="latest"`` and no reader, this is the newest there has been.
        """
        if not self._buffer:
            return None
        self._seen = self._buffer[-1]
        return self._seen

    # Writing. `offer` is one of the next two. It stands in an output's tuple of listeners, and
    # returns None because a stream never ends a delivery.

    def _offer_now(self, event: T) -> None:
        waiter = self.waiter
        if waiter is None:
            self.keep(event)
        else:
            self.waiter = None
            waiter.resume(event)

    def offer_soon(self, event: T) -> None:
        """Keep an event, and have the reader resumed when the loop next turns."""
        self.keep(event)
        self._wake()

    def keep(self, event: T) -> None:
        """Buffer an event; when full, apply the overflow policy, or raise `ChannelFullError`."""
        buffer = self._buffer
        if self._closed:
            return
        if len(buffer) >= self.bound:
            if self.overflow != "drop_oldest":
                hint = (
                    "send it with `await send_wait(event)`"
                    if self.overflow == "wait"
                    else "read faster, raise its bound, or declare what it may drop"
                )
                raise ChannelFullError(
                    f"{self.name}: expected room for one more event, "
                    f"found {self.bound} unread: {hint}"
                )
            oldest = buffer.popleft()
            if oldest is not self._seen:
                self.dropped += 1
            buffer.append(event)
            if self.merge is not None:
                buffer[0] = self.merge(oldest, buffer[0])
            return
        buffer.append(event)
        if len(buffer) > self.peak:
            self.peak = len(buffer)

    def has_room(self) -> bool:
        """Return whether an event would fit (or the stream is closed, and takes no more)."""
        return len(self._buffer) < self.bound or self._closed

    async def wait_for_room(self) -> None:
        """Return when `has_room`."""
        while not self.has_room():
            if self._room is None:
                self._room = asyncio.Event()
            self._room.clear()
            await self._room.wait()

    def close(self) -> None:
        """End the stream: buffered events can still be read, then iteration stops."""
        self._closed = True
        if self._room is not None:
            self._room.set()
        self._wake()

    def statistics(self) -> StreamStatistics:
        """Return fill level, peak and number of dropped events."""
        return StreamStatistics(len(self._buffer), self.peak, self.dropped)

    def _wake(self) -> None:
        waiter = self.waiter
        if waiter is not None:
            self.waiter = None
            waiter.resume_soon()

    # What a stock `asyncio.Task` asks of a future that was yielded to it.

    @property
    def _asyncio_future_blocking(self) -> bool:
        return True

    @_asyncio_future_blocking.setter
    def _asyncio_future_blocking(self, value: bool) -> None:
        """Ignore the task's mark: a stream can always be waited on again."""

    def get_loop(self) -> asyncio.AbstractEventLoop:
        """Return the running loop, where a future names its own."""
        return asyncio.get_running_loop()

    def add_done_callback(
        self, wakeup: Callable[[Any], None], *, context: contextvars.Context
    ) -> None:
        """Park a stock task; `wakeup` is its way to be stepped."""
        self.waiter = _ForeignTask(self, wakeup, context)

    def cancel(self, msg: Any = None) -> bool:
        """Wake the waiting stock task with a cancellation."""
        waiter = self.waiter
        if not isinstance(waiter, _ForeignTask):
            return False
        self.waiter = None
        waiter.cancel(msg)
        return True


class _Preparing(Generic[T]):
    """Iterator over a stream with something to await before and after an event is taken."""

    __slots__ = ("_stream",)

    def __init__(self, stream: Stream[T]) -> None:
        self._stream = stream

    def __aiter__(self) -> _Preparing[T]:
        return self

    async def __anext__(self) -> T:
        stream = self._stream
        if stream.before is not None:
            await stream.before()
        event = await stream.__anext__()
        return event if stream.prepare is None else await stream.prepare(event)


class _ForeignTask:
    """Reader in a task not resumable by streams, run at the loop's next turn."""

    def __init__(
        self, stream: Stream[Any], wakeup: Callable[[Any], None], context: contextvars.Context
    ) -> None:
        self._stream = stream
        self._wakeup = wakeup
        self._context = context
        self._cancelled: asyncio.CancelledError | None = None

    def resume(self, event: Any) -> None:
        self._stream.keep(event)
        self.resume_soon()

    def resume_soon(self) -> None:
        asyncio.get_running_loop().call_soon(self._wakeup, self, context=self._context)

    def cancel(self, msg: Any) -> None:
        self._cancelled = asyncio.CancelledError() if msg is None else asyncio.CancelledError(msg)
        self.resume_soon()

    def result(self) -> None:
        """Notify the task how its wait ended; called by the task."""
        if self._cancelled is not None:
            raise self._cancelled


class _FutureWaiter:
    def __init__(self, stream: Stream[Any]) -> None:
        self.future = asyncio.get_running_loop().create_future()
        self._stream = stream

    def resume(self, event: Any) -> None:
        self._stream.keep(event)
        self.resume_soon()

    def resume_soon(self) -> None:
        if not self.future.done():
            self.future.set_result(None)
