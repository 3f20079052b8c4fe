"""What the bridge says by a mapping of the user's own: events to messages of any type.

The other way round of `hearing`. A mapping is called with the event and a `Writing`, in a thread
beside the loop::

    def battery(event: Battery, writing: Writing) -> Any:
        return writing.make(
            "sensor_msgs/msg/BatteryState",
            header=writing.header(event.stamp, "base_link", event.source),
            percentage=event.percentage,
        )
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

from events import Event
from nodes.ros2_bridge.complaints import Complaints
from nodes.ros2_bridge.incoming_topic import topic
from nodes.ros2_bridge.settings import OwnPublication, Ros2BridgeConfig
from nodes.ros_messages.frame_names import FrameNames
from nodes.ros_messages.images import make_header
from nodes.ros_messages.messages import Time
from nodes.ros_messages.topics import topic_name
from nodes.ros_messages.typestore import TypeStore


class Writing:
    """What a mapping needs beside the event.

    Args:
        store: Of the types.
        names: What ROS calls our frames.
        time: Returns a stamp as messages tell it.
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
            source: Who speaks of it, which tells one vehicle's ``base_link`` from another's.
        """
        return make_header(self._store, self._time(stamp), self._names.name(frame_id, source))


Mapping = Callable[[Any, Writing], Any]


class Telling:
    """One publication's way from an event to bytes.

    Args:
        publication: As the file says.
        config: The bridge's settings.
        store: Of the types.
        complaints: Told of what is wrong.

    Raises:
        ValueError: The type is not known, or the event or the mapping cannot be imported.
    """

    def __init__(
        self,
        publication: OwnPublication,
        config: Ros2BridgeConfig,
        store: TypeStore,
        complaints: Complaints,
    ) -> None:
        self.publication = publication
        name = topic_name(config.namespace, publication.topic)
        self.topic = topic(store, name, publication.type, publication.qos)
        self._store = store
        self._complaints = complaints
        self.event = event_type(publication)
        found = _found(publication.topic, "mapping", publication.mapping)
        if not callable(found):
            raise ValueError(f"{publication.topic}: mapping: expected a function, found {found!r}")
        self._map: Mapping = found

    def wants(self, event: Event) -> bool:
        """Tell whether an event becomes a message."""
        source = self.publication.source
        return isinstance(event, self.event) and (
            not source or event.source == source or event.source.startswith(f"{source}/")
        )

    def message(self, event: Event, writing: Writing) -> bytearray | None:
        """Return the message of an event; `None` if there is none, or none can be made."""
        try:
            message = self._map(event, writing)
            if message is None:
                return None
            type_ = getattr(message, "__msgtype__", type(message).__name__)
            if type_ != self.topic.type:
                raise TypeError(f"expected a {self.topic.type}, found {type_}")
            return self._store.serialize(message)
        except Exception as error:  # a mapping is the user's own
            detail = f"{type(error).__name__}: {error}"
            self._complaints.add(self.topic.name, "mapping failed", detail)
            return None


def event_type(publication: OwnPublication) -> type[Event]:
    """Return the type of the events that a publication is of.

    Raises:
        ValueError: It cannot be imported, or is no event's.
    """
    found = _found(publication.topic, "event", publication.event)
    if not (isinstance(found, type) and issubclass(found, Event)):
        raise ValueError(f"{publication.topic}: event: expected a type of event, found {found!r}")
    return found


def _found(topic: str, what: str, path: str) -> Any:
    module, _, name = path.partition(":")
    try:
        return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise ValueError(
            f"{topic}: {what}: expected something that can be imported, found {path!r}: {error}"
        ) from None
