"""The vehicle's mission: uploaded, downloaded, gone through; how far it is stands here alone."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from visnav_mavlink.links import Sender, mav
from visnav_mavlink.vehicle import GLOBAL_FRAMES, LOCAL_SCALE, SECOND, Vehicle

MOST_ITEMS = 1000
PATIENCE, TRIES = SECOND, 5  # until an item that does not come is asked for again; how often
GUIDED = 2  # of a MISSION_ITEM's `current`: ArduPilot's way to say where to go at once
_MISSION, _ALL = mav.MAV_MISSION_TYPE_MISSION, mav.MAV_MISSION_TYPE_ALL
_OTHERS = {mav.MAV_MISSION_TYPE_FENCE, mav.MAV_MISSION_TYPE_RALLY}
_LARGEST = 2**31 - 1
_NO_MISSION = 65535  # as the number of items, where there is no mission
_FLOWN, _SUSPENDED = 1, 2  # of MISSION_CURRENT's mission_mode, which has no names


class Item(NamedTuple):
    """An item of a mission: a place in its frame, or something to do.

    Attributes:
        x: 1e-7 degrees of latitude, or 1e-4 m in local frames; `y` as well.
    """

    command: int
    frame: int
    params: tuple[float, float, float, float]
    x: int
    y: int
    z: float
    autocontinue: int

    @property
    def place(self) -> tuple[int, float, float, float]:
        """Frame and coordinates, as `Vehicle.place_of` takes them."""
        scale = 1 if self.frame in GLOBAL_FRAMES else LOCAL_SCALE
        return self.frame, self.x * scale, self.y * scale, self.z


@dataclass
class Upload:
    """An upload under way.

    Attributes:
        requested_at: Time of the next item's last request (ns); `tries` counts the requests.
        by_int: Whether items are requested by ``MISSION_REQUEST_INT``, as some programs expect.
    """

    sender: Sender
    count: int
    requested_at: int = 0
    tries: int = 0
    by_int: bool = False
    items: list[Item] = field(default_factory=list)


class Guided(NamedTuple):
    """Conventions of ArduPilot: items that are flown to at once, and home as a mission's first.

    Attributes:
        fly_to: Flies to an item's place at a time (ns); returns the reason if it cannot.
    """

    vehicle: Vehicle
    fly_to: Callable[[Item, int], str]

    @property
    def home(self) -> Item:
        """The first item of every mission."""
        x, y, altitude = self.vehicle.place(self.vehicle.home or (0.0, 0.0, 0.0))
        command, frame = mav.MAV_CMD_NAV_WAYPOINT, mav.MAV_FRAME_GLOBAL
        return Item(command, frame, (0.0, 0.0, 0.0, 0.0), x, y, altitude * 1e-3, 1)


class Missions:
    """The vehicle's mission.

    Args:
        vehicle: Its mode determines whether the mission is flown.
        send: Sends a message to all programs; its target says which is meant.
        refusal: Returns why an item cannot be flown; empty if it can.
        report: Sends a sentence to all programs, and to the log.
        changed: Called when another item than the next one is to be flown.
        guided: ArduPilot's conventions, if those count.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        send: Callable[[Any], None],
        refusal: Callable[[Item], str],
        report: Callable[[str], None],
        changed: Callable[[], None],
        guided: Guided | None = None,
    ) -> None:
        self._vehicle, self._send, self._refusal = vehicle, send, refusal
        self._report, self._changed = report, changed
        self.items: list[Item] = []
        self._guided, self._first = guided, int(guided is not None)
        self._next = self._end = 0  # the item under way, and the one before which it ends
        self.landing = False  # by the item under way, which is reached at the touch-down
        self._upload: Upload | None = None
        self._done: tuple[Sender, int] | None = None  # of the last upload, and its last item

    @property
    def progress(self) -> tuple[int, int, int, int]:
        """Fields of ``MISSION_CURRENT``: the item under way, the number of items, state, mode."""
        last = max(len(self.items) - 1, 0)
        flown = _FLOWN if self._is_flown else _SUSPENDED
        return min(self._next, last), len(self.items) or _NO_MISSION, self._state, flown

    def current(self) -> Item | None:
        """Return the item to fly; `None` after the last."""
        return self.items[self._next] if self._next < self._end else None

    def reached(self) -> None:
        """Advance to the next item, and report the reached one."""
        self._send(mav.MAVLink_mission_item_reached_message(self._next))
        self._next += 1
        self.landing = False
        self._progress()

    def resume(self) -> None:
        """Continue at the item under way; after the last one, from the first."""
        self._end = len(self.items)
        if self._next >= self._end:
            self._next = self._first
            self._progress()

    def start(self, first: float, last: float) -> str:
        """Continue from one item to another; return the reason if that is impossible.

        Args:
            first: Number of an item; below zero, or NaN: the one under way.
            last: Number of the last one; zero, or beyond the last: all.
        """
        if not self.items:
            return "expected a mission, found none: upload it first"
        if not first >= 0:
            self.resume()
        elif not first < len(self.items):
            return f"expected a first item below {len(self.items)}, found {first:g}"
        elif 0 < last < int(first):
            return f"expected a last item after the first, found {first:g} and {last:g}"
        else:
            self._jump_to(int(first))
        if 0 < last < len(self.items):
            self._end = int(last) + 1
        return ""

    def jump(self, number: float) -> int:
        """Continue with an item, -1 for the one under way; return a ``MAV_RESULT``."""
        if number == -1:
            return int(mav.MAV_RESULT_ACCEPTED)
        if not 0 <= number < len(self.items):
            self._report(f"mission: expected an item below {len(self.items)}, found {number:g}")
            return int(mav.MAV_RESULT_DENIED)
        self._jump_to(int(number))
        return int(mav.MAV_RESULT_ACCEPTED)

    def handle(self, sender: Sender, message: Any, now: int) -> str:
        """Answer a message of the mission protocol; return why it has no effect, if so."""
        kind, which = message.get_type(), getattr(message, "mission_type", _MISSION)
        if kind == "MISSION_SET_CURRENT":
            self.jump(message.seq)
        elif which != _MISSION and not (kind == "MISSION_CLEAR_ALL" and which == _ALL):
            return self._handle_unsupported(sender, kind, which)
        elif kind == "MISSION_COUNT":
            return self._start_upload(sender, message.count, now)
        elif kind in {"MISSION_ITEM_INT", "MISSION_ITEM"}:
            return self._handle_item(sender, message, now)
        elif kind == "MISSION_REQUEST_LIST":
            self._send(mav.MAVLink_mission_count_message(*sender, self._count, _MISSION))
        elif kind in {"MISSION_REQUEST_INT", "MISSION_REQUEST"}:
            self._send_item(sender, message.seq, kind == "MISSION_REQUEST_INT")
        elif kind == "MISSION_CLEAR_ALL":
            if self._is_busy(sender):
                return "another program uploads"
            self._upload = None
            self._replace([])
            self._ack(sender, mav.MAV_MISSION_ACCEPTED, which)
        elif kind == "MISSION_ACK":
            self._handle_ack(sender, message.type, now)
        return ""

    def update(self, now: int) -> None:
        """Request an item again that did not arrive."""
        upload = self._upload
        if upload is None or now - upload.requested_at < PATIENCE:
            return
        upload.tries += 1
        if upload.tries > TRIES:
            self._report(f"mission: expected item {len(upload.items)}, it never came")
            self._finish(upload, mav.MAV_MISSION_OPERATION_CANCELLED)
        else:
            self._request_item(upload, now)

    def _handle_unsupported(self, sender: Sender, kind: str, which: int) -> str:
        """Answer a message about fences or rally points, of which there are none."""
        if kind == "MISSION_ACK":
            return ""
        if which in _OTHERS and kind == "MISSION_REQUEST_LIST":
            self._send(mav.MAVLink_mission_count_message(*sender, 0, which))
        elif which in _OTHERS and kind == "MISSION_CLEAR_ALL":
            self._ack(sender, mav.MAV_MISSION_ACCEPTED, which)
        else:
            self._ack(sender, mav.MAV_MISSION_UNSUPPORTED, which)
            return "fences and rally points are not supported"
        return ""

    def _is_busy(self, sender: Sender) -> bool:
        """Return whether another program uploads; refuse the sender's message then."""
        if self._upload is None or self._upload.sender == sender:
            return False
        self._ack(sender, mav.MAV_MISSION_DENIED)
        return True

    def _start_upload(self, sender: Sender, count: int, now: int) -> str:
        if self._is_busy(sender):
            return "another program uploads"
        if count > MOST_ITEMS:
            self._ack(sender, mav.MAV_MISSION_NO_SPACE)
            return f"expected at most {MOST_ITEMS} items, found {count}"
        self._upload = upload = Upload(sender, count)
        if count:
            self._request_item(upload, now)
        else:
            self._finish(upload, mav.MAV_MISSION_ACCEPTED)
        return ""

    def _handle_item(self, sender: Sender, message: Any, now: int) -> str:
        upload = self._upload
        if self._is_busy(sender):
            return "another program uploads"
        if upload is None and message.current == GUIDED:
            return self._fly_guided(sender, message, now)
        if upload is None and self._done == (sender, message.seq):  # the answer got lost
            self._ack(sender, mav.MAV_MISSION_ACCEPTED)
        elif upload is None:
            self._ack(sender, mav.MAV_MISSION_ERROR)
            return "expected MISSION_COUNT first"
        elif message.seq == len(upload.items):  # else it came twice
            self._add_item(upload, message, now)
        return ""

    def _fly_guided(self, sender: Sender, message: Any, now: int) -> str:
        reason, item = "guided places are ArduPilot's: send DO_REPOSITION", _item(message)
        if self._guided is not None:
            reason = "its place is none" if item is None else self._guided.fly_to(item, now)
        self._ack(sender, mav.MAV_MISSION_UNSUPPORTED if reason else mav.MAV_MISSION_ACCEPTED)
        return reason

    def _add_item(self, upload: Upload, message: Any, now: int) -> None:
        upload.by_int = upload.by_int or message.get_type() == "MISSION_ITEM_INT"
        item = _item(message)
        if item is None:
            self._report(f"mission refused: item {message.seq}: its place is none")
            self._finish(upload, mav.MAV_MISSION_INVALID)
            return
        is_home = message.seq < self._first
        if not is_home and (reason := self._refusal(item)):
            self._report(f"mission refused: item {message.seq}: {reason}")
            self._finish(upload, mav.MAV_MISSION_UNSUPPORTED)
            return
        upload.items.append(item)
        upload.tries = 0
        if len(upload.items) < upload.count:
            self._request_item(upload, now)
        else:
            self._finish(upload, mav.MAV_MISSION_ACCEPTED)

    def _handle_ack(self, sender: Sender, result: int, now: int) -> None:
        """Request integers if an uploading program refuses floats; end if it cancels."""
        upload = self._upload
        if upload is None or upload.sender != sender:
            return
        if result == mav.MAV_MISSION_UNSUPPORTED and not upload.by_int:
            upload.by_int = True
            self._request_item(upload, now)
        elif result == mav.MAV_MISSION_OPERATION_CANCELLED:
            self._upload = None

    def _send_item(self, sender: Sender, seq: int, by_int: bool) -> None:
        if not 0 <= seq < self._count:
            self._ack(sender, mav.MAV_MISSION_INVALID_SEQUENCE)
            return
        item = self._guided.home if self._guided and seq == 0 else self.items[seq]
        head = *sender, seq, item.frame, item.command, int(seq == self._next), item.autocontinue
        if by_int:
            place: tuple[float, float] = item.x, item.y
            kind = mav.MAVLink_mission_item_int_message
        else:
            scale = 1e-7 if item.frame in GLOBAL_FRAMES else LOCAL_SCALE
            place = item.x * scale, item.y * scale
            kind = mav.MAVLink_mission_item_message
        self._send(kind(*head, *item.params, *place, item.z, _MISSION))

    def _request_item(self, upload: Upload, now: int) -> None:
        upload.requested_at = now
        by_int, plain = mav.MAVLink_mission_request_int_message, mav.MAVLink_mission_request_message
        kind = by_int if upload.by_int else plain
        self._send(kind(*upload.sender, len(upload.items), _MISSION))

    def _finish(self, upload: Upload, result: int) -> None:
        self._upload = None
        if result == mav.MAV_MISSION_ACCEPTED:
            self._done = upload.sender, upload.count - 1
            self._replace(upload.items)
        self._ack(upload.sender, result)

    def _replace(self, items: list[Item]) -> None:
        self.items = items
        self._jump_to(0)

    def _jump_to(self, number: int) -> None:
        self._next, self._end = max(number, self._first), len(self.items)
        self.landing = False
        self._progress()
        self._changed()

    @property
    def _count(self) -> int:
        return max(len(self.items), self._first)

    def _ack(self, sender: Sender, result: int, which: int = _MISSION) -> None:
        self._send(mav.MAVLink_mission_ack_message(*sender, result, which))

    def _progress(self) -> None:
        self._send(mav.MAVLink_mission_current_message(*self.progress))

    @property
    def _is_flown(self) -> bool:
        return self.landing or self._vehicle.mode == "mission"

    @property
    def _state(self) -> int:
        """As MAVLink's ``MISSION_STATE``."""
        if not self.items:
            return int(mav.MISSION_STATE_NO_MISSION)
        if self._next >= self._end:
            return int(mav.MISSION_STATE_COMPLETE)
        if self._is_flown:
            return int(mav.MISSION_STATE_ACTIVE)
        is_started = self._next > self._first
        return int(mav.MISSION_STATE_PAUSED if is_started else mav.MISSION_STATE_NOT_STARTED)


def _item(message: Any) -> Item | None:
    """Return an item as sent by either message; `None` if its place is none."""
    scale = 1.0
    if message.get_type() == "MISSION_ITEM":
        scale = 1e7 if message.frame in GLOBAL_FRAMES else 1 / LOCAL_SCALE
    x, y = message.x * scale, message.y * scale
    if not (abs(x) <= _LARGEST and abs(y) <= _LARGEST):
        return None
    numbers = message.param1, message.param2, message.param3, message.param4
    place = round(x), round(y), message.z
    return Item(message.command, message.frame, numbers, *place, message.autocontinue)


def is_speed(value: float) -> bool:
    """Return whether it is a speed, or one of the signs for none (-1) and the usual one (-2)."""
    return value in {-1, -2} or (math.isfinite(value) and value > 0)
