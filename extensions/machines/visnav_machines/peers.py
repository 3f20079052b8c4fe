"""The other processes of a run, as its supervisor sees them, and the events that cross over."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import msgspec

from events import Announcement, Event
from runtime.channels.sender import Listener, Sender
from runtime.channels.tasks import Fault
from runtime.channels.wire import event_type, kind_of
from runtime.config.model import Config, NodeSpec
from runtime.errors import ChannelFullError, PeerError, WireError
from runtime.run.others import Others
from runtime.summary import Summary
from runtime.time.clock import Clock, RealClock
from runtime.time.lockstep import LockstepClock, LockstepLoop
from visnav_machines import messages
from visnav_machines.joint import JointShutdown, JointStart
from visnav_machines.member import ClockFollower, Member
from visnav_machines.membership import Membership
from visnav_machines.time_token import TimeTokenHolder

log = logging.getLogger("visnav.runtime")


class Peers(Others):
    """All other processes of a run.

    Args:
        stop: Ends the run here: given a reason, an error or `None`, `by` whom, and `from_peer`.
        reconnect: Freezes the listeners of each output anew.
    """

    def __init__(
        self,
        config: Config,
        only: Iterable[str],
        clock: Clock,
        stop: Callable[..., None],
        reconnect: Callable[[], None],
    ) -> None:
        self._config = config
        self._clock = clock
        self._stop = stop
        self._reconnect = reconnect
        self._membership = Membership(config, only, self)
        self._start = JointStart(self._membership, clock, float(config.run.startup_limit))
        self.shutdown = JointShutdown(self._membership, self._gather)
        self._remote = RemoteEvents(config.nodes, self._membership, self._send_event)
        self._loop: LockstepLoop | None = None
        self._token: TimeTokenHolder | None = None
        self._early: list[tuple[Member, messages.OfTheRun, Event | None]] = []
        self._has_met = self._has_begun = False
        self._ended_here: list[str] = []
        self._follower: ClockFollower | None = None

    # Before the run.

    async def meet(self) -> int:
        """Wait until all nodes of the file are connected."""
        membership = self._membership
        before = await membership.meet()
        self._has_met = True
        if isinstance(self._clock, LockstepClock):
            loop = asyncio.get_running_loop()
            assert isinstance(loop, LockstepLoop)
            self._loop = loop
            self._token = TimeTokenHolder(
                membership.me, membership.count, loop, self._send_to, self._handle
            )
        self._receive_early()
        return before

    async def announce(self, local: Mapping[str, Iterable[Announcement]]) -> list[Announcement]:
        """Send the announcements of the nodes here; return those of all, in file order."""
        return await self._start.announce(local)

    async def begin(self) -> None:
        """Agree with the others on the first update, and wait until then."""
        self._reconnect()
        self._follow(await self._start.wait_for_first_update())

    def _follow(self, member: Member | None) -> None:
        if member is not None and isinstance(self._clock, RealClock):
            self._follower = ClockFollower(self._clock, member)

    def start_clock(self) -> None:
        """Do nothing: `begin` has started the clock."""

    def nodes_run(self) -> None:
        """Deliver messages from now on, as the nodes here run."""
        self._has_begun = True
        self._start.mark_over()
        self._membership.settle()
        if self._loop is not None:
            self._loop.move(0, (len(self._membership.nodes) << 33, self._membership.me << 32))
            self._gather()
        self._receive_early()
        for seat in self._membership.seats.values():
            absent, seat.absent = seat.absent, None
            if absent is not None:
                self.lost(absent)

    def _receive_early(self) -> None:
        early, self._early = self._early, []
        for item in early:
            self._membership.deliver(*item)

    # During the run.

    def listeners(self, output: str) -> list[Listener]:
        """Return an output's listeners in other processes."""
        return self._remote.listeners(output)

    def connect(self, listeners: list[Listener], fault: Fault) -> None:
        """Connect the listeners here to outputs elsewhere, and notify the others."""
        self._remote.connect(listeners, fault)
        self._start.send(
            messages.Subscriptions(
                subscriptions(listener for listener in listeners if listener.node != "run")
            )
        )

    def stopping(self, reason: str, error: Exception | None, *, by: str, from_peer: bool) -> None:
        """Notify the others of the run's end and its reason, also if `from_peer`.

        They may receive it from us first.
        """
        text = None if error is None else str(error)
        stop = messages.Stop(reason, text, apart=not self._has_begun, by=by)
        self._membership.ended = msgspec.structs.replace(stop, apart=True)
        for seat in self._membership.seats.values():
            seat.absent = None
        if not self._has_begun:  # also its senders: they need not wait for our turn
            self._membership.broadcast(stop)
            self._receive_early()
        elif self._time_stands():
            self._membership.broadcast(stop)
            self._gather(at_once=True)
        elif not from_peer:
            self._broadcast_in_order(stop)
        self.shutdown.start_watching()

    def node_ended(self, node: str) -> None:
        """Notify the others of the end of a node here."""
        self.shutdown.at_work = False
        self._ended_here.append(node)
        self._broadcast_in_order(messages.NodeEnded(node))

    async def wait_to_end(self, node: str) -> None:
        """Wait until all nodes after `node` have ended, in any process; "" precedes all."""
        await self.shutdown.wait_to_end(node)

    # After the run.

    async def leave(self, summary: Summary) -> Summary:
        """Exchange summaries and leave; return the summary of all processes."""
        merged = await self.shutdown.exchange_summaries(summary)
        self.shutdown.close()
        if self._follower is not None:
            self._follower.stop()
        self._token = None
        if self._loop is not None:
            self._loop.gate = None
        await self._membership.close()
        return merged

    # Notifications of the membership.

    def receive(self, member: Member, message: messages.OfTheRun, event: Event | None) -> None:
        """Handle a message of another process, or raise `WireError`."""
        self.shutdown.received_at = time.monotonic()
        ends = self._membership.ended is not None
        match message:
            case messages.EventMessage() if self._has_begun and self._token is None:  # most of all
                self._handle(member.number, message, event)
            case messages.Announcements():
                self._start.record_announcements(member, message)
            case messages.FinalSummary():
                self.shutdown.record_summary(member, message)
            case messages.SummaryReceived():
                member.has_our_summary = True
            case messages.FirstUpdate():
                member.first_update = message
                member.running = True
            case messages.Ready():
                member.ready = True
                member.running = member.running or message.begun
                if member.returning:
                    member.returning = False
                    self._readmit(member, begun=message.begun)
            case messages.Subscriptions():
                if not self._has_met:  # the processes have no numbers yet
                    self._early.append((member, message, event))
                    return
                self._remote.subscribe(member.number, message.wanted)
                if self._has_begun:
                    self._reconnect()
            case messages.Stop() if not self._has_begun or message.serial < 0:
                if message.apart:
                    self._exclude(member)
                elif self._time_stands():  # a return is not awaited any more
                    self._gather(at_once=True)
                self._handle(member.number, message, None)
            case messages.NodeEnded() if message.node not in member.nodes:
                raise WireError(f"expected one of its nodes, found {message.node!r}")
            case messages.NodeEnded() if message.serial < 0 or (ends and not self._has_begun):
                self._handle(member.number, message, None)
            case messages.StillWorking():
                pass
            case _ if not self._has_begun:
                if not ends:
                    self._early.append((member, message, event))
            case _ if self._token is not None:
                self._token.receive(member.number, message, event)
            case messages.EventMessage() | messages.Stop() | messages.NodeEnded():
                self._handle(member.number, message, event)
            case _ if not ends:
                raise WireError("expected the run to be in lockstep there, too")

    def lost(self, member: Member) -> None:
        """Deal with the loss of a process as its nodes' `on_error` says."""
        lost = set(member.nodes) - self.shutdown.ended_nodes
        self.shutdown.ended_nodes |= lost
        loss = PeerError(f"{member.name}: {member.over} ({member.place})")
        ended = self._membership.ended
        if member.returning and ended is None:
            log.error("%s: waiting for its return again", loss)
            self._membership.settle(lost=member.nodes)
            return
        if ended is not None or not lost:
            if lost:
                log.warning("%s: the run ends without it", loss)
            if lost and ended is not None and self._has_begun and self._token is not None:
                # Others may wait for its return, and not for their turn.
                self._membership.broadcast(msgspec.structs.replace(ended, apart=False))
            self._gather(at_once=ended is not None)
            return
        if self._follower is not None and self._follower.member is member:
            self._follower.continue_alone()
        self._remote.subscribe(member.number, ())
        rules = {spec.on_error for spec in self._config.nodes if spec.name in lost}
        if "stop" in rules:
            log.error("%s", loss, extra={"reported": True})
            self._gather()
            self._stop(f"{member.name} lost", loss, by=min(lost))
        elif "restart" in rules:
            log.error("%s: waiting for its return", loss)
            self._membership.settle(lost=member.nodes)
            if self._token is not None:
                self._membership.seats[member.number].awaited = True
                self._token.suspend()
        else:
            log.error("%s: left out from here on", loss)
            self._membership.settle(left_out=lost)
            self._gather()
        self._reconnect()

    def joined(self, member: Member) -> None:
        """Handle a process joining or returning after the numbering of processes."""
        self._start.resend(member)
        member.returning = self._has_begun  # until it is ready, the run does not wait for it

    def now(self, ago: int = 0) -> int:
        """Return the time of the run's clock, so many real nanoseconds ago; in any thread."""
        speed = self._clock.speed if isinstance(self._clock, RealClock) else 0
        return self._clock.now() - round(ago * speed)

    def _handle(self, number: int, message: messages.Ordered, event: Event | None) -> None:
        try:
            match message:
                case messages.EventMessage():
                    if event is not None:  # else it was invalid
                        self._remote.arrive(number, message.output, event)
                case messages.Stop():
                    member = self._membership.numbered(number)
                    name = member.name if member else "?"
                    failed = PeerError(f"at {name}: {message.error}") if message.error else None
                    self._stop(message.reason, failed, by=message.by, from_peer=True)
                case messages.NodeEnded():
                    self.shutdown.ended_nodes.add(message.node)
        except WireError as error:
            log.warning("from process %d: %s", number, error)
        self._membership.waiting.notify()

    def _readmit(self, member: Member, *, begun: bool) -> None:
        """Readmit a process: a new instance, or (if `begun`) the same, reconnected."""
        state = "found again" if begun else "back"
        log.warning("%s: %s, at %s", member.name, state, member.place)
        if not begun:
            now = self._clock.now()
            real = now / self._clock.speed if isinstance(self._clock, RealClock) else 0
            member.outbox.send(messages.FirstUpdate(time.monotonic_ns() - round(real), now))
        elif self._follower and self._follower.member.number == member.number:
            self._follow(member)
        self.shutdown.ended_nodes -= {*member.nodes}
        seat = self._membership.seats[member.number]
        seat.apart = seat.awaited = False
        seat.new = True
        self._gather()
        self._reconnect()

    def _time_stands(self) -> bool:
        return any(seat.awaited for seat in self._membership.seats.values())

    def _gather(self, *, at_once: bool = False) -> None:
        """In lockstep, share turns among the processes present, unless one is awaited."""
        if self._token is None or self._loop is None or not self._has_begun:
            return
        membership, seats = self._membership, self._membership.seats.values()
        if at_once:
            for seat in seats:
                seat.awaited = False
        if self._time_stands():
            return
        present = [seat.member for seat in seats if seat.member and not seat.apart]
        self._loop.gate = self._token if present else None
        if present:
            self._token.gather(
                [membership.me, *(member.number for member in present)],
                [membership.id, *(member.id for member in present)],
                [number for number, seat in membership.seats.items() if seat.new],
            )
        for seat in seats:
            seat.new = False

    def _exclude(self, member: Member) -> None:
        """Exclude a process from the turns: not begun yet, or given up."""
        if seat := self._membership.seats.get(member.number):
            seat.apart = True
        for node in self._ended_here:  # what was to be sent at our turn is lost
            member.outbox.send(messages.NodeEnded(node))
        self._gather()

    # Sending.

    def _broadcast_in_order(self, message: messages.Ordered) -> None:
        for number, seat in self._membership.seats.items():
            if self._token is not None and self._has_begun and seat.member and not seat.apart:
                self._token.post(number, message)
            elif seat.member:
                seat.member.outbox.send(message)

    def _send_event(self, process: int, output: str, event: Event, skip: bool) -> None:
        if self._token is not None:
            self._token.post(process, messages.EventMessage(output), event)
        elif member := self._membership.numbered(process):
            try:
                member.outbox.send(messages.EventMessage(output), event, output if skip else "")
            except ChannelFullError as error:
                raise ChannelFullError(f"{output}: {error}") from None

    def _send_to(self, number: int, message: messages.Message, event: Event | None) -> None:
        if member := self._membership.numbered(number):
            member.outbox.send(message, event)


SendEvent = Callable[[int, str, Event, bool], None]
"""Sends an event: process number, output, event, and whether a newer event may replace this."""


class RemoteEvents:
    """Outputs here with listeners in other processes, and outputs there with listeners here."""

    def __init__(
        self, specs: Iterable[NodeSpec], membership: Membership, send_event: SendEvent
    ) -> None:
        self._membership = membership
        self._send_event = send_event
        self._inputs: dict[int, list[_RemoteInput]] = {}
        self._arrivals: dict[str, Sender[Any]] = {
            (name := f"{spec.name}.{port}"): Sender(name, output.event)
            for spec in specs
            if spec.name not in membership.here
            for port, output in spec.node.declared.outputs.items()
        }

    def subscribe(self, process: int, subscriptions: tuple[messages.Subscription, ...]) -> None:
        """Record the subscriptions of a process, empty if gone; `WireError` for unknown events."""
        self._inputs[process] = [
            _RemoteInput(
                tuple(map(event_type, subscription.kinds)), subscription.source, subscription.latest
            )
            for subscription in subscriptions
        ]

    def listeners(self, output: str) -> list[Listener]:
        """Return the listeners in other processes; before those here, to reach them in any case."""
        return [
            RemoteListener(process, output, inputs, self._send_event)
            for process, inputs in sorted(self._inputs.items())
        ]

    def connect(self, listeners: Iterable[Listener], fault: Fault) -> None:
        """Connect the listeners here to outputs elsewhere."""
        listeners = list(listeners)
        for sender in self._arrivals.values():
            sender.connect(listeners, fault=fault)

    def arrive(self, process: int, output: str, event: Event) -> None:
        """Deliver an event of another process; `WireError` if it has no such output."""
        sender, node = self._arrivals.get(output), output.partition(".")[0]
        if sender is None or node not in self._membership.seats[process].nodes:
            raise WireError(f"expected an output of process {process}, found {output!r}")
        if not isinstance(event, sender.event):
            raise WireError(
                f"{output}: expected {sender.event.__name__}, found {type(event).__name__}"
            )
        sender.send(event)


class _RemoteInput(Listener):
    """In the place of an input or handler there."""

    __slots__ = ("latest",)

    def __init__(self, events: tuple[type[Event], ...], source: str | None, latest: bool) -> None:
        super().__init__("", bool, events, source)
        self.latest = latest


class RemoteListener(Listener):
    """All inputs and handlers of another process, as a single listener of an output."""

    __slots__ = ("_inputs", "_may_skip", "_output", "_process", "_send_event", "name")

    def __init__(
        self, process: int, output: str, inputs: Iterable[_RemoteInput], send_event: SendEvent
    ) -> None:
        super().__init__("", self.offer, ())
        self.name = output  # named in errors of sending
        self._process = process
        self._output = output
        self._send_event = send_event
        self._inputs = inputs
        self._may_skip: dict[tuple[type[Event], str], bool] = {}

    def may_receive(self, event: type[Event]) -> bool:
        """Return whether anything there can receive from an output of this type."""
        return any(port.may_receive(event) for port in self._inputs)

    def receives_all(self, event: type[Event]) -> bool:
        """Return whether any listener there receives all events of an output of this type."""
        return any(port.receives_all(event) for port in self._inputs)

    def receives(self, event: type[Event], source: str) -> bool:
        """Return whether anything there receives events of this very type from this source."""
        return any(port.receives(event, source) for port in self._inputs)

    def offer(self, event: Event) -> None:
        """Send an event there."""
        key = (type(event), event.source)
        skip = self._may_skip.get(key)
        if skip is None:
            skip = all(port.latest for port in self._inputs if port.receives(*key))
            self._may_skip[key] = skip
        self._send_event(self._process, self._output, event, skip)


def subscriptions(listeners: Iterable[Listener]) -> tuple[messages.Subscription, ...]:
    """Return the subscriptions of these listeners, for other processes."""
    unique = {
        messages.Subscription(
            kinds=tuple(kind_of(event) for event in listener.events),
            source=listener.source,
            latest=listener.stream is not None
            and listener.stream.bound == 1
            and listener.stream.overflow == "drop_oldest",
        ): None
        for listener in listeners
    }
    return tuple(unique)
