"""An asyncio client of AirSim's protocol: calls, and their replies in any order."""

from __future__ import annotations

import asyncio
import itertools
from typing import Any, cast

from sims.airsim import wire


class RpcCallError(Exception):
    """The server's answer to a call is an error; the text is the server's."""


class RpcClient(asyncio.Protocol):
    """One connection to a server.

    Make one with `connect`. Calls may overlap; replies find their calls by number.
    """

    def __init__(self) -> None:
        self._decoder = wire.Decoder(wire.LONGEST_REPLY)
        self._ids = itertools.count()
        self._calls: dict[int, asyncio.Future[Any]] = {}
        self._lost: Exception | None = None

    @classmethod
    async def connect(cls, host: str, port: int) -> RpcClient:
        """Return a connection.

        Raises:
            OSError: Nobody listens there.
        """
        _, client = await asyncio.get_running_loop().create_connection(cls, host, port)
        return client

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin."""
        self._transport = cast("asyncio.Transport", transport)  # uvloop's is of another class

    def connection_lost(self, exc: Exception | None) -> None:
        """Fail all calls that wait."""
        self._lost = exc or ConnectionResetError("the server closed the connection")
        calls, self._calls = self._calls, {}
        for call in calls.values():
            if not call.done():
                call.set_exception(self._lost)

    def data_received(self, data: bytes) -> None:
        """Hand replies to whoever waits for them."""
        try:
            for message in self._decoder.feed(data):
                if isinstance(message, wire.Reply):
                    self._settle(message)
        except wire.WireFormatError:
            self._transport.abort()

    def send(self, method: str, *arguments: Any) -> asyncio.Future[Any]:
        """Send a call at once, and return the future of its result.

        Raises:
            OSError: The connection is lost.
        """
        if self._lost is not None:
            raise self._lost
        id_ = next(self._ids) % (1 << 30)
        call = self._calls[id_] = asyncio.get_running_loop().create_future()
        self._transport.write(wire.request(id_, method, arguments))
        return call

    async def call(self, method: str, *arguments: Any) -> Any:
        """Call a method and return its result.

        Raises:
            RpcCallError: The server refused it.
            OSError: The connection is lost.
        """
        return await self.send(method, *arguments)

    def close(self) -> None:
        """Close the connection."""
        self._transport.close()

    def _settle(self, reply: wire.Reply) -> None:
        call = self._calls.pop(reply.id, None)
        if call is None or call.done():
            return
        if reply.error is not None:
            call.set_exception(RpcCallError(str(reply.error)))
        else:
            call.set_result(reply.result)
