"""dora between processes: a dataflow with a node per process, node 1 being dynamic.

A coordinator and a daemon of our own run beside the nodes. Nodes wait in `Node.next`. A large ping
is an Arrow array, which `send_output` copies into shared memory, and its header is the metadata;
the memory is 64 MB, since with what a node has by default large pings would often not find room.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from bench import system
from bench.systems.children import (
    PING,
    TIMEOUT,
    Crew,
    Job,
    PeerError,
    children,
    number_of,
    reply_to,
)

_DORA = (sys.executable, "-c", "import sys, dora_cli; sys.exit(dora_cli.py_main())")
_POOL = 1 << 26
_SUPERVISOR = "BENCH_SUPERVISOR"
_STARTED = "started"


class _Address(msgspec.Struct, frozen=True):
    """Where the dataflow is, and the ports of coordinator and daemon."""

    directory: str
    coordinator: int
    daemon: int


def _dataflow(case: system.Case) -> bytes:
    others = range(2, case.nodes + 1)
    pongs = {f"pong{n}": {"source": f"node{n}/pong", "queue_size": 1000} for n in others}
    nodes: list[dict[str, object]] = [
        {"id": "node1", "path": "dynamic", "inputs": pongs, "outputs": ["ping"]}
    ]
    nodes += [
        {
            "id": f"node{number}",
            "path": sys.executable,
            "args": f"-m {__name__} {number} {case.case}",
            "inputs": {"ping": {"source": "node1/ping", "queue_size": 1000}},
            "outputs": ["pong"],
        }
        for number in others
    ]
    return msgspec.json.encode({"nodes": nodes})


@contextlib.contextmanager
def _running(address: _Address, *arguments: str) -> Iterator[None]:
    process = subprocess.Popen([*_DORA, *arguments], cwd=address.directory, start_new_session=True)
    try:
        yield
    finally:
        process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(0.5)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def _wait_for_port(port: int) -> None:
    until = time.monotonic() + TIMEOUT
    while time.monotonic() < until:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1.0):
            return
        time.sleep(0.02)
    raise PeerError(f"dora: nothing listens on port {port} after {TIMEOUT:g} s")


def _start(address: _Address) -> None:
    arguments = ("start", "flow.yml", "--detach", "--coordinator-port", str(address.coordinator))
    until = time.monotonic() + TIMEOUT / 2
    while True:
        done = subprocess.run(
            [*_DORA, *arguments],
            cwd=address.directory,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=TIMEOUT,
            check=False,
        )
        if done.returncode == 0:
            return
        if time.monotonic() > until:
            raise PeerError(f"dora start: {done.stdout.decode(errors='replace')[:2000]}")
        time.sleep(0.1)


def serve(job: Job) -> None:
    """Run the dataflow, in the only child of the measuring process."""
    address = msgspec.json.decode(job.address, type=_Address)
    port = str(address.coordinator)
    os.environ[_SUPERVISOR] = str(os.getpid())
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))
    coordinator = ("coordinator", "--port", port, "--store", "memory", "--quiet")
    daemon = ("daemon", "--coordinator-port", port, "--local-listen-port", str(address.daemon))
    with _running(address, *coordinator):
        _wait_for_port(address.coordinator)
        with _running(address, *daemon):
            _wait_for_port(address.daemon)
            _start(address)
            Path(address.directory, _STARTED).touch()
            signal.pause()


def run(number: int, case: str) -> None:
    """Be a node."""
    node: Any = importlib.import_module("dora").Node()
    while _is_alive(int(os.environ[_SUPERVISOR])):
        event = node.next(timeout=1.0)
        if event is None or event["type"] != "INPUT":
            continue
        array = event["value"].to_numpy(zero_copy_only=True)
        header = array
        if case != "small":
            array.reshape(system.LARGE_SHAPE)
            metadata = event["metadata"]
            header = PING.pack(metadata["stamp"], 1, metadata["receiver"], metadata["number"])
        pong = reply_to(number, header)
        if pong is not None:
            node.send_output("pong", pong)
    # The daemon is gone, too; parting from it in form would wait for it.
    os._exit(0)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


def measure(case: system.Case) -> system.Samples:
    """Measure round trips."""
    with tempfile.TemporaryDirectory() as directory:
        Path(directory, "flow.yml").write_bytes(_dataflow(case))
        address = _Address(directory, system.free_port(), system.free_port())
        daemon = msgspec.structs.replace(case, nodes=2)
        with children(__name__, daemon, msgspec.json.encode(address).decode()) as crew:
            begin = time.perf_counter_ns()
            while not Path(directory, _STARTED).exists():
                crew.check(begin, "start of the dataflow")
                time.sleep(0.02)
            return _exchange(case, crew, address.daemon)


def _exchange(case: system.Case, crew: Crew, port: int) -> system.Samples:
    dora: Any = importlib.import_module("dora")
    pyarrow: Any = importlib.import_module("pyarrow")
    os.environ["DORA_NODE_SHM_POOL_SIZE"] = str(_POOL)
    node = dora.Node("node1", daemon_port=port)
    array = system.large_array().ravel()

    def send(stamp: int, receiver: int, number: int) -> None:
        if case.case == "small":
            node.send_output("ping", PING.pack(stamp, 1, receiver, number))
        else:
            metadata = {"stamp": stamp, "receiver": receiver, "number": number}
            node.send_output("ping", pyarrow.array(array), metadata)

    def receive() -> int | None:
        event = node.next(timeout=1.0)
        if event is None or event["type"] != "INPUT":
            return None
        return number_of(event["value"].to_numpy(zero_copy_only=True))

    return crew.exchange(case, send, receive)


SYSTEMS = (
    system.in_processes(
        "dora",
        ("stream",),
        measure,
        slowness=400,
        missing=system.needs(dora="dora-rs", dora_cli="dora-rs-cli", pyarrow="pyarrow"),
        version=system.versions("dora-rs"),
    ),
)


if __name__ == "__main__":
    run(int(sys.argv[1]), sys.argv[2])
