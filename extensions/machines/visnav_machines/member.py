"""Another process of the run: its clock compared with ours, and the messages to it.

Clocks are compared by Cristian's algorithm: a reply that took little time, there and back, cannot
have been read off far from the middle of it. (F. Cristian, Probabilistic clock synchronization,
1989.) Two machines' clocks part by some 20 µs a second. Ours runs a little quicker or slower until
it shows what the other one does, and never jumps.

Zenoh waits where the network is slow, and the loop must not. A small message goes out on the spot
as long as little is under way, by what the other process has confirmed; then Zenoh has room for
it. So does an image if the other process sees memory of ours, where it is put: its message is
small. All others are written by a thread, in order.

Of memory, a process offers the other a nameless file, by its path in ``/proc`` and a key at its
beginning. A process that can open the file and finds the key is on the same machine, and reads
frames in place; the others get them over the network. A block is used again once the last array on
it is gone. The file cannot shrink: mapped memory stays readable, whatever its owner does.
"""

from __future__ import annotations

import asyncio
import fcntl
import logging
import os
import re
import secrets
import stat
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Coroutine
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from events import Event
from runtime.channels.wire import Packed, pack, unpack
from runtime.errors import ChannelFullError, PeerError, VisnavError, WireError
from runtime.summary import ProcessSummary, Summary
from runtime.time.clock import SECOND, RealClock
from runtime.workers.shared_memory import Arena, MappedFile, anonymous_file
from visnav_machines import messages
from visnav_machines.session import Sealing

ACK_EVERY = 8192  # received bytes between two acknowledgements
FREE_EVERY = 4  # released frames of the other's memory between two acknowledgements

KEPT = 20  # number of remembered exchanges
PERIOD = 0.1  # seconds between two exchanges
EXCHANGES = 10  # exchanges for each correction of our clock; the quickest gives its lateness

MOST_DRIFT = 500e-6
"""Greatest relative change of our clock's rate, as in NTP; quartzes differ by a tenth of this."""


class Exchange(NamedTuple):
    """Result of a question and its answer (ns): `offset` is their monotonic clock minus ours.

    Half of the round trip bounds its error, and that of `late`: their clock of the run minus ours.
    """

    round_trip: int
    offset: int
    late: int


@dataclass(eq=False)
class Member:
    """Another process, for the duration of a session.

    Attributes:
        number: Its number among the processes of the run, or -1 if it is none of them.
        over: Why the session has ended, if it has.
        lost_at: When it ended, on `time.monotonic`.
        running: Whether its first update was already, as far as is known.
        unfit: Whether it is no part of the run: it runs another file, or nodes that run elsewhere.
        pending: Messages it has sent, while another process with its nodes is still in the run.
        exchanges: The latest; appended to in any thread.
        drift_ppm: Drift of its clock relative to ours, parts per million, if we follow it.
        first_update: When the first update is, if it has sent that.
        returning: Whether it came while the run went on, and is not ready yet.
        outgoing: Memory that was offered to it.
        incoming: Memory of its own that we see.
    """

    id: str
    hello: messages.Hello
    sealing: Sealing
    outbox: Outbox
    number: int = -1
    over: str = ""
    lost_at: float = 0.0
    running: bool = False
    unfit: bool = True
    pending: list[tuple[messages.OfTheRun, Event | None]] | None = None
    exchanges: deque[Exchange] = field(default_factory=lambda: deque(maxlen=KEPT))
    drift_ppm: float | None = None
    announced: messages.Announcements | None = None
    ready: bool = False
    first_update: messages.FirstUpdate | None = None
    returning: bool = False
    final_summary: Summary | None = None
    has_our_summary: bool = False
    outgoing: Outgoing | None = None
    incoming: Incoming | None = None
    _arrived: int = 0

    def __post_init__(self) -> None:
        self.running = self.hello.running

    @property
    def nodes(self) -> tuple[str, ...]:
        """Its nodes, in file order."""
        return self.hello.nodes

    @property
    def name(self) -> str:
        """Its nodes, in words."""
        return ", ".join(self.nodes)

    @property
    def place(self) -> str:
        """Host and process number, for messages to people."""
        return self.hello.place

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
        unread = 0 if self.incoming is None else len(self.incoming.freed)
        if self._arrived >= ACK_EVERY or unread >= FREE_EVERY:
            freed = () if self.incoming is None else self.incoming.pop_freed()
            self.outbox.send(messages.Ack(self._arrived, freed))
            self._arrived = 0

    def acknowledged(self, ack: messages.Ack) -> None:
        """Handle an acknowledgement: bytes received, and frames read no more."""
        self.outbox.confirm(ack.arrived)
        if self.outgoing is not None:
            self.outgoing.freed.extend(ack.freed)

    def request_time(self) -> None:
        """Request its time; the answer is an `Exchange`."""
        self.outbox.send(messages.Ping(time.monotonic_ns()))

    async def compare_clocks(
        self, until: Callable[[Callable[[], bool]], Coroutine[Any, Any, None]]
    ) -> None:
        """Measure the offset of its monotonic clock, unless it is lost."""
        self.exchanges.clear()
        for count in range(KEPT):
            self.request_time()
            await until(lambda n=count: self.over != "" or len(self.exchanges) > n)  # type: ignore[misc]

    def best(self, latest: int = KEPT) -> Exchange | None:
        """Return the quickest of the latest exchanges, if there were any."""
        return min(list(self.exchanges)[-latest:], default=None)

    def summary(self) -> ProcessSummary:
        """Return its entry in the run's summary."""
        best = self.best()
        return ProcessSummary(
            nodes=list(self.nodes),
            place=self.place,
            clock_offset_ms=None if best is None else best.offset / 1e6,
            round_trip_ms=None if best is None else best.round_trip / 1e6,
            clock_drift_ppm=self.drift_ppm,
            waited=self.outbox.peak,
            replaced=self.outbox.replaced,
        )


class PhaseLockedLoop:
    """Phase-locked loop of the second order: the speed that catches up with another clock.

    It is critically damped and settles in half a minute. (As in RFC 5905, section 11.3.) `drift` is
    how much quicker the other clock is, as estimated so far.
    """

    PROPORTIONAL = 0.2  # a second
    INTEGRAL = PROPORTIONAL**2 / 4

    def __init__(self) -> None:
        self.drift = 0.0

    def factor(self, late: float, seconds: float) -> float:
        """Return the speed from now on, if `late` seconds behind."""
        drift = self.drift + self.INTEGRAL * late * seconds
        correction = drift + self.PROPORTIONAL * late
        if abs(correction) < MOST_DRIFT:  # else this is more than drift
            self.drift = drift
        return 1.0 + min(max(correction, -MOST_DRIFT), MOST_DRIFT)


class ClockFollower:
    """Follower of another process's clock, by steering ours."""

    def __init__(self, clock: RealClock, member: Member) -> None:
        self.member = member
        self._clock = clock
        self._pursuit = PhaseLockedLoop()
        self._loop = asyncio.get_running_loop()
        self._requests = 0
        self._handle = self._loop.call_later(PERIOD, self._request_time)

    def stop(self) -> None:
        """Stop steering the clock."""
        self._handle.cancel()

    def continue_alone(self) -> None:
        """Stop comparing, and keep the other clock's speed."""
        self.stop()
        self._clock.steer(1.0 + self._pursuit.drift)

    def _request_time(self) -> None:
        self.member.request_time()
        self._requests += 1
        if self._requests % EXCHANGES == 0:
            self._steer()
        self._handle = self._loop.call_later(PERIOD, self._request_time)

    def _steer(self) -> None:
        best = self.member.best(EXCHANGES - 1)  # the last is still under way
        if best is not None:
            late = best.late / self._clock.speed / SECOND
            self._clock.steer(self._pursuit.factor(late, PERIOD * EXCHANGES))
            self.member.drift_ppm = self._pursuit.drift * 1e6


log = logging.getLogger("visnav.runtime")

Write = Callable[[bytes, bytes], None]

BOUND = 1024  # most events waiting for the network: as many as an input keeps
SMALL = 8192  # most bytes of a message written by the loop itself: copying takes a microsecond
AT_ONCE = 1 << 20  # most bytes of an event put into common memory by the loop: copying takes 0.1 ms
CLOSING = 2.0  # most seconds for what waits to be written, at the end

UNDER_WAY = 32768
"""Most unconfirmed bytes for writing at once; Zenoh's queue holds four times as many."""

LIMIT = 1 << 28  # most bytes of a file; events without room cross the network
KEY = 32


class Outbox:
    """Messages on their way to a process, in order.

    Args:
        write: Writes one; may wait.
        failed: Called, in the outbox's thread, with the error of a failed write.

    Attributes:
        replaced: Number of events replaced by a newer one of the same output.
        memory: Shared with the other process, once confirmed.
    """

    def __init__(self, name: str, write: Write, failed: Callable[[VisnavError], None]) -> None:
        self.name = name
        self.replaced = 0
        self.peak = 0
        self.memory: Outgoing | None = None
        self._write_to = write
        self._failed = failed
        self._queue: deque[_Waiting] = deque()
        self._skippable: dict[str, _Waiting] = {}
        self._events = 0
        self._under_way = 0
        self._writing = False
        self._closed = False
        self._changed = threading.Condition()
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
        with self._changed:
            if self._closed:
                return
            idle = not (self._queue or self._writing) and self._under_way < UNDER_WAY
            earlier = self._skippable.get(skip)
            if earlier is not None:
                earlier.packed = packed
                self.replaced += 1
            elif idle and (parts := self._in_bytes(message, packed, now=True)):
                self._write_now(*parts)
            else:
                self._enqueue(_Waiting(message, packed, skip))

    def confirm(self, count: int) -> None:
        """Confirm the arrival of so many bytes at the other end."""
        with self._changed:
            self._under_way = max(self._under_way - count, 0)

    def close(self) -> None:
        """Write the waiting messages, for at most `CLOSING` seconds, and end."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        if self._thread is not None:
            self._thread.join(CLOSING)

    def abandon(self) -> None:
        """Discard the waiting messages, as the process has gone."""
        with self._changed:
            self._queue.clear()
            self._closed = True
            self._changed.notify()

    def _in_bytes(
        self, message: messages.Message, packed: Packed | None, *, now: bool
    ) -> tuple[bytes, bytes] | None:
        """Return a message and its payload; `None` if making them takes too long for now."""
        if packed is None or packed.size <= SMALL:
            return messages.encode(message), b"" if packed is None else packed.frame()
        if self.memory is not None and not (now and packed.size > AT_ONCE):
            place = self.memory.store(packed)
            if place is not None:
                return messages.encode(msgspec.structs.replace(message, place=place)), b""
        return None if now else (messages.encode(message), packed.frame())

    def _write_now(self, head: bytes, frame: bytes) -> None:
        with self._changed:
            self._under_way += len(head) + len(frame)
        try:
            self._write_to(head, frame)
        except VisnavError as error:
            self._failed(error)
        except Exception as error:  # any error of a library; the outbox continues
            self._failed(PeerError(f"a message could not be sent: {_describe(error)}"))

    def _enqueue(self, waiting: _Waiting) -> None:
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
        self._changed.notify()
        if self._thread is None:
            self._thread = threading.Thread(target=self._write, name=f"to {self.name}", daemon=True)
            self._thread.start()

    def _write(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._queue or self._closed)
                if not self._queue:
                    return
                waiting = self._queue.popleft()
                self._writing = True
                self._skippable.pop(waiting.skip, None)
                self._events -= waiting.packed is not None
            try:
                parts = self._in_bytes(waiting.message, waiting.packed, now=False)
                assert parts is not None
            except Exception as error:  # the message goes without its event: others count it
                parts = messages.encode(waiting.message), b""
                self._failed(PeerError(f"an event could not be sent: {_describe(error)}"))
            self._write_now(*parts)
            self._writing = False


@dataclass(slots=True)
class _Waiting:
    message: messages.Message
    packed: Packed | None
    skip: str


def _describe(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"


class Outgoing:
    """Memory written by this process, with large events for another; closed with this object.

    `store` is called by one thread at a time.

    Attributes:
        freed: Places of frames read no more by the other process; appended to from any thread.
    """

    def __init__(self) -> None:
        self._fd = anonymous_file()
        self._arena = Arena(self._fd, LIMIT)
        weakref.finalize(self, self._arena.close)
        self._key = secrets.token_bytes(KEY)
        self._arena.store(memoryview(self._key))
        self.freed: deque[int] = deque()

    def offer(self) -> messages.MemoryOffer:
        """Return the offer of this memory to the other process."""
        return messages.MemoryOffer(
            machine=machine(), path=f"/proc/{os.getpid()}/fd/{self._fd}", key=self._key
        )

    def store(self, packed: Packed) -> tuple[int, int] | None:
        """Store a frame there, and return its place and size; `None` if there is no room."""
        while self.freed:
            if offset := self.freed.popleft():  # the key stays at 0
                self._arena.free(offset)
        place = self._arena.reserve(packed.size)
        if place is None:
            return None
        packed.write(self._arena.view(place, packed.size))
        return place, packed.size


class Incoming(MappedFile):
    """Memory written by another process, with large events for this process.

    The file is closed with this object; arrays that stand in it stay valid.
    """

    def __init__(self, fd: int) -> None:
        super().__init__(fd)
        weakref.finalize(self, os.close, fd)

    @classmethod
    def open_offer(cls, offer: messages.MemoryOffer) -> Incoming | None:
        """Return the offered memory; `None` if not accessible from here."""
        same_machine = offer.machine and offer.machine == machine()
        if not (same_machine and re.fullmatch(r"/proc/\d+/fd/\d+", offer.path)):
            return None
        try:
            fd = os.open(offer.path, os.O_RDWR | os.O_CLOEXEC | os.O_NONBLOCK)
        except OSError as error:
            log.debug("no memory in common: %s", error)
            return None
        try:
            fits = (
                stat.S_ISREG(os.fstat(fd).st_mode)
                and fcntl.fcntl(fd, fcntl.F_GET_SEALS) & fcntl.F_SEAL_SHRINK
                and secrets.compare_digest(os.pread(fd, KEY, 0), offer.key)
            )
        except OSError:
            fits = False
        if not fits:
            os.close(fd)
            log.debug("no memory in common: %s is another file", offer.path)
            return None
        return cls(fd)

    def frame(self, offset: int, size: int) -> memoryview:
        """Return a frame in place, without a copy; raise `WireError` if there is none."""
        try:
            block = self.view(offset, size)
        except (OSError, ValueError) as error:
            text = f"expected {size} bytes of common memory at {offset}, found: {error}"
            raise WireError(text) from None
        return np.frombuffer(block, np.uint8).data


def machine() -> str:
    """Return the boot id, common to the processes of a machine; "" if there is none."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text("ascii").strip()
    except OSError:
        return ""
