"""Reads ahead of the loop in a thread, so that it never decodes an image; bounded by bytes."""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import Iterator

import numpy as np

from nodes.data.replay.reader import Timed

Batch = list[Timed]

MOST = 64
"""Events of a batch."""

LARGEST = 4 << 20
"""Bytes of a batch, but for its last event. Where batches end depends on the recording only."""

_SMALL = 512


class ReadAhead:
    """Events from a thread, batch by batch.

    Args:
        events: What to read; used in the thread only.
        limit: Bytes that may wait, but for the last batch.
    """

    def __init__(self, events: Iterator[Timed], limit: int) -> None:
        self._events = events
        self._limit = limit
        self._batches: deque[tuple[Batch, int]] = deque()
        self._waiting = 0
        self.peak = 0
        """Most bytes that ever waited."""
        self._change = threading.Condition()
        self._ended = False
        self._closed = False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="read ahead", daemon=True)
        self._thread.start()

    def take(self) -> Batch | None:
        """Wait for the next batch; `None` when all has been read. Not on a loop.

        Raises:
            ReplayError: Or whatever the reading raised.
        """
        with self._change:
            while not self._batches and not self._ended:
                self._change.wait()
            if self._batches:
                batch, size = self._batches.popleft()
                self._waiting -= size
                self._change.notify_all()
                return batch
            if self._error is not None:
                raise self._error
            return None

    def close(self) -> None:
        """Stop reading; returns when the thread is done. Not on a loop."""
        with self._change:
            self._closed = True
            self._change.notify_all()
        self._thread.join()

    def _run(self) -> None:
        try:
            self._read()
        except BaseException as error:
            self._error = error
        finally:
            close = getattr(self._events, "close", None)
            with contextlib.suppress(Exception):
                if close is not None:
                    close()
            with self._change:
                self._ended = True
                self._change.notify_all()

    def _read(self) -> None:
        batch: Batch = []
        size = 0
        for each in self._events:
            batch.append(each)
            size += _size_of(each)
            if len(batch) >= MOST or size >= LARGEST:
                if not self._put(batch, size):
                    return
                batch, size = [], 0
        self._put(batch, size)

    def _put(self, batch: Batch, size: int) -> bool:
        """Add a batch when there is room; tell whether more is wanted."""
        with self._change:
            while self._waiting and self._waiting + size > self._limit and not self._closed:
                self._change.wait()
            if self._closed:
                return False
            if batch:
                self._batches.append((batch, size))
                self._waiting += size
                self.peak = max(self.peak, self._waiting)
                self._change.notify_all()
            return True


def _size_of(timed: Timed) -> int:
    event = timed.event
    values = (getattr(event, name) for name in event.__struct_fields__)
    return _SMALL + sum(value.nbytes for value in values if isinstance(value, np.ndarray))
