"""A Zenoh session between the processes of one run: the only module of this room with zenoh.

Zenoh has threads of its own and no asyncio: what it calls runs there, and must not wait.
"""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zenoh

from runtime.config import NetworkConfig
from runtime.errors import PeerError

Heard = Callable[[str, bytes, bytes], None]
"""Called in Zenoh's thread with who sends, the message, and its payload."""

Seen = Callable[[str, bool], None]
"""Called in Zenoh's thread when a process appears (True) or disappears."""

CLOSING = 3.0
"""Seconds; a peer that stands still keeps Zenoh waiting for longer."""


class Session:
    """A place among the processes of a run.

    Args:
        run: The run's name; processes of other runs are not seen.
        network: Where processes meet, and how they talk.

    Raises:
        PeerError: The session cannot be opened.

    Attributes:
        id: By which the other processes know this one.
    """

    def __init__(self, run: str, network: NetworkConfig) -> None:
        try:
            self._session = zenoh.open(_configuration(network))
        except (zenoh.ZError, OSError) as error:
            raise PeerError(f"expected to meet at {network.meet}, found: {error}") from error
        self.id = str(self._session.info.zid())
        self._prefix = f"visnav/{re.sub(r'[^A-Za-z0-9_.-]', '_', run)}"
        self._publishers: dict[str, Any] = {}
        self._kept: list[Any] = []

    def appear(self, heard: Heard, seen: Seen) -> None:
        """Be seen by the others, and see them.

        Args:
            heard: Told of messages.
            seen: Told of processes that come and go, this one not included.
        """

        def take(sample: zenoh.Sample) -> None:
            head = sample.attachment
            if head is not None:
                sender = str(sample.key_expr).rpartition("/")[2]
                heard(sender, head.to_bytes(), sample.payload.to_bytes())

        def notice(sample: zenoh.Sample) -> None:
            other = str(sample.key_expr).rpartition("/")[2]
            if other != self.id:
                seen(other, sample.kind == zenoh.SampleKind.PUT)

        self._kept = [
            self._session.declare_subscriber(
                f"{self._prefix}/to/{self.id}/*", zenoh.handlers.Callback(take, indirect=False)
            ),
            self._session.liveliness().declare_token(f"{self._prefix}/here/{self.id}"),
            self._session.liveliness().declare_subscriber(
                f"{self._prefix}/here/*",
                zenoh.handlers.Callback(notice, indirect=False),
                history=True,
            ),
        ]

    def put(self, other: str, message: bytes, payload: bytes) -> None:
        """Send a message to a process; waits if the network does."""
        if other not in self._publishers:
            self._publishers[other] = self._session.declare_publisher(
                f"{self._prefix}/to/{other}/{self.id}",
                congestion_control=zenoh.CongestionControl.BLOCK,
                reliability=zenoh.Reliability.RELIABLE,
                express=True,
            )
        try:
            self._publishers[other].put(payload, attachment=message)
        except zenoh.ZError as error:
            raise PeerError(f"a message could not be sent: {error}") from error

    def close(self) -> None:
        """Leave. What goes on for longer than `CLOSING` goes on in a thread."""
        thread = threading.Thread(target=self._session.close, name="zenoh close")
        thread.start()
        thread.join(CLOSING)


def _configuration(network: NetworkConfig) -> zenoh.Config:
    """Return the file's configuration, and where that is silent, one that finds who is there."""
    plain, configuration = zenoh.Config(), zenoh.Config()
    if network.zenoh:
        if not Path(network.zenoh).is_file():
            raise PeerError(f"network.zenoh: expected a file, found none at {network.zenoh}")
        try:
            configuration = zenoh.Config.from_file(network.zenoh)
        except zenoh.ZError as error:
            raise PeerError(
                f"network.zenoh: {network.zenoh}: expected a Zenoh configuration, found: {error}"
            ) from error
    here = re.search(r"/(127\.|localhost)", network.meet)
    settings: dict[str, Any] = {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        # The first process on that host takes the address, and the others connect to it; each
        # tells the rest where else it listens.
        "listen/endpoints": [network.meet, "tcp/127.0.0.1:0" if here else "tcp/0.0.0.0:0"],
        "listen/exit_on_failure": False,
        "listen/timeout_ms": 0,
        "connect/endpoints": [network.meet],
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": {
            "period_init_ms": 100,
            "period_max_ms": 400,
            "period_increase_factor": 2,
        },
    }
    for key, value in settings.items():
        if configuration.get_json(key) == plain.get_json(key):
            configuration.insert_json5(key, json.dumps(value))
    lease = round(float(network.lease) * 1000)
    configuration.insert_json5("transport/link/tx/lease", json.dumps(lease))
    return configuration
