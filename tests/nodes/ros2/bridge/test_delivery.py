"""What reaches a peer that joins late, loses a message, reads slowly or is killed."""

from __future__ import annotations

import contextlib
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import zenoh

from nodes.ros2.bridge.keys import (
    Attachment,
    Kind,
    Message,
    NodeName,
    Token,
    data_key,
    endpoint_token,
    node_token,
    pack,
    unpack,
)
from nodes.ros2.bridge.session import CLOSING, Publisher, Session
from nodes.ros2.messages.topics import Qos, Topic
from tests.nodes.ros2.bridge.network import free_port, zenoh_session
from tests.nodes.ros2.bridge.peer import DOMAIN, KEPT, PLAIN

NODE = NodeName(name="eye", namespace="/fleet", domain_id=DOMAIN)
Told = queue.SimpleQueue[tuple[bool, Token]]


def foreign_token(kind: Kind, topic: Topic, zid: str = "ff1", domain: int = DOMAIN) -> str:
    """Return a token as newer releases have it."""
    node = NodeName(name="slam", domain_id=domain)
    return endpoint_token(node, zid, 0, 7, kind, topic) + "/cpu:,demo:version=1.0"


@contextlib.contextmanager
def listening(**settings: Any) -> Iterator[tuple[Session, str]]:
    """Open a session, and yield it with its locator."""
    locator = f"tcp/127.0.0.1:{free_port()}"
    session = Session(NODE, connect=(), listen=(locator,), **settings)
    try:
        yield session, locator
    finally:
        session.close()


@contextlib.contextmanager
def peer(*arguments: str) -> Iterator[tuple[subprocess.Popen[str], queue.SimpleQueue[str]]]:
    """Start a peer that is ready, and yield it with the lines that it prints."""
    command = [sys.executable, "-m", "tests.nodes.ros2.bridge.peer", *arguments]
    lines: queue.SimpleQueue[str] = queue.SimpleQueue()

    def read() -> None:
        for line in process.stdout or ():
            lines.put(line.strip())

    with subprocess.Popen(command, text=True, stdout=subprocess.PIPE) as process:
        reads = threading.Thread(target=read)
        reads.start()
        try:
            assert lines.get(timeout=20) == "ready"
            yield process, lines
        finally:
            process.kill()
            reads.join()


def until(true: Callable[[], object], seconds: float = 20.0) -> None:
    """Wait until something is true."""
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.005)  # another process makes it true


def watch(session: Session, kind: Kind = "MS", topic: Topic = PLAIN) -> Told:
    told: Told = queue.SimpleQueue()
    session.watch(topic.name, kind, lambda there, token: told.put((there, token)))
    return told


@pytest.mark.slow
def test_a_subscriber_that_loses_a_kept_message_gets_it_all_the_same() -> None:
    """The plain one of the same process shows that it was lost."""
    with listening() as (session, locator), peer(locator, KEPT.name) as (process, lines):
        publisher = session.publisher(KEPT)
        junk = session._session.declare_publisher("junk")
        until(publisher.matched)
        until(lambda: junk.matching_status.matching)  # type: ignore[attr-defined]
        publisher.put(bytearray(b"one"))
        first = {lines.get(timeout=10) for _ in range(2)}
        assert first == {"plain 1 one", "ours 1 one"}
        process.send_signal(signal.SIGSTOP)
        for _ in range(30):  # more than sockets take; then messages are dropped
            junk.put(bytes(1_000_000))
        publisher.put(bytearray(b"two"))
        process.send_signal(signal.SIGCONT)
        assert lines.get(timeout=10) == "ours 2 two"
        publisher.put(bytearray(b"three"))
        assert {lines.get(timeout=10) for _ in range(2)} == {"plain 3 three", "ours 3 three"}


def test_a_message_has_its_attachment_and_none_if_what_came_is_none() -> None:
    said = Attachment(7, 123, bytes(range(16)))
    with listening() as (session, locator), zenoh_session(connect=locator) as other:
        heard: queue.SimpleQueue[Message] = queue.SimpleQueue()
        session.subscribe(PLAIN, heard.put)
        block = zenoh.CongestionControl.BLOCK  # or the last may be dropped behind the longest
        publisher: Any = other.declare_publisher(data_key(DOMAIN, PLAIN), congestion_control=block)
        until(lambda: publisher.matching_status.matching)
        for attached in (pack(said), None, b"", bytes(33), pack(said)[:-1], b"x" * 100_000):
            publisher.put(b"hello", attachment=attached)
        messages = [heard.get(timeout=10) for _ in range(6)]
        assert [message.attachment for message in messages] == [said, *[None] * 5]
        assert [(message.size, message.read()) for message in messages] == [(5, b"hello")] * 6


def test_who_joins_late_and_asks_for_the_topic_s_key_gets_what_is_kept() -> None:
    with listening() as (session, locator), zenoh_session(connect=locator) as other:
        publisher = session.publisher(KEPT)
        volatile = session.publisher(PLAIN)
        for message in (b"one", b"two", b"three"):
            publisher.put(bytearray(message))
            volatile.put(bytearray(message))

        def asked(topic: Topic) -> list[tuple[int, bytes]]:
            every = zenoh.ConsolidationMode.NONE
            samples = [
                reply.ok for reply in other.get(data_key(DOMAIN, topic), consolidation=every)
            ]
            assert all(
                str(sample.key_expr) == data_key(DOMAIN, topic) for sample in samples if sample
            )
            return [
                (unpack(sample.attachment.to_bytes()).sequence, sample.payload.to_bytes())
                for sample in samples
                if sample is not None and sample.attachment is not None
            ]

        until(lambda: asked(KEPT))
        assert asked(KEPT) == [(2, b"two"), (3, b"three")]
        assert asked(PLAIN) == []


def put_many(publisher: Publisher, count: int = 40) -> None:
    for number in range(1, count + 1):
        publisher.put(bytearray(b"%05d" % number) + bytes(1_000_000))


@pytest.mark.slow
@pytest.mark.parametrize("held", [True, False])
def test_a_peer_that_reads_slowly_gets_every_message_of_a_held_topic(held: bool) -> None:
    """Of another one it gets what the link has room for: so here the link has too little."""
    with listening() as (session, locator), peer(locator, PLAIN.name) as (process, lines):
        publisher = session.publisher(PLAIN, held=held)
        assert publisher.topic.qos == Qos(depth=3, keep_all=held)
        until(publisher.matched)
        process.send_signal(signal.SIGSTOP)
        puts = threading.Thread(target=put_many, args=(publisher,))
        puts.start()
        puts.join(1.0 if held else None)
        assert puts.is_alive() == held
        process.send_signal(signal.SIGCONT)
        puts.join()
        got = [""]
        while not got[-1].endswith("last"):
            try:
                got.append(lines.get(timeout=0.2))
            except queue.Empty:  # the link may still be full
                publisher.put(bytearray(b"last"))
        everything = [f"plain {number} {number:05d}" for number in range(1, 41)]
        assert ([line for line in got if line.startswith("plain")][:40] == everything) == held
        process.kill()
        process.wait()
        until(lambda: not publisher.matched())


@pytest.mark.slow
def test_a_peer_that_stands_still_keeps_a_held_message_and_the_end_for_a_bounded_time() -> None:
    with (
        listening(max_wait=1.0) as (session, locator),
        peer(locator, PLAIN.name) as (process, _),
    ):
        publisher = session.publisher(PLAIN, held=True)
        until(publisher.matched)
        process.send_signal(signal.SIGSTOP)
        puts = threading.Thread(target=put_many, args=(publisher,))
        begin = time.monotonic()
        puts.start()
        puts.join(20)
        assert not puts.is_alive()
        assert time.monotonic() - begin >= 1.0
        assert (publisher.failed, publisher.sent) == (1, 39)
        begin = time.monotonic()
        session.close()
        assert time.monotonic() - begin < CLOSING + 1.0


def test_endpoints_are_told_of_when_they_appear_and_when_their_process_is_killed() -> None:
    token = foreign_token("MS", PLAIN)
    with listening() as (session, locator):
        session.publisher(PLAIN)
        with zenoh_session(connect=locator) as other:
            early = other.liveliness().declare_token(token)
            until(lambda: list(session._session.liveliness().get(token)))
            told = watch(session)
            there, endpoint = told.get(timeout=10)
            assert (there, endpoint.key, endpoint.topic) == (True, token, PLAIN.name)
            early.undeclare()  # type: ignore[no-untyped-call]
            assert told.get(timeout=10) == (False, endpoint)
        session.subscribe(PLAIN, lambda _: None)  # one's own are not told of
        with peer(locator, KEPT.name, token) as (process, _):
            assert told.get(timeout=10) == (True, endpoint)
            process.kill()
            assert told.get(timeout=5) == (False, endpoint)  # or else it would take 10 s
        assert told.empty()


@pytest.mark.slow
def test_tokens_of_two_hundred_peers_are_told_of_and_no_others() -> None:
    others = [
        *("@ros2_lv/3/a/0/1/MS/%/%/n/%a%b", "@ros2_lv/3/a/0/1/MS/%/%/n/%a%b/t/h/::,1:,:,:"),
        *("@ros2_lv/3/a/x/1/MS/%/%/n/%a%b/p::msg::dds_::T_/h/::,1:,:,:,,", "@ros2_lv/3/junk"),
        foreign_token("MS", PLAIN, domain=4),
        foreign_token("MP", PLAIN),
        foreign_token("MS", KEPT),
        node_token(NODE, "ff2", 0),
    ]
    with listening() as (session, locator):
        told = watch(session)
        for _ in range(2):  # they come and go
            with zenoh_session(connect=locator) as other:
                ours = [foreign_token("MS", PLAIN, f"{number:x}") for number in range(200)]
                tokens = [other.liveliness().declare_token(key) for key in others + ours]
                changes = [told.get(timeout=10) for _ in ours]
                assert sorted(token.key for there, token in changes if there) == sorted(ours)
            changes = [told.get(timeout=10) for _ in ours]
            assert sorted(token.key for there, token in changes if not there) == sorted(ours)
            del tokens
        assert told.empty()
