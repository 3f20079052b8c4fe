"""The other processes of a run, as its supervisor sees them."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Iterable, Mapping
from typing import Protocol

import msgspec

from events import Announcement, Event
from runtime.clock import Clock
from runtime.config.model import Config
from runtime.errors import ChannelFullError, PeerError, VisnavError, WireError
from runtime.lockstep import LockstepClock, LockstepLoop
from runtime.peers.clock_sync import Following, compare
from runtime.peers.compatibility import name_of
from runtime.peers.joint_shutdown import Ending
from runtime.peers.member import Member
from runtime.peers.membership import Roster
from runtime.peers.messages import (
    Announced,
    Begin,
    Busy,
    Call,
    Farewell,
    Hearing,
    Message,
    OfTheRun,
    Ordered,
    Parted,
    Ready,
    Retired,
    Said,
    Standing,
    Stop,
    Turn,
)
from runtime.peers.remote_events import Crossing, hearing
from runtime.peers.time_token import Turns
from runtime.real_clock import RealClock
from runtime.sender import Listener
from runtime.summary import Summary
from runtime.tasks import Fault
from runtime.wire import pack, unpack

log = logging.getLogger("visnav.runtime")

LEAD = 50_000_000
"""Nanoseconds between the word to begin and the first update: it must reach everybody before."""


class Run(Protocol):
    """What the other processes can bring about here."""

    def stop(self, reason: str, error: Exception | None = None, *, told: bool = False) -> None:
        """End the run; `told` if another process says so."""

    def connect(self) -> None:
        """Freeze anew who hears whom."""


class Peers:
    """All processes of a run but this one.

    Args:
        config: The whole file.
        only: Nodes that run here.
        clock: The run's clock here.
        run: The run here.

    Attributes:
        ending: Our part in the end of it.
    """

    def __init__(self, config: Config, only: Iterable[str], clock: Clock, run: Run) -> None:
        self._config = config
        self._clock = clock
        self._run = run
        self._roster = Roster(config, only, self)
        self.ending = Ending(self._roster, self._gather)
        self._crossing: Crossing | None = None
        self._loop: LockstepLoop | None = None
        self._turns: Turns | None = None
        self._announced = Announced({})
        self._early: list[tuple[Member, OfTheRun, Event | None]] = []
        self._ready = self._decided = self._begun = self._suspended = self._ends = False
        self._decider: Member | None = None
        self._lost_early: list[Member] = []
        self._apart: set[int] = set()
        self._retired_here: list[str] = []
        self._following: Following | None = None
        self._followed = -1

    # Before the run.

    async def meet(self) -> int:
        """Wait until all nodes of the file are there.

        Returns:
            How often the nodes here were in this run before, in a process that was lost.

        Raises:
            PeerError: They are not within the limit, or somebody runs another file or our nodes.
        """
        roster = self._roster
        before = await roster.meet()
        self._crossing = Crossing(self._config.nodes, roster.owners(), roster.me, self._leave)
        if isinstance(self._clock, LockstepClock):
            loop = asyncio.get_running_loop()
            assert isinstance(loop, LockstepLoop)
            self._loop = loop
            self._turns = Turns(roster.me, roster.count, loop, self._send_to, self._do)
        return before

    async def announce(self, said: Mapping[str, Iterable[Announcement]]) -> list[Announcement]:
        """Tell the others what the nodes here announce; return what all do, in file order."""
        self._announced = Announced(
            {name: tuple(bytes(pack(a).frame()) for a in each) for name, each in said.items()}
        )
        self._roster.tell(self._announced)
        others = self._roster.present
        await self._roster.until(
            lambda: all(m.announced is not None for m in others()),
            whom=lambda m: m.announced is None,
            limit=self._start_up_limit(),
        )
        everything = dict(said)
        for member in others():
            if member.announced is not None:
                for name, frames in member.announced.said.items():
                    try:
                        everything[name] = [_announcement(frame) for frame in frames]
                    except WireError as error:
                        raise PeerError(f"{name}, at {member.place}: {error}") from None
        return [a for name in self._roster.nodes for a in everything.get(name, ())]

    async def begin(self) -> None:
        """Agree on when the first update is, and wait for it.

        One process decides that the run has begun, once all are ready. A loss before that ends
        the run; one after it is dealt with as in the run, also by those who hear of it before they
        hear that the run has begun. Who comes back to a run that goes on joins it where it is.
        """
        roster = self._roster
        reference = self._decider = self._reference()
        if reference is not None and self._turns is None:
            await compare(reference, roster.until)
        self._ready = True
        self._roster.tell(Ready())
        if reference is None:
            await roster.until(
                lambda: all(m.ready for m in roster.present()),
                whom=lambda m: not m.ready,
                limit=self._start_up_limit(),
            )
            self._decided = True
            origin = time.monotonic_ns() + LEAD
            self._roster.tell(Begin(origin))
        else:
            await roster.until(
                lambda: reference.begin is not None,
                whom=lambda m: not m.ready or m is reference,
                limit=self._start_up_limit(),
            )
            assert reference.begin is not None
            self._decided = True
            best = reference.exchanges.best()
            origin = reference.begin.origin - (best.offset if best else 0)
            if self._loop is not None:
                self._loop.move(reference.begin.now, self._loop.orders())
        if isinstance(self._clock, RealClock):
            await asyncio.sleep(max(origin - time.monotonic_ns(), 0) / 1e9)
            self._clock.start_at(origin)
            self._follow(reference)

    def _start_up_limit(self) -> float:
        """Return the real seconds that all nodes of another process may take to start up."""
        most = max((len(m.nodes) for m in self._roster.present()), default=1)
        return float(self._config.run.startup_limit) * (most + 1)

    def _follow(self, member: Member | None) -> None:
        if member is not None and isinstance(self._clock, RealClock):
            self._followed = member.number
            self._following = Following(self._clock, member)

    def begun(self) -> None:
        """Let what the others say arrive: the nodes here have begun."""
        self._begun = True
        self._roster.settle()
        if self._loop is not None:
            self._loop.move(0, (len(self._roster.nodes) << 33, self._roster.me << 32))
            self._gather()
        early, self._early = self._early, []
        for item in early:
            self.heard(*item)
        for member in self._lost_early:
            self.lost(member)

    # During the run.

    def listeners(self, output: str) -> list[Listener]:
        """Return who hears an output in other processes."""
        return self._crossing.listeners(output) if self._crossing else []

    def connect(self, listeners: list[Listener], fault: Fault) -> None:
        """Say who hears here what is said elsewhere, and tell the others."""
        if self._crossing is None:
            return
        self._crossing.connect(listeners, fault)
        wanted = hearing(each for each in listeners if each.node != "run")
        for member in self._roster.present():
            if member.told != wanted:
                member.told = wanted
                member.line.send(Hearing(wanted))

    def stopping(self, reason: str, error: Exception | None, *, told: bool) -> None:
        """Tell the others that the run ends, and why; also where one of them `told` us.

        They may hear it from us first.
        """
        self._ends = True
        text = None if error is None else str(error)
        stop = Stop(reason, text, apart=not self._begun)
        self._roster.ended = msgspec.structs.replace(stop, apart=True)
        if not self._begun:  # also those who said so: they need not wait for our turn
            self._roster.tell(stop)
            early, self._early = self._early, []
            for member, message, _ in early:
                if isinstance(message, Retired):
                    self._do(member.number, message, None)
        elif self._suspended:
            self._roster.tell(stop)
            self._gather()
        elif not told:
            self._tell_in_order(stop)
        self.ending.begin()

    def retired(self, node: str) -> None:
        """Tell the others that a node here has ended."""
        self.ending.at_work = False
        self._retired_here.append(node)
        self._tell_in_order(Retired(node))

    # After the run.

    async def close(self) -> None:
        """Say the last words, and leave."""
        self._ends = True
        self.ending.close()
        if self._following is not None:
            self._following.stop()
        self._turns = None
        if self._loop is not None:
            self._loop.gate = None
        await self._roster.close()

    # What the roster tells.

    def heard(self, member: Member, message: OfTheRun, event: Event | None) -> None:
        """Take in a message of another process.

        Raises:
            WireError: It makes no sense.
        """
        self.ending.heard_at = time.monotonic()
        match message:
            case Said() if self._begun and self._turns is None:  # first, since there are many
                self._do(member.number, message, event)
            case Announced():
                if not message.said.keys() <= {*member.nodes}:
                    raise WireError("expected announcements of its own nodes")
                member.announced = message
                if self._begun:  # it was gone, and needs ours again
                    member.line.send(self._announced)
            case Parted():
                try:
                    part = msgspec.json.decode(message.part, type=Summary)
                except (msgspec.DecodeError, RecursionError) as error:
                    raise WireError(f"expected a part of the summary, found: {error}") from None
                self.ending.parted(member, part)
            case Farewell():
                member.has_ours = True
            case Begin():
                member.begin = message
            case Ready() if not member.ready:
                member.ready = True
                if self._begun:
                    self._welcome(member)
            case Hearing() if self._crossing is not None:
                self._crossing.wants(member.number, message.wanted)
                if self._begun:
                    self._run.connect()
            case Busy() | Ready() | Hearing():
                pass
            case Stop() if not self._begun or message.serial < 0:
                if message.apart:
                    self._go_on_without(member)
                elif self._suspended:  # it is no use to wait for anybody's return
                    self._gather()
                self._do(member.number, message, None)
            case Retired() if message.node not in member.nodes:
                raise WireError(f"expected one of its nodes, found {message.node!r}")
            case Retired() if message.serial < 0 or (self._ends and not self._begun):
                self._do(member.number, message, None)
            case _ if not self._begun:
                if not self._ends:
                    self._early.append((member, message, event))
            case _ if self._turns is not None:
                self._turns.take(member.number, message, event)
            case Said() | Stop() | Retired():
                self._do(member.number, message, event)
            case Turn() | Call() | Standing() if not self._ends:
                raise WireError("expected the run to be in lockstep there, too")

    def lost(self, member: Member) -> None:
        """Deal with the loss of a process as its nodes' `on_error` says."""
        if not (self._begun or self._ends) and (
            self._decided or (self._ready and self._decider not in {None, member})
        ):
            self._lost_early.append(member)
            return
        lost = set(member.nodes) - self.ending.retired
        self.ending.retired |= lost
        name = name_of(member.nodes)
        gone = PeerError(f"{name}: {member.over} ({member.place})")
        if not (self._begun or self._ends):
            self._roster.fail(gone)
            return
        if self._ends or not lost:
            if lost:
                log.warning("%s: the run ends without it", gone)
                if self._begun and self._turns is not None and self._roster.ended is not None:
                    # Others may wait for its return, and not for their turn.
                    self._roster.tell(msgspec.structs.replace(self._roster.ended, apart=False))
            self._gather()
            return
        if self._following is not None and self._following.member is member:
            self._following.go_on_alone()
        if self._crossing is not None:
            self._crossing.wants(member.number, ())
        rules = {spec.on_error for spec in self._config.nodes if spec.name in lost}
        if "stop" in rules:
            log.error("%s", gone, extra={"told": True})
            self._gather()
            self._run.stop(f"{name} lost", gone)
        elif "restart" in rules:
            log.error("%s: waiting for its return", gone)
            self._roster.settle(lost=member.nodes)
            if self._turns is not None:
                self._suspended = True
                self._turns.suspend()
        else:
            log.error("%s: left out from here on", gone)
            self._roster.settle(left_out=lost)
            self._gather()
        self._run.connect()

    def found_again(self, member: Member) -> None:
        """Go on with a process that the network had parted from us."""
        log.warning("%s: found again, at %s", name_of(member.nodes), member.place)
        self._take_back(member)
        if member.number == self._followed:
            self._follow(member)

    def now(self, ago: int = 0) -> int:
        """Return the time of the run's clock, so many real nanoseconds ago; in any thread."""
        speed = self._clock.speed if isinstance(self._clock, RealClock) else 0
        return self._clock.now() - round(ago * speed)

    def unsent(self, member: Member, error: VisnavError) -> None:
        """Say what could not be sent; that a process has gone is noticed elsewhere."""
        if not self._ends:
            log.warning("to %s: %s", name_of(member.nodes), error)

    def _do(self, number: int, message: Ordered, event: Event | None) -> None:
        """Do what another process says; in lockstep, at our turn."""
        try:
            match message:
                case Said() if self._crossing is not None and event is not None:
                    self._crossing.arrive(number, message.output, event)
                case Stop():
                    member = self._roster.numbered(number)
                    where = name_of(member.nodes) if member else "?"
                    failed = PeerError(f"at {where}: {message.error}") if message.error else None
                    self._run.stop(message.reason, failed, told=True)
                case Retired():
                    self.ending.retired.add(message.node)
        except WireError as error:
            log.warning("from process %d: %s", number, error)
        self._roster.notify()

    def _welcome(self, member: Member) -> None:
        """Let a process that was gone take part again."""
        log.warning("%s: back, at %s", name_of(member.nodes), member.place)
        now = self._clock.now()
        real = now / self._clock.speed if isinstance(self._clock, RealClock) else 0
        member.line.send(Begin(time.monotonic_ns() - round(real), now))
        self._take_back(member)

    def _take_back(self, member: Member) -> None:
        self.ending.retired -= {*member.nodes}
        self._apart.discard(member.number)
        self._gather(new=(member.number,))
        self._run.connect()

    def _gather(self, new: tuple[int, ...] = ()) -> None:
        """In lockstep, share the turns among those who are there."""
        if self._turns is None or self._loop is None or not self._begun:
            return
        self._suspended = False
        present = [m for m in self._roster.present() if m.number not in self._apart]
        self._loop.gate = self._turns if present else None
        if present:
            numbers = [self._roster.me, *(m.number for m in present)]
            self._turns.gather(numbers, [self._roster.id, *(m.id for m in present)], new)

    def _go_on_without(self, member: Member) -> None:
        """Take a process out of the turns: it has not begun, or has given up."""
        self._apart.add(member.number)
        for node in self._retired_here:  # what was to be said at our turn is lost
            member.line.send(Retired(node))
        self._gather()

    def _reference(self) -> Member | None:
        """Return the process whose clock counts, or `None` if it is this one."""
        present = self._roster.present()
        running = [m for m in present if m.hello.running]
        first = min(running or present, key=lambda m: m.number, default=None)
        return first if first and (running or first.number < self._roster.me) else None

    # Sending.

    def _tell_in_order(self, message: Ordered) -> None:
        """Send a message that others take in in its place among the events."""
        for member in self._roster.present():
            if self._turns is not None and self._begun and member.number not in self._apart:
                self._turns.post(member.number, message)
            else:
                member.line.send(message)

    def _leave(self, process: int, output: str, event: Event, skip: bool) -> None:
        """Let an event leave for another process."""
        if self._turns is not None:
            self._turns.post(process, Said(output), event)
        elif member := self._roster.numbered(process):
            try:
                member.line.send(Said(output), event, output if skip else "")
            except ChannelFullError as error:
                raise ChannelFullError(f"{output}: {error}") from None

    def _send_to(self, number: int, message: Message, event: Event | None) -> None:
        if member := self._roster.numbered(number):
            member.line.send(message, event)


def _announcement(frame: bytes) -> Announcement:
    event = unpack(frame)
    if not isinstance(event, Announcement):
        raise WireError(f"expected an announcement, found {type(event).__name__}")
    return event
