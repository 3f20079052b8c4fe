"""Runs with a server in them, and blocking scripts that call it from a thread."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import socket
import threading
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import pytest

from events import Event
from runtime.config.model import NodeSpec
from runtime.node import Node
from runtime.testing import NodeResult, run_nodes, spec
from sims.multirotor import Multirotor
from visnav_airsim import wire
from visnav_airsim.server import AirsimServer
from visnav_airsim.server.node import PORTS


class RefusedError(Exception):
    """The server's answer was an error; its text."""


class Caller:
    """A blocking client, as scripts use one; `send` does not wait for the reply, as …Async."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=60)
        self._decoder = wire.Decoder(wire.LONGEST_REPLY)
        self._ids = itertools.count()
        self._replies: dict[int, wire.Reply] = {}

    def send(self, method: str, *arguments: Any) -> int:
        """Send a call, and return its number for `join`."""
        id_ = next(self._ids)
        self._socket.sendall(wire.request(id_, method, arguments))
        return id_

    def join(self, id_: int) -> Any:
        """Wait for the reply of a call, and return its result."""
        while id_ not in self._replies:
            data = self._socket.recv(1 << 16)
            if not data:
                raise ConnectionResetError
            for message in self._decoder.feed(data):
                assert isinstance(message, wire.Reply)
                self._replies[message.id] = message
        reply = self._replies.pop(id_)
        if reply.error is not None:
            raise RefusedError(reply.error)
        return reply.result

    def __call__(self, method: str, *arguments: Any) -> Any:
        """Call a method, and return its result."""
        return self.join(self.send(method, *arguments))

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()

    def refuses(self, error: str, method: str, *arguments: Any) -> None:
        """Check that a call is refused with a text that has this in it."""
        with pytest.raises(RefusedError) as refused:
            self(method, *arguments)
        assert error in str(refused.value), (method, arguments)


Script = Callable[[Caller], None]


def with_script(
    script: Script,
    nodes: Iterable[NodeSpec],
    *,
    duration: float = 60.0,
    inputs: Iterable[Event] = (),
    seed: int = 0,
    out: Path | None = None,
    **server: Any,
) -> NodeResult:
    """Run nodes and a server, whose time is paused unless said otherwise, until a script ends.

    Args:
        script: Called in a thread of its own, with a connected client.
        nodes: The vehicles, and what else is in the run.
        duration: Simulated seconds after which the run ends at the latest.
        inputs: Events that are sent to the nodes.
        seed: Of the run.
        out: Folder for its files.
        server: Settings of the server.
    """
    failed: list[BaseException] = []

    class Runner(Node):
        """Runs the script once all nodes are ready."""

        async def run(self) -> None:
            loop, over = asyncio.get_running_loop(), asyncio.Event()
            port = self.share(PORTS, dict[str, int])["airsim"]

            def work() -> None:
                try:
                    with contextlib.closing(Caller(port)) as caller:
                        script(caller)
                except BaseException as error:  # raised in the test, below
                    failed.append(error)
                loop.call_soon_threadsafe(over.set)

            threading.Thread(target=work, daemon=True).start()
            await over.wait()
            self.stop("the script has ended")

    settings: Mapping[str, Any] = {"port": 0, "time": "paused"} | server
    result = run_nodes(
        [*nodes, spec(AirsimServer, "airsim", settings), spec(Runner, "client")],
        inputs=inputs,
        duration=duration,
        seed=seed,
        out=out,
    )
    if failed:
        raise failed[0]
    return result


def drone(name: str = "drone", **settings: Any) -> NodeSpec:
    """Return a multirotor."""
    return spec(Multirotor, name, settings)
