"""The start and the end of a run in several processes.

At the start announcements are exchanged, and there is one first update for all.

A process passes through these states. On entering one it sends the message on the right to all
other processes:

    meeting     knows which processes are present, not yet all           `Hello`
    starting    all were present once and have numbers; its nodes start  `Announcements`
    ready       has all announcements; its nodes can begin               `Subscriptions`, `Ready`
    scheduled   knows the time of the first update                       `FirstUpdate`
    begun       the first update was                                     `Ready(begun=True)`

The first process decides; in a run that has begun already, it is the first process that has begun.
Once all are ready, it sends `FirstUpdate`. The others send it again, so that all receive it even if
the first process is lost meanwhile. A process begins once it has received `FirstUpdate` and all
present processes are ready: then it has the subscriptions of all of them.

Until a process begins, it waits up to `run.startup_limit` for the return of each lost process. So
does a process that is still needed for the decision. A process returns by itself (its link had
failed) or as a new process. Its return begins a session, and both ends send all their messages
again. So nothing depends on what was lost with the session before. A new process starts its nodes
again, and must announce the same as before, since other processes have received that. A loss after
the decision is a loss during the run, also for a process that has not received `FirstUpdate` yet.

At the end nodes end in reverse order of the file, wherever they are, and no process leaves before
all summaries are exchanged. Processes that are silent for long are not waited for.
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import Callable, Iterable, Mapping

import msgspec

from events import Announcement
from runtime.channels.wire import pack, unpack
from runtime.errors import PeerError, WireError
from runtime.summary import ProcessSummary, Summary, merged
from runtime.time.clock import Clock, RealClock
from runtime.time.lockstep import LockstepClock, LockstepLoop
from runtime.time.real_time import call_after, real_time_limit
from visnav_machines.member import Member
from visnav_machines.membership import Membership
from visnav_machines.messages import (
    Announcements,
    FinalSummary,
    FirstUpdate,
    Message,
    Ready,
    StillWorking,
    SummaryReceived,
)

log = logging.getLogger("visnav.runtime")

LEAD = 50_000_000
"""Nanoseconds from the starting message to the first update, for the message to reach all."""

BUSY_EVERY = 2.0  # seconds between two `StillWorking` messages while a node here ends
SILENCE = 8.0  # seconds without a message until the run ends without the silent processes
PARTING = 5.0  # seconds for the processes to exchange their summaries

_PARTS = msgspec.json.Decoder(Summary)
"""Made once: msgspec crashes if two threads learn a type at the same time."""


class JointStart:
    """Part of this process in the start of a run."""

    def __init__(self, membership: Membership, clock: Clock, startup_limit: float) -> None:
        self._membership = membership
        self._clock = clock
        self._startup_limit = startup_limit
        self._sent_messages: dict[type[Message], Message] = {}
        self._announced: dict[tuple[str, ...], Announcements] = {}

    async def announce(self, local: Mapping[str, Iterable[Announcement]]) -> list[Announcement]:
        """Send the announcements of the nodes here; return those of all, in file order."""
        self.send(
            Announcements(
                {name: tuple(bytes(pack(a).frame()) for a in sent) for name, sent in local.items()}
            )
        )
        membership = self._membership
        await self._until(
            lambda: self._is_complete() and all(m.announced for m in membership.present()),
            is_awaited=lambda m: m.announced is None,
        )
        announcements = dict(local)
        for member in membership.present():
            for name, frames in member.announced.by_node.items() if member.announced else ():
                try:
                    announcements[name] = [_announcement(frame) for frame in frames]
                except WireError as error:
                    raise PeerError(f"{name}, at {member.place}: {error}") from None
        return [a for name in membership.nodes for a in announcements.get(name, ())]

    async def wait_for_first_update(self) -> Member | None:
        """Agree with the others on the first update, wait for it, and return whose clock counts.

        A process that returns to a run that has begun joins it at its present time. `None` is this
        process.
        """
        membership, lockstep = self._membership, isinstance(self._clock, LockstepClock)
        while True:
            await self._until(self._is_complete, is_awaited=lambda _: False)
            reference = self._reference()
            if reference is not None and not lockstep:
                await reference.compare_clocks(membership.waiting.until)
            self.send(Ready())
            if await self._decided(reference):
                break
        if reference is None:
            origin = time.monotonic_ns() + LEAD
        else:
            assert reference.first_update is not None
            best = reference.best()
            origin = reference.first_update.origin - (best.offset if best else 0)
            if lockstep:
                loop = asyncio.get_running_loop()
                assert isinstance(loop, LockstepLoop)
                loop.move(reference.first_update.now, loop.orders())
        self.send(FirstUpdate(origin, self._clock.now()))
        if isinstance(self._clock, RealClock):
            await asyncio.sleep(max(origin - time.monotonic_ns(), 0) / 1e9)
            self._clock.start_at(origin)
        return reference and (membership.numbered(reference.number) or reference)

    async def _decided(self, reference: Member | None) -> bool:
        """Wait until the run begins; return whether by this reference."""
        membership = self._membership

        def ready() -> bool:
            return all(member.ready for member in membership.present())

        if reference is None:
            await self._until(
                lambda: self._reference() is not None or (self._is_complete() and ready()),
                is_awaited=lambda m: not m.ready,
            )
            return self._reference() is None

        def has_begun() -> bool:
            return reference.first_update is not None and ready()

        await self._until(
            lambda: reference.over != "" or has_begun(),
            is_awaited=lambda m: not m.ready or m is reference,
        )
        return has_begun()  # true also if the sender of `FirstUpdate` was lost since

    def send(self, message: Message) -> None:
        """Send a message to all processes, and to those joining or returning later."""
        if self._sent_messages.get(type(message)) != message:
            self._sent_messages[type(message)] = message
            self._membership.broadcast(message)

    def resend(self, member: Member) -> None:
        """Send a process all messages of this process about the start."""
        for _, message in sorted(self._sent_messages.items(), key=lambda item: item[0] is Ready):
            member.outbox.send(message)

    def mark_over(self) -> None:
        """Mark the start as over, also for processes arriving from now on."""
        del self._sent_messages[FirstUpdate]
        self._sent_messages[Ready] = Ready(begun=True)

    def record_announcements(self, member: Member, message: Announcements) -> None:
        """Record a process's announcements, of its nodes only, or raise `WireError`."""
        if not message.by_node.keys() <= {*member.nodes}:
            raise WireError("expected announcements of its own nodes")
        member.announced = message
        if self._announced.setdefault(member.nodes, message) != message:
            self._membership.misfit(
                PeerError(
                    f"expected {member.name}, which came back, to announce what it had "
                    f"announced before, found something else ({member.place})"
                )
            )

    def _is_complete(self) -> bool:
        return self._membership.complete() or any(m.running for m in self._membership.present())

    async def _until(
        self, condition: Callable[[], bool], *, is_awaited: Callable[[Member], bool]
    ) -> None:
        membership = self._membership
        largest = max(map(len, [membership.here, *(s.nodes for s in membership.seats.values())]))
        limit = self._startup_limit * (largest + 1)
        await membership.waiting.until(condition, is_awaited=is_awaited, limit=limit)

    def _reference(self) -> Member | None:
        present = self._membership.present()
        running = [m for m in present if m.running]
        first = next(iter(running or present), None)
        return first if first and (running or first.number < self._membership.me) else None


def _announcement(frame: bytes) -> Announcement:
    event = unpack(frame)
    if not isinstance(event, Announcement):
        raise WireError(f"expected an announcement, found {type(event).__name__}")
    return event


class JointShutdown:
    """Part of this process in the end of a run.

    Args:
        on_timeout: Called when the wait for some processes is given up.

    Attributes:
        at_work: Whether a node here is about to end.
        received_at: When the last message of another process came, on `time.monotonic`.
    """

    def __init__(self, membership: Membership, on_timeout: Callable[[], None]) -> None:
        self.ended_nodes: set[str] = set()
        self.at_work = False
        self.received_at = 0.0
        self._membership = membership
        self._on_timeout = on_timeout
        self._timer: threading.Timer | None = None
        self._with_summary: dict[int, Member] = {}

    def start_watching(self) -> None:
        """Check repeatedly, in real time, that the others still end."""
        self.received_at = time.monotonic()
        self._timer = call_after(BUSY_EVERY, asyncio.get_running_loop(), self._check_silence)

    def close(self) -> None:
        """Stop checking."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    async def wait_to_end(self, node: str) -> None:
        """Wait until all nodes after `node` have ended, in any process; "" precedes all."""
        membership = self._membership
        after = membership.nodes[membership.nodes.index(node) + 1 if node else 0 :]

        def is_awaited_member(member: Member) -> bool:
            return not {*after}.isdisjoint({*member.nodes} - self.ended_nodes)

        await membership.waiting.until(
            lambda: not any(map(is_awaited_member, membership.present())),
            despite=True,
            is_awaited=is_awaited_member,
        )
        self.at_work = bool(node)

    def record_summary(self, member: Member, message: FinalSummary) -> None:
        """Record a process's part of the summary, and confirm it; or raise `WireError`."""
        try:
            member.final_summary = _PARTS.decode(message.part)
        except (msgspec.DecodeError, RecursionError) as error:
            raise WireError(f"expected a part of the summary, found: {error}") from None
        self._with_summary[member.number] = member
        member.outbox.send(SummaryReceived())

    async def exchange_summaries(self, summary: Summary) -> Summary:
        """Exchange the processes' parts of the summary; return the merged summary."""
        membership = self._membership
        membership.broadcast(FinalSummary(msgspec.json.encode(summary)))
        try:
            async with real_time_limit(PARTING):
                await membership.waiting.until(
                    lambda: all(
                        m.final_summary and m.has_our_summary for m in membership.present()
                    ),
                    despite=True,
                )
        except TimeoutError:
            silent = [m.name for m in membership.present() if m.final_summary is None]
            log.warning("no summary of %s", "; ".join(silent))
        parts = {membership.me: summary}
        processes = {membership.me: ProcessSummary(list(membership.here), membership.hello.place)}
        for member in [*self._with_summary.values(), *membership.present()]:
            processes[member.number] = member.summary()
            if member.final_summary is not None:
                parts[member.number] = member.final_summary
        return merged(
            [part for _, part in sorted(parts.items())], [p for _, p in sorted(processes.items())]
        )

    def _check_silence(self) -> None:
        if self._timer is None:
            return
        membership = self._membership
        silent = [m for m in membership.present() if not m.has_our_summary]
        if self.at_work:
            membership.broadcast(StillWorking())
        elif time.monotonic() - self.received_at > SILENCE and silent:
            names = "; ".join(m.name for m in silent)
            log.error("%s: expected a word within %g s; the run ends without it", names, SILENCE)
            if membership.ended is not None:
                membership.broadcast(membership.ended)
            for member in silent:
                member.unfit, membership.seats[member.number].member = True, None
            self._on_timeout()
            membership.waiting.notify()
        self._timer = call_after(BUSY_EVERY, asyncio.get_running_loop(), self._check_silence)
