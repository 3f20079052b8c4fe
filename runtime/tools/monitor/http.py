"""The part of HTTP that a page on this machine needs: a request, a response, server-sent events.

Protocols: RFC 9112 (HTTP/1.1); "Server-sent events" in the HTML standard.
"""

from __future__ import annotations

import asyncio
from typing import NamedTuple
from urllib.parse import parse_qs, urlsplit

LONGEST_HEAD = 16 << 10
LONGEST_BODY = 64 << 10
"""Bytes of a request at most."""

_REASONS = {
    200: "OK",
    400: "Bad Request",
    403: "Forbidden",
    404: "Not Found",
    405: "Method Not Allowed",
    413: "Content Too Large",
    503: "Service Unavailable",
}


class HttpError(Exception):
    """A request that cannot be served."""

    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        self.status = status
        self.text = text


class Request(NamedTuple):
    """A request; names of headers are in lower case."""

    method: str
    path: str
    query: dict[str, str]
    headers: dict[str, str]
    body: bytes


_ONCE = {"host", "origin", "content-length", "x-token"}
"""Headers that say who asks, and for what: if there are two, nobody knows which one counts."""


def parse_head(head: str) -> tuple[str, str, dict[str, str]]:
    """Return method, target and headers of a request; names of headers are in lower case.

    Raises:
        HttpError: It is no request, or has two of a header of which there may be one.
    """
    first, *lines = head.split("\r\n")
    parts = first.split(" ")
    if len(parts) != 3 or not parts[2].startswith("HTTP/1."):
        raise HttpError(400, "expected a request of HTTP/1.1")
    headers: dict[str, str] = {}
    for line in lines:
        name, colon, value = line.partition(":")
        name = name.strip().lower()
        if colon and name in _ONCE and name in headers:
            raise HttpError(400, f"expected one header {name}, found two")
        if colon:
            headers[name] = value.strip()
    return parts[0], parts[1], headers


def host_of(headers: dict[str, str]) -> str:
    """Return the host that a request is for, without its port; empty if it names none."""
    host = headers.get("host", "")
    if host.startswith("["):
        return host[1:].partition("]")[0]
    return host.partition(":")[0]


async def read_request(reader: asyncio.StreamReader) -> Request:
    """Read one request.

    Raises:
        HttpError: It is none, or too long.
        EOFError: The other side went.
    """
    try:
        head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1")
    except asyncio.LimitOverrunError:
        raise HttpError(413, "expected a shorter request") from None
    method, target, headers = parse_head(head)
    try:
        url = urlsplit(target)
    except ValueError as error:
        raise HttpError(400, f"expected an address: {error}") from None
    query = {key: values[0] for key, values in parse_qs(url.query).items()}
    length = headers.get("content-length", "0")
    if not length.isascii() or not length.isdigit():
        raise HttpError(400, "expected a length")
    if len(length) > 9 or int(length) > LONGEST_BODY:
        raise HttpError(413, f"expected at most {LONGEST_BODY} bytes")
    return Request(method, url.path, query, headers, await reader.readexactly(int(length)))


def response(
    status: int, content: bytes, kind: str = "text/plain; charset=utf-8", **headers: str
) -> bytes:
    """Return a response, after which the connection is closed.

    Args:
        status: The response's.
        content: Its body.
        kind: Its type.
        headers: Others, with ``_`` for ``-``.
    """
    return _head(status, kind, {"content-length": str(len(content)), **headers}) + content


def event_stream() -> bytes:
    """Return what begins a stream of server-sent events."""
    return _head(200, "text/event-stream", {})


def server_sent(data: bytes) -> bytes:
    """Return an event of a stream; `data` is one line."""
    return b"data: " + data + b"\n\n"


def _head(status: int, kind: str, headers: dict[str, str]) -> bytes:
    lines = [f"HTTP/1.1 {status} {_REASONS[status]}", f"content-type: {kind}"]
    lines += [f"{name.replace('_', '-')}: {value}" for name, value in headers.items()]
    lines += [
        "cache-control: no-store",
        "x-content-type-options: nosniff",
        "referrer-policy: no-referrer",
        "connection: close",
    ]
    return ("\r\n".join(lines) + "\r\n\r\n").encode("latin-1")
