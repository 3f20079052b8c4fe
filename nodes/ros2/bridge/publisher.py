"""A topic that messages are put on: numbered, and kept for those who join late."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

from nodes.ros2.bridge.keys import Attachment, pack
from nodes.ros2.messages.topics import Topic


class Publisher:
    """Puts messages on a topic.

    Args:
        put: Puts a message with its attachment, and tells whether the session is still open.
        matched: Tells whether somebody subscribes to the topic.
        gid_: Of the endpoint; if ``None``, messages have no attachment.
        max_wait: Real seconds that `put` waits for a peer that does not read; then the message is
            given up.

    Attributes:
        sent: How many messages went out.
        failed: How many did not: the session is closed, or a peer did not read for `max_wait`.
        note: Called with each message that was put.
        kept: The last messages and their attachments, if the topic is transient local.
        wanted: Whether messages are to be made, even where nobody subscribes.
    """

    wanted = True

    def __init__(
        self,
        topic: Topic,
        put: Callable[[bytearray, bytes | None], bool],
        matched: Callable[[], bool],
        gid_: bytes | None,
        max_wait: float,
    ) -> None:
        self.topic = topic
        self.matched = matched
        self.sent = self.failed = 0
        self.note: Callable[[Publisher, bytearray], None] | None = None
        self._put = put
        self._gid = gid_
        self._max_wait = max_wait
        depth = topic.qos.depth if topic.qos.transient_local else 0
        self.kept: deque[tuple[bytes, bytes | None]] = deque(maxlen=depth)

    def put(self, message: bytearray) -> None:
        """Put a message; its bytes may be overwritten afterwards."""
        attachment, begin = None, time.monotonic()
        if self._gid is not None:
            number = self.sent + self.failed + 1
            attachment = pack(Attachment(number, time.time_ns(), self._gid))
        if self.kept.maxlen:
            self.kept.append((bytes(message), attachment))
        # Zenoh says nothing of a message that it gives up.
        gone_out = self._put(message, attachment) and time.monotonic() - begin < self._max_wait
        self.sent += gone_out
        self.failed += not gone_out
        if self.note is not None:
            self.note(self, message)
