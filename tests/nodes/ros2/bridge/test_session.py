"""A session: where it connects, what it shows of itself, and what becomes of puts after the end."""

from __future__ import annotations

import json
import queue
from pathlib import Path
from typing import Any

import msgspec
import pytest

from nodes.ros2.bridge.keys import NodeName, data_key, endpoint_token, gid, node_token, unpack
from nodes.ros2.bridge.session import Session, SessionError, _configuration
from nodes.ros2.messages.topics import Qos, Topic
from tests.nodes.ros2.bridge.network import free_port, zenoh_session

TOPIC = Topic(name="/a/b", type="std_msgs/msg/Empty", hash="RIHS01_0", qos=Qos(depth=3))
NODE = NodeName(name="eye", namespace="/fleet", domain_id=3)


def test_tokens_and_messages_are_seen_from_outside_and_end_with_the_session() -> None:
    locator = f"tcp/127.0.0.1:{free_port()}"
    samples: queue.SimpleQueue[Any] = queue.SimpleQueue()
    tokens: queue.SimpleQueue[Any] = queue.SimpleQueue()
    with zenoh_session(listen=locator) as other:
        other.declare_subscriber("3/**", samples.put)
        other.liveliness().declare_subscriber("@ros2_lv/3/**", tokens.put)
        session = Session(NODE, connect=(locator,), listen=())
        publisher = session.publisher(TOPIC)
        session.subscribe(TOPIC, lambda _: None)
        published = endpoint_token(NODE, session.zid, 0, 1, "MP", TOPIC)
        expected = {
            node_token(NODE, session.zid, 0),
            published,
            endpoint_token(NODE, session.zid, 0, 2, "MS", TOPIC),
        }
        assert {str(tokens.get(timeout=5).key_expr) for _ in range(3)} == expected
        for message in (b"one", b"two"):
            publisher.put(bytearray(message))
        first, second = samples.get(timeout=5), samples.get(timeout=5)
        assert str(first.key_expr) == data_key(3, TOPIC)
        assert [sample.payload.to_bytes() for sample in (first, second)] == [b"one", b"two"]
        said = [unpack(sample.attachment.to_bytes()) for sample in (first, second)]
        assert [attachment.sequence for attachment in said] == [1, 2]
        assert {attachment.gid for attachment in said} == {gid(published)}
        assert session.close()
        gone = {str(tokens.get(timeout=5).key_expr) for _ in range(3)}
        assert gone == expected
    publisher.put(bytearray(b"three"))
    assert (publisher.sent, publisher.failed) == (2, 1)


@pytest.mark.slow
def test_a_configuration_file_says_where_to_listen(tmp_path: Path) -> None:
    port = free_port()
    file = tmp_path / "zenoh.json5"
    listen = {"endpoints": [f"tcp/127.0.0.1:{port}"]}
    multicast = {"scouting": {"multicast": {"enabled": False}}}
    file.write_text(json.dumps({"mode": "peer", "listen": listen} | multicast))
    session = Session(NODE, file=str(file))
    try:
        with zenoh_session(connect=f"tcp/127.0.0.1:{port}") as other:
            replies = list(other.liveliness().get("@ros2_lv/3/**"))
            keys = [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
            assert keys == [node_token(NODE, session.zid, 0)]
    finally:
        session.close()


def test_a_broken_configuration_file_is_told_of(tmp_path: Path) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text("{ mode: ")
    with pytest.raises(SessionError, match=r"zenoh\.json5: expected a Zenoh configuration, found"):
        Session(NODE, file=str(file))
    file.write_text("{\n mod: 1 }")
    with pytest.raises(SessionError, match=r"unknown field `mod`.* \(line 2, column 2\)$"):
        Session(NODE, file=str(file))


@pytest.mark.parametrize("way", ["connect", "listen"])
def test_an_endpoint_that_is_none_is_named_with_its_setting(way: str) -> None:
    endpoints: dict[str, Any] = {"connect": (), way: ("tcp:localhost:7447",)}
    with pytest.raises(SessionError, match=f"^{way}: expected endpoints such as") as caught:
        Session(NODE, **endpoints)
    assert ".rs" not in str(caught.value)
    assert "tcp:localhost:7447" in str(caught.value)


def test_what_a_file_leaves_out_is_as_without_it(tmp_path: Path) -> None:
    """Or else a file about TLS would have Zenoh listen to all the world, and multicast."""
    file = tmp_path / "zenoh.json5"
    file.write_text("{ transport: { link: { tls: { verify_name_on_connect: true } } } }")
    names = [
        *("mode", "listen/endpoints", "connect/endpoints", "scouting/multicast/enabled"),
        *("timestamping/enabled", "connect/exit_on_failure"),
    ]
    with_file, without = _configuration(None, None, str(file)), _configuration(None, None, "")
    assert [with_file.get_json(name) for name in names] == [
        without.get_json(name) for name in names
    ]
    assert without.get_json("listen/endpoints") == '["tcp/localhost:0"]'
    assert without.get_json("scouting/multicast/enabled") == "false"
    file.write_text(
        '{ mode: "client", listen: { endpoints: ["tls/[::]:1"] }, '
        "scouting: { multicast: { enabled: true } }, timestamping: { enabled: false } }"
    )
    configuration = _configuration((), None, str(file))
    assert [configuration.get_json(name) for name in names[:5]] == [
        *('"client"', '["tls/[::]:1"]', "[]", "true"),
        "true",  # or there would be no /tf_static
    ]


def test_what_was_said_before_is_heard_by_those_who_ask_for_it() -> None:
    """As ROS's transient local: by a subscription that has it, and by one that comes late."""
    locator = f"tcp/127.0.0.1:{free_port()}"
    qos = Qos(transient_local=True, depth=2)
    kept = Topic(name="/kept", type="std_msgs/msg/Empty", hash="RIHS01_0", qos=qos)
    speaking = Session(NODE, connect=(), listen=(locator,))
    publisher = speaking.publisher(kept)
    for message in (b"one", b"two", b"three"):
        publisher.put(bytearray(message))
    hearing = Session(NODE, connect=(locator,), listen=())
    try:
        heard: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        hearing.subscribe(kept, lambda message: heard.put(message.read()))
        assert [heard.get(timeout=10) for _ in range(2)] == [b"two", b"three"]

        volatile = msgspec.structs.replace(kept, qos=Qos(depth=2))
        hearing.subscribe(volatile, lambda message: heard.put(message.read()), late=True)
        assert [heard.get(timeout=10) for _ in range(2)] == [b"two", b"three"]
    finally:
        hearing.close()
        speaking.close()
