"""The view's settings, and the library and its program, for a worker's process."""

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
from typing import Annotated, Any, Literal

import msgspec

from runtime import NodeConfig
from runtime.errors import MissingDependencyError, VisnavError
from runtime.paths import OutputPath

_Port = Annotated[int, msgspec.Meta(ge=1, le=65535)]
_Rate = Annotated[float, msgspec.Meta(ge=0, le=1000)]
_Stride = Annotated[int, msgspec.Meta(ge=1, le=64)]


class RerunConfig(NodeConfig):
    """Settings of the view.

    Attributes:
        mode: ``save``: into `file`; ``spawn``: in Rerun's window; ``serve``: in the browser (the
            log has the address).
        file: In the run's folder; ``rerun`` opens it.
        web_port: Of the page, for ``serve``.
        port: Of the data, for ``serve`` and ``spawn``.
        host: Address of the viewer, by default of this machine only: whoever reaches it sees all,
            and can send.
        memory: Memory of ``serve`` for late browsers.
        image_rate: Images a second of each camera, on the run's clock, in whole sets (colours,
            depth); 0: none.
        jpeg_quality: 1 to 100; 0: images as they are, which makes large files.
        depth: Whether to show depth images, to the centimetre.
        depth_stride: Show every n-th pixel of every n-th row of them.
        points_rate: Depth images a second shown as coloured points from the camera's true pose; 0:
            none.
        points_stride: Take every n-th pixel of every n-th row for these points.
        points_max_distance: Metres from the camera, beyond which points are left out.
        points_max_height: Metres above the camera, likewise, to look into rooms from above.
        update_rate: Batches of events a second to the viewer (fewer into a file, which is smaller
            so).
    """

    mode: Literal["save", "spawn", "serve"] = "save"
    file: Annotated[OutputPath, msgspec.Meta(pattern=r"^[\w.-]+\.rrd$")] = "flight.rrd"
    web_port: _Port = 9090
    port: _Port = 9876
    host: str = "127.0.0.1"
    memory: Annotated[str, msgspec.Meta(pattern=r"^\d+(MiB|GiB|MB|GB|%)$")] = "1GiB"
    image_rate: _Rate = 5.0
    jpeg_quality: Annotated[int, msgspec.Meta(ge=0, le=100)] = 80
    depth: bool = True
    depth_stride: _Stride = 2
    points_rate: _Rate = 2.0
    points_stride: _Stride = 6
    points_max_distance: Annotated[float, msgspec.Meta(gt=0)] = 8.0
    points_max_height: float = 0.5
    update_rate: Annotated[float, msgspec.Meta(gt=0, le=1000)] = 20.0


_INSTALL = "pip install ./extensions/rerun"
_TIMEOUT = 15.0  # real seconds until a server must listen
_COLOURS = re.compile(r"\x1b\[[0-9;]*m")  # a terminal's codes for colours
_PR_SET_PDEATHSIG = 1  # prctl(2) option: signal to a process at its parent's end


def load() -> Any:
    """Import the library; a `MissingDependencyError` if it is missing."""
    try:
        import rerun
        import rerun.blueprint
    except ImportError as error:
        raise MissingDependencyError(f"the view needs rerun ({error}): {_INSTALL}") from error
    return rerun


def check_display() -> None:
    """Raise a `MissingDependencyError` if there is no screen to show a window."""
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise MissingDependencyError(
            'mode: "spawn" expects a display, found none (DISPLAY is not set): use "serve" or '
            '"save", or run under Xvfb (`xvfb-run -a python -m runtime run …`)'
        )


class Viewer:
    """Rerun's program: a web server for the life of this process, or a lasting window.

    The library's own functions for either listen on all addresses.

    Args:
        config: Of mode ``serve`` or ``spawn``.

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
        """Return the program's last printed error after its end, or nothing."""
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
        output = self.last_words() or f"nothing in {_TIMEOUT:g} s"
        raise VisnavError(f"expected Rerun to listen on {host}:{port}, found: {output}")


def program() -> str:
    """Return the path of the program in Rerun's library."""
    spec = importlib.util.find_spec("rerun_cli")
    if spec is None or not spec.submodule_search_locations:
        raise MissingDependencyError(f"the view needs Rerun's program: {_INSTALL}")
    return str(Path(spec.submodule_search_locations[0]) / "rerun")


def _check_free(setting: str, host: str, port: int) -> None:
    """Refuse a port of another program, lest the viewer's data go there."""
    try:
        family = socket.getaddrinfo(host, port)[0][0]
        with socket.socket(family) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
    except OSError as error:
        raise VisnavError(
            f"{setting}: expected a free port {host}:{port}, found: {error}"
        ) from error
