"""Who is there: the processes that have met, those that come, and those that go.

What Zenoh's threads bring is handed to the loop here; nothing else in this room knows of threads,
but the lines.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import socket
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any, Protocol

import msgspec

from events import Event
from runtime.config import Config
from runtime.errors import PeerError, VisnavError, WireError
from runtime.limits import real_time_limit
from runtime.peers.meeting import check_fits, missing, name_of, say_missing, what_all_share
from runtime.peers.member import Member
from runtime.peers.memory import Incoming, Outgoing
from runtime.peers.messages import (
    Ack,
    Hello,
    Mapped,
    Memory,
    OfTheRun,
    Ping,
    Pong,
    Said,
    decode,
)
from runtime.peers.offsets import Exchange
from runtime.peers.session import Session

log = logging.getLogger("visnav.runtime")

GREET_EVERY = 0.2
"""Seconds between two greetings of a process that has not answered."""


class Told(Protocol):
    """Who is told of what happens, on the loop."""

    def heard(self, member: Member, message: OfTheRun, event: Event | None) -> None:
        """Take in a message of a process of the run.

        Raises:
            WireError: It makes no sense.
        """

    def lost(self, member: Member) -> None:
        """Do without a process of the run."""

    def found_again(self, member: Member) -> None:
        """Go on with a process that went on without us, too."""

    def now(self, ago: int = 0) -> int:
        """Return the time of the run's clock, so many real nanoseconds ago; in any thread."""

    def unsent(self, member: Member, error: VisnavError) -> None:
        """Deal with what could not be sent to a process."""


class Roster:
    """The processes of a run.

    Args:
        config: The whole file.
        only: Nodes that run here.
        told: Told of messages and losses.

    Attributes:
        nodes: Of the whole file, in order.
        here: Those that run in this process, in order.
        me: Number of this process. They are numbered by their first nodes, once all have met.
        count: How many processes there are in all.
        hello: Who we are.
    """

    def __init__(self, config: Config, only: Iterable[str], told: Told) -> None:
        chosen = set(only)
        self.nodes = [spec.name for spec in config.nodes]
        self.here = tuple(name for name in self.nodes if name in chosen)
        self.me = 0
        self.count = 0
        self.hello = Hello(
            nodes=self.here,
            config=what_all_share(config),
            place=f"{socket.gethostname()}, process {os.getpid()}",
            began=time.time(),
        )
        self._run = config.run.name
        self._network = config.network
        self._told = told
        self._loop = asyncio.get_running_loop()
        self._session: Session | None = None
        self._lock = threading.Lock()
        self._members: dict[str, Member] = {}
        self._numbers: dict[tuple[str, ...], int] = {}
        self._numbered: dict[int, Member] = {}
        self._waiting: set[asyncio.Future[None]] = set()
        self._broken: VisnavError | None = None
        self._enough = threading.Event()

    async def meet(self) -> None:
        """Wait until all nodes of the file are there, and number their processes.

        Raises:
            PeerError: They are not within the limit, or somebody runs another file or our nodes.
        """
        network = self._network
        self._session = await asyncio.to_thread(Session, self._run, network)
        await asyncio.to_thread(self._session.appear, self._hear, self._see)
        threading.Thread(target=self._greet, name="greet", daemon=True).start()
        if absent := self._missing():
            log.info("waiting for %s at %s", name_of(absent), network.meet)
        try:
            async with real_time_limit(float(network.wait)):
                await self.until(lambda: not self._missing())
        except TimeoutError:
            text = say_missing(self._missing(), float(network.wait), network.meet)
            raise PeerError(text) from None
        others = self._fitting()
        everybody = sorted(
            [self.here, *(m.nodes for m in others)], key=lambda nodes: self.nodes.index(nodes[0])
        )
        self._numbers = {nodes: number for number, nodes in enumerate(everybody)}
        self.me, self.count = self._numbers[self.here], len(everybody)
        for member in others:
            member.number = self._numbers[member.nodes]
            self._numbered[member.number] = member

    def owners(self) -> dict[str, int]:
        """Return the number of the process that has each node."""
        return {node: number for nodes, number in self._numbers.items() for node in nodes}

    def present(self) -> list[Member]:
        """Return the other processes of the run that are there, in the order of their numbers."""
        return [member for _, member in sorted(self._numbered.items())]

    def numbered(self, number: int) -> Member | None:
        """Return the process with a number, if it is there."""
        return self._numbered.get(number)

    def ids(self) -> list[str]:
        """Return the ids of all that are there, this one's included."""
        assert self._session is not None
        return [self._session.id, *(m.id for m in self.present())]

    def settle(self, *, left_out: Iterable[str] = ()) -> None:
        """Say from now on that the run goes on, and without whom."""
        self._enough.set()
        self.hello = msgspec.structs.replace(self.hello, running=True, left_out=tuple(left_out))

    async def close(self) -> None:
        """Say the last words, and leave."""
        self._enough.set()
        with self._lock:
            members = list(self._members.values())
        for member in members:
            await asyncio.to_thread(member.line.close)
        if self._session is not None:
            await asyncio.to_thread(self._session.close)

    # Waiting for what others say.

    async def until(self, condition: Callable[[], bool], *, despite: bool = False) -> None:
        """Wait for something that others bring about.

        Args:
            condition: Looked at whenever something has come.
            despite: Go on waiting though something has failed: the run ends anyway.

        Raises:
            VisnavError: It will not come; see `fail`.
        """
        while True:
            if self._broken is not None and not despite:
                raise self._broken
            if condition():
                return
            future = self._loop.create_future()
            self._waiting.add(future)
            try:
                await future
            finally:
                self._waiting.discard(future)

    def notify(self) -> None:
        """Have all who wait look again."""
        for future in list(self._waiting):
            if not future.done():
                future.set_result(None)

    def fail(self, error: VisnavError) -> None:
        """Let all who wait fail."""
        self._broken = self._broken or error
        self.notify()

    # In threads of Zenoh's and of lines.

    def _hear(self, sender: str, head: bytes, payload: bytes) -> None:
        received = time.monotonic_ns()
        member = self._member(sender)
        try:
            message = decode(head)
            event = member.event(message, payload) if isinstance(message, Said) else None
        except WireError as error:
            log.warning("from %s: %s", member.place, error)
            return
        if isinstance(message, Ack):
            member.acknowledged(message)
            return
        match message:
            case Ping():  # answered here: a detour by the loop would take time
                member.line.send(Pong(message.sent, received, self._told.now()))
            case Pong():
                half = (received - message.sent) // 2
                offset = message.here - message.sent - half
                late = message.now - self._told.now(ago=half)
                member.exchanges.add(Exchange(received - message.sent, offset, late))
                self._soon(self.notify)
            case Memory():
                member.incoming = Incoming.found(message) if self._network.shared else None
                if member.incoming is not None:
                    member.line.send(Mapped())
            case Mapped():
                member.line.memory = member.outgoing
            case _:
                self._soon(self._take, member, message, event)
        member.acknowledge(len(head) + len(payload))

    def _see(self, other: str, here: bool) -> None:
        self._soon(self._came if here else self._went, self._member(other))

    def _greet(self) -> None:
        while not self._enough.wait(GREET_EVERY):
            with self._lock:
                members = list(self._members.values())
            for member in members:
                if member.hello is None:
                    member.line.send(self.hello)

    def _member(self, other: str) -> Member:
        with self._lock:
            if other not in self._members:

                def put(message: bytes, payload: bytes) -> None:
                    assert self._session is not None
                    self._session.put(other, message, payload)

                def failed(error: VisnavError) -> None:
                    self._soon(self._told.unsent, self._member(other), error)

                self._members[other] = Member(other, put, failed)
            return self._members[other]

    def _soon(self, call: Callable[..., Any], *args: Any) -> None:
        with contextlib.suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(call, *args)

    # On the loop.

    def _take(self, member: Member, message: Hello | OfTheRun, event: Event | None) -> None:
        try:
            if isinstance(message, Hello):
                self._meet(member, message)
            elif member.unfit:
                log.debug("from %s, who is no part of this run: %s", member.place, message)
            else:
                self._told.heard(member, message, event)
        except WireError as error:
            log.warning("from %s: %s", member.place, error)
        self.notify()

    def _meet(self, member: Member, hello: Hello) -> None:
        """Take in who somebody is, and say who we are if they do not know yet."""
        member.hello = hello
        if not hello.knows_you:
            member.line.send(msgspec.structs.replace(self.hello, knows_you=True))
        try:
            check_fits(self.hello, hello, self.nodes)
        except PeerError as error:
            member.unfit = True
            if self.hello.running or self.hello.began < hello.began:  # the newcomer gives up
                log.warning("left alone: %s", error)
            else:
                self.fail(error)
            return
        if self._network.shared and member.outgoing is None:
            member.outgoing = Outgoing()
            member.line.send(member.outgoing.offer())
        if self._numbers:
            number = self._numbers.get(hello.nodes, -1)
            member.unfit = number < 0 or self._numbered.get(number, member) is not member
            if not member.unfit and number not in self._numbered:
                member.number = number
                self._numbered[number] = member
                if hello.running and self.hello.running:
                    self._told.found_again(member)

    def _came(self, member: Member) -> None:
        if member.hello is None:
            member.line.send(self.hello)

    def _went(self, member: Member) -> None:
        member.line.abandon()
        with self._lock:
            self._members.pop(member.id, None)
        if self._numbered.get(member.number) is member:
            del self._numbered[member.number]
            self._told.lost(member)
        self.notify()

    def _fitting(self) -> list[Member]:
        with self._lock:
            members = list(self._members.values())
        return [m for m in members if m.hello is not None and not m.unfit]

    def _missing(self) -> list[str]:
        hellos = [m.hello for m in self._fitting() if m.hello is not None]
        return missing([self.hello, *hellos], self.nodes)
