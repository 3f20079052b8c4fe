"""One client's connection: its requests in order, its replies as they come."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import Awaitable
from typing import Any

from runtime.logs import NodeLogger
from sims.airsim import wire
from sims.airsim.server.methods import Flavour, RpcError, Table, thrown


class Connection(asyncio.Protocol):
    """Serves one client.

    Args:
        table: The methods.
        flavour: Whose structures the client is taken to expect.
        log: Where refusals are logged.
        connections: All that are open.
    """

    def __init__(
        self, table: Table, flavour: Flavour, log: NodeLogger, connections: set[Connection]
    ) -> None:
        self.flavour: Flavour = flavour
        self.address = ""
        self._table = table
        self._log = log
        self._connections = connections
        self._decoder = wire.Decoder()
        self._waiting: set[asyncio.Future[Any]] = set()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        host, port, *_ = transport.get_extra_info("peername")
        self.address = f"{host}:{port}"
        self._connections.add(self)

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002
        """End; tasks of vehicles go on, as with AirSim."""
        self._connections.discard(self)

    def close(self) -> None:
        """Close the connection, and give up what it waits for."""
        for task in self._waiting:
            task.cancel()
        self._transport.close()

    def data_received(self, data: bytes) -> None:
        """Serve the requests that are complete."""
        try:
            for message in self._decoder.feed(data):
                if isinstance(message, wire.Request):
                    self._serve(message)
        except wire.WireFormatError as error:
            self._log.warning("%s: connection closed: %s", self.address, error)
            self._transport.close()

    def _serve(self, request: wire.Request) -> None:
        try:
            result = self._table.call(self, request.method, request.arguments)
        except RpcError as error:
            self._answer(request, str(error), None)
            return
        if inspect.isawaitable(result):
            task = asyncio.ensure_future(self._wait(request, result))
            self._waiting.add(task)
            task.add_done_callback(self._waiting.discard)
        else:
            self._answer(request, None, result)

    async def _wait(self, request: wire.Request, result: Awaitable[Any]) -> None:
        try:
            found = await result
        except (RpcError, ValueError) as error:
            text = thrown(request.method, len(request.arguments), str(error))
            self._answer(request, text, None)
        else:
            self._answer(request, None, found)

    def _answer(self, request: wire.Request, error: str | None, result: Any) -> None:
        if error is not None:
            self._log.warning("%s: refused: %s", self.address, error)
        if request.id is not None and not self._transport.is_closing():
            self._transport.write(wire.reply(request.id, error, result))
