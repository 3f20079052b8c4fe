"""The monitor as a page: the same tables and commands as in a terminal, and a camera's images.

Served on this machine only. The token in the address allows commands: other users of the machine
do not know it, and other pages in the browser can neither read it nor send the header that a
command needs.
"""

from __future__ import annotations

import asyncio
import contextlib
import secrets
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import jinja2
import msgspec

from runtime.errors import CommandError, VisnavError
from runtime.tools.monitor.client import (
    LONGEST_HEAD,
    Client,
    HttpError,
    Request,
    event_stream,
    host_of,
    read_request,
    response,
    server_sent,
)
from runtime.tools.monitor.protocol import (
    COLUMNS,
    LEFT,
    QUICKEST,
    RIGHT,
    SLOWEST,
    UNREADABLE,
    Answer,
    Snapshot,
    decode_command,
    encode,
    is_number,
)

TOKEN_HEADER = "x-token"  # noqa: S105  # the header's name, not a secret
_HOSTS = {"127.0.0.1", "localhost"}
_MAX_BACKLOG = 3
"""Snapshots queued for a slow page at most."""


class Page:
    """Server of a run's page.

    Args:
        token: Required in addresses; random if not given.
    """

    def __init__(self, client: Client, token: str | None = None) -> None:
        self.token = token or secrets.token_urlsafe(16)
        self.over = asyncio.Event()
        """Set when the run is over."""
        self._client = client
        self._pages: set[asyncio.Queue[bytes | None]] = set()
        self._last: bytes | None = None
        self._end = "the run is over: it does not answer any more"

    async def listen(self) -> None:
        """Send the run's snapshots to all pages until the run is over."""
        try:
            async for snapshot in self._client.snapshots():
                self._last = encode(page_data(snapshot))
                self._offer(self._last)
                if snapshot.ended:
                    self._end = f"the run is over: {snapshot.ended}"
        except VisnavError as error:
            self._end = str(error)
        finally:
            self._offer(None)
            self.over.set()

    def _offer(self, data: bytes | None) -> None:
        for page in self._pages:
            if page.full():
                page.get_nowait()
            page.put_nowait(data)

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve a connection."""
        try:
            request = await asyncio.wait_for(read_request(reader), 10.0)
            await self._respond(request, writer)
            await writer.drain()
        except HttpError as error:
            writer.write(response(error.status, f"{error.text}\n".encode()))
        except (OSError, EOFError, TimeoutError):
            pass
        finally:
            writer.close()

    async def _respond(self, request: Request, writer: asyncio.StreamWriter) -> None:
        self._authorize(request)
        match request.method, request.path:
            case "GET", "/":
                writer.write(self._page())
            case "GET", "/events":
                writer.write(event_stream())
                async for data in self._events():
                    writer.write(data)
                    await writer.drain()
            case "GET", "/image":
                writer.write(response(200, await self._image(request), "image/jpeg"))
            case "POST", "/command":
                answer = await self._command(request)
                writer.write(response(200, encode(answer), "application/json"))
            case _, "/" | "/events" | "/image" | "/command":
                raise HttpError(405, f"{request.path} takes no {request.method}")
            case _:
                raise HttpError(404, f"there is no {request.path}")

    def _authorize(self, request: Request) -> None:
        """Check a request's token and, against DNS rebinding, its host: this machine.

        Raises:
            HttpError: It is not allowed.
        """
        host = host_of(request.headers)
        if host not in _HOSTS:
            raise HttpError(403, f"expected a request to 127.0.0.1, found {host!r}")
        given = (
            request.headers.get(TOKEN_HEADER, "")
            if request.method == "POST"
            else request.query.get("token", "")
        )
        if not secrets.compare_digest(given.encode(), self.token.encode()):
            raise HttpError(403, "expected the address that was printed, token included")

    def _page(self) -> bytes:
        nonce = secrets.token_urlsafe(16)
        text = _template().render(
            nonce=nonce,
            slowest=SLOWEST,
            quickest=QUICKEST,
            token=self.token,
            first=None if self._last is None else msgspec.json.decode(self._last),
            stacks=[
                {
                    name: [(title, is_number(name, n)) for n, title in enumerate(COLUMNS[name])]
                    for name in stack
                }
                for stack in (LEFT, RIGHT)
            ],
        )
        policy = (
            f"default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; "
            "connect-src 'self'; img-src 'self'; frame-ancestors 'none'; base-uri 'none'; "
            "form-action 'none'"
        )
        return response(
            200, text.encode(), "text/html; charset=utf-8", content_security_policy=policy
        )

    async def _events(self) -> AsyncIterator[bytes]:
        page: asyncio.Queue[bytes | None] = asyncio.Queue(_MAX_BACKLOG)
        self._pages.add(page)
        try:
            if self._last is not None:
                yield server_sent(self._last)
            if not self.over.is_set():
                while (data := await page.get()) is not None:
                    yield server_sent(data)
            yield server_sent(encode({"over": self._end}))
        finally:
            self._pages.discard(page)

    async def _image(self, request: Request) -> bytes:
        try:
            return await self._client.image(request.query.get("camera", ""))
        except CommandError as error:
            raise HttpError(404, str(error)) from None

    async def _command(self, request: Request) -> Answer:
        try:
            command = decode_command(request.body)
        except UNREADABLE as error:
            raise HttpError(400, f"expected a command: {error}") from None
        if self.over.is_set():
            return Answer(number=-1, done=False, text="the run is over")
        return await self._client.ask(command)


def page_data(snapshot: Snapshot) -> dict[str, Any]:
    """Return the data of a snapshot for the page."""
    return {
        "headline": snapshot.headline,
        "paused": snapshot.clock.paused,
        "speed": snapshot.clock.aim,
        "fixed": snapshot.clock.fixed,
        "cameras": snapshot.cameras,
        "tables": snapshot.tables,
        "log": [msgspec.to_builtins(line) for line in snapshot.log],
    }


async def serve(client: Client, port: int, token: str | None = None, leave: bool = False) -> None:
    """Serve a run's page until Ctrl-C, or until the run is over.

    Args:
        port: On 127.0.0.1; 0 for any that is free.
        token: See `Page`.

    Raises:
        OSError: The port is taken.
    """
    page = Page(client, token)
    server = await asyncio.start_server(page.serve, "127.0.0.1", port, limit=LONGEST_HEAD)
    number = server.sockets[0].getsockname()[1]
    print(
        f"the monitor is at http://127.0.0.1:{number}/?token={quote(page.token, safe='')}",
        flush=True,
    )
    listening = asyncio.create_task(page.listen())
    try:
        if leave:
            await listening
            await asyncio.sleep(0.5)  # the pages receive the end
        else:
            await asyncio.get_running_loop().create_future()
    finally:
        listening.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await listening
        server.close()


def _template() -> jinja2.Template:
    text = (Path(__file__).parent / "page.html.jinja").read_text(encoding="utf-8")
    return jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(text)
