"""A display without a screen, and runs with a window on it: what the tests of windows stand on.

Needs the Debian packages xvfb and xdotool (which bring setxkbmap and libX11 along).
"""

from __future__ import annotations

import ctypes
import json
import os
import queue
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

DEADLINE = 20.0
"""Seconds after which something that should have happened has not."""

MISSING = [program for program in ("Xvfb", "xdotool") if shutil.which(program) is None]

Message = dict[str, Any]

KEYBOARD: Message = {"name": "keyboard", "type": "ImageWindow"}


class Display:
    """An X server of our own, on a number that is free."""

    def __init__(self, folder: Path) -> None:
        self._screen = folder / "Xvfb_screen0"
        read, write = os.pipe()
        # Keys repeat soon and quickly, so that a test of held keys need not wait for it.
        self._server = subprocess.Popen(
            f"Xvfb -displayfd {write} -screen 0 800x600x24 -nolisten tcp -fbdir {folder} "
            "-ardelay 50 -arinterval 10".split(),
            pass_fds=[write],
            stderr=subprocess.DEVNULL,
        )
        os.close(write)
        with os.fdopen(read) as number:
            self.name = f":{number.readline().strip()}"

    def close(self) -> None:
        self._server.terminate()
        self._server.wait()

    def environment(self) -> dict[str, str]:
        """Return ours, with this display in place of whatever there is."""
        return without_display() | {"DISPLAY": self.name, "LIBGL_ALWAYS_SOFTWARE": "1"}

    def call(self, *command: str) -> str:
        """Run a program on this display and return what it printed."""
        return subprocess.run(
            command, env=self.environment(), check=True, capture_output=True, text=True, timeout=20
        ).stdout.strip()

    def pixels(self) -> npt.NDArray[np.uint8]:
        """Return what is on the screen: RGB, shape (600, 800, 3)."""
        data = self._screen.read_bytes()
        header = np.frombuffer(data, ">u4", 25)  # XWDFileHeader in X11/XWDFile.h
        size, width, height, colours = (int(header[n]) for n in (0, 4, 5, 19))
        flat = np.frombuffer(data, np.uint8, width * height * 4, size + 12 * colours)
        return flat.reshape(height, width, 4)[:, :, 2::-1]

    def ask_to_close(self, window: int) -> None:
        """Send a window what a window manager sends when its cross is clicked."""
        with _Connection(self.name) as (x11, display):
            protocols, delete = (
                x11.XInternAtom(display, name, 0) for name in (b"WM_PROTOCOLS", b"WM_DELETE_WINDOW")
            )
            event = _ClientMessage(_CLIENT_MESSAGE, 0, 1, display, window, protocols, 32)
            event.data[0] = delete
            x11.XSendEvent(display, window, 0, 0, ctypes.byref(event))

    def take_focus_away(self) -> None:
        """Give the keyboard to nobody."""
        with _Connection(self.name) as (x11, display):
            x11.XSetInputFocus(display, 0, 0, 0)


class Run:
    """A run of nodes with a `ImageWindow` among them, in a process of its own.

    Args:
        display: Where its window is.
        title: Of the window, unlike any other's on the display.
        nodes: Tables of nodes; a listener is put before them, and a `ImageWindow` after them.
        keyboard: Settings of the keyboard.
    """

    def __init__(
        self, display: Display, title: str, *nodes: Message, keyboard: Message | None = None
    ) -> None:
        self._display = display
        self._title = title
        self._process = start(
            display.environment(), *nodes, KEYBOARD | {"title": title} | (keyboard or {})
        )
        self._lines: queue.Queue[Message | None] = queue.Queue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        self.heard: list[Message] = []

    @property
    def window(self) -> int:
        """The window's number."""
        return int(self._display.call("xdotool", "search", "--name", f"^{self._title}$"))

    def focus(self) -> None:
        """Give the window the keyboard."""
        self._display.call("xdotool", "windowfocus", "--sync", str(self.window))

    def keys(self, *down_or_up: str) -> None:
        """Press or release keys: ``keys("keydown", "w")``."""
        self._display.call("xdotool", *down_or_up)

    def wait_for(self, event: str, **fields: Any) -> Message:
        """Wait for something to be heard, with these fields among its own."""
        deadline = time.monotonic() + DEADLINE
        while True:
            try:
                message = self._lines.get(timeout=max(deadline - time.monotonic(), 0.0))
            except queue.Empty:
                message = None
            if message is None:
                raise AssertionError(f"expected {event} {fields}, heard {self.heard}")
            self.heard.append(message)
            if message["event"] == event and fields.items() <= message.items():
                return message

    def kill_window(self) -> None:
        """Kill the window's process, as a broken driver would."""
        threads = Path(f"/proc/{self._process.pid}/task").glob("*/children")
        (child,) = [int(pid) for file in threads for pid in file.read_text().split()]
        os.kill(child, signal.SIGKILL)

    def end(self) -> None:
        """End the run if it has not ended."""
        self._process.terminate()
        self._process.wait(DEADLINE)
        self._reader.join()

    def __enter__(self) -> Run:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def _read(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as lines:
            for line in lines:
                self._lines.put(json.loads(line))
        self._lines.put(None)


def start(environment: dict[str, str], *nodes: Message) -> subprocess.Popen[str]:
    """Start a run in a process, with warnings as errors there and in its worker."""
    listener = {"name": "listener", "type": "tests.nodes.viewers.window.window_run:Listener"}
    table = {"run": {"clock": "real", "duration": 60}, "nodes": [listener, *nodes]}
    return subprocess.Popen(
        [sys.executable, "-m", "tests.nodes.viewers.window.window_run", json.dumps(table)],
        cwd=Path(__file__).parents[4],
        env=environment | {"PYTHONWARNINGS": "error"},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )


def without_display() -> dict[str, str]:
    """Return our environment without any display."""
    hidden = {"DISPLAY", "WAYLAND_DISPLAY", "XDG_SESSION_TYPE"}
    return {name: value for name, value in os.environ.items() if name not in hidden}


def eventually(condition: Callable[[], bool]) -> bool:
    """Wait for a condition that nobody tells us about, and return whether it came true."""
    deadline = time.monotonic() + DEADLINE
    while not (met := condition()) and time.monotonic() < deadline:
        # Another process draws in its own time, and the screen tells nobody.
        time.sleep(0.02)
    return met


_CLIENT_MESSAGE = 33


class _ClientMessage(ctypes.Structure):
    _fields_ = (
        ("type", ctypes.c_int),
        ("serial", ctypes.c_ulong),
        ("send_event", ctypes.c_int),
        ("display", ctypes.c_void_p),
        ("window", ctypes.c_ulong),
        ("message_type", ctypes.c_ulong),
        ("format", ctypes.c_int),
        ("data", ctypes.c_long * 5),
        ("rest", ctypes.c_long * 12),  # XEvent is a union of 24 longs
    )


class _Connection:
    """A connection to an X server, for what xdotool cannot do."""

    def __init__(self, name: str) -> None:
        self._x11 = x11 = ctypes.CDLL("libX11.so.6")
        x11.XOpenDisplay.restype = ctypes.c_void_p
        x11.XInternAtom.restype = ctypes.c_ulong
        x11.XInternAtom.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_int]
        x11.XSendEvent.argtypes = [ctypes.c_void_p, ctypes.c_ulong, ctypes.c_int, ctypes.c_long]
        x11.XSendEvent.argtypes += [ctypes.c_void_p]
        x11.XSetInputFocus.argtypes = [ctypes.c_void_p, ctypes.c_ulong, ctypes.c_int]
        x11.XSetInputFocus.argtypes += [ctypes.c_ulong]
        x11.XCloseDisplay.argtypes = [ctypes.c_void_p]
        self._display = x11.XOpenDisplay(name.encode())

    def __enter__(self) -> tuple[Any, Any]:
        return self._x11, self._display

    def __exit__(self, *_: object) -> None:
        self._x11.XCloseDisplay(self._display)  # sends what waits, too
