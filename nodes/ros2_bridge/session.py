"""A Zenoh session as a ROS 2 node: the only module that imports zenoh.

Zenoh has threads of its own and no asyncio: what it calls runs there, and must not wait.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import zenoh

from nodes.ros2_bridge.attachment import Attachment, pack
from nodes.ros2_bridge.gid import gid
from nodes.ros2_bridge.keys import (
    NodeName,
    Topic,
    data_key,
    endpoint_token,
    node_token,
    ros2dds_key,
)

Take = Callable[[int, Callable[[], bytes]], None]
"""Called in a thread with a message's size and what returns its bytes."""

WAIT_BEFORE_DROP = 300
"""Microseconds that a put waits for a peer that does not read; Zenoh's default is 1000."""


WAITING = 64
"""Messages that Zenoh keeps until they are read; it lets the sender wait when there are more."""

PAUSE = 0.001
"""Seconds between two looks at what has come: what comes faster is taken in handfuls."""

CLOSING = 3.0
"""Seconds."""


class SessionError(Exception):
    """A session cannot be opened; the message says why."""


class Session:
    """A session with one ROS node.

    Args:
        node: As whom to appear.
        keys: How topics are named.
        connect: Endpoints to connect to, again and again until they answer.
        listen: Endpoints to listen on.
        file: A Zenoh configuration; it also says what the two are if they are `None`, which
            without a file are those that rmw_zenoh_cpp has.

    Raises:
        SessionError: It cannot be opened.
    """

    def __init__(
        self,
        node: NodeName,
        *,
        keys: Literal["rmw_zenoh", "ros2dds"] = "rmw_zenoh",
        connect: tuple[str, ...] | None = None,
        listen: tuple[str, ...] | None = None,
        file: str = "",
    ) -> None:
        self._node = node
        self._keys = keys
        try:
            self._session = zenoh.open(_configuration(connect, listen, file))
        except (zenoh.ZError, OSError) as error:
            raise SessionError(f"expected a Zenoh session, found: {error}") from error
        self.zid = str(self._session.info.zid())
        self._ids = itertools.count(1)
        self._kept: list[Any] = []
        if keys == "rmw_zenoh":
            self._keep(node_token(node, self.zid, 0))

    def publisher(self, topic: Topic) -> Publisher:
        """Declare a publisher, and show it to ROS."""
        token = endpoint_token(self._node, self.zid, 0, next(self._ids), "MP", topic)
        options: dict[str, Any] = {
            "congestion_control": zenoh.CongestionControl.DROP,
            "reliability": (
                zenoh.Reliability.RELIABLE if topic.qos.reliable else zenoh.Reliability.BEST_EFFORT
            ),
        }
        if topic.qos.transient_local:
            declared: Any = zenoh.ext.declare_advanced_publisher(
                self._session,
                self._key(topic),
                cache=zenoh.ext.CacheConfig(max_samples=topic.qos.depth),
                publisher_detection=True,
                **options,
            )
        else:
            declared = self._session.declare_publisher(self._key(topic), **options)
        if self._keys == "rmw_zenoh":
            self._keep(token)
        return Publisher(topic, declared, gid(token) if self._keys == "rmw_zenoh" else None)

    def subscribe(self, topic: Topic, take: Take) -> None:
        """Declare a subscription, and show it to ROS."""
        # Not called by Zenoh for each message: each call takes the interpreter from the loop, and
        # under a flood the loop would wait for it again and again.
        subscriber = self._session.declare_subscriber(
            self._key(topic), zenoh.handlers.FifoChannel(WAITING)
        )
        self._kept.append(subscriber)
        threading.Thread(
            target=_read, args=(subscriber, take), name=f"hears {topic.name}", daemon=True
        ).start()
        if self._keys == "rmw_zenoh":
            self._keep(endpoint_token(self._node, self.zid, 0, next(self._ids), "MS", topic))

    def first(self, topic: Topic, seconds: float, largest: int) -> bytes | None:
        """Wait for one message of a topic, in the caller's thread; `None` if none came in time."""
        found: list[bytes] = []
        came = threading.Event()

        def heard(sample: zenoh.Sample) -> None:
            if not came.is_set() and len(sample.payload) <= largest:
                found.append(sample.payload.to_bytes())
                came.set()

        with self._session.declare_subscriber(
            self._key(topic), zenoh.handlers.Callback(heard, indirect=False)
        ):
            came.wait(seconds)
        return found[0] if found else None

    def close(self) -> bool:
        """Leave, and tell whether that was done within `CLOSING`.

        A peer that stands still can keep Zenoh waiting for longer (10 s). Then a thread goes
        on with it, and the process ends after that: to end before would crash in Zenoh.
        """
        thread = threading.Thread(target=self._session.close, name="zenoh close")
        thread.start()
        thread.join(CLOSING)
        return not thread.is_alive()

    def _key(self, topic: Topic) -> str:
        if self._keys == "ros2dds":
            return ros2dds_key(topic)
        return data_key(self._node.domain_id, topic)

    def _keep(self, token: str) -> None:
        self._kept.append(self._session.liveliness().declare_token(token))


class Publisher:
    """Puts messages on a topic.

    Attributes:
        topic: Which.
        sent: How many messages went out.
        failed: How many did not, since the session is closed.
    """

    def __init__(self, topic: Topic, declared: Any, gid_: bytes | None) -> None:
        self.topic = topic
        self.sent = self.failed = 0
        self._put = declared.put
        self._gid = gid_

    def put(self, message: bytearray) -> None:
        """Put a message; its bytes may be overwritten afterwards."""
        try:
            if self._gid is None:
                self._put(message)
            else:
                attachment = Attachment(self.sent + 1, time.time_ns(), self._gid)
                self._put(message, attachment=pack(attachment))
            self.sent += 1
        except zenoh.ZError:
            self.failed += 1


def _read(subscriber: Any, take: Take) -> None:
    """Take messages, in a thread, until the subscription or the session is closed."""
    with contextlib.suppress(zenoh.ZError):
        sample = subscriber.recv()
        while True:
            while sample is not None:
                payload = sample.payload
                take(len(payload), payload.to_bytes)
                sample = subscriber.try_recv()
            time.sleep(PAUSE)
            sample = subscriber.recv()


def _configuration(
    connect: tuple[str, ...] | None, listen: tuple[str, ...] | None, file: str
) -> zenoh.Config:
    """Return the configuration of a peer as rmw_zenoh_cpp opens it (or as `file` says)."""
    if file:
        if not Path(file).is_file():
            raise SessionError(f"zenoh_config: expected a file, found none at {file}")
        configuration = zenoh.Config.from_file(file)
    else:
        configuration = zenoh.Config()
        for key, value in {
            "mode": "peer",
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": True,
            "timestamping/enabled": True,  # the cache of an advanced publisher needs it
            "connect/endpoints": ["tcp/localhost:7447"],
            "listen/endpoints": ["tcp/localhost:0"],
            "connect/timeout_ms": -1,  # try for ever,
            "connect/exit_on_failure": False,  # but beside the run; and again if a router goes
            "transport/link/tx/queue/congestion_control/drop/wait_before_drop": WAIT_BEFORE_DROP,
        }.items():
            configuration.insert_json5(key, json.dumps(value))
    for way, endpoints in (("connect", connect), ("listen", listen)):
        if endpoints is not None:
            configuration.insert_json5(f"{way}/endpoints", json.dumps(endpoints))
    return configuration
