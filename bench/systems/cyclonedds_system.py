"""Cyclone DDS between processes, over UDP on the loopback, with its Python binding.

Topics are reliable and keep all; node 1 and the others wait in `DataReader.take_iter`, as the
binding's examples do. The array of a large ping is an array of octets, which the binding copies
some times on both sides in Python. The nodes meet in a domain of their own without multicast;
fragments and socket buffers are as large as the system lets them be, or large pings get lost and
are sent again after 100 ms.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import random
import types
from collections.abc import Iterator
from typing import Any

import numpy as np

from bench.system import LARGE_SHAPE, Case, Samples, in_processes, large_array, packaged
from bench.systems.children import Job, answer, children

_BYTES = int(np.prod(LARGE_SHAPE)) * 4

_DOMAIN = """
<CycloneDDS><Domain Id="any">
  <General>
    <Interfaces><NetworkInterface address="127.0.0.1" multicast="false"/></Interfaces>
    <AllowMulticast>false</AllowMulticast>
    <MaxMessageSize>65500B</MaxMessageSize>
    <FragmentSize>64000B</FragmentSize>
  </General>
  <Internal>
    <SocketReceiveBufferSize max="16MB"/><SocketSendBufferSize max="16MB"/>
  </Internal>
  <Discovery>
    <ParticipantIndex>auto</ParticipantIndex>
    <MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>
    <Peers><Peer address="127.0.0.1"/></Peers>
  </Discovery>
</Domain></CycloneDDS>
"""


class _Domain:
    def __init__(self, number: int, *, large: bool) -> None:
        load = importlib.import_module
        dds: Any = load("cyclonedds.core")
        self._duration: Any = load("cyclonedds.util").duration
        self._pub: Any = load("cyclonedds.pub")
        self._sub: Any = load("cyclonedds.sub")
        domain: Any = load("cyclonedds.domain")
        self._domain = domain.Domain(number, _DOMAIN)
        self._participant = domain.DomainParticipant(number)
        reliable = dds.Policy.Reliability.Reliable(self._duration(seconds=10))
        self._qos = dds.Qos(reliable, dds.Policy.History.KeepAll)
        self.ping, self.pong = _ping(large=large), _pong()

    def writer(self, kind: type) -> Any:
        """Return a data writer of a message type."""
        return self._pub.DataWriter(self._participant, self._topic(kind), qos=self._qos)

    def reader(self, kind: type) -> Iterator[Any]:
        """Return an iterator of a type's samples; `None` after a second without any."""
        reader = self._sub.DataReader(self._participant, self._topic(kind), qos=self._qos)
        second = self._duration(seconds=1)

        def read() -> Iterator[Any]:
            while True:
                yield from reader.take_iter(timeout=second)
                yield None

        return read()

    def _topic(self, kind: type) -> Any:
        topic: Any = importlib.import_module("cyclonedds.topic").Topic
        return topic(self._participant, kind.__name__, kind, qos=self._qos)


def _struct(name: str, **fields: object) -> Any:
    idl: Any = importlib.import_module("cyclonedds.idl")

    def body(namespace: dict[str, Any]) -> None:
        namespace["__annotations__"] = fields
        namespace["__module__"] = __name__

    made = types.new_class(name, (idl.IdlStruct,), {"typename": f"bench.{name}"}, body)
    return dataclasses.dataclass(made)


def _ping(*, large: bool) -> Any:
    t: Any = importlib.import_module("cyclonedds.idl.types")
    payload = {"payload": t.array[t.uint8, _BYTES]} if large else {}
    return _struct(
        "Ping", stamp=t.int64, sender=t.int32, receiver=t.int32, number=t.int32, **payload
    )


def _pong() -> Any:
    t: Any = importlib.import_module("cyclonedds.idl.types")
    return _struct("Pong", stamp=t.int64, number=t.int32)


def serve(job: Job) -> None:
    """Be a node."""
    large = job.case != "small"
    domain = _Domain(int(job.address), large=large)
    pongs = domain.writer(domain.pong)
    for ping in domain.reader(domain.ping):
        if ping is None:
            continue
        if large:
            np.frombuffer(ping.payload, np.float32).reshape(LARGE_SHAPE)
        number = answer(job.node, ping.receiver, ping.number)
        if number is not None:
            pongs.write(domain.pong(ping.stamp, number))


def measure(case: Case) -> Samples:
    """Measure round trips."""
    # Ports follow from the number of the domain; beyond 100, the system may have given them away.
    number = random.randrange(1, 100)
    domain = _Domain(number, large=case.case != "small")
    pings = domain.writer(domain.ping)
    pongs = domain.reader(domain.pong)
    payload = {} if case.case == "small" else {"payload": large_array().data.cast("B")}
    make = functools.partial(domain.ping, **payload)

    def send(stamp: int, receiver: int, number: int) -> None:
        pings.write(make(stamp=stamp, sender=1, receiver=receiver, number=number))

    def receive() -> int | None:
        pong = next(pongs)
        return None if pong is None else pong.number

    with children(__name__, case, str(number)) as crew:
        return crew.exchange(case, send, receive)


SYSTEMS = (
    in_processes("cyclonedds", ("stream",), measure, 200, **packaged(cyclonedds="cyclonedds")),
)
