"""A peer in a process of its own, to be stopped or killed.

python -m tests.nodes.ros2.bridge.peer LOCATOR TOPIC [TOKEN …]

It declares the tokens, and subscribes to the topic as the bridge does (``ours``), and as who knows
nothing of messages that are kept (``plain``). It prints ``ready``, then a line for each message:
which of the two has it, its number, and its first bytes. What comes on ``junk`` it only reads.
"""

from __future__ import annotations

import sys
import time

import zenoh

from nodes.ros2.bridge.keys import Attachment, Message, NodeName, data_key, unpack
from nodes.ros2.bridge.session import Session
from nodes.ros2.messages.topics import Qos, Topic

DOMAIN = 3
PLAIN = Topic(name="/a/b", type="std_msgs/msg/Empty", hash="RIHS01_0", qos=Qos(depth=3))
KEPT = Topic(
    name="/kept",
    type="std_msgs/msg/Empty",
    hash="RIHS01_0",
    qos=Qos(transient_local=True, depth=2),
)


def tell(who: str, attachment: Attachment | None, data: bytes) -> None:
    """Print a message."""
    assert attachment is not None
    sys.stdout.write(f"{who} {attachment.sequence} {data[:5].decode()}\n")
    sys.stdout.flush()


def ours(message: Message) -> None:
    """Take a message of the bridge's own subscription."""
    tell("ours", message.attachment, message.read())


def plain(sample: zenoh.Sample) -> None:
    """Take a message of the other one."""
    assert sample.attachment is not None
    tell("plain", unpack(sample.attachment.to_bytes()), sample.payload.to_bytes())


def main() -> None:
    locator, name, *tokens = sys.argv[1:]
    node = NodeName(name="peer", domain_id=DOMAIN)
    session = Session(node, connect=(locator,), listen=())
    (topic,) = (candidate for candidate in (PLAIN, KEPT) if candidate.name == name)
    session.subscribe(topic, ours)
    kept = [
        session._session.declare_subscriber(data_key(DOMAIN, topic), plain),
        session._session.declare_subscriber("junk", lambda _: None),
        *(session._session.liveliness().declare_token(token) for token in tokens),
    ]
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    time.sleep(120)  # to be killed before
    del kept


if __name__ == "__main__":
    main()
