"""Where ROS's messages go: topics of the server, whose messages are CDR."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TypeVar

from events import Event
from nodes.ros2.messages.publications import TOPICS
from nodes.ros2.messages.topics import Topic
from nodes.ros2.messages.typestore import TypeStore
from nodes.viewers.foxglove.server import Server

E = TypeVar("E", bound=Event)


class RosTopics:
    """The topics of ROS's messages.

    Args:
        server: Whose topics they are.
        store: Of the types.
    """

    def __init__(self, server: Server, store: TypeStore) -> None:
        self.server = server
        self._definitions = {type_: store.definition(type_) for _, type_, _ in TOPICS.values()}
        self._stamps = threading.local()  # of what each thread puts

    def publisher(self, topic: Topic) -> RosTopic:
        """Declare a topic."""
        self.server.declare_ros(topic.name, topic.type, self._definitions[topic.type])
        return RosTopic(self, topic)

    def stamped(self, put: Callable[[E], None]) -> Callable[[E], None]:
        """Return `put`, whose messages then have the time of their event."""

        def put_stamped(event: E) -> None:
            self._stamps.stamp = event.stamp
            put(event)

        return put_stamped

    @property
    def stamp(self) -> int:
        """Return the stamp of the event whose messages this thread puts (ns)."""
        return getattr(self._stamps, "stamp", 0)


class RosTopic:
    """One of them.

    Viewers that come later get the newest message of what ROS keeps for late joiners, and of a
    cloud that is no sensor's: a map.
    """

    def __init__(self, topics: RosTopics, topic: Topic) -> None:
        self.topic = topic
        self._topics = topics
        cloud = topic.type == "sensor_msgs/msg/PointCloud2"
        self._kept = topic.qos.transient_local or (cloud and topic.qos.reliable)

    @property
    def wanted(self) -> bool:
        """Tell whether anybody looks, or may look later at what is kept."""
        return self._kept or self._topics.server.wanted(self.topic.name)

    def put(self, message: bytearray) -> None:
        """Send a message to those who look."""
        data, server, stamp = bytes(message), self._topics.server, self._topics.stamp
        if self._kept:
            server.latch(self.topic.name, lambda: data, stamp)
        else:
            server.log(self.topic.name, data, stamp)
