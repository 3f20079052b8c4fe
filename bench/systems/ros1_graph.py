"""A ROS 1 graph of its own for one measurement: a master on a free port, and nodes.

Everything is on the loopback, its files are in a temporary directory, and it ends with the block
that opened it or with this process.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import tempfile
import time
import xmlrpc.client
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO

from bench.systems.compiled import KEEP_MEMORY, guarded

MASTER = Path("/usr/bin/rosmaster")

CLOSING = 10.0
"""Seconds that nodes have to end after node 1 has."""


class GraphError(RuntimeError):
    """The master does not come up, or a node failed or did not end in time."""


class Graph:
    """A master and its nodes. Made by `graph`."""

    def __init__(self, directory: Path, stack: contextlib.ExitStack) -> None:
        self.directory = directory
        self._stack = stack
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        self._uri = f"http://127.0.0.1:{port}"
        self._outputs: dict[int, IO[bytes]] = {}
        self._await_master(self.start([MASTER, "--core", "-p", str(port)]))

    def start(self, command: Sequence[str | Path]) -> subprocess.Popen[bytes]:
        """Start a node; it is ended with the graph at the latest."""
        output = self._stack.enter_context(tempfile.TemporaryFile())  # noqa: SIM115
        environment = {
            # Of this Python's packages Debian's is to see nothing.
            **{k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "ROS_"))},
            **KEEP_MEMORY,
            "ROS_MASTER_URI": self._uri,
            "ROS_HOSTNAME": "127.0.0.1",
            "ROS_HOME": str(self.directory),
            "ROS_LOG_DIR": str(self.directory),
            "TMPDIR": str(self.directory),
        }
        process = subprocess.Popen(
            guarded(command),
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
        )
        self._stack.callback(_end, process)
        self._outputs[process.pid] = output
        return process

    def finish(
        self,
        first: subprocess.Popen[bytes],
        others: Sequence[subprocess.Popen[bytes]],
        deadline: float,
    ) -> None:
        """Wait until node 1 has ended, and then the others, all well.

        Raises:
            GraphError: A node failed, or did not end in time.
        """
        until = time.monotonic() + deadline
        while first.poll() is None:
            for process in others:
                # A listener that has heard all leaves a moment before node 1 does.
                if process.poll():
                    raise self._error(process, f"ended with {process.returncode}")
            if time.monotonic() > until:
                raise self._error(first, f"expected to end within {deadline:g} s")
            with contextlib.suppress(subprocess.TimeoutExpired):
                first.wait(0.05)
        until = time.monotonic() + CLOSING
        for process in (first, *others):
            try:
                code = process.wait(max(0.01, until - time.monotonic()))
            except subprocess.TimeoutExpired:
                raise self._error(process, "expected to end after the last ping") from None
            if code:
                raise self._error(process, f"ended with {code}")

    def _await_master(self, process: subprocess.Popen[bytes]) -> None:
        until = time.monotonic() + 20
        while time.monotonic() < until:
            if process.poll() is not None:
                raise self._error(process, f"ended with {process.returncode}")
            with contextlib.suppress(OSError), xmlrpc.client.ServerProxy(self._uri) as master:
                master.getPid("/bench")
                return
            time.sleep(0.05)
        raise self._error(process, "expected to answer within 20 s")

    def _error(self, process: subprocess.Popen[bytes], what: str) -> GraphError:
        output = self._outputs[process.pid]
        output.seek(0)
        text = output.read().decode(errors="replace").strip()[-2000:]
        return GraphError(f"{process.args!r} {what}: {text}")


@contextlib.contextmanager
def graph() -> Iterator[Graph]:
    """Run a master; end it and all nodes with the block.

    Raises:
        GraphError: The master does not come up.
    """
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as directory,
        contextlib.ExitStack() as stack,
    ):
        yield Graph(Path(directory), stack)


def _end(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        process.send_signal(signal.SIGKILL)
    process.wait()
