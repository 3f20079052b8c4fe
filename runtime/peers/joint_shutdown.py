"""The end of a run in several processes: in order, and not for ever.

Nodes end in reverse order of the file, wherever they are, and no process leaves before all
summaries are exchanged. Processes that are silent for long are not waited for.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
import time
from collections.abc import Callable

import msgspec

from runtime.errors import WireError
from runtime.peers.compatibility import name_of
from runtime.peers.member import Member
from runtime.peers.membership import Membership
from runtime.peers.messages import FinalSummary, StillWorking, SummaryReceived
from runtime.summary import ProcessSummary, Summary, merged
from runtime.time.time_limits import real_time_limit

log = logging.getLogger("visnav.runtime")

_PARTS = msgspec.json.Decoder(Summary)
"""Made once: msgspec crashes if two threads learn a type at the same time."""

BUSY_EVERY = 2.0
"""Seconds between two messages that this process is still ending its nodes."""

SILENCE = 8.0
"""Seconds without a message, after which the end goes on without the silent processes."""

PARTING = 5.0
"""Seconds that the processes have to exchange their summaries."""


class JointShutdown:
    """Our part in the end of a run.

    Args:
        membership: Who is there.
        on_timeout: Called when some are not waited for any more.

    Attributes:
        ended_nodes: Nodes of other processes that have ended.
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

    def begin(self) -> None:
        """Look from now on, in real time, whether the end goes on."""
        self.received_at = time.monotonic()
        self._watch()

    def close(self) -> None:
        """Look no more."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    async def wait_to_end(self, node: str) -> None:
        """Wait until all nodes after this one have ended, wherever they are; "" is before all."""
        nodes = self._membership.nodes
        after = set(nodes[nodes.index(node) + 1 if node else 0 :])
        await self._membership.waiting.until(
            lambda: (
                not any(after & {*m.nodes} - self.ended_nodes for m in self._membership.present())
            ),
            despite=True,
            whom=lambda m: bool(after & {*m.nodes} - self.ended_nodes),
        )
        self.at_work = bool(node)

    def receive(
        self, member: Member, message: FinalSummary | SummaryReceived | StillWorking
    ) -> None:
        """Take in another process's part of the summary, or that it has ours.

        Raises:
            WireError: It is no summary.
        """
        if isinstance(message, SummaryReceived):
            member.has_our_summary = True
        if not isinstance(message, FinalSummary):
            return
        try:
            member.final_summary = _PARTS.decode(message.part)
        except (msgspec.DecodeError, RecursionError) as error:
            raise WireError(f"expected a part of the summary, found: {error}") from None
        self._with_summary[member.number] = member
        member.outbox.send(SummaryReceived())

    async def exchange_summaries(self, mine: Summary) -> Summary:
        """Exchange each process's part of the summary; return all of it together."""
        membership = self._membership
        membership.broadcast(FinalSummary(msgspec.json.encode(mine)))
        try:
            async with real_time_limit(PARTING):
                await membership.waiting.until(
                    lambda: all(
                        m.final_summary and m.has_our_summary for m in membership.present()
                    ),
                    despite=True,
                )
        except TimeoutError:
            silent = [name_of(m.nodes) for m in membership.present() if m.final_summary is None]
            log.warning("no summary of %s", "; ".join(silent))
        parts = {membership.me: mine}
        processes = {membership.me: ProcessSummary(list(membership.here), membership.hello.place)}
        for member in [*self._with_summary.values(), *membership.present()]:
            processes[member.number] = member.summary()
            if member.final_summary is not None:
                parts[member.number] = member.final_summary
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
            self._membership.broadcast(StillWorking())
        elif time.monotonic() - self.received_at > SILENCE:
            self._give_up()
        self._watch()

    def _give_up(self) -> None:
        """End without the silent processes."""
        membership = self._membership
        if silent := [m for m in membership.present() if not m.has_our_summary]:
            names = "; ".join(name_of(m.nodes) for m in silent)
            log.error("%s: expected a word within %g s; the run ends without it", names, SILENCE)
            if membership.ended is not None:
                membership.broadcast(membership.ended)
            for member in silent:
                membership.forget(member)
            self._on_timeout()
            membership.waiting.notify()
