"""A viewer for tests: speaks ``foxglove.sdk.v1`` and reads protobuf, without Foxglove's library.

Protocol: https://github.com/foxglove/ws-protocol; wire format:
https://protobuf.dev/programming-guides/encoding.
"""

from __future__ import annotations

import contextlib
import json
import struct
import time
from collections import defaultdict
from typing import Any

from websockets.sync.client import connect
from websockets.typing import Subprotocol

TIMEOUT = 10.0


class Viewer:
    """A connection to a server, with everything that was said on it.

    Attributes:
        info: The server's first words.
        channels: What it advertised, by topic.
        messages: What came on each topic: stamp (ns) and bytes.
        times: What it said of its time (ns).
    """

    def __init__(self, address: str) -> None:
        self._open = contextlib.ExitStack()
        said = connect(address, subprotocols=[Subprotocol("foxglove.sdk.v1")], max_size=None)
        self.connection = self._open.enter_context(said)
        self.info: dict[str, Any] = json.loads(self.connection.recv(TIMEOUT))
        self.channels: dict[str, dict[str, Any]] = {}
        self.messages: dict[str, list[tuple[int, bytes]]] = defaultdict(list)
        self.times: list[int] = []
        self._topics: dict[int, str] = {}

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Say goodbye, if the connection still stands."""
        self._open.close()

    def take(self, timeout: float = TIMEOUT) -> None:
        """Take one message of any kind."""
        data = self.connection.recv(timeout)
        if isinstance(data, str):
            said = json.loads(data)
            if said["op"] == "advertise":
                self.channels |= {channel["topic"]: channel for channel in said["channels"]}
        elif data[0] == 1:
            subscription, stamp = struct.unpack_from("<IQ", data, 1)
            self.messages[self._topics[subscription]].append((stamp, data[13:]))
        elif data[0] == 2:
            self.times.append(struct.unpack_from("<Q", data, 1)[0])

    def subscribe(self, *topics: str) -> None:
        """Subscribe to topics, once they have been advertised."""
        while not set(topics) <= self.channels.keys():
            self.take()
        wanted = []
        for topic in topics:
            self._topics[len(self._topics)] = topic
            identity = len(self._topics) - 1
            wanted.append({"id": identity, "channelId": self.channels[topic]["id"]})
        self.connection.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def next(self, topic: str) -> bytes:
        """Return the oldest message of a topic that has not been returned."""
        end = time.monotonic() + TIMEOUT
        while not self.messages[topic]:
            self.take(max(end - time.monotonic(), 0.01))
        return self.messages[topic].pop(0)[1]


Fields = dict[int, list[Any]]
"""Values by field number: int, float, or bytes."""


def fields(data: bytes) -> Fields:
    """Read a protobuf message, one level deep."""
    values: Fields = defaultdict(list)
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        value: Any
        match key & 7:
            case 0:
                value, at = _varint(data, at)
            case 1:
                (value,) = struct.unpack_from("<d", data, at)
                at += 8
            case 2:
                size, at = _varint(data, at)
                value = data[at : at + size]
                at += size
            case 5:
                (value,) = struct.unpack_from("<I", data, at)
                at += 4
            case kind:
                raise ValueError(f"expected a wire type, found {kind}")
        values[key >> 3].append(value)
    return values


def doubles(data: bytes, count: int) -> list[float]:
    """Read a message of so many numbers; those that are 0 are not there."""
    values = fields(data)
    return [values[i + 1][0] if i + 1 in values else 0.0 for i in range(count)]


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[at]
        at += 1
        value |= (byte & 127) << shift
        shift += 7
        if byte < 128:
            return value, at
