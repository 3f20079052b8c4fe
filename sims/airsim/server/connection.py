"""One client's connection: its requests in order, its replies as they come; bounded in all.

The socket is read directly, a little in each turn of the loop: a transport would read (and a
client could have served) much at once, and would need telling when not to.
"""

from __future__ import annotations

import asyncio
import functools
import socket
import time
from collections import deque
from collections.abc import Awaitable, Callable
from typing import Any

from sims.airsim import wire
from sims.airsim.server.incidents import Incidents
from sims.airsim.server.methods import EXPECTED_ERRORS, Flavour, RpcError, Table, thrown

OPEN_REQUESTS = 256
"""Requests of one connection that may wait for their replies; one more is refused."""

LONGEST_QUEUE = 64 << 20
"""Bytes of replies that a client may leave unread; with more, its connection is closed."""

SILENT, IDLE = 5.0, 300.0
"""Real seconds after which a connection that never spoke, or that did and waits for nothing, makes
room for another one, if there is none."""

SMALL, LARGE = 256, 2048
"""Bytes that are read in one turn of the loop: some requests, or a part of a long one."""


class Connection:
    """Serves one client.

    Args:
        client: Its socket.
        address: Its address, for messages.
        table: The methods.
        flavour: Whose structures the client is taken to expect.
        incidents: Is told what happens.
        on_close: Called once the connection is closed.
    """

    def __init__(
        self,
        client: socket.socket,
        address: str,
        table: Table,
        flavour: Flavour,
        incidents: Incidents,
        on_close: Callable[[Connection], None],
    ) -> None:
        self.address = address
        self.flavour: Flavour = flavour
        self._table = table
        self._incidents = incidents
        self._on_close = on_close
        self._socket = client
        self._loop = asyncio.get_running_loop()
        self._decoder = wire.Decoder()
        self._chunk = SMALL
        self._open = 0
        self._tasks: set[asyncio.Task[Any]] = set()
        self._unsent: deque[memoryview] = deque()
        self._is_closed = False
        self._heard, self._spoke = time.monotonic(), False
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in (("TCP_KEEPIDLE", 30), ("TCP_KEEPINTVL", 10), ("TCP_KEEPCNT", 6)):
            if hasattr(socket, option):
                client.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)
        self._loop.add_reader(client, self._read)

    def spare_for(self) -> float:
        """Return for how many real seconds it could have made room; negative if it may stay."""
        if self._open or self._unsent:
            return -1.0
        return time.monotonic() - self._heard - (IDLE if self._spoke else SILENT)

    def close(self, reason: str = "") -> None:
        """Close the connection: what only it waits for ends, and a vehicle's task goes on.

        Args:
            reason: Why, for the log; empty if the client closed it, or the run ends.
        """
        if self._is_closed:
            return
        self._is_closed = True
        self._loop.remove_reader(self._socket)
        self._loop.remove_writer(self._socket)
        self._socket.close()
        self._unsent.clear()
        for task in self._tasks:
            task.cancel()
        if reason:
            self._incidents.refused(self.address, f"connection closed: {reason}")
        self._on_close(self)

    def _read(self) -> None:
        """Serve what the next bytes complete; more of them are for the next turn of the loop."""
        try:
            data = self._socket.recv(self._chunk)
        except (BlockingIOError, InterruptedError):
            return
        except OSError:
            data = b""
        if not data:
            self.close()
            return
        self._chunk = min(2 * self._chunk, LARGE)
        try:
            for message in self._decoder.feed(data):
                self._chunk = SMALL
                if self._is_closed:
                    return
                if isinstance(message, wire.Request):
                    self._serve(message)
                else:
                    self._incidents.count("replies, ignored")
        except wire.WireFormatError as error:
            self.close(str(error))

    def _serve(self, request: wire.Request) -> None:
        self._heard, self._spoke = time.monotonic(), True
        self._incidents.count("requests" if request.id is not None else "notifications")
        try:
            if self._open >= OPEN_REQUESTS:
                text = f"expected at most {OPEN_REQUESTS} open requests of one connection"
                raise RpcError(thrown(request.method, len(request.arguments), text))
            result = self._table.call(self, request.method, request.arguments)
        except RpcError as error:
            self._refuse(request, str(error))
        except Exception as error:  # a handler's own
            self._fail(request, error)
        else:
            if isinstance(result, Awaitable):
                self._open += 1
                self._future(result).add_done_callback(functools.partial(self._done, request))
            else:
                self._answer(request, None, result)

    def _future(self, result: Awaitable[Any]) -> asyncio.Future[Any]:
        if isinstance(result, asyncio.Future):  # a vehicle's, which may outlive the connection
            return result

        async def waiting() -> Any:
            return await result

        # A coroutine itself, since one that a cancelled task has not come to await is a warning.
        task = self._loop.create_task(result if asyncio.iscoroutine(result) else waiting())
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    def _done(self, request: wire.Request, future: asyncio.Future[Any]) -> None:
        self._open -= 1
        if future.cancelled():
            self._refuse(
                request, thrown(request.method, len(request.arguments), "it was cancelled")
            )
        elif (error := future.exception()) is None:
            self._answer(request, None, future.result())
        elif isinstance(error, EXPECTED_ERRORS):
            self._refuse(request, thrown(request.method, len(request.arguments), str(error)))
        else:
            self._fail(request, error)

    def _refuse(self, request: wire.Request, text: str) -> None:
        if not self._is_closed:
            self._incidents.refused(self.address, text)
            self._answer(request, text, None)

    def _fail(self, request: wire.Request, error: BaseException) -> None:
        self._incidents.failed(request.method, error)
        text = f"{type(error).__name__} in the server, whose log has more"
        self._answer(request, thrown(request.method, len(request.arguments), text), None)

    def _answer(self, request: wire.Request, error: str | None, result: Any) -> None:
        if request.id is None or self._is_closed:
            return
        try:
            data = wire.reply(request.id, error, result)
        except Exception as unencodable:
            self._fail(request, unencodable)
        else:
            self._write(memoryview(data))

    def _write(self, data: memoryview) -> None:
        """Send; while anything is unsent, the client's requests are not read."""
        if self._unsent:
            self._unsent.append(data)
            if sum(map(len, self._unsent)) > LONGEST_QUEUE + len(data):
                self.close(f"more than {LONGEST_QUEUE} bytes of replies are not read")
            return
        self._unsent.append(data)
        self._flush()
        if self._unsent:
            self._loop.remove_reader(self._socket)
            self._loop.add_writer(self._socket, self._resume)

    def _resume(self) -> None:
        self._flush()
        if not self._unsent and not self._is_closed:
            self._loop.remove_writer(self._socket)
            self._loop.add_reader(self._socket, self._read)

    def _flush(self) -> None:
        try:
            while self._unsent:
                rest = self._unsent[0][self._socket.send(self._unsent[0]) :]
                if rest:
                    self._unsent[0] = rest
                    return
                self._unsent.popleft()
        except (BlockingIOError, InterruptedError):
            pass
        except OSError:
            self.close()
