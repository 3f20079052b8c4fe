"""A peer out of nothing but sockets: what the tests of the child processes talk to."""

from __future__ import annotations

import socket
import sys

from bench.system import Case, Samples
from bench.systems.children import PING, Job, children, number_of, reply_to


def serve(job: Job) -> None:
    if job.variant == "fail":
        raise RuntimeError("no bananas")
    host, port = job.address.split(":")
    with socket.create_connection((host, int(port))) as link:
        while ping := link.recv(PING.size, socket.MSG_WAITALL):
            if job.variant == "silent":
                continue
            pong = reply_to(job.node, ping)
            if pong is not None:
                link.sendall(pong)


def measure(case: Case, variant: str = "") -> Samples:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.2)
        links: list[socket.socket] = []

        def send(stamp: int, receiver: int, number: int) -> None:
            for link in links:
                link.sendall(PING.pack(stamp, 1, receiver, number))

        def receive() -> int | None:
            if len(links) < case.nodes - 1:
                try:
                    link, _ = server.accept()
                except TimeoutError:
                    return None
                link.setblocking(False)
                links.append(link)
                return None
            for link in links:
                try:
                    return number_of(link.recv(12))
                except BlockingIOError:
                    continue
            return None

        address = f"127.0.0.1:{server.getsockname()[1]}"
        try:
            with children(__name__, case, address, variant) as crew:
                print("running", flush=True)
                return crew.exchange(case, send, receive)
        finally:
            for link in links:
                link.close()


if __name__ == "__main__":
    measure(Case(nodes=3, samples=10**9), sys.argv[1])
