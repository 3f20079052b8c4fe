"""Mappings as a user would write them, good and bad."""

from __future__ import annotations

from typing import Any, cast

from events import Event
from nodes.ros2_bridge.incoming import Reading


class Battery(Event):
    """An event of the user's own."""

    percentage: float


def battery(message: Any, reading: Reading) -> Event | None:
    if message.percentage < 0.0:
        return None
    return Battery(
        stamp=reading.stamp(message.header), source=reading.source, percentage=message.percentage
    )


def broken(message: Any, reading: Reading) -> Event | None:
    raise KeyError("no such thing")


def no_event(message: Any, reading: Reading) -> Event | None:
    return cast("Event", "not an event")
