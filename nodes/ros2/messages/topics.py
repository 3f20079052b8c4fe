"""Topics: their names as ROS allows them, their types and their quality of service."""

from __future__ import annotations

import re

import msgspec

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
        keep_all: Whether a publisher waits for who is slow rather than drop a message.
    """

    reliable: bool = True
    transient_local: bool = False
    depth: int = 10
    keep_all: bool = False

    def text(self) -> str:
        """Return what stands in a token; what is rmw_zenoh_cpp's default stays empty.

        ``reliability:durability:history,depth:deadline s,ns:lifespan s,ns:liveliness,lease s,ns``
        """
        reliability = "" if self.reliable else "2"
        durability = "1" if self.transient_local else ""
        history = "2" if self.keep_all else ""
        depth = "" if self.depth == _DEFAULT_DEPTH else str(self.depth)
        return f"{reliability}:{durability}:{history},{depth}:,:,:,,"


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
