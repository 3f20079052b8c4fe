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
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec

from bench import system
from bench.systems.children import PING, TIMEOUT, Crew, PeerError, number_of, reply_to
from bench.systems.compiled import guarded

_DORA = (sys.executable, "-c", "import sys, dora_cli; sys.exit(dora_cli.py_main())")
_POOL = 1 << 26


def _dataflow(case: system.Case, directory: str) -> bytes:
    others = range(2, case.nodes + 1)
    pongs = {f"pong{n}": {"source": f"node{n}/pong", "queue_size": 1000} for n in others}
    nodes: list[dict[str, object]] = [
        {"id": "node1", "path": "dynamic", "inputs": pongs, "outputs": ["ping"]}
    ]
    nodes += [
        {
            "id": f"node{number}",
            "path": sys.executable,
            "args": f"-m {__name__} {number} {case.case} {directory}",
            "inputs": {"ping": {"source": "node1/ping", "queue_size": 1000}},
            "outputs": ["pong"],
        }
        for number in others
    ]
    return msgspec.json.encode({"nodes": nodes})


@contextlib.contextmanager
def _running(directory: str, port: int, *arguments: str) -> Iterator[None]:
    """Run a part of dora beside the block, which begins once something listens on the port."""
    command = guarded([*_DORA, *arguments])
    process = subprocess.Popen(command, cwd=directory, start_new_session=True)
    try:
        _retry(lambda: socket.create_connection(("127.0.0.1", port), 1.0).close())
        yield
    finally:
        process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(0.5)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def _start(directory: str, port: int) -> None:
    command = [*_DORA, "start", "flow.yml", "--detach", "--coordinator-port", str(port)]
    subprocess.run(command, cwd=directory, capture_output=True, timeout=TIMEOUT, check=True)


def _retry(do: Callable[[], None]) -> None:
    """Do something as soon as it works; raise `PeerError` if it does not."""
    until = time.monotonic() + TIMEOUT / 2
    while True:
        try:
            return do()
        except (OSError, subprocess.CalledProcessError) as error:
            if time.monotonic() > until:
                output = getattr(error, "stderr", b"") or b""
                raise PeerError(f"dora: {error}: {output.decode(errors='replace')}") from None
        time.sleep(0.05)


def run(number: int, case: str, directory: Path) -> None:
    """Be a node, as long as the directory of the dataflow is there."""
    node: Any = importlib.import_module("dora").Node()
    while directory.exists():
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
    # Parting from the daemon in form would wait for it.
    os._exit(0)


def measure(case: system.Case) -> system.Samples:
    """Measure round trips."""
    port, listening = system.free_port(), system.free_port()
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))
    coordinator = ("coordinator", "--port", str(port), "--store", "memory", "--quiet")
    daemon = ("daemon", "--coordinator-port", str(port), "--local-listen-port", str(listening))
    with tempfile.TemporaryDirectory() as directory:
        Path(directory, "flow.yml").write_bytes(_dataflow(case, directory))
        with _running(directory, port, *coordinator), _running(directory, listening, *daemon):
            _retry(lambda: _start(directory, port))
            return _exchange(case, listening)


def _exchange(case: system.Case, port: int) -> system.Samples:
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

    return Crew().exchange(case, send, receive)


_PACKAGES: dict[str, Any] = {
    "missing": system.needs(dora="dora-rs", dora_cli="dora-rs-cli", pyarrow="pyarrow"),
    "version": system.versions("dora-rs"),
}

SYSTEMS = (system.in_processes("dora", ("stream",), measure, 400, **_PACKAGES),)


if __name__ == "__main__":
    run(int(sys.argv[1]), sys.argv[2], Path(sys.argv[3]))
