"""pyzmq between processes: PUB to all nodes and PUSH back to node 1, over ipc sockets.

Messages are never dropped (no high-water mark). Large pings are a second frame that is handed to
ZeroMQ without a copy in Python; the socket copies it for each node.
"""

from __future__ import annotations

import importlib
import tempfile
from typing import Any

import numpy as np

from bench.system import LARGE_SHAPE, Case, Samples, in_processes, large_array, packaged
from bench.systems.children import PING, Job, children, number_of, reply_to


def _socket(context: Any, kind: int, zmq: Any) -> Any:
    socket = context.socket(kind)
    socket.set(zmq.LINGER, 0)
    socket.set(zmq.SNDHWM, 0)
    socket.set(zmq.RCVHWM, 0)
    return socket


def serve(job: Job) -> None:
    """Be a node."""
    zmq: Any = importlib.import_module("zmq")
    context = zmq.Context()
    pings = _socket(context, zmq.SUB, zmq)
    pings.connect(f"ipc://{job.address}/ping")
    pings.subscribe(b"")
    pongs = _socket(context, zmq.PUSH, zmq)
    pongs.connect(f"ipc://{job.address}/pong")
    while True:
        if job.case == "small":
            header = pings.recv()
        else:
            header, array = pings.recv_multipart(copy=False)
            np.frombuffer(array, np.float32).reshape(LARGE_SHAPE)
        pong = reply_to(job.node, header)
        if pong is not None:
            pongs.send(pong)


def measure(case: Case) -> Samples:
    """Measure round trips."""
    zmq: Any = importlib.import_module("zmq")
    with (
        tempfile.TemporaryDirectory() as directory,
        zmq.Context() as context,
        _socket(context, zmq.PUB, zmq) as pings,
        _socket(context, zmq.PULL, zmq) as pongs,
    ):
        pings.bind(f"ipc://{directory}/ping")
        pongs.bind(f"ipc://{directory}/pong")
        pongs.set(zmq.RCVTIMEO, 1000)
        array = large_array()

        def send(stamp: int, receiver: int, number: int) -> None:
            header = PING.pack(stamp, 1, receiver, number)
            if case.case == "small":
                pings.send(header)
            else:
                pings.send(header, zmq.SNDMORE)
                pings.send(array, copy=False)

        def receive() -> int | None:
            try:
                return number_of(pongs.recv())
            except zmq.Again:
                return None

        with children(__name__, case, directory) as crew:
            return crew.exchange(case, send, receive)


SYSTEMS = (in_processes("pyzmq (ipc)", ("stream",), measure, 100, **packaged(zmq="pyzmq")),)
