"""iceoryx2 between processes, in shared memory: polled, or woken by its events.

A ping is written into memory that the publisher lends, and read where it lies. ``large`` copies the
array into it; ``large-shared`` writes the header only, as a producer would that makes its images
in lent memory. Publishers wait rather than drop. Polling keeps a core busy a node, and is measured
for no more nodes than there are cores; with events each node sleeps in a listener.
"""

from __future__ import annotations

import ctypes
import functools
import importlib
import os
import uuid
from collections.abc import Callable
from typing import Any

import numpy as np

from bench.system import ALL_CASES, LARGE_SHAPE, Case, Samples, in_processes, large_array, packaged
from bench.systems.children import Job, answer, children

_BYTES = int(np.prod(LARGE_SHAPE)) * 4
_POLLS = 100_000


class Small(ctypes.Structure):
    """A ping without payload, and a pong."""

    _fields_ = (
        ("stamp", ctypes.c_int64),
        ("sender", ctypes.c_int32),
        ("receiver", ctypes.c_int32),
        ("number", ctypes.c_int32),
    )


class Large(ctypes.Structure):
    """A ping with an array."""

    _fields_ = (*Small._fields_, ("array", ctypes.c_float * (_BYTES // 4)))


class _Topic:
    def __init__(self, node: Any, name: str, kind: type, *, events: bool) -> None:
        iox2: Any = importlib.import_module("iceoryx2")
        self._iox2 = iox2
        self._samples = (
            node.service_builder(iox2.ServiceName.new(name))
            .publish_subscribe(kind)
            .enable_safe_overflow(False)
            .subscriber_max_buffer_size(2)
            .max_subscribers(32)
            .max_publishers(32)
            .max_nodes(64)
            .open_or_create()
        )
        self._events = None
        if events:
            builder = node.service_builder(iox2.ServiceName.new(name)).event()
            builder = builder.max_listeners(32).max_notifiers(32).max_nodes(64)
            self._events = builder.open_or_create()

    def sender(self) -> tuple[Any, Callable[[], object]]:
        """Return a publisher, and the function to call after each send."""
        retry = self._iox2.BackpressureStrategy.RetryUntilDelivered
        publisher = self._samples.publisher_builder().backpressure_strategy(retry).create()
        if self._events is None:
            return publisher, lambda: None
        return publisher, self._events.notifier_builder().create().notify

    def receiver(self) -> Callable[[], Any]:
        """Return a function to wait for a sample, up to a second; `None` without any."""
        receive = self._samples.subscriber_builder().create().receive
        if self._events is None:

            def poll() -> Any:
                for _ in range(_POLLS):
                    sample = receive()
                    if sample is not None:
                        return sample
                return None

            return poll
        timed_wait = self._events.listener_builder().create().timed_wait
        second = self._iox2.Duration.from_secs(1)

        def wait() -> Any:
            sample = receive()
            if sample is None:
                timed_wait(second)
                sample = receive()
            return sample

        return wait


def _node() -> Any:
    iox2: Any = importlib.import_module("iceoryx2")
    iox2.set_log_level(iox2.LogLevel.Error)
    quiet = iox2.SignalHandlingMode.Disabled
    return iox2.NodeBuilder.new().signal_handling_mode(quiet).create(iox2.ServiceType.Ipc)


def serve(job: Job) -> None:
    """Be a node."""
    node = _node()
    events = job.variant == "events"
    kind = Small if job.case == "small" else Large
    receive = _Topic(node, f"{job.address}/ping", kind, events=events).receiver()
    pongs, notify = _Topic(node, f"{job.address}/pong", Small, events=events).sender()
    while True:
        sample = receive()
        if sample is None:
            continue
        ping = sample.payload().contents
        if kind is Large:
            np.frombuffer(ping.array, np.float32).reshape(LARGE_SHAPE)
        number = answer(job.node, ping.receiver, ping.number)
        if number is not None:
            pongs.send_copy(Small(ping.stamp, job.node, 1, number))
            notify()
        del ping, sample


def measure(case: Case, variant: str) -> Samples:
    """Measure round trips, polled or with events."""
    node = _node()
    address = f"bench-{os.getpid()}-{uuid.uuid4().hex[:8]}"
    events = variant == "events"
    kind = Small if case.case == "small" else Large
    pings, notify = _Topic(node, f"{address}/ping", kind, events=events).sender()
    next_pong = _Topic(node, f"{address}/pong", Small, events=events).receiver()
    array = large_array()

    def send(stamp: int, receiver: int, number: int) -> None:
        if kind is Small:
            pings.send_copy(Small(stamp, 1, receiver, number))
        else:
            sample = pings.loan_uninit()
            ping = sample.payload().contents
            ping.stamp, ping.sender, ping.receiver, ping.number = stamp, 1, receiver, number
            if case.case == "large":
                ctypes.memmove(ping.array, array.ctypes.data, _BYTES)
            sample.assume_init().send()
        notify()

    def receive() -> int | None:
        pong = next_pong()
        return None if pong is None else pong.payload().contents.number

    try:
        with children(__name__, case, address, variant) as crew:
            return crew.exchange(case, send, receive)
    finally:
        # The other nodes did not leave of their own accord; what they had in memory goes now.
        node.try_cleanup_dead_nodes()


SYSTEMS = tuple(
    in_processes(
        f"iceoryx2 ({variant})",
        ("stream",),
        functools.partial(measure, variant=variant),
        slowness,
        ALL_CASES,
        max_nodes=max_nodes,
        **packaged(iceoryx2="iceoryx2"),
    )
    for variant, slowness, max_nodes in (
        ("polled", 8, max(2, min(16, os.cpu_count() or 2))),
        ("events", 70, 16),
    )
)
