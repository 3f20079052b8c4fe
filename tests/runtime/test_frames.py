"""The frame in which a thread is, found without collecting garbage on the way."""

from __future__ import annotations

import gc
import subprocess
import sys
import threading

import pytest

from runtime.run.event_loop import frame_of

DEADLOCK = """
import gc, os, sys, threading, weakref
from runtime.run.event_loop import frame_of

class Garbage:
    def __init__(self):
        self.itself = self
        weakref.finalize(self, lambda: os.close(os.dup(1)))  # gives up the GIL

def start_threads():
    for _ in range(300):
        thread = threading.Thread(target=int)
        thread.start()
        thread.join()

gc.set_threshold(1, 1, 1)
starter = threading.Thread(target=start_threads)
starter.start()
while starter.is_alive():
    gc.disable()
    Garbage()
    gc.enable()  # the next thing that is made has it collected
    FIND(threading.main_thread().ident)
print("went on")
"""


def test_it_is_where_the_thread_is() -> None:
    begun, end = threading.Event(), threading.Event()

    def wait() -> None:
        begun.set()
        end.wait()

    thread = threading.Thread(target=wait)
    thread.start()
    begun.wait()
    assert thread.ident is not None
    frame = frame_of(thread.ident)
    names = set()
    while frame is not None:
        names.add(frame.f_code.co_name)
        frame = frame.f_back
    end.set()
    thread.join()
    assert "wait" in names
    assert frame_of(-1) is None


@pytest.mark.parametrize("collects", [True, False])
def test_the_collector_is_left_as_it_was(collects: bool) -> None:
    (gc.enable if collects else gc.disable)()
    try:
        frame_of(threading.get_ident())
        assert gc.isenabled() is collects
    finally:
        gc.enable()


def test_threads_that_start_meanwhile_and_finalizers_that_let_them_stop_nothing() -> None:
    program = DEADLOCK.replace("FIND", "frame_of")
    done = subprocess.run(  # our own program
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=50, check=True
    )
    assert "went on" in done.stdout
