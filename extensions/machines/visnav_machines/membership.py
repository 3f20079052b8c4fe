"""Presence of the run's processes: meeting, joining, leaving, and waiting for them.

Slow processes are named, and none is awaited for ever. Messages from Zenoh's threads are handed to
the loop here; in the rest of this package, only handshakes and outboxes use threads.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import os
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import msgspec

from events import Event
from runtime.config.model import Config
from runtime.errors import PeerError, VisnavError, WireError
from runtime.time.lockstep import LockstepLoop
from runtime.time.real_time import real_time_limit
from visnav_machines import messages
from visnav_machines.handshake import Handshakes, check_fits, shared_settings
from visnav_machines.member import Exchange, Incoming, Member, Outgoing
from visnav_machines.session import ForgedError, Session, certified, derive, is_hello, secret_of

log = logging.getLogger("visnav.runtime")

ALONE = 1.0
"""Seconds without another process until a check of the meeting place: nobody listens there if the
listening process ended just after we connected to it.
"""

NAMED_EVERY = 5.0  # real seconds between two log lines naming the awaited processes


@dataclass(eq=False)
class Seat:
    """Another process's part in the run, kept after a loss for the process that takes it next.

    Attributes:
        member: The process, if present.
        absent: The process that was lost before the first update, until its return.
        first_loss: When one was first lost so, on `time.monotonic`; 0 if none was.
        awaited: Whether simulated time stands until it is back.
        apart: Whether it takes no turns: its run has not begun yet, or it has given up.
        new: Whether it has changed since turns were last shared.
    """

    nodes: tuple[str, ...]
    member: Member | None
    absent: Member | None = None
    first_loss: float = 0.0
    awaited: bool = False
    apart: bool = False
    new: bool = False


class Run(Protocol):
    """Receiver of a membership's notifications; called on the run's loop."""

    def receive(self, member: Member, message: messages.OfTheRun, event: Event | None) -> None:
        """Handle a message of another process, or raise `WireError`."""

    def joined(self, member: Member) -> None:
        """Handle a process joining or returning after the numbering of processes."""

    def lost(self, member: Member) -> None:
        """Handle the loss of a process."""

    def now(self, ago: int = 0) -> int:
        """Return the time of the run's clock, so many real nanoseconds ago; in any thread."""


class Membership:
    """The processes of a run.

    Args:
        peers: Notified, on the loop, of messages and losses.

    Attributes:
        nodes: All of the run, in file order.
        here: Those that run in this process, in order.
        id: Of this process's session.
        me: Number of this process. They are numbered by their first nodes, once all have met.
        count: Number of processes; 0 before.
        seats: Those of the others, by number and in that order.
        waiting: For other processes, and for the return of those lost before the first update.
        ended: Once the run ends, what is sent to processes that join.
    """

    def __init__(self, config: Config, only: Iterable[str], peers: Run) -> None:
        chosen = set(only)
        self.nodes = [spec.name for spec in config.nodes]
        self.here = tuple(name for name in self.nodes if name in chosen)
        self.id = ""
        self.me = self.count = 0
        self.seats: dict[int, Seat] = {}
        self._before = 0
        self.hello = messages.Hello(
            nodes=self.here,
            config=shared_settings(config),
            place=f"{socket.gethostname()}, process {os.getpid()}",
            began=time.time(),
        )
        self._run = config.run.name
        self._network = config.network
        self._peers = peers
        self._loop = asyncio.get_running_loop()
        self._handshakes: Handshakes | None = None
        self.ended: messages.Stop | None = None
        self._unfit: list[str] = []
        self.waiting = Waiting(self.seats, float(config.run.startup_limit))

    async def meet(self) -> int:
        """Wait until all nodes of the file are there, and number their processes.

        Returns:
            How often a process with our nodes was in this run before.

        Raises:
            PeerError: They are not within the limit, or one runs another file or our nodes.
        """
        network, limit = self._network, float(self._network.wait)
        by_certificate = not network.secret and certified(network)
        secret = b"known by certificate" if by_certificate else secret_of(network.secret)
        await self._appear(secret)
        if absent := self._missing():
            log.info("waiting for %s at %s", ", ".join(absent), network.meet)
        try:
            async with real_time_limit(limit):
                while True:
                    with contextlib.suppress(TimeoutError):
                        async with real_time_limit(ALONE):
                            return await self.numbers()
                    if self._handshakes and await self._handshakes.alone():
                        await self._handshakes.close()
                        await self._appear(secret)
        except TimeoutError:
            absent = self._missing()
            text = (
                f"expected all nodes to be there within {limit:g} s (network.wait), found "
                f"none of {', '.join(absent)} that knows our secret (network.secret) at "
                f"{network.meet}: start them with --only {','.join(absent)}"
            )
            raise PeerError("; ".join([text, *self._unfit])) from None

    async def _appear(self, secret: bytes) -> None:
        session = await asyncio.to_thread(Session, self._run, self._network, secret)
        self.id = session.id
        self._handshakes = Handshakes(derive(secret, "run", self._run), session, self)
        await asyncio.to_thread(self._handshakes.begin, self._receive)

    async def numbers(self) -> int:
        """Wait until all were there once, and have numbers; see `meet`."""
        await self.waiting.until(self._number_all)
        return self._before

    def _number_all(self) -> bool:
        if self.count:
            return True
        if self._missing():
            return False
        fitting = self._fitting()
        others = {member.nodes: member for member in fitting}
        for member in fitting:  # one is back before it was missed
            member.unfit = others[member.nodes] is not member
        everybody = sorted([self.here, *others], key=lambda nodes: self.nodes.index(nodes[0]))
        self.me, self.count = everybody.index(self.here), len(everybody)
        for number, nodes in enumerate(everybody):
            if number != self.me:
                others[nodes].number = number
                self.seats[number] = Seat(nodes, others[nodes])
        running = [m.hello for m in others.values() if m.hello.running]
        self._before = max((max(h.lost.count(self.here[0]), 1) for h in running), default=0)
        return True

    def present(self) -> list[Member]:
        """Return the other processes present, in the order of their numbers."""
        return [seat.member for seat in self.seats.values() if seat.member is not None]

    def complete(self) -> bool:
        """Return whether all processes of the run are there."""
        return len(self.present()) == self.count - 1

    def numbered(self, number: int) -> Member | None:
        """Return the process of a number, if present."""
        return self.seats[number].member if number in self.seats else None

    def broadcast(self, message: messages.Message) -> None:
        """Send a message to all other processes present."""
        for member in self.present():
            member.outbox.send(message)

    def settle(self, *, lost: Iterable[str] = (), left_out: Iterable[str] = ()) -> None:
        """State in hellos from now on that the run continues, with these nodes lost or left out."""
        lost, left_out = (*self.hello.lost, *lost), (*self.hello.left_out, *left_out)
        self.hello = msgspec.structs.replace(self.hello, running=True, lost=lost, left_out=left_out)

    async def close(self) -> None:
        """Send the waiting messages, and leave."""
        if self._handshakes is not None:
            await self._handshakes.close()

    # In threads of Zenoh's and of lines.

    def _receive(self, sender: str, sealed: bytes, payload: bytes) -> None:
        received = time.monotonic_ns()
        handshakes = self._handshakes
        assert handshakes is not None
        member = handshakes.member(sender)
        try:
            if member is None or is_hello(sealed):
                handshakes.receive(sender, sealed)
                return
            data = member.sealing.open(sealed, payload)
            message = messages.decode(data)
        except ForgedError as error:
            handshakes.refuse(sender, error)
            return
        except PeerError as error:  # another version
            self.soon(self.misfit, error)
            return
        except WireError as error:
            handshakes.end(sender, error)
            return
        event = None
        if isinstance(message, messages.EventMessage):
            try:
                event = member.event(message, payload)
            except Exception as error:  # counted all the same: in lockstep, all are awaited
                log.warning("from %s: %s", member.place, error)
        if isinstance(message, messages.Ack):
            member.acknowledged(message)
            return
        match message:
            case messages.Ping():  # answered here: a detour by the loop would take time
                member.outbox.send(messages.Pong(message.sent, received, self._peers.now()))
            case messages.Pong():
                half = (received - message.sent) // 2
                offset = message.here - message.sent - half
                late = message.now - self._peers.now(ago=half)
                member.exchanges.append(Exchange(received - message.sent, offset, late))
                self.soon(self.waiting.notify)
            case messages.Hello():
                pass
            case messages.MemoryOffer():
                member.incoming = Incoming.open_offer(message) if self._network.shared else None
                if member.incoming is not None:
                    member.outbox.send(messages.MemoryMapped())
            case messages.MemoryMapped():
                member.outbox.memory = member.outgoing
            case _:
                self.soon(self.deliver, member, message, event)
        member.acknowledge(len(data) + len(payload))

    def soon(self, call: Callable[..., Any], *args: Any) -> None:
        """Call a function on the loop, unless closed; for any thread."""
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(call, *args)

    # On the loop.

    def unsent(self, name: str, error: VisnavError) -> None:
        """Log a failure to send; the loss of a process is noticed elsewhere."""
        if self.ended is None:
            log.warning("to %s: %s", name, error)

    def deliver(self, member: Member, message: messages.OfTheRun, event: Event | None) -> None:
        """Pass on a message, unless its session has ended; invalid messages are logged."""
        try:
            if member.pending is not None:
                member.pending.append((message, event))
            elif member.unfit or member.over:
                log.debug("from %s, who is no part of this run: %s", member.place, message)
            else:
                self._peers.receive(member, message, event)
        except WireError as error:
            log.warning("from %s: %s", member.place, error)
        self.waiting.notify()

    def misfit(self, error: PeerError) -> None:
        """Handle an incompatible process: log during the run, fail before."""
        if self.hello.running:
            log.warning("%s", error)
        else:
            self.waiting.fail(error)

    def joined(self, member: Member) -> None:
        """Handle the start of a session with a process."""
        try:
            check_fits(self.hello, member.hello, self.nodes)
        except PeerError as error:
            if self.hello.began < member.hello.began:  # the newcomer gives up
                log.warning("left alone: %s", error)
                self._unfit = [str(error)]
            else:
                self.misfit(error)
            return
        if self.ended is not None:
            member.outbox.send(self.ended)
            return
        if self._network.shared and member.outgoing is None:
            member.outgoing = Outgoing()
            member.outbox.send(member.outgoing.offer())
        if self.count:
            number = next((n for n, s in self.seats.items() if s.nodes == member.nodes), -1)
            if number < 0:
                text = "left alone: %s, at %s: no process of this run had these nodes"
                log.warning(text, member.name, member.place)
                return
            seat = self.seats[number]
            if seat.member is not None:  # the one before has gone, but we do not know yet
                member.pending = member.pending or []
                return
            member.number, seat.member = number, member
            if seat.absent is not None:
                seat.absent = None
                log.warning("%s: back, at %s", member.name, member.place)
        member.unfit = False
        if self.count:
            self._peers.joined(member)
        self._number_all()
        pending, member.pending = member.pending, None
        for message, event in pending or ():
            self.deliver(member, message, event)
        self.waiting.notify()

    def left(self, member: Member, reason: str = "their process is gone") -> None:
        """Handle the end of a process's session."""
        if member.over:
            return
        member.over = reason
        member.lost_at = time.monotonic()
        member.outbox.abandon()
        early = not self.hello.running and self.ended is None
        if early and not member.unfit:
            log.warning("%s: waiting for its return", _loss(member))
        seat = self.seats.get(member.number)
        if seat is not None and seat.member is member:
            seat.member = None
            if early:
                seat.absent = member
                seat.first_loss = seat.first_loss or member.lost_at
            else:
                self._peers.lost(member)
            for other in self._handshakes.members() if self._handshakes else ():
                if other.pending is not None and other.nodes == member.nodes:
                    self.joined(other)
        self.waiting.notify()

    def _fitting(self) -> list[Member]:
        members = self._handshakes.members() if self._handshakes else []
        return [m for m in members if not (m.unfit or m.over)]

    def _missing(self) -> list[str]:
        present = {*self.here, *(node for member in self._fitting() for node in member.nodes)}
        return [node for node in self.nodes if node not in present]


class Waiting:
    """Waits of this process for conditions met by other processes.

    Args:
        startup_limit: Real seconds within which a process lost before the first update must return.
    """

    def __init__(self, seats: Mapping[int, Seat], startup_limit: float) -> None:
        self._seats = seats.values()
        self._startup_limit = startup_limit
        self._changed = asyncio.Event()
        self._broken: VisnavError | None = None

    async def until(
        self,
        condition: Callable[[], bool],
        *,
        despite: bool = False,
        is_awaited: Callable[[Member], bool] | None = None,
        limit: float = math.inf,
    ) -> None:
        """Wait until others meet a condition; holds simulated time unless `despite`.

        Args:
            condition: Checked after each message.
            despite: Continue waiting after a failure, as the run ends anyway.
            is_awaited: Returns whether a process is waited for; those are named in messages.
            limit: Real seconds after which it takes too long, with `is_awaited`. They count from
                the first loss of a process, if that is later: it has to start again.

        Raises:
            PeerError: It takes too long, or a process that was lost has not returned in time.
            VisnavError: The condition cannot be met any more; see `fail`.
        """
        start = time.monotonic()
        while True:
            if self._broken is not None and not despite:
                raise self._broken
            if condition():
                return
            gate = contextlib.nullcontext() if despite else _time_stands()
            remaining = min(NAMED_EVERY, max(self._time_left(start, limit), 0.0))
            patience = (
                contextlib.nullcontext() if is_awaited is None else real_time_limit(remaining)
            )
            try:
                with gate:
                    async with patience:
                        await self._changed.wait()
            except TimeoutError:
                assert is_awaited is not None
                self._report_slow(is_awaited, limit, late=self._time_left(start, limit) <= 0)

    def notify(self) -> None:
        """Make all waits check their conditions again."""
        self._changed.set()  # which wakes those that wait now
        self._changed.clear()

    def fail(self, error: VisnavError) -> None:
        """Make all waits fail."""
        self._broken = self._broken or error
        self.notify()

    def _time_left(self, start: float, limit: float) -> float:
        if limit == math.inf:
            return limit
        ends = [max([start, *(seat.first_loss for seat in self._seats)]) + limit]
        if not any(s.member and s.member.running for s in self._seats):  # else the run continues
            ends += [s.absent.lost_at + self._startup_limit for s in self._seats if s.absent]
        return min(ends) - time.monotonic()

    def _report_slow(
        self, is_awaited: Callable[[Member], bool], limit: float, *, late: bool
    ) -> None:
        members = [seat.member for seat in self._seats if seat.member]
        slow = "; ".join(f"{m.name} ({m.place})" for m in members if is_awaited(m))
        losses = "; ".join(_loss(seat.absent) for seat in self._seats if seat.absent)
        if late and losses:
            within = f"{self._startup_limit:g} s (run.startup_limit)"
            raise PeerError(f"{losses}: expected its return within {within}, found none") from None
        if late:
            within = f"{limit:g} s (of run.startup_limit for each node)"
            raise PeerError(f"expected a word within {within} of {slow}, found none") from None
        log.info("still waiting for %s", "; ".join(filter(None, [losses, slow])))


def _loss(member: Member) -> str:
    return f"{member.name}: {member.over} ({member.place})"


class _Closed:
    def may_go(self, key: messages.Key) -> bool:  # noqa: ARG002
        return False


@contextlib.contextmanager
def _time_stands() -> Iterator[None]:
    """Hold simulated time: other processes' delays must not decide the order of things due."""
    loop = asyncio.get_running_loop()
    if not isinstance(loop, LockstepLoop):
        yield
        return
    before, loop.gate = loop.gate, _Closed()
    try:
        yield
    finally:
        loop.gate = before
