"""How rmw_zenoh_cpp names things on Zenoh: data keys, liveliness tokens, QoS as text.

Source: rmw_zenoh, docs/design.md and liveliness_utils.cpp. zenoh-plugin-ros2dds names topics
otherwise (`ros2dds_key`). Nothing here talks to Zenoh.
"""

from __future__ import annotations

import re
from typing import Literal

import msgspec

Kind = Literal["NN", "MP", "MS", "SS", "SC"]
"""Node, publisher, subscription, service server, service client."""

ADMIN_SPACE = "@ros2_lv"

NO_HASH = "TypeHashNotSupported"
"""What Humble says in the place of a type's hash."""

_DEFAULT_DEPTH = 42
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


class Qos(msgspec.Struct, frozen=True, kw_only=True):
    """Quality of service, as far as we use it.

    Attributes:
        reliable: Else best effort.
        transient_local: Whether late joiners get the last `depth` messages.
        depth: How many messages are kept.
    """

    reliable: bool = True
    transient_local: bool = False
    depth: int = 10

    def text(self) -> str:
        """Return what stands in a token; what is rmw_zenoh_cpp's default stays empty.

        ``reliability:durability:history,depth:deadline s,ns:lifespan s,ns:liveliness,lease s,ns``
        """
        reliability = "" if self.reliable else "2"
        durability = "1" if self.transient_local else ""
        depth = "" if self.depth == _DEFAULT_DEPTH else str(self.depth)
        return f"{reliability}:{durability}:,{depth}:,:,:,,"


class Topic(msgspec.Struct, frozen=True, kw_only=True):
    """A topic as one end of it sees it.

    Attributes:
        name: With its leading slash.
        type: ``sensor_msgs/msg/Image``.
        hash: ``RIHS01_…``, or `NO_HASH`.
        qos: Of this end.
    """

    name: str
    type: str
    hash: str
    qos: Qos = Qos()


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


def dds_type(type_: str) -> str:
    """Return ``sensor_msgs::msg::dds_::Image_`` for ``sensor_msgs/msg/Image``.

    Raises:
        ValueError: It is not of the form ``package/msg/Type``.
    """
    parts = type_.split("/")
    if len(parts) != 3 or not all(_NAME.fullmatch(part) for part in parts):
        raise ValueError(f'expected a type such as "sensor_msgs/msg/Image", found {type_!r}')
    package, folder, name = parts
    return f"{package}::{folder}::dds_::{name}_"


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


def graph_key(domain_id: int) -> str:
    """Return the key expression that all tokens of a domain match."""
    return f"{ADMIN_SPACE}/{domain_id}/**"


def topic_name(namespace: str, name: str) -> str:
    """Return a topic's full name; a name that begins with a slash stands for itself.

    Raises:
        ValueError: ROS would not allow the name.
    """
    full = name if name.startswith("/") else f"{namespace.rstrip('/')}/{name}"
    if not all(_NAME.fullmatch(part) for part in full[1:].split("/")):
        raise ValueError(
            "expected a topic of letters, digits, _ and /, none of its parts beginning with a "
            f"digit, found {name!r}"
        )
    return full


def ros_name(source: str) -> str:
    """Return what comes nearest to the name of a source of events that ROS allows."""
    parts = [re.sub(r"[^A-Za-z0-9_]", "_", part) for part in source.split("/") if part]
    return "/".join(f"_{part}" if part[0].isdigit() else part for part in parts) or "_"


def _token(node: NodeName, zid: str, node_id: int, id_: int, kind: Kind) -> str:
    namespace = mangle("" if node.namespace == "/" else node.namespace)
    ids = f"{zid}/{node_id}/{id_}"
    return f"{ADMIN_SPACE}/{node.domain_id}/{ids}/{kind}/%/{namespace}/{mangle(node.name)}"
