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
import importlib
import os
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import IO, Any, Self

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
    """Programs of a measurement, such as the processes of nodes 2 to N; they end with the block.

    Their output is kept, to be told when one fails. A program whose standard input was a pipe gets
    the end of it and `grace` seconds before it is killed.
    """

    def __init__(self, grace: float = 0.0) -> None:
        self._grace = grace
        self._programs: dict[subprocess.Popen[bytes], tuple[str, IO[bytes]]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._programs:
            if process.stdin is not None:
                process.stdin.close()
        for process, (_name, output) in self._programs.items():
            try:
                process.wait(self._grace)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            output.close()

    def add(self, name: str, command: Sequence[str], **options: Any) -> subprocess.Popen[bytes]:
        """Start a program; options are those of `subprocess.Popen`."""
        output = tempfile.TemporaryFile()  # noqa: SIM115
        process = subprocess.Popen(command, stdout=output, stderr=output, **options)
        self._programs[process] = name, output
        return process

    def failure(self, process: subprocess.Popen[bytes], what: str) -> PeerError:
        """Return the error of a program, with the end of its output."""
        name, output = self._programs[process]
        output.seek(0)
        return PeerError(f"{name} {what}: {output.read().decode(errors='replace').strip()[-2000:]}")

    def check(self, since: int, awaited: str) -> None:
        """Raise `PeerError` if a program ended, or the wait since `since` (ns) is too long."""
        for process in self._programs:
            if process.poll() is not None:
                raise self.failure(process, f"ended with {process.returncode}")
        if time.perf_counter_ns() - since > TIMEOUT * 1e9:
            raise PeerError(f"{awaited}: nothing came for {TIMEOUT:g} s")

    def exchange(self, case: Case, send: Send, receive: Receive) -> Samples:
        """Call the roll, then measure; raise `PeerError` if nodes are silent."""
        now = time.perf_counter_ns
        taken = np.empty(case.warm_up + case.samples, np.int64)
        self._call_roll(case.nodes, send, receive)
        for number in range(len(taken)):
            begin = now()
            send(begin, case.nodes, number)
            while receive() != number:
                self.check(begin, f"reply to ping {number}")
            taken[number] = now() - begin
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
    with Crew(2 * GRACE) as crew:
        for node in range(2, case.nodes + 1):
            job = Job(node=node, nodes=case.nodes, case=case.case, address=address, variant=variant)
            words = ("-m", __name__, module, msgspec.json.encode(job).decode())
            crew.add(f"node {node}", [sys.executable, *words], stdin=subprocess.PIPE)
        yield crew


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
