"""Sockets to MAVLink's programs: what they send is parsed, counted and bounded."""

from __future__ import annotations

import asyncio
import functools
import socket
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import common

from nodes.mavlink.settings import address_of
from runtime.logs import NodeLogger

mav: Any = common
"""MAVLink's common dialect: messages and constants."""

BURST = 400  # messages of all peers that are read in a period; the kernel drops the rest
MOST_PEERS = 8  # programs on one TCP port
LONGEST_QUEUE = 1 << 20  # bytes not yet taken by a program, beyond which it is hung up on
_EPOCH_2015 = 1_420_070_400  # signatures' time begins there (mavlink.io, message signing)

Receive = Callable[[int, int, Any], None]
"""Called with a sender's system, its component, and the message."""


class Peer:
    """A program at the other end, with its own parser and numbering."""

    def __init__(self, name: str, send: Callable[[bytes], None], ids: tuple[int, int], key: bytes):
        self.name = name
        self.heard = -float("inf")
        self._send = send
        self.parser = mav.MAVLink(None, *ids)
        self.parser.robust_parsing = True
        if key:
            signing = self.parser.signing
            signing.secret_key, signing.sign_outgoing = key, True
            signing.timestamp = int((time.time() - _EPOCH_2015) * 1e5)

    def hear(self, data: bytes, is_whole: bool) -> list[Any]:
        """Return the messages in some bytes; what `is_whole` goes on from nothing before it."""
        if is_whole:
            self.parser.buf, self.parser.buf_index = bytearray(), 0
            self.parser.expected_length = mav.HEADER_LEN_V1 + 2
        return self.parser.parse_buffer(data) or []

    def send(self, message: Any) -> None:
        """Send a message, with this peer's sequence number and signature."""
        self._send(message.pack(self.parser))


class Links:
    """All links of a vehicle.

    UDP links speak to one address and hear it alone; TCP links listen. Nobody is waited for.
    """

    def __init__(self, ids: tuple[int, int], key: bytes, receive: Receive, log: NodeLogger) -> None:
        self._ids, self._key, self._receive, self._log = ids, key, receive, log
        self._loop = asyncio.get_running_loop()
        self._peers: dict[socket.socket, Peer] = {}
        self._unsent: dict[socket.socket, bytearray] = {}
        self._listeners: list[socket.socket] = []
        self._now, self._left = 0.0, BURST
        self._muted: list[socket.socket] = []
        self.counts: Counter[str] = Counter()

    def open(self, link: str) -> None:
        """Open a link.

        Raises:
            OSError: It cannot be opened.
        """
        protocol, host, port = address_of(link)
        if protocol == "udp":
            end = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            end.setblocking(False)
            end.connect((host, port))
            self._adopt(end, link, functools.partial(self._send_datagram, end), self._hear_datagram)
        else:
            end = socket.create_server((host, port), backlog=MOST_PEERS)
            end.setblocking(False)
            self._listeners.append(end)
            self._loop.add_reader(end, self._accept, end)

    def send(self, message: Any) -> None:
        """Send a message to every peer."""
        for peer in [*self._peers.values()]:
            peer.send(message)

    def quiet_for(self, now: float) -> float:
        """Return the seconds since any peer was heard; infinite if never."""
        return now - max((peer.heard for peer in self._peers.values()), default=-float("inf"))

    def refill(self, now: float) -> None:
        """Begin a period: what waits is read again."""
        self._now, self._left = now, BURST
        muted, self._muted = self._muted, []
        for end in muted:
            if peer := self._peers.get(end):
                hear = self._hear_datagram if end.type == socket.SOCK_DGRAM else self._hear_stream
                self._loop.add_reader(end, hear, end, peer)

    def close(self) -> None:
        """Close all sockets; log what was odd."""
        for end in [*self._peers]:
            self._hang_up(end)
        for end in self._listeners:
            self._loop.remove_reader(end)
            end.close()
        odd = ", ".join(f"{n} {what}" for what, n in self.counts.items() if what != "messages")
        self._log.info("%d messages heard%s", self.counts["messages"], odd and f"; {odd}")

    def _adopt(self, end: socket.socket, name: str, send: Any, hear: Any) -> None:
        peer = self._peers[end] = Peer(name, send, self._ids, self._key)
        self._loop.add_reader(end, hear, end, peer)

    def _accept(self, listener: socket.socket) -> None:
        try:
            end, (host, port, *_) = listener.accept()
        except OSError:
            return
        if sum(each.type == socket.SOCK_STREAM for each in self._peers) >= MOST_PEERS:
            self.counts["connections refused"] += 1
            end.close()
            return
        end.setblocking(False)
        self._unsent[end] = bytearray()
        send = functools.partial(self._send_stream, end)
        self._adopt(end, f"tcp://{host}:{port}", send, self._hear_stream)

    def _hear_datagram(self, end: socket.socket, peer: Peer) -> None:
        try:
            self._take(end, peer, end.recv(65535))
        except OSError:  # nobody listens there yet
            return

    def _hear_stream(self, end: socket.socket, peer: Peer) -> None:
        try:
            data = end.recv(4096)
        except (BlockingIOError, InterruptedError):
            return
        except OSError:
            data = b""
        if data:
            self._take(end, peer, data)
        else:
            self._hang_up(end)

    def _take(self, end: socket.socket, peer: Peer, data: bytes) -> None:
        for message in peer.hear(data, end.type == socket.SOCK_DGRAM):
            if message.get_type() == "BAD_DATA":
                self.counts["pieces of garbage"] += 1
            elif (message.get_srcSystem(), message.get_srcComponent()) == self._ids:
                self.counts["messages in our own name"] += 1
            else:
                self.counts["messages"] += 1
                peer.heard = self._now
                self._receive(message.get_srcSystem(), message.get_srcComponent(), message)
            self._left -= 1
        if self._left <= 0 and end in self._peers:
            self.counts["pauses in a flood"] += 1
            self._loop.remove_reader(end)
            self._muted.append(end)

    def _send_datagram(self, end: socket.socket, data: bytes) -> None:
        try:
            end.send(data)
        except OSError:  # nobody listens, or its buffer is full: datagrams may get lost
            self.counts["datagrams not taken"] += 1

    def _send_stream(self, end: socket.socket, data: bytes) -> None:
        unsent = self._unsent[end]
        unsent += data
        if len(unsent) > LONGEST_QUEUE:
            self._log.warning("%s takes nothing: hung up", self._peers[end].name)
            self._hang_up(end)
        elif len(unsent) == len(data):
            self._flush(end)

    def _flush(self, end: socket.socket) -> None:
        unsent = self._unsent[end]
        try:
            del unsent[: end.send(unsent)]
        except (BlockingIOError, InterruptedError):
            pass
        except OSError:
            self._hang_up(end)
            return
        if unsent:
            self._loop.add_writer(end, self._flush, end)
        else:
            self._loop.remove_writer(end)

    def _hang_up(self, end: socket.socket) -> None:
        self._loop.remove_reader(end)
        self._loop.remove_writer(end)
        self._peers.pop(end, None)
        self._unsent.pop(end, None)
        end.close()
