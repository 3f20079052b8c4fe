"""Missions and parameters: their protocols (mavlink.io, mission and parameter protocol)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from nodes.mavlink.links import mav
from nodes.mavlink.vehicle import SECOND

MOST_ITEMS = 1000
PATIENCE, TRIES = SECOND, 5  # until an item that does not come is asked for again; how often
PARAMETERS = {
    "MIS_TAKEOFF_ALT": (2.5, 0.3, 100.0),
    "MPC_XY_CRUISE": (2.0, 0.1, 20.0),
    "RTL_RETURN_ALT": (2.5, 0.0, 100.0),
}
"""PX4's name to value, least and most: metres above home; metres per second."""


class Item(NamedTuple):
    """An item of a mission: a place in its frame, or something to do."""

    command: int
    frame: int
    params: tuple[float, float, float, float]
    x: int
    y: int
    z: float
    autocontinue: int


class Missions:
    """The vehicle's mission: uploaded, downloaded, gone through.

    Args:
        send: Sends a message to all programs, who know by its target whether it is for them.
        refused: Tells whether an item cannot be flown.
    """

    def __init__(
        self,
        send: Callable[[Any], None],
        refused: Callable[[Item], bool],
        tell: Callable[[str], None],
    ) -> None:
        self._send, self._refused, self._tell = send, refused, tell
        self.items: list[Item] = []
        self._next = 0
        self._upload: list[Item] | None = None
        self._from = (0, 0)
        self._count = self._tries = self._asked = 0

    def current(self) -> Item | None:
        """Return the item to fly; `None` after the last."""
        return self.items[self._next] if self._next < len(self.items) else None

    def reached(self) -> None:
        """Go on to the next item, and say so."""
        self._send(mav.MAVLink_mission_item_reached_message(self._next))
        self._next += 1
        self._progress()

    def jump(self, number: float) -> int:
        """Go on with an item; return a ``MAV_RESULT``."""
        if not (math.isfinite(number) and 0 <= number < len(self.items)):
            return int(mav.MAV_RESULT_DENIED)
        self._next = int(number)
        self._progress()
        return int(mav.MAV_RESULT_ACCEPTED)

    def hear(self, sender: tuple[int, int], message: Any, now: int) -> None:
        """Answer a message of the mission protocol."""
        kind = message.get_type()
        which = getattr(message, "mission_type", 0)
        if kind in {"MISSION_REQUEST_LIST", "MISSION_COUNT"} and which:  # a fence or rally points
            if kind == "MISSION_COUNT":
                self._tell("fences and rally points are not supported")
                self._ack(sender, mav.MAV_MISSION_UNSUPPORTED, which)
            else:
                self._send(mav.MAVLink_mission_count_message(*sender, 0, which))
        elif kind == "MISSION_COUNT":
            self._begin(sender, message.count, now)
        elif kind in {"MISSION_ITEM_INT", "MISSION_ITEM"} and self._upload is not None:
            self._take(sender, message, now)
        elif kind == "MISSION_REQUEST_LIST":
            self._send(mav.MAVLink_mission_count_message(*sender, len(self.items), 0))
        elif kind in {"MISSION_REQUEST_INT", "MISSION_REQUEST"}:
            self._give(sender, message.seq)
        elif kind == "MISSION_CLEAR_ALL":
            self.items, self._next, self._upload = [], 0, None
            self._ack(sender, mav.MAV_MISSION_ACCEPTED, which)
        elif kind == "MISSION_SET_CURRENT":
            self.jump(message.seq)

    def update(self, now: int) -> None:
        """Ask again for an item that did not come."""
        if self._upload is None or now - self._asked < PATIENCE:
            return
        self._tries += 1
        if self._tries > TRIES:
            self._tell(f"mission: expected item {len(self._upload)}, it never came")
            self._end(mav.MAV_MISSION_OPERATION_CANCELLED)
        else:
            self._ask(now)

    def _begin(self, sender: tuple[int, int], count: int, now: int) -> None:
        if count > MOST_ITEMS:
            self._ack(sender, mav.MAV_MISSION_NO_SPACE)
            return
        self._upload, self._from, self._count, self._tries = [], sender, count, 0
        if count:
            self._ask(now)
        else:
            self._end(mav.MAV_MISSION_ACCEPTED)

    def _take(self, sender: tuple[int, int], message: Any, now: int) -> None:
        assert self._upload is not None
        if sender != self._from or message.seq != len(self._upload):
            return  # twice, or of another program
        scale = 1e7 if message.get_type() == "MISSION_ITEM" and message.frame != 1 else 1
        numbers = message.param1, message.param2, message.param3, message.param4
        x, y = message.x * scale, message.y * scale
        if not (math.isfinite(x) and math.isfinite(y)):
            self._end(mav.MAV_MISSION_INVALID)
            return
        place = round(x), round(y), message.z
        item = Item(message.command, message.frame, numbers, *place, message.autocontinue)
        if self._refused(item):
            self._tell(f"mission refused: item {message.seq}, command {message.command}")
            self._end(mav.MAV_MISSION_UNSUPPORTED)
            return
        self._upload.append(item)
        self._tries = 0
        if len(self._upload) < self._count:
            self._ask(now)
        else:
            self._end(mav.MAV_MISSION_ACCEPTED)

    def _give(self, sender: tuple[int, int], seq: int) -> None:
        if not 0 <= seq < len(self.items):
            self._ack(sender, mav.MAV_MISSION_INVALID_SEQUENCE)
            return
        item = self.items[seq]
        self._send(
            mav.MAVLink_mission_item_int_message(
                *sender, seq, item.frame, item.command, int(seq == self._next),
                item.autocontinue, *item.params, item.x, item.y, item.z, 0,
            )
        )  # fmt: skip

    def _ask(self, now: int) -> None:
        assert self._upload is not None
        self._asked = now
        self._send(mav.MAVLink_mission_request_int_message(*self._from, len(self._upload), 0))

    def _end(self, result: int) -> None:
        if result == mav.MAV_MISSION_ACCEPTED:
            self.items, self._next = self._upload or [], 0
            self._progress()
        self._upload = None
        self._ack(self._from, result)

    def _ack(self, sender: tuple[int, int], result: int, which: int = 0) -> None:
        self._send(mav.MAVLink_mission_ack_message(*sender, result, which))

    def _progress(self) -> None:
        last = max(len(self.items) - 1, 0)
        self._send(mav.MAVLink_mission_current_message(min(self._next, last), len(self.items)))


class Parameters(dict[str, float]):
    """Parameters that have a meaning here, by PX4's names; sent as 32-bit floats."""

    def __init__(self, send: Callable[[Any], None], tell: Callable[[str], None]) -> None:
        super().__init__({name: value for name, (value, *_) in PARAMETERS.items()})
        self._send, self._tell = send, tell

    def hear(self, message: Any) -> None:
        """Answer a message of the parameter protocol."""
        kind = message.get_type()
        if kind == "PARAM_REQUEST_LIST":
            for name in self:
                self._give(name)
            return
        names = [*self]
        if kind == "PARAM_REQUEST_READ" and 0 <= message.param_index < len(names):
            self._give(names[message.param_index])
            return
        name = message.param_id.rstrip("\0")
        if name not in self:
            return  # as PX4: who asks for it learns by silence
        if kind == "PARAM_SET":
            _, least, most = PARAMETERS[name]
            if least <= message.param_value <= most:
                self[name] = message.param_value
            else:
                self._tell(f"{name}: expected {least:g} to {most:g}")
        self._give(name)

    def _give(self, name: str) -> None:
        real, index = mav.MAV_PARAM_TYPE_REAL32, [*self].index(name)
        self._send(
            mav.MAVLink_param_value_message(name.encode(), self[name], real, len(self), index)
        )
