"""Who may look: viewers and Foxglove's pages, and no other page of a browser on this machine."""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Iterator

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

from extensions.foxglove.tests.client import Viewer
from runtime.http_gate import HttpError
from visnav_foxglove import server as gate
from visnav_foxglove.server import FoxgloveConfig, Gate, Server, hidden_host

PROTOCOL = [Subprotocol("foxglove.sdk.v1")]


@pytest.fixture
def refusals() -> list[str]:
    return []


@pytest.fixture
def server(refusals: list[str]) -> Iterator[Server]:
    made = Server(FoxgloveConfig(port=0), "test", refusals.append)
    yield made
    made.close()


def port_of(server: Server) -> int:
    return int(server.address.rpartition(":")[2])


@pytest.mark.parametrize("origin", ["https://evil.example", "null", "http://localhost:3000", ""])
def test_a_page_of_another_origin_is_refused(
    server: Server, refusals: list[str], origin: str
) -> None:
    """And the log tells what to write if it should have been let in."""
    with (
        pytest.raises(InvalidStatus) as refused,
        connect(server.address, origin=Origin(origin), subprotocols=PROTOCOL),
    ):
        pass
    assert refused.value.response.status_code == 403
    assert refusals == [f"expected a page that origins names in the run's file, found {origin!r}"]


@pytest.mark.parametrize("origin", [None, "https://app.foxglove.dev", "file://"])
def test_viewers_and_foxgloves_pages_are_let_in(server: Server, origin: str | None) -> None:
    named = None if origin is None else Origin(origin)
    with connect(server.address, origin=named, subprotocols=PROTOCOL) as connection:
        assert "serverInfo" in str(connection.recv(10.0))


def request(*headers: str) -> str:
    return "\r\n".join(["GET / HTTP/1.1", *headers, "", ""])


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        (["Host: localhost:8765"], 0),
        ([f"Host: {socket.gethostname()}"], 0),
        (["Host: evil.example:8765"], 403),
        ([], 403),
        (["Host: evil.example", "host : localhost"], 400),
        (["Host: localhost", "Origin: file://", "Origin: https://evil.example"], 400),
    ],
)
def test_names_that_a_page_gave_to_this_machine_are_refused(
    server: Server, headers: list[str], status: int
) -> None:
    """Or its own server's answers would be of its origin; of two headers neither counts."""
    if not status:
        server._gate.check(request(*headers))
        return
    with pytest.raises(HttpError) as refused:
        server._gate.check(request(*headers))
    assert refused.value.args[0] == status


def test_the_library_listens_where_no_page_can_find_it(server: Server) -> None:
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", server._server.port), 1.0)
    assert len({hidden_host() for _ in range(50)}) > 40


@pytest.mark.slow
@pytest.mark.parametrize("words", [b"", b"GET / HT", b"\x00\xff" * 20_000, b"HELLO\r\n\r\n"])
def test_who_says_something_else_is_sent_away_and_others_are_served(
    server: Server, words: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gate, "_HEAD_TIMEOUT", 1.0)
    with socket.create_connection(("127.0.0.1", port_of(server))) as other:
        other.settimeout(10.0)
        with contextlib.suppress(OSError):  # it need not hear all of it
            other.sendall(words)
            while other.recv(1 << 16):
                pass
        with Viewer(server.address) as viewer:
            assert viewer.info["op"] == "serverInfo"


def test_the_end_of_the_gate_is_the_end_of_all_connections() -> None:
    """Of those that stand, and of those that come while it ends."""
    with socket.create_server(("127.0.0.1", 0)) as inside:
        place = inside.getsockname()
        door = Gate("127.0.0.1", 0, place, (), lambda _: None)
        with socket.create_connection(("127.0.0.1", door.port)) as viewer:
            viewer.sendall(request("Host: localhost").encode())
            server, _ = inside.accept()
            assert server.recv(1 << 16).startswith(b"GET / HTTP/1.1\r\n")
            server.sendall(b"hello")
            assert viewer.recv(100) == b"hello"
            door.close()
            viewer.settimeout(10.0)
            assert viewer.recv(100) == b""
            server.close()
    end = time.monotonic() + 10.0
    while door._open and time.monotonic() < end:
        time.sleep(0.01)  # for threads, which have no clock of ours
    assert not door._open
