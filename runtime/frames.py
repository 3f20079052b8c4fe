"""The frame in which a thread of this process is."""

from __future__ import annotations

import gc
import sys
import threading
from types import FrameType

_one_at_a_time = threading.Lock()


def frame_of(thread_id: int) -> FrameType | None:
    """Return the frame in which a thread is; `None` if there is no such thread.

    Up to Python 3.11, `sys._current_frames` collects garbage while it holds a lock that every
    thread takes as it starts and ends; if a finalizer gives up the GIL then, the process stands
    still for ever (https://github.com/python/cpython/issues/106883). So nothing is collected.
    """
    if sys.version_info >= (3, 12):
        return sys._current_frames().get(thread_id)
    with _one_at_a_time:
        collects = gc.isenabled()
        gc.disable()
        try:
            return sys._current_frames().get(thread_id)
        finally:
            if collects:
                gc.enable()
