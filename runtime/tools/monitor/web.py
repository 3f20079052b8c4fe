"""The monitor as a page: what the terminal shows, the same commands, and a camera's images.

Served on this machine only, each page with a connection of its own to the run. The token in the
address allows commands: other users of the machine do not know it, and other pages in the browser
can neither read it nor send the header that a command needs.
"""

from __future__ import annotations

import asyncio
import contextlib
import secrets
import socket
import sys
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, quote, urlsplit

import jinja2
import msgspec

from runtime.errors import CommandError
from runtime.http_gate import HttpError, check_headers
from runtime.tools.monitor import protocol

TOKEN_HEADER = "x-token"  # noqa: S105  # the header's name, not a secret
LONGEST_BODY = 64 << 10  # bytes of a command at most

_ONCE = ("host", "origin", "content-length", TOKEN_HEADER)


class PageServer(ThreadingHTTPServer):
    """Server of a run's page, a thread for each connection.

    Args:
        port: On 127.0.0.1; 0 for any that is free.
        token: Required in addresses; random if not given.

    Raises:
        OSError: The port is taken.
    """

    def __init__(self, port: int, run: Path, token: str | None = None) -> None:
        self.run = run
        self.token = token or secrets.token_urlsafe(16)
        super().__init__(("127.0.0.1", port), _Handler)
        self.address = f"http://127.0.0.1:{self.server_port}/?token={quote(self.token, safe='')}"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Report an error, unless it is that a page has gone."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    server: PageServer
    timeout = 10.0  # seconds for the request to come, and for a page to take what it is sent

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002  # the base's name
        """Log no requests."""

    def _handle(self) -> None:
        try:
            self._respond()
        except HttpError as error:
            status, text = error.args
            self._send(status, f"{text}\n".encode())

    do_GET = do_POST = _handle  # noqa: N815  # the base's names

    def _respond(self) -> None:
        try:
            url = urlsplit(self.path)
        except ValueError as error:
            raise HttpError(400, f"expected an address: {error}") from None
        query = {key: values[0] for key, values in parse_qs(url.query).items()}
        self._authorize(query.get("token", ""))
        match self.command, url.path:
            case "GET", "/":
                self._page()
            case "GET", "/events":
                asyncio.run(self._events())
            case "GET", "/image":
                answer = self._ask(protocol.Look(camera=query.get("camera", "")))
                if not answer.done:
                    raise HttpError(404, answer.text)
                self._send(200, answer.jpeg, "image/jpeg")
            case "POST", "/command":
                answer = self._ask(self._body())
                self._send(200, protocol.encode(answer), "application/json")
            case _, "/" | "/events" | "/image" | "/command":
                raise HttpError(405, f"{url.path} takes no {self.command}")
            case _:
                raise HttpError(404, f"there is no {url.path}")

    def _authorize(self, token: str) -> None:
        """Check a request's host and token, or raise `HttpError`."""
        headers = check_headers(self.headers.items(), _ONCE)
        received = headers.get(TOKEN_HEADER, "") if self.command == "POST" else token
        if not secrets.compare_digest(received.encode(), self.server.token.encode()):
            raise HttpError(403, "expected the address that was printed, token included")

    def _body(self) -> bytes:
        length = self.headers.get("content-length", "0")
        if not length.isascii() or not length.isdigit():
            raise HttpError(400, "expected a length")
        if len(length) > 9 or int(length) > LONGEST_BODY:
            raise HttpError(413, f"expected at most {LONGEST_BODY} bytes")
        return self.rfile.read(int(length)).replace(b"\n", b" ")

    def _ask(self, request: protocol.Request | bytes) -> protocol.Answer:
        return asyncio.run(self._client().ask(request))

    def _client(self) -> protocol.Client:
        return protocol.Client(self.server.run)

    def _page(self) -> None:
        nonce = secrets.token_urlsafe(16)
        text = (Path(__file__).parent / "page.html.jinja").read_text(encoding="utf-8")
        page = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
        content = page.from_string(text).render(
            nonce=nonce, slowest=protocol.SLOWEST, quickest=protocol.QUICKEST,
            token=self.server.token, stacks=protocol.STACKS, columns=protocol.COLUMNS,
            first=msgspec.json.decode(asyncio.run(self._newest())),
        )  # fmt: skip
        policy = (
            f"default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; "
            "connect-src 'self'; img-src 'self'; frame-ancestors 'none'; base-uri 'none'; "
            "form-action 'none'"
        )
        self._send(200, content.encode(), "text/html; charset=utf-8", policy)

    async def _newest(self) -> bytes:
        with contextlib.suppress(OSError, CommandError):  # a time-out is an OSError, too
            async with asyncio.timeout(2.0), self._client().lines(protocol.Watch()) as lines:
                return await lines.readline() or b"null"
        return b"null"

    async def _events(self) -> None:
        """Send the run's snapshots as events, each a line; and ``null`` when it is over."""
        self._head(200, "text/event-stream")
        with contextlib.suppress(OSError, CommandError):
            async with self._client().lines(protocol.Watch()) as lines:
                async for line in lines:
                    self.wfile.write(b"data: " + line + b"\n")
        self.wfile.write(b"data: null\n\n")

    def _send(
        self, status: int, content: bytes, kind: str = "text/plain; charset=utf-8", policy: str = ""
    ) -> None:
        self._head(status, kind, policy)
        self.wfile.write(content)

    def _head(self, status: int, kind: str, policy: str = "") -> None:
        self.send_response(status)
        self.send_header("content-type", kind)
        self.send_header("cache-control", "no-store")
        self.send_header("x-content-type-options", "nosniff")
        self.send_header("referrer-policy", "no-referrer")
        if policy:
            self.send_header("content-security-policy", policy)
        self.end_headers()


def serve(server: PageServer) -> None:
    """Serve a run's page until the run is over."""
    with server, contextlib.suppress(OSError), socket.socket(socket.AF_UNIX) as run:
        run.connect(str(server.run))
        print(f"the monitor is at {server.address}", flush=True)
        threading.Thread(target=server.serve_forever, args=(0.1,), daemon=True).start()
        try:
            run.recv(1)  # nothing comes but the end
            time.sleep(0.5)  # the pages receive the end
        finally:
            server.shutdown()
