"""Publishing of events' messages, by `mappings`, to a `Sink`: a session, a file, a server."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Any, Generic, Protocol, TypeVar

import msgspec

from events import (
    Announcement,
    EstimatorAnnouncement,
    Event,
    TrackedFeatures,
    TransformStamped,
    VehicleAnnouncement,
)
from nodes.ros2.messages import outgoing
from nodes.ros2.messages.mappings import (
    PUBLISHED,
    TopicKind,
    announced_topics,
    publication,
    rows_of,
)
from nodes.ros2.messages.outgoing import Outgoing
from nodes.ros2.messages.topics import PublishingConfig, Topic, topic_name
from nodes.ros2.messages.typestore import MessageBuilder, Time, TypeStore

Write = Callable[[Outgoing, Any], Any]


class Publisher(Protocol):
    """Protocol of a topic's publisher."""

    @property
    def topic(self) -> Topic:
        """Return the topic."""

    @property
    def wanted(self) -> bool:
        """Tell whether messages are to be made at all; large ones cost time."""

    def put(self, message: bytearray) -> None:
        """Take a message as CDR, whose bytes may be overwritten afterwards."""


P = TypeVar("P", bound=Publisher)
P_co = TypeVar("P_co", bound=Publisher, covariant=True)


class Sink(Protocol[P_co]):
    """Where messages go."""

    def publisher(self, topic: Topic) -> P_co:
        """Declare a topic."""


class Publishing(Generic[P]):
    """Maker and publisher of events' messages; `time` returns a stamp's time in messages."""

    def __init__(
        self, sink: Sink[P], store: TypeStore, config: PublishingConfig, time: Callable[[int], Time]
    ) -> None:
        self._sink, self._store, self._config = sink, store, config
        self._out = Outgoing(store, config, time)
        self.names = self._out.names
        self.builder = MessageBuilder(store, self.names, time)
        self._vehicles: list[str] = []
        self._estimators: list[str] = []
        self._publishers: dict[tuple[TopicKind, str], P | None] = {}
        self._lock = threading.Lock()

    @property
    def publishers(self) -> list[P]:
        """Return the publishers declared so far."""
        return [each for each in self._publishers.values() if each is not None]

    def announced(self, announcement: Announcement) -> None:
        """Declare the topics of an announcement."""
        if isinstance(announcement, VehicleAnnouncement):
            self._vehicles.append(announcement.source)
        elif isinstance(announcement, EstimatorAnnouncement):
            self._estimators.append(announcement.source)
        self._out.announced(announcement)
        for key in announced_topics(announcement):
            if self._declare(*key) is not None:
                self._out.sensors[key] = announcement

    def warm_up(self) -> None:
        """Compute all type hashes for the first messages, while there is time."""
        for type_ in {row.type for row in PUBLISHED}:
            self._store.hash(type_)

    def unannounced(self) -> Iterator[str]:
        """Yield a line for each setting with an unannounced name."""
        config = self._config
        for setting, name, known, what in (
            ("vehicle", config.vehicle, self._vehicles, "a vehicle"),
            ("tf", "" if config.tf == "truth" else config.tf, self._estimators, "an estimator"),
        ):
            if name and name not in known:
                yield (
                    f'{setting}: expected {what} that is announced, found "{name}" '
                    f"(there are: {', '.join(known) or 'none'})"
                )

    def unused(self) -> Iterator[str]:
        """Yield a line for each new name in `topics` without a topic."""
        names = {each.topic.name for each in self.publishers}
        for given, name in self._config.topics.items():
            if topic_name(self._config.namespace, name) not in names:
                yield f'topics: expected the name of a topic, found "{given}", which none has'

    def begin(self) -> None:
        """Put the fixed transforms, for the whole run."""
        if self._out.transforms.static():
            self._put("tf_static", "", outgoing.fixed_transforms, None)

    def clock(self, now: int) -> None:
        """Put the time (ns)."""
        self._put("clock", "", outgoing.clock, now)

    def put(self, event: Event) -> None:
        """Put the messages of an event; for `LARGE` events in threads, a thread per type."""
        if isinstance(event, TrackedFeatures):
            self.names.vehicles.tracked(event)
        if isinstance(event, TransformStamped) and self._out.transforms.add_static(event):
            self.begin()
        for row in rows_of(type(event)):
            source = row.source(self._out, event)
            if source is None or not row.wanted(self._config):
                continue
            self._put(row.kind, source, row.write, event)

    def _put(self, kind: TopicKind, source: str, write: Write, of: Any) -> None:
        if publisher := self._publisher(kind, source):
            message = write(self._out, of)
            if message is not None:
                done = isinstance(message, bytearray)
                publisher.put(message if done else self._store.serialize(message))

    def _publisher(self, kind: TopicKind, source: str) -> P | None:
        """Return the source's publisher if in demand, declared now if new; else `None`."""
        try:
            publisher = self._publishers[kind, source]
        except KeyError:
            publisher = self._declare(kind, source)
        return publisher if publisher is not None and publisher.wanted else None

    def _declare(self, kind: TopicKind, source: str) -> P | None:
        with self._lock:  # two threads may want one for the first time together
            if (kind, source) not in self._publishers:
                made, topic = None, publication(kind, source, self._config)
                if topic is not None:
                    hashed = msgspec.structs.replace(topic, hash=self._store.hash(topic.type))
                    made = self._sink.publisher(hashed)
                self._publishers[kind, source] = made
            return self._publishers[kind, source]
