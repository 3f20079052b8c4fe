"""Connections of clients: where they connect, their requests in order, and their replies.

All is bounded. A socket is read directly, a little in each turn of the loop: a transport would read
(and a client could have served) much at once, and would need telling when not to.
"""

from __future__ import annotations

import asyncio
import errno
import functools
import re
import socket
import time
from collections import Counter, deque
from collections.abc import Awaitable, Callable
from typing import Any

import msgspec

from runtime.logs import NodeLogger
from visnav_airsim import wire
from visnav_airsim.server.methods import EXPECTED_ERRORS, Flavour, RpcError, Table, thrown

OPEN_REQUESTS = 256  # requests of a connection that may wait for their replies; more are refused
LONGEST_QUEUE = 64 << 20  # bytes of unread replies with more of which a connection is closed
MOST_WARNINGS = 500  # different refusals that are logged as warnings; others are at debug level
# Real seconds after which a connection that never spoke, or that did and waits for nothing, makes
# room for another one, if there is none.
SILENT, IDLE = 5.0, 300.0
# Bytes that are read in one turn of the loop: some requests, or a part of a long one.
SMALL, LARGE = 256, 2048
_FOREIGN = {errno.EADDRNOTAVAIL, errno.EAFNOSUPPORT, errno.EINVAL}  # of others' addresses
CHUNK = 1 << 17  # bytes of an answer that are sent in one turn of the loop: some 30 µs


class Incidents:
    """Counts and log messages of incidents on all connections."""

    def __init__(self, log: NodeLogger) -> None:
        self._log = log
        self.counts: Counter[str] = Counter()
        self._logged: set[tuple[str, str]] = set()

    def refused(self, address: str, text: str) -> None:
        """Log a refusal, unseen by some scripts, once for each host and text but numbers."""
        self.counts["refused"] += 1
        key = address.rpartition(":")[0], re.sub(r"[\d.]+", "#", text)
        is_new = key not in self._logged and len(self._logged) < MOST_WARNINGS
        if is_new:
            self._logged.add(key)
        text = text if text.isprintable() else ascii(text)
        (self._log.warning if is_new else self._log.debug)("%s: refused: %.400s", address, text)

    def failed(self, method: str, error: BaseException) -> None:
        """Log an internal error of the server, once for each method."""
        self.counts["failed"] += 1
        if ("", method) not in self._logged:
            self._logged.add(("", method))
            self._log.error("%s failed, which is a bug of the server", method, exc_info=error)

    def log_counts(self) -> None:
        """Log how often each thing happened."""
        if self.counts:
            counts = (f"{count} {incident}" for incident, count in self.counts.items())
            self._log.info("AirSim's clients: %s", ", ".join(counts))


class Connection:
    """Connection of a client to the server."""

    def __init__(
        self,
        client: socket.socket,
        address: str,
        table: Table,
        flavour: Flavour,
        incidents: Incidents,
        on_close: Callable[[Connection], None],  # called once the connection is closed
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
        self._last_request_at, self._has_requested = time.monotonic(), False
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in (("TCP_KEEPIDLE", 30), ("TCP_KEEPINTVL", 10), ("TCP_KEEPCNT", 6)):
            if hasattr(socket, option):
                client.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)
        self._loop.add_reader(client, self._read)

    def spare_for(self) -> float:
        """Return the real seconds since the connection became spare; negative in use."""
        if self._open or self._unsent:
            return -1.0
        return time.monotonic() - self._last_request_at - (IDLE if self._has_requested else SILENT)

    def close(self, reason: str = "") -> None:
        """Close the connection and cancel its calls, not vehicles' tasks; log a `reason`."""
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
        """Serve the requests in the next bytes; leave further bytes to the next turn."""
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
                    self._incidents.counts["replies, ignored"] += 1
        except wire.WireFormatError as error:
            self.close(str(error))

    def _serve(self, request: wire.Request) -> None:
        self._last_request_at, self._has_requested = time.monotonic(), True
        self._incidents.counts["requests" if request.id is not None else "notifications"] += 1
        try:
            if self._open >= OPEN_REQUESTS:
                text = f"expected at most {OPEN_REQUESTS} open requests of one connection"
                raise RpcError(_thrown(request, text))
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
            self._refuse(request, _thrown(request, "it was cancelled"))
        elif (error := future.exception()) is None:
            self._answer(request, None, future.result())
        elif isinstance(error, EXPECTED_ERRORS):
            self._refuse(request, _thrown(request, str(error)))
        else:
            self._fail(request, error)

    def _refuse(self, request: wire.Request, text: str) -> None:
        if not self._is_closed:
            self._incidents.refused(self.address, text)
            self._answer(request, text, None)

    def _fail(self, request: wire.Request, error: BaseException) -> None:
        self._incidents.failed(request.method, error)
        text = f"{type(error).__name__} in the server, whose log has more"
        self._answer(request, _thrown(request, text), None)

    def _answer(self, request: wire.Request, error: str | None, result: Any) -> None:
        if request.id is None or self._is_closed:
            return
        if isinstance(result, msgspec.Raw):  # images, sent from where they are
            head = wire.reply(request.id, error, msgspec.Raw())
            self._write(memoryview(head), memoryview(result))
            return
        try:
            data = wire.reply(request.id, error, result)
        except Exception as unencodable:
            self._fail(request, unencodable)
        else:
            self._write(memoryview(data))

    def _write(self, *data: memoryview) -> None:
        """Send; while anything is unsent, the client's requests are not read."""
        before = sum(map(len, self._unsent))
        self._unsent.extend(data)
        if before:
            if before > LONGEST_QUEUE:
                self.close(f"more than {LONGEST_QUEUE} bytes of replies are not read")
            return
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
        """Send a chunk of what is unsent; the rest is for further turns of the loop."""
        chunk: list[memoryview] = []
        room = CHUNK
        for piece in self._unsent:
            chunk.append(piece[:room])
            room -= len(chunk[-1])
            if not room:
                break
        try:
            sent = self._socket.sendmsg(chunk)
        except (BlockingIOError, InterruptedError):
            return
        except OSError:
            self.close()
            return
        while sent >= len(self._unsent[0]):
            sent -= len(self._unsent.popleft())
            if not self._unsent:
                return
        self._unsent[0] = self._unsent[0][sent:]


def check_address(host: str, port: int = 0) -> None:
    """Raise a `ValueError` if an address is another machine's, or its port (0: any) not free."""
    _listening(host, port).close()


def _listening(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except PermissionError as error:
        raise ValueError(
            f"port: expected one that this user may open, found {port}: {error}"
        ) from None
    except (OSError, UnicodeError) as error:
        # Names that stand for no address have numbers below 0 (EAI_NONAME, …), or none.
        number = (error.errno or 0) if isinstance(error, OSError) else -1
        if number < 0 or number in _FOREIGN:
            raise ValueError(
                "host: expected an address of this machine (127.0.0.1 for clients on it, 0.0.0.0 "
                f"for all), found {host} (LocalHostIp in settings.json): {error}"
            ) from None
        raise ValueError(
            f"port: expected one that is free on {host}, found {port} (ApiServerPort in "
            f"settings.json): {error}"
        ) from None


def _thrown(request: wire.Request, text: str) -> str:
    return thrown(request.method, len(request.arguments), text)


class Listener:
    """Listener on a port (0: any) for at most `most` clients, served from `serve` on.

    `on_change` gets whether any client is there, whenever one has come or left.

    Raises:
        ValueError: The address is not this machine's, or the port is not free.
    """

    def __init__(
        self,
        host: str,
        port: int,
        most: int,
        log: NodeLogger,
        on_change: Callable[[bool], None] = lambda _: None,
    ) -> None:
        self._socket = _listening(host, port)
        self._socket.setblocking(False)
        self.port: int = self._socket.getsockname()[1]
        self._most = most
        self._on_change = on_change
        self._incidents = Incidents(log)
        self._connections: set[Connection] = set()

    def serve(self, table: Table, flavour: Flavour) -> None:
        """Serve the clients already connected and those to come."""
        self._table, self._flavour = table, flavour
        asyncio.get_running_loop().add_reader(self._socket, self._accept)

    def close(self) -> None:
        """Close all connections, and log the counts."""
        self._on_change = lambda _: None
        asyncio.get_running_loop().remove_reader(self._socket)
        self._socket.close()
        for connection in tuple(self._connections):
            connection.close()
        self._incidents.log_counts()

    def _accept(self) -> None:
        try:
            client, (host, port, *_) = self._socket.accept()
        except OSError:  # it is gone again
            return
        address = f"{host}:{port}"
        if len(self._connections) >= self._most:
            idlest = max(self._connections, key=Connection.spare_for)
            if idlest.spare_for() < 0.0:
                self._incidents.refused(address, f"expected at most {self._most} connections")
                client.close()
                return
            idlest.close("it was idle, and another client came")
        self._incidents.counts["connections"] += 1
        connection = Connection(
            client, address, self._table, self._flavour, self._incidents, self._left
        )
        self._connections.add(connection)
        self._on_change(bool(self._connections))

    def _left(self, connection: Connection) -> None:
        self._connections.discard(connection)
        self._on_change(bool(self._connections))
