"""Names, attachments and complaints of messages on Zenoh, as in rmw_zenoh_cpp.

Data keys, liveliness tokens and QoS as text are those of rmw_zenoh's docs/design.md and
liveliness_utils.cpp; zenoh-plugin-ros2dds names topics otherwise (`ros2dds_key`). A malformed
attachment (number, time and sender of a message) ends a ROS process. Nothing here talks to Zenoh.
"""

from __future__ import annotations

import re
import struct
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import msgspec
import xxhash

from nodes.ros2.messages.topics import Topic, dds_type

Kind = Literal["NN", "MP", "MS", "SS", "SC"]  # node, publisher, subscription, server, client
ADMIN_SPACE = "@ros2_lv"


class NodeName(msgspec.Struct, frozen=True, kw_only=True):
    """A ROS node; `namespace` is ``/`` or ``/fleet/one``, `domain_id` ROS_DOMAIN_ID."""

    name: str
    namespace: str = "/"
    domain_id: int = 0


class Token(msgspec.Struct, frozen=True, kw_only=True):
    """Contents of a node's or endpoint's liveliness token."""

    key: str  # the token itself; its `gid` stands in its owner's messages
    kind: Kind
    node: NodeName
    zid: str  # the session's id as text
    topic: str = ""  # name of its topic or service; empty for a node
    extra: str = ""  # the rest, as shareable buffers of newer releases


_TOKEN = re.compile(
    r"@ros2_lv/(\d{1,9})/([^/]+)/\d+/\d+/(NN|MP|MS|SS|SC)/[^/]+/([^/]+)/([^/]+)"
    r"(?:/([^/]+)/[^/]+/[^/]+/\d?:\d?:\d?,\d*:\d*,\d*:\d*,\d*:\d?,\d*,\d*)?((?:/[^/]+)*)",
    re.ASCII,
)


def parse_token(key: str) -> Token:
    """Read a liveliness token; a `ValueError` if none of rmw_zenoh_cpp's."""
    match = _TOKEN.fullmatch(key)
    if match is None or (match[3] != "NN" and match[6] is None):
        raise ValueError(f"expected a liveliness token of ROS, found {key!r:.200}")
    kind: Any
    domain, zid, kind, namespace, name, topic, extra = match.groups("")
    namespace, topic = namespace.replace("%", "/"), topic.replace("%", "/")
    node = NodeName(name=name, namespace=namespace, domain_id=int(domain))
    return Token(key=key, kind=kind, node=node, zid=zid, topic=topic, extra=extra[1:])


def mangle(name: str) -> str:
    """Return a name as a component of a key: ``/`` becomes ``%``, and so does nothing."""
    return name.replace("/", "%") or "%"


def data_key(domain_id: int, topic: Topic) -> str:
    """Return the key of a topic's messages."""
    return f"{domain_id}/{topic.name.strip('/')}/{dds_type(topic.type)}/{topic.hash}"


def ros2dds_key(topic: Topic) -> str:
    """Return a topic's key in zenoh-plugin-ros2dds; the payload there has no attachment."""
    return topic.name.strip("/")


def node_token(node: NodeName, zid: str, node_id: int) -> str:
    """Return the liveliness token of a node."""
    return _token(node, zid, node_id, node_id, "NN")


def endpoint_token(
    node: NodeName, zid: str, node_id: int, id_: int, kind: Kind, topic: Topic
) -> str:
    """Return the liveliness token of a publisher or subscription, number `id_` in its session."""
    head = _token(node, zid, node_id, id_, kind)
    return f"{head}/{mangle(topic.name)}/{dds_type(topic.type)}/{topic.hash}/{topic.qos.text()}"


def endpoints_key(domain_id: int, kind: Kind, topic_name: str) -> str:
    """Return the key expression of the tokens of a topic's endpoints, and no others."""
    return f"{ADMIN_SPACE}/{domain_id}/*/*/*/{kind}/*/*/*/{mangle(topic_name)}/**"


def _token(node: NodeName, zid: str, node_id: int, id_: int, kind: Kind) -> str:
    namespace = mangle("" if node.namespace == "/" else node.namespace)
    ids = f"{zid}/{node_id}/{id_}"
    return f"{ADMIN_SPACE}/{node.domain_id}/{ids}/{kind}/%/{namespace}/{mangle(node.name)}"


_LAYOUT = struct.Struct("<qqB16s")  # two numbers, and 16 bytes after their length (Zenoh's)
SIZE = _LAYOUT.size


class Attachment(NamedTuple):
    """Contents of a message's attachment."""

    sequence: int  # number of the message from its publisher, from 1
    stamp: int  # wall clock, nanoseconds since 1970
    gid: bytes  # publisher's 16 bytes


class Message(NamedTuple):
    """A received message; its bytes are copied only on request."""

    size: int
    read: Callable[[], bytes]
    # Returns the attachment, to convert to bytes; `None` if there is none.
    attached: Callable[[], Any] = bytes

    @property
    def attachment(self) -> Attachment | None:
        """Return the attachment; ``None`` if missing or malformed."""
        try:
            return unpack(bytes(self.attached() or b""))
        except ValueError:
            return None


def gid(token: str) -> bytes:
    """Return a token owner's GID, as rmw_zenoh_cpp: its XXH3 hash, low 64 bits first."""
    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")


def pack(attachment: Attachment) -> bytes:
    """Return the attachment's 33 bytes; a `ValueError` if the GID has not 16 bytes."""
    if len(attachment.gid) != 16:
        raise ValueError(f"gid: expected 16 bytes, found {len(attachment.gid)}")
    return _LAYOUT.pack(attachment.sequence, attachment.stamp, 16, attachment.gid)


def unpack(data: bytes) -> Attachment:
    """Read an attachment; a `ValueError` if it is none."""
    if len(data) != SIZE or data[16] != 16:
        raise ValueError(f"attachment: expected {SIZE} bytes with a GID of 16, found {data!r:.80}")
    sequence, stamp, _, gid = _LAYOUT.unpack(data)
    return Attachment(sequence, stamp, gid)


LOG_INTERVAL = 5.0  # real seconds between two log lines about the same


class Complaints:
    """Counts of refusals and errors, by topic and kind. For any thread."""

    def __init__(
        self, log: Callable[[str], None], now: Callable[[], float] = time.monotonic
    ) -> None:
        self.counts: Counter[tuple[str, str]] = Counter()
        self._log, self._now = log, now
        self._logged: dict[tuple[str, str], tuple[float, int]] = {}
        self._lock = threading.Lock()

    def add(self, place: str, kind: str, detail: str = "") -> None:
        """Count an error; log once per `LOG_INTERVAL`, topic and (one of a few) kind."""
        with self._lock:
            key, now = (place, kind), self._now()
            self.counts[key] += 1
            last_time, before = self._logged.get(key, (-LOG_INTERVAL, 0))
            if now - last_time < LOG_INTERVAL:
                return
            count = self.counts[key]
            self._logged[key] = (now, count)
            repeated = count - before
        times = f" ({repeated} times since the last such line)" if repeated > 1 else ""
        self._log(f"{place}: {kind}{': ' if detail else ''}{detail:.300}{times}")
