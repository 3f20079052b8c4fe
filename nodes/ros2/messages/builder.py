"""What a user's own mapping from events to messages is given: it builds messages of any type.

A mapping is called with the event and a `MessageBuilder`::

    def battery(event: Battery, builder: MessageBuilder) -> Any:
        return builder.make(
            "sensor_msgs/msg/BatteryState",
            header=builder.header(event.stamp, "base_link", event.source),
            percentage=event.percentage,
        )
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from nodes.ros2.messages.frame_names import FrameNames
from nodes.ros2.messages.stamps import Time
from nodes.ros2.messages.typestore import TypeStore


class MessageBuilder:
    """Builds messages.

    Args:
        store: Of the types.
        names: What ROS calls our frames.
        time: Returns the time in messages of a stamp (ns).
    """

    def __init__(self, store: TypeStore, names: FrameNames, time: Callable[[int], Time]) -> None:
        self._store = store
        self._names = names
        self._time = time

    def make(self, type_: str, **fields: Any) -> Any:
        """Return a message; fields that are not given are zero, empty or false.

        Raises:
            ValueError: There is no such type.
            TypeError: It has no such field.
        """
        message = self._store.zero(type_)
        for name, value in fields.items():
            if not hasattr(message, name):
                raise TypeError(f"{type_} has no field {name!r}")
            setattr(message, name, value)
        return message

    def stamp(self, stamp: int) -> Any:
        """Return the ``builtin_interfaces/msg/Time`` of a stamp (ns)."""
        sec, nanosec = self._time(stamp)
        return self._store.message("builtin_interfaces/msg/Time")(sec=sec, nanosec=nanosec)

    def header(self, stamp: int, frame_id: str, source: str = "") -> Any:
        """Return a ``std_msgs/msg/Header``.

        Args:
            stamp: Nanoseconds of the run's clock.
            frame_id: Our name of the frame.
            source: Whose frame it is: each of several vehicles has its own ``base_link``.
        """
        return self._store.header(self._time(stamp), self._names.name(frame_id, source))
