"""The library and its program: the only module that imports rerun, and not before it is asked.

For a worker's process.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib.util
import os
import re
import signal
import socket
import subprocess
import tempfile
import time
import urllib.parse
from pathlib import Path
from typing import Any

import msgspec

from nodes.viewers.rerun.settings import RerunConfig
from runtime.errors import MissingDependencyError, VisnavError
from runtime.extras import install_command

_TIMEOUT = 15.0
"""Real seconds until a server must listen."""

_COLOURS = re.compile(r"\x1b\[[0-9;]*m")
"""A terminal's codes for colours."""

_PR_SET_PDEATHSIG = 1
"""prctl(2): which signal a process gets when its parent ends."""


class Library(msgspec.Struct, frozen=True):
    """Rerun's two modules.

    Attributes:
        log: ``rerun``.
        blueprint: ``rerun.blueprint``.
    """

    log: Any
    blueprint: Any


def load() -> Library:
    """Import the library.

    Raises:
        MissingDependencyError: It is not installed.
    """
    try:
        import rerun
        import rerun.blueprint
    except ImportError as error:
        raise MissingDependencyError(
            f"the view needs rerun ({error}): {install_command('rerun')}"
        ) from error
    return Library(rerun, rerun.blueprint)


def check_display() -> None:
    """Make sure that there is a screen for a window.

    Raises:
        MissingDependencyError: There is none.
    """
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise MissingDependencyError(
            'mode: "spawn" expects a display, found none (DISPLAY is not set): use "serve" or '
            '"save", or run under Xvfb (`xvfb-run -a python -m runtime run …`)'
        )


class Viewer:
    """Rerun's program: a web server that ends with this process, or a window that stays.

    The library's own functions for either listen on all of the machine's addresses; the program
    has options for that.

    Args:
        config: Mode ``serve`` or ``spawn``; where to listen, and how much to remember.

    Raises:
        MissingDependencyError: There is no program, or no screen for its window.
        VisnavError: It cannot listen there.
    """

    def __init__(self, config: RerunConfig) -> None:
        self._web = config.mode == "serve"
        if not self._web:
            check_display()
        ports = {"port": config.port} | ({"web_port": config.web_port} if self._web else {})
        for setting, port in ports.items():
            _check_free(setting, config.host, port)
        host = f"[{config.host}]" if ":" in config.host else config.host
        self.data = f"rerun+http://{host}:{config.port}/proxy"
        query = urllib.parse.urlencode({"url": self.data}, safe=":/[]")
        self.page = f"http://{host}:{config.web_port}?{query}" if self._web else ""
        more = ["--expect-data-soon"]
        if self._web:
            more = ["--serve-web", "--web-viewer-port", str(config.web_port)]
            more += ["--server-memory-limit", config.memory]
        prctl = ctypes.CDLL(None).prctl
        self._output = tempfile.TemporaryFile()  # noqa: SIM115  # closed in `close`
        self._process = subprocess.Popen(  # noqa: S603  # the library's own program
            [program(), "--bind", config.host, "--port", str(config.port), *more],
            stdin=subprocess.DEVNULL,
            stdout=self._output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            preexec_fn=(lambda: prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)) if self._web else None,
        )
        try:
            for port in ports.values():
                self._wait(config.host, port)
        except VisnavError:
            self._end()
            raise

    def last_words(self) -> str:
        """Return the last error that the program printed if it has ended, or nothing."""
        if self._process.poll() is None:
            return ""
        self._output.seek(0)
        lines = _COLOURS.sub("", self._output.read().decode(errors="replace")).splitlines()
        errors = [line for line in lines if "error" in line.lower()]
        return errors[-1] if errors else f"exit code {self._process.returncode}"

    def close(self) -> None:
        """End the server; a window stays."""
        if self._web:
            self._end()
        self._output.close()

    def _end(self) -> None:
        self._process.terminate()
        try:
            self._process.wait(2.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _wait(self, host: str, port: int) -> None:
        end = time.monotonic() + _TIMEOUT
        while self._process.poll() is None and time.monotonic() < end:
            with contextlib.suppress(OSError), socket.create_connection((host, port), 1.0):
                return
            time.sleep(0.05)
        found = self.last_words() or f"nothing in {_TIMEOUT:g} s"
        raise VisnavError(f"expected Rerun to listen on {host}:{port}, found: {found}")


def program() -> str:
    """Return the path of the program that comes with the library."""
    found = importlib.util.find_spec("rerun_cli")
    if found is None or not found.submodule_search_locations:
        raise MissingDependencyError(f"the view needs Rerun's program: {install_command('rerun')}")
    return str(Path(found.submodule_search_locations[0]) / "rerun")


def _check_free(setting: str, host: str, port: int) -> None:
    """Refuse a port that another program has, to which we would otherwise talk."""
    try:
        family = socket.getaddrinfo(host, port)[0][0]
        with socket.socket(family) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
    except OSError as error:
        raise VisnavError(
            f"{setting}: expected a free port {host}:{port}, found: {error}"
        ) from error
