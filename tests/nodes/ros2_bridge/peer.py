"""A peer in a process of its own that only knows Zenoh, to be stopped or killed.

python -m tests.nodes.ros2_bridge.peer LOCATOR KEY [TOKEN …]

It declares the tokens and subscribes to the key twice: as a plain subscriber, and as rmw_zenoh_cpp
does for what is reliable and transient local. It prints ``ready`` and then a line for each message:
which of the two has it, its number, and its first bytes. What comes on ``junk`` it only reads.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import zenoh

from nodes.ros2_bridge.attachment import unpack
from tests.nodes.ros2_bridge.network import zenoh_session


def printer(who: str) -> Callable[[zenoh.Sample], None]:
    """Return what prints a message."""

    def tell(sample: zenoh.Sample) -> None:
        assert sample.attachment is not None
        number = unpack(sample.attachment.to_bytes()).sequence
        sys.stdout.write(f"{who} {number} {sample.payload.to_bytes()[:5].decode()}\n")
        sys.stdout.flush()

    return tell


def main() -> None:
    locator, key, *tokens = sys.argv[1:]
    ext = zenoh.ext
    with zenoh_session(connect=locator) as session:
        held = [session.liveliness().declare_token(token) for token in tokens]
        ext.declare_advanced_subscriber(
            session,
            key,
            printer("advanced"),
            history=ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
            recovery=ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
        )
        session.declare_subscriber(key, printer("plain"))
        session.declare_subscriber("junk", lambda _: None)
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        time.sleep(120)  # to be killed before
        del held


if __name__ == "__main__":
    main()
