"""Nodes in processes of their own: starting and ending them, and the exchange with them.

Node 1 is the measuring process. The others run ``python -m bench.systems.children MODULE JOB``,
which calls `serve` of a system's module; they end with the block that started them, or when the
measuring process is gone for whatever reason. Headers of pings and pongs are packed structs. A
round trip ends when the last node's reply is there; others may still be on the way to having the
ping.

Before anything is measured, node 1 calls the roll until all have answered, so that a subscription
that is still on its way loses no ping.
"""

from __future__ import annotations

import contextlib
import faulthandler
import importlib
import os
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from typing import IO, Any

import msgspec
import numpy as np

from bench.system import Case, CaseName, Samples

PING = struct.Struct("<qiii")  # stamp, sender, receiver, number
PONG = struct.Struct("<qi")  # stamp, number
ALL = 0  # receiver number of a roll call: each node answers with minus its own number
TIMEOUT = 60.0  # seconds without an answer before a measurement is given up
GRACE = 2.0  # seconds for a child to clean up after SIGTERM, before a forced exit
Send = Callable[[int, int, int], None]  # sends a ping to all nodes: its stamp, receiver and number

Receive = Callable[[], int | None]
"""Waits a second at most for a pong and returns its number, or `None` if none came."""


class Job(msgspec.Struct, frozen=True, kw_only=True):
    """Job of a child process.

    Attributes:
        node: Its number, from 2.
        address: Where to meet: a directory, a locator, a name; as the peer has it.
    """

    node: int
    nodes: int
    case: CaseName
    address: str
    variant: str = ""


class PeerError(RuntimeError):
    """The other processes of a measurement ended, or fell silent."""


class Crew:
    """The processes of nodes 2 to N."""

    def __init__(self, nodes: dict[int, tuple[subprocess.Popen[bytes], IO[bytes]]]) -> None:
        self._nodes = nodes

    def check(self, since: int, awaited: str) -> None:
        """Raise `PeerError` if a process ended, or the wait since `since` (ns) is too long."""
        for node, (process, output) in self._nodes.items():
            if process.poll() is not None:
                output.seek(0)
                text = output.read().decode(errors="replace").strip()[-2000:]
                raise PeerError(f"node {node} ended with {process.returncode}: {text}")
        if time.perf_counter_ns() - since > TIMEOUT * 1e9:
            raise PeerError(f"{awaited}: nothing came for {TIMEOUT:g} s")

    def exchange(self, case: Case, send: Send, receive: Receive) -> Samples:
        """Call the roll, then measure; raise `PeerError` if nodes are silent."""
        now = time.perf_counter_ns
        taken = np.empty(case.warm_up + case.samples, np.int64)
        try:
            _end_if_stuck()
            self._call_roll(case.nodes, send, receive)
            for number in range(len(taken)):
                if number % 1000 == 0:
                    _end_if_stuck()
                begin = now()
                send(begin, case.nodes, number)
                while receive() != number:
                    self.check(begin, f"reply to ping {number}")
                taken[number] = now() - begin
        finally:
            faulthandler.cancel_dump_traceback_later()
        return taken[case.warm_up :]

    def _call_roll(self, nodes: int, send: Send, receive: Receive) -> None:
        begin = time.perf_counter_ns()
        absent = set(range(2, nodes + 1))
        while absent:
            self.check(begin, f"answers of nodes {sorted(absent)}")
            send(time.perf_counter_ns(), ALL, -1)
            until = time.perf_counter_ns() + 200_000_000
            while absent and time.perf_counter_ns() < until:
                absent.discard(-(receive() or 0))


@contextlib.contextmanager
def children(module: str, case: Case, address: str, variant: str = "") -> Iterator[Crew]:
    """Run nodes 2 to N, each in a process, and end them with the block."""
    nodes: dict[int, tuple[subprocess.Popen[bytes], IO[bytes]]] = {}
    with contextlib.ExitStack() as stack:
        stack.callback(_end, nodes)
        for node in range(2, case.nodes + 1):
            job = Job(node=node, nodes=case.nodes, case=case.case, address=address, variant=variant)
            output = stack.enter_context(tempfile.TemporaryFile())
            process = subprocess.Popen(
                [sys.executable, "-m", __name__, module, msgspec.json.encode(job).decode()],
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=output,
            )
            nodes[node] = process, output
        yield Crew(nodes)


def answer(node: int, receiver: int, number: int) -> int | None:
    """Return the number of a node's answer to a ping; `None` for another receiver."""
    if receiver == node:
        return number
    return -node if receiver == ALL else None


def reply_to(node: int, ping: Any) -> bytes | None:
    """Return a node's pong for the bytes of a ping; `None` for another receiver."""
    stamp, _, receiver, number = PING.unpack_from(ping)
    answered = answer(node, receiver, number)
    return None if answered is None else PONG.pack(stamp, answered)


def number_of(pong: Any) -> int:
    """Return the number of a pong from its bytes."""
    number: int = PONG.unpack_from(pong)[1]
    return number


def _end_if_stuck() -> None:
    # For a `send` that never returns, in a library that does not even let Python handle Ctrl-C.
    faulthandler.dump_traceback_later(5 * TIMEOUT, exit=True)


def _end(nodes: dict[int, tuple[subprocess.Popen[bytes], IO[bytes]]]) -> None:
    processes = [process for process, _ in nodes.values()]
    for process in processes:
        if process.stdin is not None:
            process.stdin.close()
    for process in processes:
        try:
            process.wait(2 * GRACE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _end_with_parent() -> None:
    while os.read(0, 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(GRACE)
    os._exit(1)


def main(module: str, job: str) -> None:
    """Run a node until the measuring process ends this process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    threading.Thread(target=_end_with_parent, daemon=True).start()
    importlib.import_module(module).serve(msgspec.json.decode(job, type=Job))


if __name__ == "__main__":
    main(*sys.argv[1:])
