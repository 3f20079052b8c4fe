"""What waits to be written is bounded by bytes, and nothing is dropped in silence."""

from __future__ import annotations

import threading

import msgspec
import numpy as np

from events import Image
from nodes.data.recorder.writer_process import SMALL, Backlog, WhenFull
from tests.nodes.data.recorder.samples import depth, image, imu

LARGE = SMALL + 400 * 400 * 3


def backlog(when_full: WhenFull, room: int = 3) -> Backlog:
    return Backlog(room * LARGE, when_full)


def large(stamp: int) -> Image:
    return msgspec.structs.replace(image(stamp), data=np.zeros((400, 400, 3), np.uint8))


def taken(queue: Backlog) -> list[int]:
    stamps = []
    while (waiting := queue.pop()) is not None:
        stamps.append(waiting.event.stamp)
        queue.done(waiting)
    return stamps


def test_events_are_references_in_order_with_their_times() -> None:
    """Nothing is copied; bytes are counted until the writing is done."""
    queue = backlog("wait")
    event = depth(1)
    queue.add(5, event)
    queue.add(6, imu(2))
    assert queue.bytes == SMALL + event.data.nbytes + SMALL == queue.peak
    first = queue.pop()
    assert first is not None
    assert first.event is event
    assert first.time == 5
    assert queue.bytes == SMALL + event.data.nbytes + SMALL
    queue.done(first)
    assert queue.bytes == SMALL
    assert taken(queue) == [2]
    assert queue.pop() is None
    assert queue.bytes == 0


def test_wait_keeps_everything_and_says_that_it_is_full() -> None:
    """Whoever feeds it has to wait, in a thread, until half of it is written."""
    queue = backlog("wait")
    for stamp in range(5):
        queue.add(stamp, large(stamp))
    assert queue.is_full
    waiter = threading.Thread(target=queue.wait_for_room)
    waiter.start()
    assert taken(queue) == [0, 1, 2, 3, 4]
    waiter.join(5.0)
    assert not waiter.is_alive()
    assert not queue.is_full
    assert queue.dropped == 0


def test_drop_images_keeps_what_is_small() -> None:
    """Images beyond the limit are left out; measurements are not."""
    queue = backlog("drop_images")
    for stamp in range(10):
        queue.add(stamp, large(stamp) if stamp % 2 else imu(stamp))
    assert taken(queue) == [0, 1, 2, 3, 4, 6, 8]
    assert queue.dropped == 3


def test_drop_images_is_bounded_for_small_events_too() -> None:
    """Beyond a quarter more than the limit, the oldest makes room."""
    queue = Backlog(8 * SMALL, "drop_images")
    for stamp in range(20):
        queue.add(stamp, imu(stamp))
    assert taken(queue) == list(range(10, 20))
    assert queue.dropped == 10


def test_drop_oldest_keeps_the_newest() -> None:
    """Whatever has waited longest goes, and is counted."""
    queue = backlog("drop_oldest")
    for stamp in range(6):
        queue.add(stamp, large(stamp))
    assert taken(queue) == [3, 4, 5]
    assert queue.dropped == 3
    assert queue.bytes == 0


def test_a_released_backlog_keeps_nobody_waiting() -> None:
    """When nothing will be written any more, simulated time must go on."""
    queue = backlog("wait")
    for stamp in range(5):
        queue.add(stamp, large(stamp))
    queue.release()
    queue.wait_for_room()
    assert not queue.is_full
