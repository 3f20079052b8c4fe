"""A session: where it connects, what it shows of itself, and what becomes of puts after the end."""

from __future__ import annotations

import json
import queue
from pathlib import Path
from typing import Any

import pytest

from nodes.ros2_bridge.attachment import unpack
from nodes.ros2_bridge.gid import gid
from nodes.ros2_bridge.keys import NodeName, Qos, Topic, data_key, endpoint_token, node_token
from nodes.ros2_bridge.session import Session, SessionError
from tests.nodes.ros2_bridge.network import free_port, zenoh_session

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
        session.subscribe(TOPIC, lambda size, read: None)
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
        assert [each.payload.to_bytes() for each in (first, second)] == [b"one", b"two"]
        said = [unpack(each.attachment.to_bytes()) for each in (first, second)]
        assert [each.sequence for each in said] == [1, 2]
        assert {each.gid for each in said} == {gid(published)}
        assert session.close()
        gone = {str(tokens.get(timeout=5).key_expr) for _ in range(3)}
        assert gone == expected
    publisher.put(bytearray(b"three"))
    assert (publisher.sent, publisher.failed) == (2, 1)


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
            found = [str(each.ok.key_expr) for each in replies if each.ok is not None]
            assert found == [node_token(NODE, session.zid, 0)]
    finally:
        session.close()


def test_a_broken_configuration_file_is_told_of(tmp_path: Path) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text("{ mode: ")
    with pytest.raises(SessionError, match="expected a Zenoh session, found"):
        Session(NODE, file=str(file))
