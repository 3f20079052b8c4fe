"""A simulator that takes its time: answers each request with an image pair, 80 ms later.

Stands for the image fetch over a socket that the thesis measured. Runs in a process of its own:
``python -m bench.slow_server DELAY BYTES`` prints its port, and ends with its standard input.
"""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

DELAY = 0.08


def main(delay: float, size: int) -> None:
    """Serve one connection after another until standard input ends."""
    answer = bytes(size)
    server = socket.create_server(("127.0.0.1", 0))
    print(server.getsockname()[1], flush=True)
    threading.Thread(target=_serve, args=(server, delay, answer), daemon=True).start()
    sys.stdin.read()


def _serve(server: socket.socket, delay: float, answer: bytes) -> None:
    while True:
        connection, _ = server.accept()
        with connection, contextlib.suppress(OSError):
            while connection.recv(1):
                time.sleep(delay)  # the fetch that is simulated
                connection.sendall(answer)


@contextlib.contextmanager
def slow_server(size: int, delay: float = DELAY) -> Iterator[int]:
    """Run the server while the block runs, and give its port.

    Args:
        size: Bytes of an answer.
        delay: Seconds that it takes.
    """
    command = [sys.executable, "-m", "bench.slow_server", str(delay), str(size)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            yield int(process.stdout.readline())
        finally:
            process.stdin.close()


if __name__ == "__main__":
    main(float(sys.argv[1]), int(sys.argv[2]))
