"""Another process of the run: the way to send messages, and the offset of its clocks.

Zenoh waits where the network is slow, and the loop must not. A small message goes out on the spot
as long as little is under way, by what the other process has confirmed; then Zenoh has room for
it. So does an image if the other process sees memory of ours, where it is put: its message is
small. All others are written by a thread, in order (`Outbox`).

Clocks are compared by Cristian's algorithm: a reply that took little time, there and back, cannot
have been read off far from the middle of it. (F. Cristian, Probabilistic clock synchronization,
1989.)
"""

from __future__ import annotations

import collections
import queue
import threading
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import msgspec

from events import Event
from runtime.errors import ChannelFullError, PeerError, VisnavError, WireError
from runtime.peers import messages
from runtime.peers.authentication import Sealing
from runtime.peers.shared_memory import Incoming, Outgoing
from runtime.summary import ProcessSummary, Summary
from runtime.wire import Packed, pack, unpack

Put = Callable[[bytes, bytes], None]

BOUND = 1024  # most events waiting for the network: as many as an input keeps
SMALL = 8192  # most bytes of a message written by the loop itself: copying takes a microsecond
AT_ONCE = 1 << 20  # most bytes of an event put into common memory by the loop: copying takes 0.1 ms

UNDER_WAY = 32768
"""Most unconfirmed bytes for writing at once; Zenoh's queue holds four times as many."""


class Outbox:
    """Messages on their way to a process, in order.

    Args:
        put: Writes one; may wait.
        failed: Called, in the outbox's thread, with the error of a failed write.

    Attributes:
        replaced: Number of events replaced by a newer one of the same output.
        memory: Shared with the other process, once confirmed.
    """

    def __init__(self, name: str, put: Put, failed: Callable[[VisnavError], None]) -> None:
        self.name = name
        self.replaced = 0
        self.peak = 0
        self.memory: Outgoing | None = None
        self._put = put
        self._failed = failed
        self._queue: deque[_Waiting] = deque()
        self._skippable: dict[str, _Waiting] = {}
        self._events = 0
        self._under_way = 0
        self._writing = False
        self._lock = threading.RLock()
        self._wake: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._closed = False
        self._thread: threading.Thread | None = None

    def send(self, message: messages.Message, event: Event | None = None, skip: str = "") -> None:
        """Send a message now, or queue behind the waiting messages.

        Args:
            skip: If given, the event takes the place of one with the same word that still waits.

        Raises:
            WireError: The event cannot be made into bytes.
            ChannelFullError: Too many events wait already, and this one may not replace one.
        """
        packed = None if event is None else pack(event)
        with self._lock:
            if self._closed:
                return
            before = self._skippable.get(skip)
            if before is not None:
                before.packed = packed
                self.replaced += 1
            elif self._idle() and (parts := self._in_bytes(message, packed, now=True)):
                self._put_now(*parts)
            else:
                self._wait(_Waiting(message, packed, skip))

    def arrived(self, count: int) -> None:
        """Take in how many bytes have arrived at the other end."""
        with self._lock:
            self._under_way = max(self._under_way - count, 0)

    def close(self, timeout: float = 2.0) -> None:
        """Write the waiting messages, for at most `timeout` seconds, and end."""
        with self._lock:
            self._closed = True
            self._wake.put(None)
        if self._thread is not None:
            self._thread.join(timeout)

    def abandon(self) -> None:
        """Write no more: the process has gone."""
        with self._lock:
            self._queue.clear()
            self._closed = True
            self._wake.put(None)

    def _idle(self) -> bool:
        return not (self._queue or self._writing) and self._under_way < UNDER_WAY

    def _in_bytes(
        self, message: messages.Message, packed: Packed | None, *, now: bool
    ) -> tuple[bytes, bytes] | None:
        """Return a message and its payload; `None` if making them takes too long for now."""
        if packed is None or packed.size <= SMALL:
            return messages.encode(message), b"" if packed is None else packed.frame()
        if self.memory is not None and not (now and packed.size > AT_ONCE):
            place = self.memory.put(packed)
            if place is not None:
                return messages.encode(msgspec.structs.replace(message, place=place)), b""
        return None if now else (messages.encode(message), packed.frame())

    def _put_now(self, head: bytes, frame: bytes) -> None:
        with self._lock:
            self._under_way += len(head) + len(frame)
        try:
            self._put(head, frame)
        except VisnavError as error:
            self._failed(error)
        except Exception as error:  # whatever a library does, the outbox goes on
            self._failed(PeerError(f"a message could not be sent: {_describe(error)}"))

    def _wait(self, waiting: _Waiting) -> None:
        if waiting.packed is not None:
            if self._events >= BOUND:
                raise ChannelFullError(
                    f"expected room for one more event to {self.name}, found {BOUND} that wait "
                    'for the network: send less, or read them with keep="latest" there'
                )
            self._events += 1
        self._queue.append(waiting)
        if waiting.skip:
            self._skippable[waiting.skip] = waiting
        self.peak = max(self.peak, len(self._queue))
        self._wake.put(None)
        if self._thread is None:
            self._thread = threading.Thread(target=self._write, name=f"to {self.name}", daemon=True)
            self._thread.start()

    def _write(self) -> None:
        while True:
            self._wake.get()
            with self._lock:
                if not self._queue:
                    if self._closed:
                        return
                    continue
                waiting = self._queue.popleft()
                self._writing = True
                self._skippable.pop(waiting.skip, None)
                if waiting.packed is not None:
                    self._events -= 1
            try:
                parts = self._in_bytes(waiting.message, waiting.packed, now=False)
                assert parts is not None
            except Exception as error:  # the message goes without its event: others count it
                parts = messages.encode(waiting.message), b""
                self._failed(PeerError(f"an event could not be sent: {_describe(error)}"))
            self._put_now(*parts)
            self._writing = False
            if self._closed:
                self._wake.put(None)  # look again whether anything is left


def _describe(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"


class _Waiting:
    __slots__ = ("message", "packed", "skip")

    def __init__(self, message: messages.Message, packed: Packed | None, skip: str) -> None:
        self.message = message
        self.packed = packed
        self.skip = skip


KEPT = 20  # number of remembered exchanges


class Exchange(NamedTuple):
    """Result of a question and its answer (ns): `offset` is their monotonic clock minus ours.

    Half of the round trip bounds its error, and that of `late`: their clock of the run minus ours.
    """

    round_trip: int
    offset: int
    late: int


class Exchanges:
    """Latest exchanges with a process; the quickest counts."""

    def __init__(self) -> None:
        self.count = 0
        self._latest: collections.deque[Exchange] = collections.deque(maxlen=KEPT)

    def add(self, exchange: Exchange) -> None:
        """Record an exchange; for any thread."""
        self._latest.append(exchange)
        self.count += 1

    def best(self, latest: int = KEPT) -> Exchange | None:
        """Return the quickest of the latest exchanges, if there were any."""
        return min(list(self._latest)[-latest:], default=None)


ACK_EVERY = 8192  # received bytes between two acknowledgements
FREE_EVERY = 4  # released frames of the other's memory between two acknowledgements


class Member:
    """Another process, for the duration of a session.

    Attributes:
        number: Its number among the processes of the run, or -1 if it is none of them.
        over: Why the session has ended, if it has.
        lost_at: When it ended, on `time.monotonic`.
        running: Whether its first update was already, as far as is known.
        unfit: Whether it is no part of the run: it runs another file, or nodes that run elsewhere.
        held: Messages it has sent, while another process with its nodes is still in the run.
        drift_ppm: Drift of its clock relative to ours, parts per million, if we follow it.
        begin: When the first update is, if it has sent that.
        outgoing: Memory that was offered to it.
        incoming: Memory of its own that we see.
    """

    def __init__(
        self,
        id_: str,
        hello: messages.Hello,
        sealing: Sealing,
        put: Put,
        failed: Callable[[VisnavError], None],
    ) -> None:
        self.id = id_
        self.hello = hello
        self.sealing = sealing
        self.number = -1
        self.over = ""
        self.lost_at = 0.0
        self.running = hello.running
        self.unfit = True
        self.held: list[tuple[messages.OfTheRun, Event | None]] | None = None
        self.exchanges = Exchanges()
        self.drift_ppm: float | None = None
        self.announced: messages.Announcements | None = None
        self.ready = False
        self.begin: messages.FirstUpdate | None = None
        self._arrived = 0
        self.final_summary: Summary | None = None
        self.outgoing: Outgoing | None = None
        self.incoming: Incoming | None = None
        self.has_our_summary = False
        self.outbox = Outbox(
            id_, lambda message, payload: put(sealing.seal(message, payload), payload), failed
        )

    def event(self, message: messages.EventMessage, payload: bytes) -> Event:
        """Return the event of a message, or raise `WireError`."""
        if message.place is None:
            return unpack(payload)
        if self.incoming is None:
            raise WireError("expected an event as a payload, found its place in unknown memory")
        return unpack(self.incoming.frame(*message.place))

    def acknowledge(self, count: int) -> None:
        """Count received bytes, and acknowledge them once in a while."""
        self._arrived += count
        unread = 0 if self.incoming is None else self.incoming.unread
        if self._arrived >= ACK_EVERY or unread >= FREE_EVERY:
            freed = () if self.incoming is None else self.incoming.freed()
            self.outbox.send(messages.Ack(self._arrived, freed))
            self._arrived = 0

    def acknowledged(self, ack: messages.Ack) -> None:
        """Handle an acknowledgement: bytes received, and frames read no more."""
        self.outbox.arrived(ack.arrived)
        if self.outgoing is not None:
            self.outgoing.freed(ack.freed)

    @property
    def nodes(self) -> tuple[str, ...]:
        """Its nodes, in file order."""
        return self.hello.nodes

    @property
    def place(self) -> str:
        """Host and process number, for messages to people."""
        return self.hello.place

    def summary(self) -> ProcessSummary:
        """Return its entry in the run's summary."""
        best = self.exchanges.best()
        return ProcessSummary(
            nodes=list(self.nodes),
            place=self.place,
            clock_offset_ms=None if best is None else best.offset / 1e6,
            round_trip_ms=None if best is None else best.round_trip / 1e6,
            clock_drift_ppm=self.drift_ppm,
            waited=self.outbox.peak,
            replaced=self.outbox.replaced,
        )
