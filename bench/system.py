"""What is measured, and the interface that every measured system implements.

The exchange is the thesis's: node 1 sends a ping (sender, receiver, number, time) that all N-1
other nodes hear; the last of them is its receiver and replies; the sample is the time at node 1
from just before the send to the arrival of the reply. Pings never overlap.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from events import Event

CaseName = Literal["small", "large", "large-shared"]
Mode = Literal["handler", "stream", "routed"]
Place = Literal["one process", "processes"]

LARGE_SHAPE = (1080, 1080)
"""Of the large message: float32, 4.67 MB."""

NODES = (2, 4, 8, 10, 16, 32, 50, 64, 100, 128)


class Case(msgspec.Struct, frozen=True, kw_only=True):
    """One thing to measure.

    Attributes:
        case: ``small``: no payload. ``large``: each ping carries a fresh copy of a float32 array
            of `LARGE_SHAPE`, made within the measured time. ``large-shared``: each ping carries
            the same array by reference, or whatever comes nearest in the system.
        mode: ``handler``: receivers are functions that are called. ``stream``: receivers are
            coroutines or threads that wait for the next message. ``routed``: the ping reaches
            its receiver only.
        nodes: N, sender included; at least 2.
        samples: How many round trips to record.
        warm_up: How many to leave out before.
    """

    case: CaseName = "small"
    mode: Mode = "handler"
    nodes: int = 2
    samples: int = 10_000
    warm_up: int = 1_000


Samples = npt.NDArray[np.int64]
"""Round trips in nanoseconds, shape (samples,), in the order in which they were measured."""


class System(msgspec.Struct, frozen=True, kw_only=True):
    """Something that can be measured.

    Attributes:
        name: As it stands in tables: ``asyncio.Queue (uvloop)``.
        modes: Which modes it has.
        cases: Which cases it has.
        place: Whether its nodes share a process.
        max_nodes: Beyond this it is not measured: too slow, or too many processes for a laptop.
        slowness: About how many microseconds a round trip takes at N = 2; the driver shortens
            runs of slow systems by it.
        missing: Returns why it cannot be measured here (with what installs it), or `None`.
        version: Returns what is measured, as ``library 1.2``.
        measure: Measures a case; called in a fresh process of its own.
    """

    name: str
    modes: tuple[Mode, ...]
    cases: tuple[CaseName, ...] = ("small", "large", "large-shared")
    place: Place = "one process"
    max_nodes: int = 128
    slowness: float = 1.0
    missing: Callable[[], str | None] = lambda: None
    version: Callable[[], str] = lambda: ""
    measure: Callable[[Case], Samples]


def large_array() -> npt.NDArray[np.float32]:
    """Return the array that large pings carry."""
    return np.arange(np.prod(LARGE_SHAPE), dtype=np.float32).reshape(LARGE_SHAPE)


class Ping(Event):
    """What node 1 says to all.

    Attributes:
        receiver: Number of the node that is to reply.
        number: Of the ping.
        payload: An array, or `None`.
    """

    receiver: int
    number: int
    payload: Any = None


class Pong(Event):
    """What the receiver replies to node 1.

    Attributes:
        number: Of the ping.
    """

    number: int
