"""A session in the place of Zenoh's, which takes down what is put."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

from nodes.ros2.bridge.keys import Message
from nodes.ros2.bridge.session import MessageCallback
from nodes.ros2.messages.topics import Topic
from tests.nodes.ros2.messages import samples


class Taken:
    """What a publisher put.

    Attributes:
        topic: On which.
        messages: As bytes, in order.
    """

    failed = 0
    wanted = True

    def __init__(self, topic: Topic) -> None:
        self.topic = topic
        self.messages: list[bytes] = []

    @property
    def sent(self) -> int:
        return len(self.messages)

    def put(self, message: bytearray) -> None:
        self.messages.append(bytes(message))

    def read(self) -> list[Any]:
        """Return the messages."""
        return [samples.store().deserialize(data, self.topic.type) for data in self.messages]


class TakingSession:
    """Does what the bridge asks of a session, in this process.

    Args:
        said: Messages that come on each topic that is subscribed to.
    """

    def __init__(self, said: Sequence[bytes] = ()) -> None:
        self.taken: list[Taken] = []
        self.said = said

    def publisher(self, topic: Topic, *, held: bool = False) -> Any:
        self.taken.append(Taken(topic))
        return self.taken[-1]

    def subscribe(self, topic: Topic, take: MessageCallback, *, late: bool = False) -> None:
        for message in self.said:
            take(Message(len(message), functools.partial(bytes, message)))

    def close(self) -> bool:
        return True

    def on(self, name: str) -> list[Taken]:
        """Return the publishers of a topic."""
        return [entry for entry in self.taken if entry.topic.name == name]
