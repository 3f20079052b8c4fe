"""Presence of the run's processes: meeting, joining and leaving.

Messages from Zenoh's threads are handed to the loop here; of the rest of this package, only
handshakes and outboxes know of threads.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import socket
import time
from collections.abc import Callable, Iterable
from typing import Any, Protocol

import msgspec

from events import Event
from runtime.config.model import Config
from runtime.errors import PeerError, VisnavError, WireError
from runtime.peers import messages
from runtime.peers.authentication import ForgedError, derive, is_hello, secret_of
from runtime.peers.handshake import (
    Handshakes,
    check_fits,
    missing,
    missing_message,
    name_of,
    what_all_share,
)
from runtime.peers.member import Exchange, Member
from runtime.peers.shared_memory import Incoming, Outgoing
from runtime.peers.waiting import Waiting
from runtime.peers.zenoh_session import Session, certified
from runtime.time.time_limits import real_time_limit

log = logging.getLogger("visnav.runtime")

ALONE = 1.0
"""Seconds without another process until a check of the meeting place: nobody listens there if the
listening process ended just after we connected to it.
"""


class Reactions(Protocol):
    """Receiver of the other processes' messages, arrivals and losses, on the loop."""

    def receive(self, member: Member, message: messages.OfTheRun, event: Event | None) -> None:
        """Take in a message."""

    def lost(self, member: Member) -> None:
        """Deal with the loss of a process in the run."""

    def joined(self, member: Member) -> None:
        """Handle a process joining or returning after the numbering of processes."""

    def unsent(self, member: Member, error: VisnavError) -> None:
        """Log a failure to send."""

    def now(self, ago: int = 0) -> int:
        """Return the time of the run's clock, so many real nanoseconds ago; in any thread."""


class Membership:
    """The processes of a run.

    Args:
        peers: Notified, on the loop, of messages and losses.

    Attributes:
        here: Those that run in this process, in order.
        me: Number of this process. They are numbered by their first nodes, once all have met.
        waiting: For other processes, and for the return of those lost before the first update.
        ended: Once the run ends, what is sent to processes that join.
    """

    def __init__(self, config: Config, only: Iterable[str], peers: Reactions) -> None:
        chosen = set(only)
        self.nodes = [spec.name for spec in config.nodes]
        self.here = tuple(name for name in self.nodes if name in chosen)
        self.me = 0
        self.count = 0
        self._before = 0
        self.hello = messages.Hello(
            nodes=self.here,
            config=what_all_share(config),
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
        self._numbers: dict[tuple[str, ...], int] = {}
        self._numbered: dict[int, Member] = {}
        self.waiting = Waiting(self.present, float(config.run.startup_limit))

    async def meet(self) -> int:
        """Wait until all nodes of the file are there, and number their processes.

        Returns:
            How often a process with our nodes was in this run before.

        Raises:
            PeerError: They are not within the limit, or one runs another file or our nodes.
        """
        network = self._network
        by_certificate = not network.secret and certified(network)
        secret = b"known by certificate" if by_certificate else secret_of(network.secret)
        await self._appear(secret)
        if absent := self._missing():
            log.info("waiting for %s at %s", name_of(absent), network.meet)
        try:
            async with real_time_limit(float(network.wait)):
                while True:
                    with contextlib.suppress(TimeoutError):
                        async with real_time_limit(ALONE):
                            return await self.numbers()
                    if self._handshakes and await self._handshakes.alone():
                        await self._handshakes.close()
                        await self._appear(secret)
        except TimeoutError:
            text = missing_message(self._missing(), float(network.wait), network.meet)
            raise PeerError("; ".join([text, *self._unfit])) from None

    async def _appear(self, secret: bytes) -> None:
        session = await asyncio.to_thread(Session, self._run, self._network, secret)
        self._handshakes = Handshakes(derive(secret, "run", self._run), session, self)
        await asyncio.to_thread(self._handshakes.begin, self._receive)

    async def numbers(self) -> int:
        """Wait until all were there once, and have numbers; see `meet`."""
        await self.waiting.until(self._number_all)
        return self._before

    def _number_all(self) -> bool:
        if self._numbers:
            return True
        if self._missing():
            return False
        others = self._fitting()
        everybody = sorted(
            [self.here, *(m.nodes for m in others)], key=lambda nodes: self.nodes.index(nodes[0])
        )
        self._numbers = {nodes: number for number, nodes in enumerate(everybody)}
        self.me, self.count = self._numbers[self.here], len(everybody)
        for member in others:
            member.number = self._numbers[member.nodes]
            self._numbered[member.number] = member
        running = [m.hello for m in others if m.hello.running]
        self._before = max((max(h.lost.count(self.here[0]), 1) for h in running), default=0)
        return True

    def largest(self) -> int:
        """Return how many nodes the process with the most has."""
        return max(map(len, self._numbers))

    def owners(self) -> dict[str, int]:
        """Return the number of each node's process."""
        return {node: number for nodes, number in self._numbers.items() for node in nodes}

    def present(self) -> list[Member]:
        """Return the other processes present, in the order of their numbers."""
        return [member for _, member in sorted(self._numbered.items())]

    def complete(self) -> bool:
        """Return whether all processes of the run are there."""
        return len(self._numbered) == self.count - 1

    def numbered(self, number: int) -> Member | None:
        """Return the process of a number, if present."""
        return self._numbered.get(number)

    @property
    def id(self) -> str:
        """Id of this process among the others."""
        assert self._handshakes is not None
        return self._handshakes.id

    def broadcast(self, message: messages.Message) -> None:
        """Send a message to all other processes present."""
        for member in self.present():
            member.outbox.send(message)

    def forget(self, member: Member) -> None:
        """Go on as if a process were gone."""
        member.unfit = True
        self._numbered.pop(member.number, None)

    def settle(self, *, lost: Iterable[str] = (), left_out: Iterable[str] = ()) -> None:
        """State in hellos from now on: the run goes on, with these nodes lost or left out."""
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
            except Exception as error:  # it is counted all the same: in lockstep, all are awaited
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
                member.exchanges.add(Exchange(received - message.sent, offset, late))
                self.soon(self.waiting.notify)
            case messages.Hello():
                pass
            case messages.MemoryOffer():
                member.incoming = Incoming.found(message) if self._network.shared else None
                if member.incoming is not None:
                    member.outbox.send(messages.MemoryMapped())
            case messages.MemoryMapped():
                member.outbox.memory = member.outgoing
            case _:
                self.soon(self.take, member, message, event)
        member.acknowledge(len(data) + len(payload))

    def soon(self, call: Callable[..., Any], *args: Any) -> None:
        """Call a function on the loop, unless closed; for any thread."""
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(call, *args)

    def unsent(self, member: Member, error: VisnavError) -> None:
        """Pass on a failure to send."""
        self.soon(self._peers.unsent, member, error)

    # On the loop.

    def take(self, member: Member, message: messages.OfTheRun, event: Event | None) -> None:
        """Pass on a message, unless its session has ended; invalid messages are logged."""
        try:
            if member.held is not None:
                member.held.append((message, event))
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
        if self._numbers:
            number = self._numbers.get(member.nodes, -1)
            if number in self._numbered:  # the one before has gone, but we do not know yet
                member.held = member.held or []
                return
            if number < 0:
                text = "left alone: %s, at %s: no process of this run had these nodes"
                log.warning(text, name_of(member.nodes), member.place)
                return
            member.number = number
            self._numbered[number] = member
            self.waiting.returned(member)
        member.unfit = False
        if self._numbers:
            self._peers.joined(member)
        self._number_all()
        held, member.held = member.held, None
        for message, event in held or ():
            self.take(member, message, event)
        self.waiting.notify()

    def left(self, member: Member, why: str = "their process is gone") -> None:
        """Go on without a process whose session has ended."""
        if member.over:
            return
        member.over = why
        member.lost_at = time.monotonic()
        member.outbox.abandon()
        early = not self.hello.running and self.ended is None
        if early and not member.unfit:
            self.waiting.lost(member)
        if self._numbered.get(member.number) is member:
            del self._numbered[member.number]
            if not early:
                self._peers.lost(member)
            for other in self._handshakes.members() if self._handshakes else ():
                if other.held is not None and other.nodes == member.nodes:
                    self.joined(other)
        self.waiting.notify()

    def _fitting(self) -> list[Member]:
        members = self._handshakes.members() if self._handshakes else []
        return [m for m in members if not (m.unfit or m.over)]

    def _missing(self) -> list[str]:
        return missing([self.hello, *(m.hello for m in self._fitting())], self.nodes)
