"""Mappings as a user would write them, good and bad."""

from __future__ import annotations

from typing import Any, cast

from events import Event
from nodes.ros2_bridge.outgoing_topic import Writing
from nodes.ros_messages.incoming import Reading

PERCENT = 100
BATTERY = "sensor_msgs/msg/BatteryState"


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


def tell_battery(event: Battery, writing: Writing) -> Any:
    if event.percentage < 0.0:
        return None
    header = writing.header(event.stamp, "base_link", event.source)
    return writing.make(BATTERY, header=header, percentage=event.percentage, present=True)


def tell_broken(event: Battery, writing: Writing) -> Any:
    raise KeyError("no such thing")


def tell_another_type(event: Battery, writing: Writing) -> Any:
    return writing.make("std_msgs/msg/Float64", data=event.percentage)


def tell_nonsense(event: Battery, writing: Writing) -> Any:
    return "not a message"


def tell_a_text_for_a_number(event: Battery, writing: Writing) -> Any:
    return writing.make(BATTERY, percentage="full")


def tell_no_such_field(event: Battery, writing: Writing) -> Any:
    return writing.make(BATTERY, charm=1.0)
