"""Lockstep in several processes: the turn passes to the process with the earliest thing due.

Each process has a loop on simulated time. The one that has the turn runs on until another has
something due before its own next thing, or until it has sent something that others must receive
first; then it passes the turn on, with the time, and with the counters that order what is due at
one time. So everything happens in the order in which one process would have done it, and workers
and threads run beside it in all processes at once.

Here are no sockets: messages are sent by `send`, and passed to `receive`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import msgspec

from events import Event
from runtime.errors import WireError
from runtime.time.lockstep import LockstepLoop
from visnav_machines.messages import (
    NEVER,
    Key,
    Message,
    Ordered,
    StateReport,
    TimeToken,
    TokenRequest,
)

Send = Callable[[int, Message, Event | None], None]
Deliver = Callable[[int, Ordered, Event | None], None]


class TimeTokenHolder:
    """A process's part in passing the turn.

    Args:
        me: Number of this process; they are numbered in the order of their first nodes.
        deliver: Given the messages of others, in order, at this process's turn.
    """

    def __init__(
        self, me: int, count: int, timeline: LockstepLoop, send: Send, deliver: Deliver
    ) -> None:
        self.holding = False
        self._me = me
        self._timeline = timeline
        self._send = send
        self._deliver = deliver
        self._keys: list[Key] = [NEVER] * count
        self._unread: set[int] = set()
        self._calls: set[int] = set()
        self._epoch = 0
        self._oldest = 1
        self._next: TimeToken | None = None
        self._outbox: list[tuple[int, Ordered, Event | None]] = []
        self._inbox: list[tuple[int, Ordered, Event | None]] = []
        self._sent = [[0] * count for _ in range(count)]
        self._received = [0] * count
        self._reported_key: Key = NEVER
        self._called = False
        self._next_elsewhere: Key = NEVER
        self._alive: frozenset[int] = frozenset()
        self._ids: tuple[str, ...] = ()
        self._reports: dict[int, StateReport] = {}
        self._report_due = False

    # Processes of the turn.

    def gather(self, alive: Sequence[int], ids: Sequence[str], new: Sequence[int] = ()) -> None:
        """Start again with these processes, by number and id, as the turn may be lost.

        There is a turn again once all report the same ids; `new` were absent before, or have
        changed.
        """
        self._alive = frozenset(alive)
        self._ids = tuple(sorted(ids))
        self._reports = {n: s for n, s in self._reports.items() if n in self._alive}
        self.holding = False
        self._next = None
        self._oldest = self._epoch + 1
        self._report_due = True
        for process in new:
            self._received[process] = 0
            self._sent[self._me][process] = 0
            self._inbox = [item for item in self._inbox if item[0] != process]
        self._outbox = [item for item in self._outbox if item[0] in self._alive]

    def suspend(self) -> None:
        """Stop time until processes are gathered again."""
        self.holding = False
        self._next = None
        self._report_due = False
        self._oldest = self._epoch + 1

    # Called by the loop, whenever nothing is ready.

    def may_go(self, key: Key) -> bool:
        """Return whether time may advance to the next thing due here."""
        if self._report_due:
            self._report_state(key)
        if not self.holding:
            if (self._outbox or key < self._reported_key) and not self._called and self._epoch:
                self._called = True
                for other in self._alive - {self._me}:
                    self._send(other, TokenRequest(), None)
            return False
        if not (self._outbox or self._unread or self._calls):
            if key == NEVER == self._next_elsewhere:  # what comes now comes from outside
                return False
            if key <= self._next_elsewhere:
                return True
        self._flush()
        self._unread |= self._calls & self._alive
        self._calls.clear()
        self._pass(key)
        return False

    def post(self, other: int, message: Ordered, event: Event | None = None) -> None:
        """Send a message to be handled by the other before time advances."""
        self._outbox.append((other, message, event))

    # Messages of other processes.

    def receive(
        self,
        other: int,
        message: TimeToken | TokenRequest | StateReport | Ordered,
        event: Event | None,
    ) -> None:
        """Handle a message of another process; raise `WireError` if it counts other processes."""
        count = len(self._keys)
        match message:
            case TimeToken():
                if {len(message.keys), len(message.sent), *map(len, message.sent)} != {count}:
                    raise WireError(f"expected a turn of {count} processes")
                if message.epoch >= self._oldest:
                    self._next = message
            case TokenRequest():
                self._calls.add(other)  # of all of us, since only one has the turn
            case StateReport():
                if len(message.sent) != count:
                    raise WireError(f"expected a standing of {count} processes")
                self._reports[other] = message
                self._resume()
            case _:
                self._received[other] += 1
                self._inbox.append((other, message, event))
        self._accept_turn()

    def _accept_turn(self) -> None:
        """Accept the passed turn once all messages sent before have arrived."""
        turn = self._next
        if turn is None or any(
            self._received[other] < turn.sent[other][self._me] for other in self._alive - {self._me}
        ):
            return
        self._next = None
        self.holding = True
        self._called = False
        self._epoch = turn.epoch
        self._oldest = turn.epoch
        self._sent = [list(row) for row in turn.sent]
        self._keys = list(turn.keys)
        self._unread = set(turn.unread) - {self._me}
        self._next_elsewhere = min(self._keys[n] for n in self._alive - {self._me})
        self._timeline.move(turn.now, turn.orders)
        inbox, self._inbox = sorted(self._inbox, key=lambda item: item[1].serial), []
        for other, message, event in inbox:
            self._deliver(other, message, event)

    def _flush(self) -> None:
        outbox, self._outbox = self._outbox, []
        schedule, order = self._timeline.orders()
        for serial, (other, message, event) in enumerate(outbox, order):
            self._sent[self._me][other] += 1
            self._unread.add(other)
            self._send(other, msgspec.structs.replace(message, serial=serial), event)
        self._timeline.move(self._timeline.now, (schedule, order + len(outbox)))

    def _pass(self, key: Key) -> None:
        """Pass the turn to a process with something to receive, or else with the next thing due."""
        others = self._alive - {self._me}
        self._reported_key = self._keys[self._me] = key
        if waiting := self._unread & others:
            to = min(waiting)
        else:
            to = min(others, key=lambda n: self._keys[n])
        self.holding = False
        self._send(
            to,
            TimeToken(
                epoch=self._epoch,
                now=self._timeline.now,
                orders=self._timeline.orders(),
                keys=tuple(self._keys),
                unread=tuple(sorted(self._unread & others)),
                sent=tuple(tuple(row) for row in self._sent),
            ),
            None,
        )

    # After a process left or joined.

    def _report_state(self, key: Key) -> None:
        self._report_due = False
        self._reported_key = key
        standing = StateReport(
            processes=self._ids,
            epoch=self._epoch,
            now=self._timeline.now,
            orders=self._timeline.orders(),
            key=key,
            sent=tuple(self._sent[self._me]),
        )
        maker = min(self._alive)
        if maker == self._me:
            self._reports[self._me] = standing
            self._resume()
        else:
            self._send(maker, standing, None)

    def _resume(self) -> None:
        reports = [self._reports.get(n) for n in sorted(self._alive)]
        if min(self._alive, default=-1) != self._me or any(
            s is None or s.processes != self._ids for s in reports
        ):
            return
        standings = {n: self._reports.pop(n) for n in self._alive}
        keys, sent = [NEVER] * len(self._keys), [[0] * len(self._keys) for _ in self._keys]
        for n, standing in standings.items():
            keys[n], sent[n] = standing.key, list(standing.sent)
        self._next = TimeToken(
            epoch=max(s.epoch for s in standings.values()) + 1,
            now=max(s.now for s in standings.values()),
            orders=(
                max(s.orders[0] for s in standings.values()),
                max(s.orders[1] for s in standings.values()),
            ),
            keys=tuple(keys),
            unread=tuple(sorted(self._alive)),
            sent=tuple(tuple(row) for row in sent),
        )
        self._accept_turn()
