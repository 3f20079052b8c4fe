"""A connection on the run's loop whose calls have real time limits, on either clock."""

from __future__ import annotations

import asyncio
import socket
import threading
import time
from typing import Any

from runtime import Node
from sims.airsim.client.rpc import RpcClient

_AGAIN = 0.1
"""Real seconds between two attempts to connect."""


class Calls:
    """One connection to a server.

    In lockstep, simulated time waits for each reply, so that it comes at one simulated time in
    every run. An `OSError`, which a `TimeoutError` is, always means that the connection is gone.

    Args:
        node: The node that calls.
        address: The server's host and port.
        limit: Real seconds that a reply may take.
    """

    def __init__(self, node: Node[Any], address: tuple[str, int], limit: float) -> None:
        self._node, self._address, self._limit = node, address, limit
        self._client: RpcClient | None = None

    async def connect(self, seconds: float) -> None:
        """Connect, with as many attempts as it takes, and wait for a first reply.

        Raises:
            OSError: There is no server in so many real seconds.
        """
        offload, until = self._node.offload, time.monotonic() + seconds
        while True:
            self.close()
            rest = max(until - time.monotonic(), _AGAIN)
            try:
                opened = await offload(socket.create_connection, self._address, rest)
                loop = asyncio.get_running_loop()
                _, self._client = await loop.create_connection(RpcClient, sock=opened)
                await self.call("ping", limit=rest)
                return
            except OSError:
                if time.monotonic() > until:
                    raise
            await offload(time.sleep, _AGAIN)

    def send(self, method: str, *arguments: Any) -> asyncio.Future[Any]:
        """Send a call, and return the future of its result.

        Raises:
            OSError: The connection is lost.
        """
        if self._client is None:
            raise ConnectionResetError("not connected")
        future = self._client.send(method, *arguments)
        future.add_done_callback(asyncio.Future.exception)  # lest it be said that nobody looked
        return future

    async def call(self, method: str, *arguments: Any, limit: float | None = None) -> Any:
        """Call a method and return its result.

        Raises:
            RpcCallError: The server refused it.
            OSError: The connection is lost, or no reply has come in time.
        """
        future, limit = self.send(method, *arguments), self._limit if limit is None else limit
        if self._node.clock.kind == "real":
            await asyncio.wait([future], timeout=limit)
        else:  # the loop reads sockets while simulated time waits for a thread
            over = threading.Event()
            future.add_done_callback(lambda _: over.set())
            await self._node.offload(over.wait, limit)
        if not future.done():
            self.close()
            raise TimeoutError(f"{method}: no reply in {limit:g} s")
        return future.result()

    async def settle(self) -> None:
        """In lockstep, wait until all calls before have started, and replies due by now are here.

        A server starts the requests of one connection in order, and so it replies.
        """
        if self._node.clock.kind == "lockstep":
            await self.call("ping")

    def close(self) -> None:
        """Close the connection."""
        if self._client is not None:
            self._client.close()
            self._client = None
