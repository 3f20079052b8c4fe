"""Mappings as a user would write them, good and bad."""

from __future__ import annotations

from typing import Any, cast

from events import Event
from nodes.ros2.messages.incoming import MessageContext
from nodes.ros2.messages.typestore import MessageBuilder

PERCENT = 100
BATTERY = "sensor_msgs/msg/BatteryState"


class Battery(Event):
    """An event of the user's own."""

    percentage: float


def battery(message: Any, context: MessageContext) -> Event | None:
    if message.percentage < 0.0:
        return None
    return Battery(
        stamp=context.stamp(message.header), source=context.source, percentage=message.percentage
    )


def broken(message: Any, context: MessageContext) -> Event | None:
    raise KeyError("no such thing")


def no_event(message: Any, context: MessageContext) -> Event | None:
    return cast("Event", "not an event")


def make_battery(event: Battery, builder: MessageBuilder) -> Any:
    if event.percentage < 0.0:
        return None
    header = builder.header(event.stamp, "base_link", event.source)
    return builder.make(BATTERY, header=header, percentage=event.percentage, present=True)


def make_broken(event: Battery, builder: MessageBuilder) -> Any:
    raise KeyError("no such thing")


def make_another_type(event: Battery, builder: MessageBuilder) -> Any:
    return builder.make("std_msgs/msg/Float64", data=event.percentage)


def make_nonsense(event: Battery, builder: MessageBuilder) -> Any:
    return "not a message"


def make_a_text_for_a_number(event: Battery, builder: MessageBuilder) -> Any:
    return builder.make(BATTERY, percentage="full")


def make_no_such_field(event: Battery, builder: MessageBuilder) -> Any:
    return builder.make(BATTERY, charm=1.0)
