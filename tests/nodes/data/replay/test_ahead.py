"""Reading ahead: all in order, never more in memory than allowed, errors where they belong."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import msgspec
import numpy as np
import pytest

from nodes.data.replay.node import MOST, Batch, ReadAhead
from nodes.data.replay.reader import ReplayError, Timed
from tests.nodes.data.recorder.samples import image, imu

PIXELS = 1 << 20


def timed_images(count: int, made: list[int]) -> Iterator[Timed]:
    for stamp in range(count):
        made.append(stamp)
        data = np.zeros((1024, 1024), np.uint8)
        yield Timed(stamp, msgspec.structs.replace(image(stamp, grey=True), data=data))


def drain(ahead: ReadAhead) -> list[Batch]:
    batches = []
    while (batch := ahead.pop()) is not None:
        batches.append(batch)
    return batches


def test_all_comes_in_order_and_batches_are_the_same_every_time() -> None:
    """Where they end must not depend on which thread was quicker: simulated time sees it."""

    def read() -> list[list[int]]:
        ahead = ReadAhead(iter([Timed(n, imu(n)) for n in range(150)]), 1 << 20)
        return [[timed.time for timed in batch] for batch in drain(ahead)]

    batches = read()
    assert [len(batch) for batch in batches] == [MOST, MOST, 150 - 2 * MOST]
    assert sum(batches, []) == list(range(150))  # noqa: RUF017  # a few
    assert read() == batches


def test_memory_is_bounded() -> None:
    """No more is read than may wait, and a batch."""
    made: list[int] = []
    ahead = ReadAhead(timed_images(60, made), 8 * PIXELS)
    ahead._thread.join(0.3)  # in which it would read everything, if it could
    assert ahead._thread.is_alive()
    assert len(made) <= 13
    assert sum(len(batch) for batch in drain(ahead)) == 60
    assert ahead.peak <= 9 * PIXELS


def test_closing_stops_the_reading() -> None:
    """The thread ends, and what it reads is closed."""
    closed = threading.Event()

    def events() -> Iterator[Timed]:
        try:
            yield from timed_images(1000, [])
        finally:
            closed.set()

    ahead = ReadAhead(events(), 8 * PIXELS)
    ahead.pop()
    ahead.close()
    assert closed.is_set()


def test_an_error_comes_after_what_was_read_before() -> None:
    """To whoever takes, not to the thread."""

    def events() -> Iterator[Timed]:
        for n in range(MOST):
            yield Timed(n, imu(n))
        raise ReplayError("a.mcap: damaged")

    ahead = ReadAhead(events(), 1 << 20)
    assert len(ahead.pop() or []) == MOST
    with pytest.raises(ReplayError, match="damaged"):
        ahead.pop()
