"""The end of a run in several processes: in order, and not for ever.

Nodes end in reverse order of the file, wherever they are, and nobody leaves before all know what
each has to say. Those who say nothing for long are not waited for.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
import time
from collections.abc import Callable

import msgspec

from runtime.peers.compatibility import name_of
from runtime.peers.member import Member
from runtime.peers.membership import Roster
from runtime.peers.messages import Busy, Farewell, Parted
from runtime.summary import ProcessSummary, Summary, merged
from runtime.time_limits import real_time_limit

log = logging.getLogger("visnav.runtime")

BUSY_EVERY = 2.0
"""Seconds after which those who wait for us in the end are told that we are still at it."""

SILENCE = 8.0
"""Seconds without a word in the end, after which it goes on without those who are silent."""

PARTING = 5.0
"""Seconds that a process has, in the end, to tell what there was."""


class Ending:
    """Our part in the end of a run.

    Args:
        roster: Who is there.
        went: Told that some are not waited for any more.

    Attributes:
        retired: Nodes of other processes that have ended.
        at_work: Whether a node here is about to end.
        heard_at: When the last word of another process came, on `time.monotonic`.
    """

    def __init__(self, roster: Roster, went: Callable[[], None]) -> None:
        self.retired: set[str] = set()
        self.at_work = False
        self.heard_at = 0.0
        self._roster = roster
        self._went = went
        self._timer: threading.Timer | None = None
        self._parted: dict[int, Member] = {}

    def begin(self) -> None:
        """Look from now on, in real time, whether the end goes on."""
        self.heard_at = time.monotonic()
        self._watch()

    def close(self) -> None:
        """Look no more."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    async def turn(self, node: str) -> None:
        """Wait until all nodes after this one have ended, wherever they are; "" is before all."""
        nodes = self._roster.nodes
        after = set(nodes[nodes.index(node) + 1 if node else 0 :])
        await self._roster.until(
            lambda: not any(after & {*m.nodes} - self.retired for m in self._roster.present()),
            despite=True,
            whom=lambda m: bool(after & {*m.nodes} - self.retired),
        )
        self.at_work = bool(node)

    def parted(self, member: Member, part: Summary) -> None:
        """Take in what another process has to say of the run."""
        member.parted = part
        self._parted[member.number] = member
        member.line.send(Farewell())

    async def part(self, mine: Summary) -> Summary:
        """Exchange what each process has to say of the run; return all of it together."""
        roster = self._roster
        roster.tell(Parted(msgspec.json.encode(mine)))
        try:
            async with real_time_limit(PARTING):
                await roster.until(
                    lambda: all(m.parted and m.has_ours for m in roster.present()), despite=True
                )
        except TimeoutError:
            silent = [name_of(m.nodes) for m in roster.present() if m.parted is None]
            log.warning("no summary of %s", "; ".join(silent))
        parts = {roster.me: mine}
        processes = {roster.me: ProcessSummary(list(roster.here), roster.hello.place)}
        for member in [*self._parted.values(), *roster.present()]:
            processes[member.number] = member.summary()
            if member.parted is not None:
                parts[member.number] = member.parted
        return merged(
            [part for _, part in sorted(parts.items())], [p for _, p in sorted(processes.items())]
        )

    def _watch(self) -> None:
        loop = asyncio.get_running_loop()

        def ring() -> None:
            with contextlib.suppress(RuntimeError):  # the loop is closed
                loop.call_soon_threadsafe(self._look)

        self._timer = threading.Timer(BUSY_EVERY, ring)
        self._timer.daemon = True
        self._timer.start()

    def _look(self) -> None:
        if self._timer is None:
            return
        if self.at_work:
            self._roster.tell(Busy())
        elif time.monotonic() - self.heard_at > SILENCE:
            self._give_up()
        self._watch()

    def _give_up(self) -> None:
        """End without those who say nothing."""
        roster = self._roster
        if silent := [m for m in roster.present() if not m.has_ours]:
            names = "; ".join(name_of(m.nodes) for m in silent)
            log.error("%s: expected a word within %g s; the run ends without it", names, SILENCE)
            if roster.ended is not None:
                roster.tell(roster.ended)
            for member in silent:
                roster.forget(member)
            self._went()
            roster.notify()
