"""Messages between the processes of a run: tagged msgpack maps, with at most a single event."""

from __future__ import annotations

from typing import Annotated, Any

import msgspec

from runtime.errors import WireError

Key = tuple[int, int, int]
"""When something is due: nanoseconds, kind (timers, then work, then the schedule), order."""

NEVER: Key = (1 << 62, 3, 0)

Count = Annotated[int, msgspec.Meta(ge=0)]
AT_ONCE = -1  # serial number of a message handled on arrival, not at a turn


class Message(msgspec.Struct, frozen=True, tag=True, omit_defaults=True):
    """Base of all messages."""


class Hello(Message, frozen=True):
    """Description of the sending process.

    Attributes:
        nodes: That run here.
        config: The file, with its defaults, but for what may differ from process to process.
        place: Host and process number, for messages to people.
        began: When the process began, in seconds since 1970: of two with one node, the later is
            wrong here.
        nonce: New for each session.
        seen: The nonce of the hello that this one answers.
        session: The tag of the session that there is already.
        running: Whether the first update was already.
        left_out: Nodes that this run goes on without.
        lost: Nodes whose process was lost, each as often as it was.
    """

    nodes: tuple[str, ...]
    config: dict[str, Any]
    place: str
    began: float
    nonce: bytes = b""
    seen: bytes = b""
    session: bytes = b""
    running: bool = False
    left_out: tuple[str, ...] = ()
    lost: tuple[str, ...] = ()


class Announcements(Message, frozen=True):
    """Announcements of each node of the sender, as frames of `runtime.channels.wire`."""

    by_node: dict[str, tuple[bytes, ...]]


class Subscription(msgspec.Struct, frozen=True):
    """Events received by an input or handler.

    Attributes:
        kinds: Types of events, by `runtime.channels.wire.kind_of`; their subclasses come too.
        source: Only this source and those below it; `None` for all.
        latest: Whether all but the newest may be skipped.
    """

    kinds: tuple[str, ...]
    source: str | None
    latest: bool


class Subscriptions(Message, frozen=True):
    """Events received by the sender's nodes."""

    wanted: tuple[Subscription, ...]


class Ping(Message, frozen=True):
    """Request for the receiver's time; `sent` is my monotonic clock (ns)."""

    sent: int


class Pong(Message, frozen=True):
    """An answer: `sent` of the ping, `here` my monotonic clock (ns), `now` that of the run."""

    sent: int
    here: int
    now: int


class Ready(Message, frozen=True):
    """My nodes can begin; or, of a session later than my first update, have begun."""

    begun: bool = False


class FirstUpdate(Message, frozen=True):
    """The first update is (or was) then.

    Attributes:
        origin: On my monotonic clock, in nanoseconds.
        now: In lockstep, the time of the run's clock (ns) at which you join.
    """

    origin: int
    now: int = 0


class MemoryOffer(Message, frozen=True):
    """Memory of the sender for large frames, if the receiver sees it; `key` is its first bytes."""

    machine: str
    path: str
    key: bytes


class MemoryMapped(Message, frozen=True):
    """I see your memory."""


class EventMessage(Message, frozen=True):
    """An event of an output (``node.port``).

    Attributes:
        serial: Its place among the ordered messages.
        place: Where its frame stands in my memory, and its size; `None`: it is the payload.
    """

    output: str
    serial: int = AT_ONCE
    place: tuple[int, int] | None = None


class Stop(Message, frozen=True):
    """End the run.

    Attributes:
        serial: Its place among the ordered messages.
        apart: Whether I take no part in the turns: my first update was not yet, or I give up.
        by: Who ends it, as in `RunEnd`.
    """

    reason: str
    error: str | None = None
    serial: int = AT_ONCE
    apart: bool = False
    by: str = ""


class NodeEnded(Message, frozen=True):
    """A node of the sender has ended, and receives nothing any more."""

    node: str
    serial: int = AT_ONCE


class FinalSummary(Message, frozen=True):
    """The sender's part of the run's summary, as JSON."""

    part: bytes


class SummaryReceived(Message, frozen=True):
    """Receipt of a final summary: the other process may leave.

    A process's departure may be noticed before its last messages arrive.
    """


class StillWorking(Message, frozen=True):
    """I am still at work on the end of a node of mine."""


class TimeToken(Message, frozen=True):
    """Turn in lockstep, passed to the receiver.

    Attributes:
        epoch: Turns of an earlier one are void.
        orders: Counters that order what is due at one time: of the schedule, and of the loop.
        keys: What each process has due next.
        unread: Processes that have messages to take in before time goes on.
        sent: How many ordered messages each process (row) has sent to each other one.
    """

    epoch: Count
    now: Count
    orders: tuple[Count, Count]
    keys: tuple[Key, ...]
    unread: tuple[Count, ...]
    sent: tuple[tuple[Count, ...], ...]


class Ack(Message, frozen=True):
    """So many bytes have arrived, and these places in your memory are read no more."""

    arrived: Count
    freed: tuple[Count, ...] = ()


class TokenRequest(Message, frozen=True):
    """Request of a turn, as something came from outside."""


class StateReport(Message, frozen=True):
    """Lockstep state of the sender after a process left or joined, for a new turn.

    Attributes:
        processes: Ids of all processes that are present for the sender.
        epoch: Of the last turn known to the sender.
        sent: Number of ordered messages from the sender to each process.
    """

    processes: tuple[str, ...]
    epoch: Count
    now: Count
    orders: tuple[Count, Count]
    key: Key
    sent: tuple[Count, ...]


Ordered = EventMessage | Stop | NodeEnded
"""Messages handled in lockstep at the receiver's turn, in the order of their serial numbers;
without one, at once.
"""

OfTheRun = (
    Announcements
    | Subscriptions
    | Ready
    | FirstUpdate
    | Ordered
    | FinalSummary
    | SummaryReceived
    | StillWorking
    | TimeToken
    | TokenRequest
    | StateReport
)
AnyMessage = Hello | Ping | Pong | Ack | MemoryOffer | MemoryMapped | OfTheRun

encode = msgspec.msgpack.Encoder().encode
_decoder: msgspec.msgpack.Decoder[AnyMessage] = msgspec.msgpack.Decoder(AnyMessage)


def decode(data: bytes) -> AnyMessage:
    """Read a message, or raise `WireError`."""
    try:
        return _decoder.decode(data)
    except (msgspec.DecodeError, RecursionError) as error:
        raise WireError(f"expected a message of a process, found something else: {error}") from None
