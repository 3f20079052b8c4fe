"""What is kept of a flight: ``events.bin``, the events as bytes, and ``index.msgpack``, the rest.

The loop gets into nodes by what is due: ticks, timers, work done elsewhere, and the first step of
each `run`. Each of these is an *occasion*, and what nodes do on it are its *actions*: they send
events, and set what brings about later occasions.
"""

from __future__ import annotations

from typing import Literal

import msgspec

EVENTS, INDEX = "events.bin", "index.msgpack"

Kind = Literal["send", "handled", "stop", "once", "held", "timer"]


class Action(msgspec.Struct, frozen=True, array_like=True):
    """One thing that a node of the flight did.

    Attributes:
        kind: ``send`` an event, say in a handler that it is ``handled``, ``stop`` the run; or set
            what is due later: in the schedule (``once``), work done elsewhere (``held``), a timer
            of asyncio's.
        node: Which did it.
        within: The action, of the same occasion, while whose event was delivered it was done; -1
            if there is none.
        turn: Turns of the loop since the occasion; -1 before the loop went on.
        text: The output (``node.port``), or why the run is to stop.
        due: Place of the event's frame in the file; or when the later occasion is due, ns (of a
            timer: s).
        number: Size of the frame; or the later occasion.
    """

    kind: Kind
    node: str
    within: int
    turn: int
    text: str = ""
    due: int | float = 0
    number: int = -1


class Flight(msgspec.Struct, frozen=True):
    """A whole flight.

    Attributes:
        unfit: Why it cannot be used; empty if it can.
        announcements: Of each node, pickled: a whole number in them stays one, and no float.
        tickers: Of each node, name and rate, in the order of their making.
        ticks: Name of a ticker to its ticks on which something was done, with their occasions.
        starts: Name of a node to the occasion on which its `run` begins.
        occasions: Their actions, in order.
        environment: What the nodes found of the machine.
        size: Bytes of the events.
        checksum: Of the events.
    """

    unfit: str = ""
    announcements: dict[str, list[bytes]] = {}
    tickers: dict[str, list[tuple[str, float]]] = {}
    ticks: dict[str, dict[int, int]] = {}
    starts: dict[str, int] = {}
    occasions: list[list[Action]] = []
    environment: dict[str, str] = {}
    size: int = 0
    checksum: str = ""


def pruned(occasions: list[list[Action]]) -> list[list[Action]]:
    """Return occasions without the actions that come to nothing."""
    kept: list[list[Action]] = [[] for _ in occasions]
    for index in reversed(range(len(occasions))):  # what is due later has a higher number
        numbers: dict[int, int] = {}
        for number, action in enumerate(occasions[index]):
            if action.kind in {"once", "held", "timer"} and not kept[action.number]:
                continue
            numbers[number] = len(kept[index])
            within = numbers.get(action.within, -1)
            kept[index].append(msgspec.structs.replace(action, within=within))
    return kept
