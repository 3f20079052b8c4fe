"""The start of a run in several processes: announcements exchanged, and one first update for all.

One process decides that the run has begun, once all are ready. A loss before that ends the run;
one after it is dealt with as in the run, also by a process that learns of it before it learns that
the run has begun.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterable, Mapping

from events import Announcement
from runtime.clock import Clock
from runtime.errors import PeerError, WireError
from runtime.lockstep import LockstepClock, LockstepLoop
from runtime.peers.clock_sync import compare
from runtime.peers.member import Member
from runtime.peers.membership import Membership
from runtime.peers.messages import Announcements, FirstUpdate, Ready
from runtime.real_clock import RealClock
from runtime.wire import pack, unpack

LEAD = 50_000_000
"""Nanoseconds between the message to begin and the first update: it must reach all before."""


class JointStart:
    """Our part in the start of a run.

    Args:
        membership: Who is there.
        clock: The run's clock here.
        startup_limit: Seconds that one node may take to start up.

    Attributes:
        announced: What the nodes here announce, as the others receive it.
    """

    def __init__(self, membership: Membership, clock: Clock, startup_limit: float) -> None:
        self.announced = Announcements({})
        self._membership = membership
        self._clock = clock
        self._startup_limit = startup_limit
        self._ready = self._decided = False
        self._decider: Member | None = None

    async def announce(self, own: Mapping[str, Iterable[Announcement]]) -> list[Announcement]:
        """Send the others what the nodes here announce; return what all do, in file order."""
        self.announced = Announcements(
            {name: tuple(bytes(pack(a).frame()) for a in each) for name, each in own.items()}
        )
        self._membership.broadcast(self.announced)
        others = self._membership.present
        await self._membership.until(
            lambda: all(m.announced is not None for m in others()),
            whom=lambda m: m.announced is None,
            limit=self._limit(),
        )
        everything = dict(own)
        for member in others():
            if member.announced is not None:
                for name, frames in member.announced.by_node.items():
                    try:
                        everything[name] = [_announcement(frame) for frame in frames]
                    except WireError as error:
                        raise PeerError(f"{name}, at {member.place}: {error}") from None
        return [a for name in self._membership.nodes for a in everything.get(name, ())]

    async def begin(self) -> Member | None:
        """Agree on when the first update is, and wait for it.

        A process that comes back to a run that goes on joins it where it is.

        Returns:
            The process whose clock counts, or `None` if it is this one.
        """
        membership, lockstep = self._membership, isinstance(self._clock, LockstepClock)
        reference = self._decider = self._reference()
        if reference is not None and not lockstep:
            await compare(reference, membership.until)
        self._ready = True
        membership.broadcast(Ready())
        if reference is None:
            await membership.until(
                lambda: all(m.ready for m in membership.present()),
                whom=lambda m: not m.ready,
                limit=self._limit(),
            )
            self._decided = True
            origin = time.monotonic_ns() + LEAD
            membership.broadcast(FirstUpdate(origin))
        else:
            await membership.until(
                lambda: reference.begin is not None,
                whom=lambda m: not m.ready or m is reference,
                limit=self._limit(),
            )
            assert reference.begin is not None
            self._decided = True
            best = reference.exchanges.best()
            origin = reference.begin.origin - (best.offset if best else 0)
            if lockstep:
                loop = asyncio.get_running_loop()
                assert isinstance(loop, LockstepLoop)
                loop.move(reference.begin.now, loop.orders())
        if isinstance(self._clock, RealClock):
            await asyncio.sleep(max(origin - time.monotonic_ns(), 0) / 1e9)
            self._clock.start_at(origin)
        return reference

    def may_have_begun(self, lost: Member) -> bool:
        """Return whether the run may have begun although a process has been lost here."""
        return self._decided or (self._ready and self._decider not in {None, lost})

    def _limit(self) -> float:
        """Return the real seconds that all nodes of another process may take to start up."""
        most = max((len(m.nodes) for m in self._membership.present()), default=1)
        return self._startup_limit * (most + 1)

    def _reference(self) -> Member | None:
        """Return the process whose clock counts, or `None` if it is this one."""
        present = self._membership.present()
        running = [m for m in present if m.hello.running]
        first = min(running or present, key=lambda m: m.number, default=None)
        return first if first and (running or first.number < self._membership.me) else None


def _announcement(frame: bytes) -> Announcement:
    event = unpack(frame)
    if not isinstance(event, Announcement):
        raise WireError(f"expected an announcement, found {type(event).__name__}")
    return event
