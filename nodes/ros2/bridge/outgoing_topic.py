"""A topic that is published by a mapping of the user's own, from events to messages of any type."""

from __future__ import annotations

from events import Event
from nodes.ros2.bridge.complaints import Complaints
from nodes.ros2.bridge.incoming_topic import topic
from nodes.ros2.bridge.mappings import event_type, import_mapping
from nodes.ros2.bridge.publisher import Publisher
from nodes.ros2.bridge.settings import OwnPublication, Ros2BridgeConfig
from nodes.ros2.messages.builder import MessageBuilder
from nodes.ros2.messages.topics import topic_name
from nodes.ros2.messages.typestore import TypeStore
from runtime import Stream


class OutgoingTopic:
    """Makes the messages of one publication.

    Args:
        publication: As the file says.
        config: The bridge's settings.
        store: Of the types.
        complaints: Notes what is wrong.

    Attributes:
        waiting: Events that wait to be published.
        publisher: Of the topic, once it is declared.

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
        self.waiting = Stream[Event](publication.topic, publication.depth, "drop_oldest", soon=True)
        self.publisher: Publisher | None = None
        name = topic_name(config.namespace, publication.topic)
        self.topic = topic(store, name, publication.type, publication.qos)
        self._store = store
        self._complaints = complaints
        self.event = event_type(publication)
        self._map = import_mapping(publication.topic, publication.mapping)

    def wants(self, event: Event) -> bool:
        """Tell whether an event becomes a message."""
        source = self.publication.source
        return isinstance(event, self.event) and (
            not source or event.source == source or event.source.startswith(f"{source}/")
        )

    def put(self, builder: MessageBuilder, event: Event) -> None:
        """Put the message of an event, if there is one."""
        if self.publisher is not None and (message := self.message(event, builder)) is not None:
            self.publisher.put(message)

    def message(self, event: Event, builder: MessageBuilder) -> bytearray | None:
        """Return the message of an event; `None` if there is none, or none can be made."""
        try:
            message = self._map(event, builder)
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
