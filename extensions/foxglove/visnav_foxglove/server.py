"""Foxglove's library and server, and a gate before them: the only import of foxglove.

A small message costs about 4 µs without viewers, and 30 µs with one (mostly to wake a thread): done
on the loop. The library takes any WebSocket, which browsers open for any page. So it listens on an
unguessable address of 127.0.0.0/8, and a gate on the known port reads each viewer's first request,
decides, and passes bytes in both directions, in threads without Python's lock.
"""

from __future__ import annotations

import contextlib
import ipaddress
import secrets
import socket
import threading
from collections.abc import Callable, Collection
from http import HTTPStatus
from typing import Annotated, Any

import msgspec

from runtime import NodeConfig
from runtime.errors import MissingDependencyError, VisnavError
from runtime.http_gate import HttpError, check_headers

MOST = 64  # viewers at a time, including those still to send their request
_HEAD_TIMEOUT = 10.0  # real seconds for a viewer to send its request
_LONGEST_HEAD = 16 << 10  # bytes of that request at most
_PART = 1 << 16


def hidden_host() -> str:
    """Return a random address of this machine, for no page to guess."""
    return str(ipaddress.IPv4Address((127 << 24) + 2 + secrets.randbelow((1 << 24) - 4)))


class Gate:
    """Gate for viewers of the right origin: passes bytes between them and the server.

    Args:
        origins: Pages that may connect; programs other than browsers name none, and may.

    Raises:
        OSError: It cannot listen there.
    """

    def __init__(
        self,
        host: str,
        port: int,  # 0 for any free one
        inside: tuple[str, int],
        origins: Collection[str],
        refused: Callable[[str], None],  # called, in a thread, with the reason of a refusal
    ) -> None:
        self._inside, self._origins, self._refused = inside, origins, refused
        self._lock = threading.Lock()
        self._open: set[socket.socket] = set()
        self._closed = False
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._listener = socket.create_server((host, port), family=family)
        self.port = int(self._listener.getsockname()[1])
        threading.Thread(target=self._listen, name="foxglove gate", daemon=True).start()

    def close(self) -> None:
        """Stop listening, and close all connections."""
        with self._lock:
            self._closed = True
            open_ = [self._listener, *self._open]
        for connection in open_:
            _shut(connection)
        self._listener.close()

    def check(self, head: str) -> None:
        """Check a viewer's request; an `HttpError` says why it may not come in."""
        first, _, fields = head.partition("\r\n")
        if len(first.split(" ")) != 3 or " HTTP/1." not in first:
            raise HttpError(400, "expected a request of HTTP/1.1")
        pairs = (line.partition(":")[::2] for line in fields.split("\r\n"))
        headers = check_headers(pairs, ("host", "origin"), ("localhost", socket.gethostname()))
        origin = headers.get("origin")
        if origin is not None and origin not in self._origins:
            raise HttpError(
                403, f"expected a page that origins names in the run's file, found {origin!r:.80}"
            )

    def _listen(self) -> None:
        while True:
            try:
                viewer, _ = self._listener.accept()
            except OSError:
                if self._closed:
                    return
                continue
            if self._holds(viewer):
                threading.Thread(target=self._serve, args=(viewer,), daemon=True).start()
            else:
                viewer.close()

    def _holds(self, connection: socket.socket) -> bool:
        """Register a connection; return False if there is no room."""
        with self._lock:
            if self._closed or len(self._open) >= 2 * MOST:
                return False
            self._open.add(connection)
            return True

    def _serve(self, viewer: socket.socket) -> None:
        server = socket.socket()
        try:
            viewer.settimeout(_HEAD_TIMEOUT)
            try:
                head, remaining = _read_head(viewer)
                self.check(head.decode("latin-1"))
            except HttpError as error:
                status, text = error.args
                self._refused(text)
                reply = f"HTTP/1.1 {status} {HTTPStatus(status).phrase}\r\nconnection: close\r\n"
                viewer.sendall(f"{reply}content-type: text/plain\r\n\r\n{text}\n".encode())
                return
            viewer.settimeout(None)
            if not self._holds(server):
                return
            server.connect(self._inside)
            for end in (viewer, server):
                end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, True)
            server.sendall(head + remaining)
            thread = threading.Thread(target=_pass_on, args=(server, viewer), daemon=True)
            thread.start()
            _pass_on(viewer, server)
            thread.join()
        except OSError:
            pass
        finally:
            for end in (viewer, server):
                with self._lock:
                    self._open.discard(end)
                end.close()


def _read_head(viewer: socket.socket) -> tuple[bytes, bytes]:
    """Return a request up to its empty line, and any bytes after."""
    data = b""
    while b"\r\n\r\n" not in data:
        if len(data) > _LONGEST_HEAD:
            raise HttpError(413, "expected a shorter request")
        part = viewer.recv(_PART)
        if not part:
            raise OSError("gone")
        data += part
    end = data.index(b"\r\n\r\n") + 4
    return data[:end], data[end:]


def _pass_on(source: socket.socket, target: socket.socket) -> None:
    """Pass on bytes until either connection ends, then end both."""
    buffer = memoryview(bytearray(_PART))
    with contextlib.suppress(OSError):
        while count := source.recv_into(buffer):
            target.sendall(buffer[:count])
    _shut(source)
    _shut(target)


def _shut(connection: socket.socket) -> None:
    with contextlib.suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)


class FoxgloveConfig(NodeConfig):
    """Settings of the server.

    Attributes:
        host: Address to listen on, by default of this machine only: whoever reaches it sees the
            run, except pages of other origins.
        port: Port; 0: any free one (the log has it).
        origins: Pages that may connect, by default Foxglove's own; programs need none.
        image_rate: Images a second of each camera, on the run's clock, in whole sets (colours,
            depth); 0: none.
        jpeg_quality: 1 to 100; 0: images as they are.
        depth: Whether to show depth images, in millimetres.
        clock_rate: Messages a second with the run's time.
        backlog: Messages waiting for a slow viewer; the oldest is dropped.
    """

    host: str = "127.0.0.1"
    port: Annotated[int, msgspec.Meta(ge=0, le=65535)] = 8765
    origins: tuple[str, ...] = ("https://app.foxglove.dev", "file://")
    image_rate: Annotated[float, msgspec.Meta(ge=0, le=1000)] = 15.0
    jpeg_quality: Annotated[int, msgspec.Meta(ge=0, le=100)] = 80
    depth: bool = True
    clock_rate: Annotated[float, msgspec.Meta(gt=0, le=1000)] = 50.0
    backlog: Annotated[int, msgspec.Meta(ge=1)] = 1024


Make = Callable[[], Any]  # returns a message
_CLOSING = 2.0  # real seconds for viewers to leave


class Server:
    """A WebSocket server (``foxglove.sdk.v1``) and its topics.

    Args:
        refused: Called, in a thread, with the reason of a refusal.

    Raises:
        MissingDependencyError: foxglove is not installed.
        VisnavError: It cannot listen there.
    """

    def __init__(
        self, config: FoxgloveConfig, name: str, refused: Callable[[str], None] = lambda _: None
    ) -> None:
        try:
            import foxglove
            import foxglove.channels
            import foxglove.messages
            import foxglove.websocket
        except ImportError as error:
            raise MissingDependencyError(
                f"the server needs foxglove ({error}): pip install ./extensions/foxglove"
            ) from error
        self.types: Any = foxglove.messages
        self._channel, self._schema = foxglove.Channel, foxglove.Schema
        self._typed = foxglove.channels
        self._context = foxglove.Context()
        self._channels: dict[str, Any] = {}
        self._latched: dict[str, tuple[Make, int]] = {}
        self._lock = threading.Lock()
        inner = hidden_host()
        listener: Any = self  # of the library's `ServerListener`, as far as used
        try:
            self._server = foxglove.start_server(
                name=name,
                host=inner,
                port=0,
                capabilities=[foxglove.websocket.Capability.Time],
                server_listener=listener,
                message_backlog_size=config.backlog,
                context=self._context,
            )
        except Exception as error:  # the library's own type is not public
            raise VisnavError(f"expected the library to listen here, found: {error}") from error
        try:
            inside = inner, self._server.port
            self._gate = Gate(config.host, config.port, inside, config.origins, refused)
        except OSError as error:
            self._server.stop()
            raise VisnavError(
                f"port: expected to listen on {config.host}:{config.port}, found: {error.strerror}"
            ) from error
        host = f"[{config.host}]" if ":" in config.host else config.host
        self.address = f"ws://{host}:{self._gate.port}"

    def declare(self, topic: str, kind: str) -> None:
        """Declare a topic of a Foxglove type: ``CompressedImage``."""
        if topic not in self._channels:
            channel = getattr(self._typed, f"{kind}Channel")
            self._channels[topic] = channel(topic, context=self._context)

    def declare_ros(self, topic: str, type_: str, definition: str) -> None:
        """Declare a topic of ROS's messages, with their type and its definition."""
        schema = self._schema(name=type_, encoding="ros2msg", data=definition.encode())
        self._channels[topic] = self._channel(
            topic, schema=schema, message_encoding="cdr", context=self._context
        )

    def wanted(self, topic: str) -> bool:
        """Return whether a topic has a viewer."""
        return bool(self._channels[topic].has_sinks())

    def log(self, topic: str, message: Any, stamp: int) -> None:
        """Send a message to the topic's viewers; in any thread."""
        self._channels[topic].log(message, log_time=stamp)

    def latch(self, topic: str, make: Make, stamp: int) -> None:
        """Send the message of `make` now, and to every later viewer of the topic."""
        with self._lock:
            self._latched[topic] = make, stamp
        if self.wanted(topic):
            self.log(topic, make(), stamp)

    def send_time(self, now: int) -> None:
        """Send the run's time (ns)."""
        self._server.broadcast_time(now)

    def close(self) -> None:
        """End the server, also with connections without a request, which it would wait for."""
        stopping = threading.Thread(target=self._server.stop, name="foxglove stops", daemon=True)
        stopping.start()
        stopping.join(_CLOSING)
        self._gate.close()

    def on_subscribe(self, _: Any, channel: Any) -> None:
        """Send the topic's newest message to a new viewer; the library calls it."""
        with self._lock:
            make, stamp = self._latched.get(channel.topic, (None, 0))
        if make is not None:
            self.log(channel.topic, make(), stamp)

    def on_unsubscribe(self, _: Any, channel: Any) -> None:
        """Do nothing: the library counts."""
