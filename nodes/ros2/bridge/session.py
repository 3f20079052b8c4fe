"""Zenoh session as a ROS 2 node, and its publishers: the only import of zenoh and its threads."""

from __future__ import annotations

import contextlib
import functools
import itertools
import json
import math
import queue
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import msgspec
import zenoh

from nodes.ros2.bridge.keys import (
    Attachment,
    Kind,
    Message,
    NodeName,
    Token,
    data_key,
    endpoint_token,
    endpoints_key,
    gid,
    node_token,
    pack,
    parse_token,
    ros2dds_key,
)
from nodes.ros2.messages.topics import Topic


class Publisher:
    """Publisher of messages on a topic.

    Args:
        max_wait: Real seconds that `put` waits for a peer that does not read; the message is then
            lost.

    Attributes:
        sent: Number of messages out.
        failed: Number of messages lost: the session is closed, or a peer did not read for
            `max_wait`.
        wanted: Whether messages are made even without subscribers.
    """

    wanted = True

    def __init__(
        self,
        topic: Topic,
        put: Callable[..., object],
        matched: Callable[[], bool],  # returns whether the topic has a subscriber
        gid_: bytes | None,  # of the endpoint; if ``None``, messages have no attachment
        max_wait: float,
    ) -> None:
        self.topic, self.matched = topic, matched
        self.sent = self.failed = 0
        # Called with each published message.
        self.on_put: Callable[[Publisher, bytearray], None] | None = None
        self._put, self._gid, self._max_wait = put, gid_, max_wait
        depth = topic.qos.depth if topic.qos.transient_local else 0
        # The last messages and their attachments, if the topic is transient local.
        self.history: deque[tuple[bytes, bytes | None]] = deque(maxlen=depth)

    def put(self, message: bytearray) -> None:
        """Publish a message; its bytes may be overwritten afterwards."""
        attachment, start = None, time.monotonic()
        if self._gid is not None:
            number = self.sent + self.failed + 1
            attachment = pack(Attachment(number, time.time_ns(), self._gid))
        if self.history.maxlen:
            self.history.append((bytes(message), attachment))
        try:
            self._put(message, attachment=attachment)
        except zenoh.ZError:  # the session is closed
            delivered = False
        else:  # Zenoh does not report a dropped message
            delivered = time.monotonic() - start < self._max_wait
        self.sent += delivered
        self.failed += not delivered
        if self.on_put is not None:
            self.on_put(self, message)


MessageCallback = Callable[[Message], None]  # called in a thread with each message
Answer = Callable[[bytearray | str, bytes], None]  # of a request: message and attachment, or error
WAIT_BEFORE_DROP = 300  # microseconds of a put's wait for a peer; Zenoh's default is 1000
WAITING = 64  # unread messages kept by Zenoh; with more, the sender has to wait
PAUSE = 0.001  # seconds between two polls for messages; faster messages are taken in batches
CLOSING = 3.0  # seconds
_QUEUE = "transport/link/tx/queue/congestion_control"
_DEFAULTS: dict[str, Any] = {
    "mode": "peer",
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": True,
    "connect/endpoints": ["tcp/localhost:7447"],
    "listen/endpoints": ["tcp/localhost:0"],
    "connect/timeout_ms": -1,  # try for ever,
    "connect/exit_on_failure": False,  # but beside the run; and again if a router goes
    f"{_QUEUE}/drop/wait_before_drop": WAIT_BEFORE_DROP,
}  # replacements of Zenoh's defaults, such as listening on all addresses, and multicast

_IN_ZENOH = re.compile(r" at /\S+\.rs:\d+\.?")
_IN_FILE = re.compile(r'Message \{ msg: "(.*)", location: .*line: (\d+), column: (\d+).*')
"""Location of an error in Zenoh; an error of JSON5 as shown by Rust, and its location."""


class SessionError(Exception):
    """A session cannot be opened; the message says why."""


class Session:
    """Zenoh session of a single ROS node.

    Args:
        file: A Zenoh configuration; the default, also for endpoints of `None`, is rmw_zenoh_cpp's.
        max_wait: Real seconds that a held message waits for a peer that does not read; it then
            fails, and that connection ends.

    Raises:
        SessionError: It cannot be opened.
    """

    def __init__(
        self,
        node: NodeName,
        *,
        keys: Literal["rmw_zenoh", "ros2dds"] = "rmw_zenoh",  # naming of topics
        connect: tuple[str, ...] | None = None,  # endpoints to connect to, until they answer
        listen: tuple[str, ...] | None = None,
        file: str = "",
        max_wait: float = 5.0,
    ) -> None:
        self._node, self._keys, self._max_wait = node, keys, max_wait
        configuration = _configuration(connect, listen, file)
        configuration.insert_json5(f"{_QUEUE}/block/wait_before_close", f"{max_wait * 1e6:.0f}")
        try:
            self._session = zenoh.open(configuration)
        except (zenoh.ZError, OSError) as error:
            raise SessionError(
                "expected a Zenoh session that listens on "
                f"{configuration.get_json('listen/endpoints')}, found: {_reason(error)}"
            ) from error
        self.zid = str(self._session.info.zid())
        self._ids = itertools.count(1)
        self._declarations: list[Any] = []
        if keys == "rmw_zenoh":
            self._declare_token(node_token(node, self.zid, 0))

    def publisher(self, topic: Topic, *, held: bool = False) -> Publisher:
        """Declare a publisher, visible to ROS.

        Held, it is reliable, keeps all, and waits (up to `max_wait`) for slow peers rather than
        drop.
        """
        if held:
            qos = msgspec.structs.replace(topic.qos, reliable=True, keep_all=True)
            topic = msgspec.structs.replace(topic, qos=qos)
        qos, key, reliability = topic.qos, self._key(topic), zenoh.Reliability
        block, drop = zenoh.CongestionControl.BLOCK, zenoh.CongestionControl.DROP
        blocks = qos.reliable and qos.keep_all
        options: dict[str, Any] = {
            "congestion_control": block if blocks else drop,
            "reliability": reliability.RELIABLE if qos.reliable else reliability.BEST_EFFORT,
        }
        plain: Any = self._session.declare_publisher(key, **options)
        declared = plain
        if qos.transient_local:
            # Subscribers learn the last message's number so often, as in rmw_publisher_data.cpp.
            heartbeat = zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5)
            declared = zenoh.ext.declare_advanced_publisher(
                self._session,
                key,
                cache=zenoh.ext.CacheConfig(max_samples=qos.depth),
                sample_miss_detection=heartbeat if qos.reliable else None,
                publisher_detection=True,
                **options,
            )
        publisher = Publisher(
            topic,
            declared.put,
            lambda: plain.matching_status.matching,  # an advanced publisher does not know
            self._declare_endpoint(topic, "MP"),
            self._max_wait if blocks else math.inf,
        )
        if qos.transient_local:
            answer = functools.partial(_answer, publisher, key)
            self._declarations.append(self._session.declare_queryable(key, answer, complete=True))
        return publisher

    def subscribe(self, topic: Topic, callback: MessageCallback, *, late: bool = False) -> None:
        """Declare a subscription, visible to ROS; with `late`, kept messages come too."""
        # Not called by Zenoh for each message: each call takes the interpreter from the loop, and
        # under a flood the loop would wait for it again and again.
        ext, key, qos = zenoh.ext, self._key(topic), topic.qos
        channel: Any = zenoh.handlers.FifoChannel(WAITING)
        if late or qos.transient_local:
            recovery = ext.RecoveryConfig(periodic_queries=None, heartbeat=True)
            subscriber: Any = ext.declare_advanced_subscriber(
                self._session,
                key,
                channel,
                history=ext.HistoryConfig(detect_late_publishers=True, max_samples=qos.depth),
                recovery=recovery if qos.reliable else None,
                subscriber_detection=True,
            )
        else:
            subscriber = self._session.declare_subscriber(key, channel)
        self._declarations.append(subscriber)
        threading.Thread(
            target=_read, args=(subscriber, callback), name=f"reads {topic.name}", daemon=True
        ).start()
        self._declare_endpoint(topic, "MS")

    def subscribe_in_order(self, callbacks: Sequence[tuple[Topic, MessageCallback]]) -> None:
        """Subscribe to topics in a common order of arrival, at more cost than by `subscribe`."""
        samples: queue.Queue[tuple[MessageCallback, zenoh.Sample] | None] = queue.Queue(WAITING)

        def queue_for(callback: MessageCallback) -> Any:
            put, closed = lambda sample: samples.put((callback, sample)), lambda: samples.put(None)
            return zenoh.handlers.Callback(put, closed, indirect=False)

        def read() -> None:
            for _ in callbacks:  # until each is closed
                for callback, sample in iter(samples.get, None):
                    callback(_message(sample))

        for topic, callback in callbacks:
            subscriber = self._session.declare_subscriber(self._key(topic), queue_for(callback))
            self._declarations.append(subscriber)
            self._declare_endpoint(topic, "MS")
        threading.Thread(target=read, name=f"reads {callbacks[0][0].name}", daemon=True).start()

    def watch(self, topic_name: str, kind: Kind, changed: Callable[[bool, Token], None]) -> None:
        """Report the endpoints of other sessions on a topic, now and at each change.

        Those of a killed process disappear at once; invalid tokens are left out.

        Args:
            kind: Of the endpoints: ``MP`` for publishers, ``MS`` for subscriptions.
            changed: Called in any thread with an endpoint's presence and token.
        """

        def report(sample: zenoh.Sample) -> None:
            try:
                token = parse_token(str(sample.key_expr))
            except ValueError:
                return
            if token.zid != self.zid:
                changed(sample.kind == zenoh.SampleKind.PUT, token)

        key = endpoints_key(self._node.domain_id, kind, topic_name)
        liveliness = self._session.liveliness()
        self._declarations.append(liveliness.declare_subscriber(key, report, history=True))

    def serve(self, service: Topic, callback: Callable[[Message, Answer], None]) -> None:
        """Declare a service, visible to ROS; `callback` gets requests in a thread: no waiting."""
        key = data_key(self._node.domain_id, service)

        def answer(query: zenoh.Query, reply: bytearray | str, attachment: bytes) -> None:
            with contextlib.suppress(zenoh.ZError), query:  # the client may have gone
                if isinstance(reply, str):
                    query.reply_err(reply)
                else:
                    query.reply(key, reply, attachment=attachment)

        def receive(query: zenoh.Query) -> None:
            callback(_message(query), functools.partial(answer, query))

        self._declarations.append(self._session.declare_queryable(key, receive, complete=True))
        self._declare_endpoint(service, "SS")

    def close(self) -> bool:
        """Close the session; return whether done within `CLOSING`.

        Zenoh waits up to 10 s for a peer that stands still; a thread then delays the process's end,
        which would crash in Zenoh otherwise.
        """
        thread = threading.Thread(target=self._session.close, name="zenoh close")
        thread.start()
        thread.join(CLOSING)
        return not thread.is_alive()

    def _key(self, topic: Topic) -> str:
        if self._keys == "ros2dds":
            return ros2dds_key(topic)
        return data_key(self._node.domain_id, topic)

    def _declare_endpoint(self, topic: Topic, kind: Kind) -> bytes | None:
        """Declare an endpoint to ROS, and return its GID; ``None`` if the keys are not ROS's."""
        if self._keys != "rmw_zenoh":
            return None
        token = endpoint_token(self._node, self.zid, 0, next(self._ids), kind, topic)
        self._declare_token(token)
        return gid(token)

    def _declare_token(self, token: str) -> None:
        self._declarations.append(self._session.liveliness().declare_token(token))


def _answer(publisher: Publisher, key: str, query: zenoh.Query) -> None:
    """Send the stored messages to a late joiner asking for the topic's key, without `@adv`."""
    for message, attachment in tuple(publisher.history):
        with contextlib.suppress(zenoh.ZError):  # the subscriber may have gone
            query.reply(key, message, attachment=attachment)


def _read(subscriber: Any, callback: MessageCallback) -> None:
    """Read messages, in a thread, until the subscription or the session is closed."""
    with contextlib.suppress(zenoh.ZError):
        sample = subscriber.recv()
        while True:
            while sample is not None:
                callback(_message(sample))
                sample = subscriber.try_recv()
            time.sleep(PAUSE)
            sample = subscriber.recv()


def _message(sample: zenoh.Sample | zenoh.Query) -> Message:
    payload = sample.payload
    attached = functools.partial(getattr, sample, "attachment")
    if payload is None:  # a query needs none
        return Message(0, bytes, attached)
    return Message(len(payload), payload.to_bytes, attached)


def _configuration(
    connect: tuple[str, ...] | None, listen: tuple[str, ...] | None, file: str
) -> zenoh.Config:
    plain, configuration = zenoh.Config(), zenoh.Config()
    if file:
        if not Path(file).is_file():
            raise SessionError(f"zenoh_config: expected a file, found none at {file}")
        try:
            configuration = zenoh.Config.from_file(file)
        except zenoh.ZError as error:
            raise SessionError(
                f"zenoh_config: {file}: expected a Zenoh configuration, found: {_reason(error)}"
            ) from error
    for key, value in _DEFAULTS.items():
        if configuration.get_json(key) == plain.get_json(key):
            configuration.insert_json5(key, json.dumps(value))
    # The cache of an advanced publisher needs it.
    configuration.insert_json5("timestamping/enabled", "true")
    for setting, endpoints in (("connect", connect), ("listen", listen)):
        if endpoints is not None:
            try:
                configuration.insert_json5(f"{setting}/endpoints", json.dumps(endpoints))
            except zenoh.ZError as error:
                raise SessionError(
                    f'{setting}: expected endpoints such as "tcp/127.0.0.1:7447", '
                    f"found {list(endpoints)}: {_reason(error)}"
                ) from error
    return configuration


def _reason(error: Exception) -> str:
    return _IN_FILE.sub(r"\1 (line \2, column \3)", _IN_ZENOH.sub("", str(error)))
