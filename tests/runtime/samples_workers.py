"""Objects that tests run in worker processes."""

from __future__ import annotations

import asyncio
import concurrent.futures
import ctypes
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np


class UnpicklableError(Exception):
    """An error that cannot be made again from its arguments."""

    def __init__(self, first: int, second: int) -> None:
        super().__init__(f"{first} and {second}")


class UnloadableError(Exception):
    """An error that can be made again in its own process only."""

    def __reduce__(self) -> Any:
        return load_in, (os.getpid(),)


def load_in(pid: int) -> UnloadableError:
    """Make the error, in a process of this number."""
    if os.getpid() != pid:
        raise SystemExit("expected the process of the error")
    return UnloadableError("of another process")


class SpeechlessError(Exception):
    """An error whose message cannot be made."""

    def __str__(self) -> str:
        raise KeyError("no words")


ODD: dict[str, tuple[Callable[[], BaseException], str]] = {
    "StopIteration": (lambda: StopIteration("seeds"), "StopIteration: seeds"),
    "StopAsyncIteration": (lambda: StopAsyncIteration("seeds"), "StopAsyncIteration: seeds"),
    "asyncio's CancelledError": (lambda: asyncio.CancelledError("off"), "CancelledError: off"),
    "a thread's CancelledError": (
        lambda: concurrent.futures.CancelledError("off"),
        "CancelledError: off",
    ),
    "GeneratorExit": (lambda: GeneratorExit("gone"), "GeneratorExit: gone"),
    "KeyboardInterrupt": (lambda: KeyboardInterrupt("^C"), "KeyboardInterrupt: ^C (expected self."),
    "SystemExit": (lambda: SystemExit("enough"), "SystemExit: enough (expected self.stop(reason)"),
    "BaseException": (lambda: BaseException("of the very base"), "BaseException: of the very base"),
    "unpicklable": (lambda: UnpicklableError(1, 2), "UnpicklableError: 1 and 2"),
    "unloadable": (lambda: UnloadableError("of a process"), "UnloadableError: of a process"),
    "speechless": (SpeechlessError, "SpeechlessError: a message that cannot be made"),
}
"""Errors that a coroutine, a pickle or a message could stumble over, and how they are reported."""


def raise_odd(way: str) -> None:
    """Raise one of `ODD`."""
    error = ODD[way][0]()
    raise error


class Plant:
    """Does as it is told."""

    def __init__(self, trouble: str = "") -> None:
        if trouble == "value":
            raise ValueError("no such plant")
        if trouble == "file":
            raise FileNotFoundError(2, "No such file or directory", "plant.xml")
        if trouble == "exit":
            print("seed not found", flush=True)
            sys.exit(3)
        if trouble == "end":
            print("seed not found", flush=True)
            os._exit(3)
        if trouble == "hang":
            time.sleep(1000)
        self._kept: list[Any] = []

    def echo(self, *args: Any) -> Any:
        return args if len(args) != 1 else args[0]

    def keep(self, array: Any) -> int:
        self._kept.append(array)
        return len(self._kept)

    def kept(self, index: int) -> Any:
        return self._kept[index]

    def drop(self) -> None:
        self._kept.clear()

    def big(self, size: int, value: int) -> Any:
        return np.full(size, value, np.uint8)

    def cores(self) -> set[int]:
        return os.sched_getaffinity(0)

    def count(self, *args: Any) -> int:
        return len(args)

    def pid(self) -> int:
        return os.getpid()

    def variable(self, name: str) -> str | None:
        return os.environ.get(name)

    def sleep(self, seconds: float) -> float:
        time.sleep(seconds)
        return seconds

    def die(self, code: int) -> None:
        print("goodbye", flush=True)
        os._exit(code)

    def fall(self) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    def fail(self) -> None:
        raise LookupError("not here")

    def fail_oddly(self) -> None:
        raise UnpicklableError(1, 2)

    def fail_as(self, way: str) -> None:
        raise_odd(way)

    def lock(self) -> Any:
        import threading

        return threading.Lock()

    def say(self, text: str) -> None:
        print(text, flush=True)

    def say_in_c(self, text: str) -> None:
        """Print as a library does: into C's buffer."""
        ctypes.CDLL(None).printf(text.encode())

    def fill(self, size: int) -> int:
        """Have so many bytes for a moment."""
        return len(b"x" * size)

    @classmethod
    def again(cls) -> Plant:
        """Make a plant, under another name."""
        return cls()

    def burn(self, seconds: float) -> None:
        """Take processor time."""
        end = time.thread_time() + seconds
        while time.thread_time() < end:
            pass

    def burn_beside(self, seconds: float) -> None:
        """Take processor time in a thread, and wait for it in the next `join`."""
        self._thread = threading.Thread(target=self.burn, args=(seconds,))
        self._thread.start()

    def join(self) -> None:
        self._thread.join()

    def loop(self) -> None:
        """Never return."""
        while True:
            pass

    def loop_in_c(self) -> None:
        """Never return, nor let go of the interpreter's lock."""
        re.match(r"(a+)+$", "a" * 100 + "b")

    def start_a_program(self) -> int:
        """Start a program that lives on and shares the output; return its number."""
        return subprocess.Popen(["sleep", "60"]).pid

    def exit_beside_a_fork(self, code: int) -> None:
        """End, but for a fork that holds all that was open."""
        if fork := os.fork():
            print(fork, flush=True)
            os._exit(code)
        time.sleep(60)
        os._exit(0)

    def answer_twice(self) -> None:
        """Have a fork that goes on with what this process does."""
        os.fork()


def plain() -> Plant:
    """Make a plant, as a function instead of a class."""
    return Plant()
