"""The messages of the exchange; every system in Python that passes objects passes these."""

from __future__ import annotations

from typing import Any

from events import Event


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
