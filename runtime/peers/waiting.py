"""Waiting for other processes: slow processes are named, and none is awaited for ever."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import time
from collections.abc import Callable, Iterable, Iterator

from runtime.errors import PeerError, VisnavError
from runtime.peers.handshake import name_of
from runtime.peers.member import Member
from runtime.peers.messages import Key
from runtime.time.lockstep import LockstepLoop
from runtime.time.time_limits import real_time_limit

log = logging.getLogger("visnav.runtime")

NAMED_EVERY = 5.0  # real seconds between two log lines naming the awaited processes


class Waiting:
    """Waits of this process for conditions met by other processes.

    Args:
        startup_limit: Real seconds within which a process lost before the first update must return.

    Attributes:
        absent: Those processes, by number, until they return.
    """

    def __init__(self, present: Callable[[], Iterable[Member]], startup_limit: float) -> None:
        self.absent: dict[int, Member] = {}
        self._present = present
        self._startup_limit = startup_limit
        self._first_losses: dict[int, float] = {}
        self._futures: set[asyncio.Future[None]] = set()
        self._broken: VisnavError | None = None

    async def until(
        self,
        condition: Callable[[], bool],
        *,
        despite: bool = False,
        whom: Callable[[Member], bool] | None = None,
        limit: float = math.inf,
    ) -> None:
        """Wait until others meet a condition; holds simulated time unless `despite`.

        Args:
            condition: Checked whenever something has come.
            despite: Go on waiting though something has failed: the run ends anyway.
            whom: Tells who is waited for; they are named when it takes long.
            limit: Real seconds after which it takes too long, if `whom` is given. They count from
                the first loss of a process, if that is later: it has to start again.

        Raises:
            PeerError: It takes too long, or a process that was lost has not returned in time.
            VisnavError: It will not come; see `fail`.
        """
        begin = time.monotonic()
        while True:
            if self._broken is not None and not despite:
                raise self._broken
            if condition():
                return
            future = asyncio.get_running_loop().create_future()
            self._futures.add(future)
            try:
                with contextlib.nullcontext() if despite else _time_stands():
                    if whom is None:
                        await future
                    else:
                        left = self._time_left(begin, limit)
                        async with real_time_limit(min(NAMED_EVERY, max(left, 0.0))):
                            await future
            except TimeoutError:
                assert whom is not None
                self._name(whom, limit, late=self._time_left(begin, limit) <= 0)
            finally:
                self._futures.discard(future)

    def notify(self) -> None:
        """Have all waits check their conditions again."""
        for future in list(self._futures):
            if not future.done():
                future.set_result(None)

    def fail(self, error: VisnavError) -> None:
        """Let all waits fail."""
        self._broken = self._broken or error
        self.notify()

    def lost(self, member: Member) -> None:
        """Await the return of a process lost before the first update."""
        log.warning("%s: waiting for its return", _loss(member))
        if member.number >= 0:
            self.absent[member.number] = member
            self._first_losses.setdefault(member.number, member.lost_at)

    def returned(self, member: Member) -> None:
        """Record a process as present, perhaps after an absence."""
        if self.absent.pop(member.number, None) is not None:
            log.warning("%s: back, at %s", name_of(member.nodes), member.place)

    def _time_left(self, begin: float, limit: float) -> float:
        if limit == math.inf:
            return limit
        ends = [max([begin, *self._first_losses.values()]) + limit]
        if not any(member.running for member in self._present()):  # else the run goes on without
            ends += [member.lost_at + self._startup_limit for member in self.absent.values()]
        return min(ends) - time.monotonic()

    def _name(self, whom: Callable[[Member], bool], limit: float, *, late: bool) -> None:
        slow = "; ".join(f"{name_of(m.nodes)} ({m.place})" for m in self._present() if whom(m))
        gone = "; ".join(_loss(member) for _, member in sorted(self.absent.items()))
        if late and gone:
            within = f"{self._startup_limit:g} s (run.startup_limit)"
            raise PeerError(f"{gone}: expected its return within {within}, found none") from None
        if late:
            within = f"{limit:g} s (of run.startup_limit for each node)"
            raise PeerError(f"expected a word within {within} of {slow}, found none") from None
        log.info("still waiting for %s", "; ".join(filter(None, [gone, slow])))


def _loss(member: Member) -> str:
    return f"{name_of(member.nodes)}: {member.over} ({member.place})"


class _Closed:
    def may_go(self, key: Key) -> bool:  # noqa: ARG002
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
