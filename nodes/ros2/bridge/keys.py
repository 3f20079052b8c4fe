"""How rmw_zenoh_cpp names things on Zenoh: data keys, liveliness tokens, QoS as text.

Source: rmw_zenoh, docs/design.md and liveliness_utils.cpp. zenoh-plugin-ros2dds names topics
otherwise (`ros2dds_key`). Nothing here talks to Zenoh.
"""

from __future__ import annotations

import re
from typing import Any, Literal

import msgspec

from nodes.ros2.messages.topics import Topic, dds_type

Kind = Literal["NN", "MP", "MS", "SS", "SC"]
"""Node, publisher, subscription, service server, service client."""

ADMIN_SPACE = "@ros2_lv"


class NodeName(msgspec.Struct, frozen=True, kw_only=True):
    """A ROS node.

    Attributes:
        name: Without namespace.
        namespace: ``/`` or ``/fleet/one``.
        domain_id: ROS_DOMAIN_ID.
    """

    name: str
    namespace: str = "/"
    domain_id: int = 0


class Token(msgspec.Struct, frozen=True, kw_only=True):
    """What a liveliness token says of a node or of one of its endpoints.

    Attributes:
        key: The token itself; `attachment.gid` of it stands in its owner's messages.
        kind: What it is of.
        node: Whose.
        zid: The session's id as text.
        topic: The name of its topic or service; empty for a node.
        extra: What follows; newer releases say there which buffers an endpoint can share.
    """

    key: str
    kind: Kind
    node: NodeName
    zid: str
    topic: str = ""
    extra: str = ""


_TOKEN = re.compile(
    r"@ros2_lv/(\d{1,9})/([^/]+)/\d+/\d+/(NN|MP|MS|SS|SC)/[^/]+/([^/]+)/([^/]+)"
    r"(?:/([^/]+)/[^/]+/[^/]+/\d?:\d?:\d?,\d*:\d*,\d*:\d*,\d*:\d?,\d*,\d*)?((?:/[^/]+)*)",
    re.ASCII,
)


def parse_token(key: str) -> Token:
    """Read a liveliness token.

    Raises:
        ValueError: It is none that rmw_zenoh_cpp would declare.
    """
    found = _TOKEN.fullmatch(key)
    if found is None or (found[3] != "NN" and found[6] is None):
        raise ValueError(f"expected a liveliness token of ROS, found {key!r:.200}")
    kind: Any
    domain, zid, kind, namespace, name, topic, extra = found.groups("")
    namespace, topic = namespace.replace("%", "/"), topic.replace("%", "/")
    node = NodeName(name=name, namespace=namespace, domain_id=int(domain))
    return Token(key=key, kind=kind, node=node, zid=zid, topic=topic, extra=extra[1:])


def mangle(name: str) -> str:
    """Return a name as one component of a key: ``/`` becomes ``%``, nothing becomes ``%``."""
    return name.replace("/", "%") or "%"


def data_key(domain_id: int, topic: Topic) -> str:
    """Return the key on which a topic's messages are put."""
    return f"{domain_id}/{topic.name.strip('/')}/{dds_type(topic.type)}/{topic.hash}"


def ros2dds_key(topic: Topic) -> str:
    """Return the key that zenoh-plugin-ros2dds uses; its payload has no attachment."""
    return topic.name.strip("/")


def node_token(node: NodeName, zid: str, node_id: int) -> str:
    """Return the liveliness token of a node."""
    return _token(node, zid, node_id, node_id, "NN")


def endpoint_token(
    node: NodeName, zid: str, node_id: int, id_: int, kind: Kind, topic: Topic
) -> str:
    """Return the liveliness token of a publisher or subscription.

    Args:
        node: To which it belongs.
        zid: The session's id as text.
        node_id: The node's number in the session.
        id_: Its own number in the session.
        kind: What it is.
        topic: Its topic.
    """
    head = _token(node, zid, node_id, id_, kind)
    return f"{head}/{mangle(topic.name)}/{dds_type(topic.type)}/{topic.hash}/{topic.qos.text()}"


def endpoints_key(domain_id: int, kind: Kind, topic_name: str) -> str:
    """Return the key expression that the tokens of a topic's endpoints match, and no others."""
    return f"{ADMIN_SPACE}/{domain_id}/*/*/*/{kind}/*/*/*/{mangle(topic_name)}/**"


def _token(node: NodeName, zid: str, node_id: int, id_: int, kind: Kind) -> str:
    namespace = mangle("" if node.namespace == "/" else node.namespace)
    ids = f"{zid}/{node_id}/{id_}"
    return f"{ADMIN_SPACE}/{node.domain_id}/{ids}/{kind}/%/{namespace}/{mangle(node.name)}"
