"""Clients that flood, starve, garble and vanish; each is bounded, counted and survived."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import re
import socket
from collections.abc import Awaitable, Callable
from typing import Any

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runtime.logs import NodeLogger
from visnav_airsim import wire
from visnav_airsim.server.connections import LONGEST_QUEUE, OPEN_REQUESTS, Listener, check_address
from visnav_airsim.server.methods import RpcError, Table, rpc


class Methods:
    """Methods for tests."""

    def __init__(self) -> None:
        self.called: list[int] = []
        self.ended: list[str] = []
        self.vehicle: asyncio.Future[bool] = asyncio.get_running_loop().create_future()

    @rpc("note")
    def note(self, number: int) -> int:
        """Take note of a number."""
        self.called.append(number)
        return number

    @rpc("later")
    def later(self, number: int) -> Awaitable[int]:
        """Take note of a number at once, and return it some turns of the loop later."""
        self.called.append(number)

        async def wait() -> int:
            for _ in range(number % 7):
                await asyncio.sleep(0)
            return number

        return wait()

    @rpc("wait")
    def wait(self) -> Awaitable[None]:
        """Wait for ever."""

        async def wait() -> None:
            try:
                await asyncio.get_running_loop().create_future()
            finally:
                self.ended.append("wait")

        return wait()

    @rpc("fly")
    def fly(self) -> Awaitable[bool]:
        """Wait for a vehicle's task."""
        self.called.append(0)
        return self.vehicle

    @rpc("large")
    def large(self, size: int) -> bytes:
        """Return that many bytes."""
        return bytes(size)

    @rpc("bug")
    def bug(self) -> None:
        """Fail."""
        raise KeyError("what a handler did not expect")

    @rpc("odd")
    def odd(self) -> object:
        """Return what msgpack cannot hold."""
        return object()

    @rpc("refuse")
    def refuse(self) -> Awaitable[None]:
        """Refuse after a while."""

        async def wait() -> None:
            await asyncio.sleep(0)
            raise RpcError("no")

        return wait()


class Client:
    """A client that sees bytes."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer
        self._decoder = wire.Decoder(wire.LONGEST_REPLY)

    def send(self, *requests: tuple[int, str, list[Any]]) -> None:
        """Send requests, all in one go."""
        self.writer.write(b"".join(wire.request(*request) for request in requests))

    async def messages(self, count: int) -> list[wire.Reply]:
        """Return the next replies."""
        replies: list[Any] = []
        while len(replies) < count:
            data = await self.reader.read(1 << 16)
            assert data, "the server closed the connection"
            replies += self._decoder.feed(data)
        assert len(replies) == count
        return replies

    async def call(self, method: str, *arguments: Any) -> wire.Reply:
        self.send((0, method, [*arguments]))
        return (await self.messages(1))[0]

    async def closed(self) -> None:
        """Wait until the server closes the connection; what it sends before is read."""
        with contextlib.suppress(ConnectionResetError):
            while await self.reader.read(1 << 16):
                pass


class Clients:
    """Makes clients, and closes them in the end."""

    def __init__(self, port: int) -> None:
        self.port = port
        self.all: list[Client] = []

    async def connect(self) -> Client:
        client = Client(*await asyncio.open_connection("127.0.0.1", self.port))
        self.all.append(client)
        return client

    async def close(self) -> None:
        for client in self.all:
            client.writer.transport.abort()
            with contextlib.suppress(OSError):
                await client.writer.wait_closed()


Scenario = Callable[[Methods, Clients], Awaitable[None]]


def serve(scenario: Scenario) -> None:
    """Run a scenario beside a server, which answers another client afterwards."""

    async def main() -> None:
        methods = Methods()
        log = NodeLogger("airsim")
        listener = Listener("127.0.0.1", 0, 64, log)
        listener.serve(Table([methods], log), "airsim")
        clients = Clients(listener.port)
        try:
            async with asyncio.timeout(20):
                await scenario(methods, clients)
                other = await clients.connect()
                assert (await other.call("ping")).result is True
        finally:
            listener.close()
            await clients.close()

    asyncio.run(main())


async def until(condition: Callable[[], bool]) -> None:
    """Let the loop turn until something is so."""
    while not condition():  # noqa: ASYNC110  # nothing tells when
        await asyncio.sleep(0)


def test_requests_of_one_connection_begin_in_order_and_end_as_they_do() -> None:
    async def scenario(methods: Methods, clients: Clients) -> None:
        client = await clients.connect()
        numbers = range(200)
        client.send(*((n, "later", [n]) for n in numbers))
        replies = await client.messages(len(numbers))
        assert methods.called == [*numbers]
        assert sorted((reply.id, reply.result) for reply in replies) == [(n, n) for n in numbers]
        assert [reply.id for reply in replies] != [*numbers]

    serve(scenario)


@pytest.mark.slow
@pytest.mark.parametrize("after_a_long_one", [False, True])
def test_a_flood_of_one_client_leaves_turns_of_the_loop_to_others(
    *, after_a_long_one: bool
) -> None:
    async def scenario(methods: Methods, clients: Clients) -> None:
        client = await clients.connect()
        first = [(0, "note", ["x" * 100_000])] if after_a_long_one else []
        client.send(*first, *((n, "note", [n]) for n in range(20_000)))
        seen: list[int] = []
        while len(methods.called) < 20_000:
            seen.append(len(methods.called))
            await asyncio.sleep(0)
        steps = [b - a for a, b in itertools.pairwise(seen)]
        assert max(steps) <= 200  # in one turn
        assert methods.called == [*range(20_000)]

    serve(scenario)


def test_a_client_that_does_not_read_is_not_served_until_it_does() -> None:
    async def scenario(methods: Methods, clients: Clients) -> None:
        loop = asyncio.get_running_loop()
        deaf = socket.create_connection(("127.0.0.1", clients.port))
        deaf.setblocking(False)
        size, count = 1 << 20, 40
        requests = b"".join(
            wire.request(n, "large", [size]) + wire.request(n, "note", [n]) for n in range(count)
        )
        await loop.sock_sendall(deaf, requests)
        other = await clients.connect()
        for _ in range(200):
            await other.call("ping")
        assert len(methods.called) < count  # the rest waits in the socket
        decoder, replies = wire.Decoder(wire.LONGEST_REPLY), 0
        while replies < 2 * count:
            replies += len([*decoder.feed(await loop.sock_recv(deaf, 1 << 20))])
        assert methods.called == [*range(count)]
        deaf.close()

    serve(scenario)


def test_replies_that_pile_up_unread_close_the_connection(caplog: pytest.LogCaptureFixture) -> None:
    async def scenario(methods: Methods, clients: Clients) -> None:
        client = await clients.connect()
        size = LONGEST_QUEUE // 3
        client.send(*((n, "fly", []) for n in range(8)))
        await until(lambda: len(methods.called) == 8)
        methods.vehicle.set_result(bytes(size))  # type: ignore[arg-type]
        await client.closed()

    with caplog.at_level(logging.WARNING):
        serve(scenario)
    assert "replies are not read" in caplog.text


def test_open_requests_are_bounded() -> None:
    async def scenario(methods: Methods, clients: Clients) -> None:
        client = await clients.connect()
        more = OPEN_REQUESTS + 3
        client.send(*((n, "wait", []) for n in range(more)))
        replies = await client.messages(3)
        assert all("at most 256 open requests" in reply.error for reply in replies)
        client.writer.close()
        await until(lambda: len(methods.ended) == OPEN_REQUESTS)

    serve(scenario)


def test_a_client_that_vanishes_ends_what_it_waits_for_but_not_the_vehicles_task() -> None:
    async def scenario(methods: Methods, clients: Clients) -> None:
        client = await clients.connect()
        client.send((1, "wait", []), (2, "fly", []))
        await client.call("ping")
        client.writer.transport.abort()
        await until(lambda: methods.ended == ["wait"])
        assert not methods.vehicle.done()
        other = await clients.connect()
        other.send((3, "fly", []))
        await other.call("ping")
        methods.vehicle.set_result(True)
        assert await other.messages(1) == [wire.Reply(3, None, True)]

    serve(scenario)


def test_more_connections_than_allowed_are_closed_and_logged_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async def scenario(methods: Methods, clients: Clients) -> None:
        for _ in range(64):
            assert (await (await clients.connect()).call("ping")).result is True
        for _ in range(136):
            await (await clients.connect()).closed()
        assert (await clients.all[0].call("ping")).result is True
        for client in clients.all[1:3]:
            client.writer.close()
        while not (await _answered(await clients.connect())):
            pass

    with caplog.at_level(logging.INFO):
        serve(scenario)
    assert caplog.text.count("expected at most 64 connections") == 1
    assert int(re.findall(r"(\d+) refused", caplog.text)[-1]) >= 136


def test_connections_that_never_speak_make_room_for_others(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("visnav_airsim.server.connections.SILENT", 0.0)

    async def scenario(methods: Methods, clients: Clients) -> None:
        assert (await (await clients.connect()).call("ping")).result is True
        for _ in range(100):
            await clients.connect()
        assert (await (await clients.connect()).call("ping")).result is True
        assert (await clients.all[0].call("ping")).result is True, "it spoke"

    with caplog.at_level(logging.WARNING):
        serve(scenario)
    assert "connection closed: it was idle, and another client came" in caplog.text


async def _answered(client: Client) -> bool:
    client.send((0, "ping", []))
    with contextlib.suppress(ConnectionResetError):
        return bool(await client.reader.read(100))
    return False


@pytest.mark.parametrize(
    "garbage",
    [
        b"GET / HTTP/1.1\r\n\r\n",
        b"\xc1",
        b"\x91" * 2000,
        b"\xdd\x00\xff\xff\xff" * 2000,
        b"\x94\x00\x00\xa4ping\x91\x81\x90\x00",  # a list as a key
        b"\x95\x00\x00\xa4ping\x90\x00",
        wire.request(0, "ping", [[[]] * wire.MOST_LISTS]),
        b"\xdb\xff\xff\xff\xff" + b"x" * (wire.LONGEST + 1),
    ],
)
def test_what_is_no_message_closes_only_its_connection(
    garbage: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    async def scenario(methods: Methods, clients: Clients) -> None:
        client = await clients.connect()
        client.writer.write(garbage)
        await client.closed()

    with caplog.at_level(logging.WARNING):
        serve(scenario)
    assert "refused: connection closed: expected" in caplog.text


def test_odd_but_complete_messages_are_survived() -> None:
    async def scenario(methods: Methods, clients: Clients) -> None:
        client = await clients.connect()
        client.writer.write(msgpack.packb([2, "note", [5]]))  # a notification
        client.writer.write(msgpack.packb([2, "bug", []]))
        client.writer.write(msgpack.packb([1, 7, None, 8]))  # a reply, to a server
        for id_ in (2**64 - 1, -(2**63), 0, 0):  # huge, and one twice
            client.writer.write(wire.request(id_, "note", [6]))
        replies = await client.messages(4)
        assert [reply.id for reply in replies] == [2**64 - 1, -(2**63), 0, 0]
        assert methods.called == [5, 6, 6, 6, 6]

    serve(scenario)


def test_a_bug_of_a_handler_is_logged_once_with_its_traceback_and_answered(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async def scenario(methods: Methods, clients: Clients) -> None:
        client = await clients.connect()
        for method in ("bug", "bug", "odd", "refuse"):
            reply = await client.call(method)
            assert f"function '{method}' (called with 0 arg(s)) threw" in reply.error
            assert reply.result is None

    with caplog.at_level(logging.WARNING):
        serve(scenario)
    assert caplog.text.count("KeyError: 'what a handler did not expect'") == 1
    assert caplog.text.count("odd failed, which is a bug of the server") == 1
    assert caplog.text.count("refused: rpclib: function 'refuse'") == 1


def test_refusals_do_not_flood_the_log(caplog: pytest.LogCaptureFixture) -> None:
    async def scenario(methods: Methods, clients: Clients) -> None:
        client = await clients.connect()
        for method in ("no\nthing", "nothing" * 1000, "simGetDetections"):
            for count in range(5):
                reply = await client.call(method, *range(count))
                assert len(reply.error) < 300

    with caplog.at_level(logging.WARNING):
        serve(scenario)
    assert len(caplog.records) == 3
    assert "not supported by visnav-runtime: make boxes" in caplog.text
    assert "no\nthing" not in caplog.text


@pytest.mark.parametrize("host", ["192.0.2.1", "2001:db8::1", "a" * 80])
def test_an_address_of_another_machine_is_named_and_not_the_port(host: str) -> None:
    """Those numbers are for documentation (RFC 5737 and 3849): no machine has them."""
    for listen in (check_address, lambda host: Listener(host, 41451, 1, NodeLogger("airsim"))):
        with pytest.raises(ValueError, match=f"host: expected an address of this .* {host}") as no:
            listen(host)
        assert "LocalHostIp" in str(no.value)
        assert "port" not in str(no.value)


def test_a_port_in_use_is_named_and_not_the_address() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(
            ValueError, match=f"port: expected .* on 127.0.0.1, found {port} "
        ) as no:
            Listener("127.0.0.1", port, 1, NodeLogger("airsim"))
        assert "ApiServerPort" in str(no.value)
        check_address("127.0.0.1")


@settings(max_examples=60, deadline=None)
@given(st.lists(st.one_of(st.binary(max_size=40), st.sampled_from([1, 2, 3])), max_size=8))
def test_any_bytes_are_survived(pieces: list[bytes | int]) -> None:
    async def scenario(methods: Methods, clients: Clients) -> None:
        client = await clients.connect()
        for piece in pieces:
            if isinstance(piece, int):
                client.writer.write(wire.request(piece, "note", [piece])[: -piece or None])
            else:
                client.writer.write(piece)
            try:
                await client.writer.drain()
            except ConnectionError:
                return

    serve(scenario)
