"""The door of the server: who may come in is decided here, before a viewer meets the library.

The library takes every WebSocket, and a browser opens one for any page that asks. So the library
listens on an address of this machine that nobody can guess (one of the 16 million of 127.0.0.0/8),
and this gate on the port that is known: it reads each viewer's first request, and then passes bytes
in both directions, in threads that hold no lock of Python's while they wait.
"""

from __future__ import annotations

import contextlib
import ipaddress
import secrets
import socket
import threading
from collections.abc import Callable, Collection

from runtime.tools.monitor.http import LONGEST_HEAD, HttpError, host_of, parse_head, response

MOST = 64
"""Viewers at a time, those included that have yet to send their request."""

_HEAD_TIMEOUT = 10.0
"""Real seconds in which a viewer has to send its request."""

_PART = 1 << 16


def hidden_host() -> str:
    """Return an address of this machine that no page can guess."""
    return str(ipaddress.IPv4Address((127 << 24) + 2 + secrets.randbelow((1 << 24) - 4)))


class Gate:
    """Lets in viewers of the right origin, and passes bytes between them and the server.

    Args:
        host: Where to listen.
        port: The same; 0 for any that is free.
        inside: Host and port of the server.
        origins: Pages that may connect. Programs that are no browsers name none, and may.
        refused: Called, in a thread, with why somebody was not let in.

    Raises:
        OSError: It cannot listen there.
    """

    def __init__(
        self,
        host: str,
        port: int,
        inside: tuple[str, int],
        origins: Collection[str],
        refused: Callable[[str], None],
    ) -> None:
        self._inside = inside
        self._origins = origins
        self._refused = refused
        self._lock = threading.Lock()
        self._open: set[socket.socket] = set()
        self._closed = False
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._listener = socket.create_server((host, port), family=family)
        self.port = int(self._listener.getsockname()[1])
        threading.Thread(target=self._listen, name="foxglove gate", daemon=True).start()

    def close(self) -> None:
        """Let nobody in any more, and end all connections."""
        with self._lock:
            self._closed = True
            open_ = [self._listener, *self._open]
        for each in open_:
            _shut(each)
        self._listener.close()

    def check(self, head: str) -> None:
        """Look at a viewer's request.

        Raises:
            HttpError: It may not come in; the text says why.
        """
        _, _, headers = parse_head(head)
        host = host_of(headers)
        try:
            ipaddress.ip_address(host)
        except ValueError:
            # A page can give this machine's address a name of its own, and then it is its origin.
            if host not in {"localhost", socket.gethostname()}:
                raise HttpError(
                    403, f"expected a request to an address or localhost, found {host!r:.80}"
                ) from None
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
        """Note a connection; tell whether there is room for it."""
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
                head, rest = _read_head(viewer)
                self.check(head.decode("latin-1"))
            except HttpError as error:
                self._refused(error.text)
                viewer.sendall(response(error.status, f"{error.text}\n".encode()))
                return
            viewer.settimeout(None)
            if not self._holds(server):
                return
            server.connect(self._inside)
            for each in (viewer, server):
                each.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, True)
            server.sendall(head + rest)
            back = threading.Thread(target=_pass_on, args=(server, viewer), daemon=True)
            back.start()
            _pass_on(viewer, server)
            back.join()
        except OSError:
            pass
        finally:
            for each in (viewer, server):
                with self._lock:
                    self._open.discard(each)
                each.close()


def _read_head(viewer: socket.socket) -> tuple[bytes, bytes]:
    """Return a request up to its empty line, and what has come after it."""
    data = b""
    while b"\r\n\r\n" not in data:
        if len(data) > LONGEST_HEAD:
            raise HttpError(413, "expected a shorter request")
        part = viewer.recv(_PART)
        if not part:
            raise OSError("gone")
        data += part
    end = data.index(b"\r\n\r\n") + 4
    return data[:end], data[end:]


def _pass_on(source: socket.socket, target: socket.socket) -> None:
    """Pass on what comes until either is at its end, and then end both."""
    buffer = memoryview(bytearray(_PART))
    with contextlib.suppress(OSError):
        while count := source.recv_into(buffer):
            target.sendall(buffer[:count])
    _shut(source)
    _shut(target)


def _shut(connection: socket.socket) -> None:
    with contextlib.suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)
