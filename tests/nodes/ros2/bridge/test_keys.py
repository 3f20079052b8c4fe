"""Names on Zenoh, against what rmw_zenoh's design document and its users show."""

from __future__ import annotations

import contextlib
from typing import get_args

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from nodes.ros2.bridge.keys import (
    SIZE,
    Attachment,
    Kind,
    NodeName,
    Token,
    data_key,
    endpoint_token,
    endpoints_key,
    gid,
    node_token,
    pack,
    parse_token,
    ros2dds_key,
    unpack,
)
from nodes.ros2.messages.topics import Qos, Topic, dds_type, ros_name, topic_name
from nodes.ros2.messages.typestore import TypeStore

STRING = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
LISTENER = "aac3178e146ba6f1fc6e6a4085e77f21"
TALKER = "8b20917502ee955ac4476e0266340d5c"


def chatter(depth: int = 10) -> Topic:
    return Topic(name="/chatter", type="std_msgs/msg/String", hash=STRING, qos=Qos(depth=depth))


def test_the_token_of_a_node_is_that_of_the_design_document() -> None:
    token = node_token(NodeName(name="listener"), LISTENER, 0)
    assert token == f"@ros2_lv/0/{LISTENER}/0/0/NN/%/%/listener"


def test_the_tokens_of_endpoints_are_those_of_the_design_document() -> None:
    listener = endpoint_token(NodeName(name="listener"), LISTENER, 0, 10, "MS", chatter())
    assert listener == (
        f"@ros2_lv/0/{LISTENER}/0/10/MS/%/%/listener/%chatter/"
        f"std_msgs::msg::dds_::String_/{STRING}/::,10:,:,:,,"
    )
    talker = endpoint_token(NodeName(name="talker"), TALKER, 0, 10, "MP", chatter(7))
    assert talker == (
        f"@ros2_lv/0/{TALKER}/0/10/MP/%/%/talker/%chatter/"
        f"std_msgs::msg::dds_::String_/{STRING}/::,7:,:,:,,"
    )


@pytest.mark.parametrize("kind", [*get_args(Kind)])
def test_the_tokens_of_a_client_that_nobody_here_wrote_are_ours(kind: Kind) -> None:
    entity = pytest.importorskip("zenoh_ros2_sdk.entity")
    keys = pytest.importorskip("zenoh_ros2_sdk.keyexpr")
    theirs = entity.NodeEntity(3, TALKER, 0, "talker", "/fleet")
    node, topic = NodeName(name="talker", namespace="/fleet", domain_id=3), chatter()
    if kind == "NN":
        key = keys.node_liveliness_keyexpr(theirs)
        assert key == node_token(node, TALKER, 0)
    else:
        of = (topic.name, dds_type(topic.type), topic.hash, topic.qos.text())
        endpoint = entity.EndpointEntity(theirs, 7, entity.EntityKind(kind), *of)
        key = keys.endpoint_liveliness_keyexpr(endpoint)
        assert key == endpoint_token(node, TALKER, 0, 7, kind, topic)
    name = "" if kind == "NN" else topic.name
    assert parse_token(key) == Token(key=key, kind=kind, node=node, zid=TALKER, topic=name)


def test_slashes_within_a_component_become_percent_signs() -> None:
    node = NodeName(name="eye", namespace="/fleet/one", domain_id=7)
    topic = Topic(name="/fleet/one/image", type="a/msg/B", hash="h")
    assert endpoint_token(node, "z", 1, 2, "MP", topic) == (
        "@ros2_lv/7/z/1/2/MP/%/%fleet%one/eye/%fleet%one%image/a::msg::dds_::B_/h/::,10:,:,:,,"
    )


@pytest.mark.parametrize(
    ("qos", "text"),
    [
        (Qos(), "::,10:,:,:,,"),
        (Qos(reliable=False, depth=5), "2::,5:,:,:,,"),
        (Qos(transient_local=True, depth=1), ":1:,1:,:,:,,"),
        (Qos(depth=42), "::,:,:,:,,"),
        (Qos(keep_all=True), "::2,10:,:,:,,"),
    ],
)
def test_quality_of_service_names_only_what_is_not_default(qos: Qos, text: str) -> None:
    assert qos.text() == text


NAMES = st.from_regex(r"[A-Za-z_][A-Za-z0-9_]{0,9}", fullmatch=True)
PATHS = st.lists(NAMES, min_size=1, max_size=3).map(lambda parts: "/" + "/".join(parts))
TOPICS = st.builds(
    Topic,
    name=PATHS,
    type=st.tuples(NAMES, st.sampled_from(["msg", "srv", "action"]), NAMES).map("/".join),
    hash=st.just("TypeHashNotSupported") | NAMES.map("RIHS01_".__add__),
    qos=st.builds(
        Qos,
        reliable=st.booleans(),
        transient_local=st.booleans(),
        depth=st.integers(0, 10**6),
        keep_all=st.booleans(),
    ),
)
NODES = st.builds(
    NodeName, name=NAMES, namespace=st.just("/") | PATHS, domain_id=st.integers(0, 232)
)
NUMBERS = st.integers(0, 2**31)
EXTRA = st.lists(st.text("abc:,=;%.0", min_size=1), max_size=2).map(tuple)


@pytest.mark.slow
@given(NODES, st.from_regex(r"[0-9a-f]{1,32}", fullmatch=True), NUMBERS, NUMBERS, TOPICS, EXTRA)
def test_a_token_is_read_as_it_was_written_and_what_follows_it_is_kept(
    node: NodeName, zid: str, node_id: int, id_: int, topic: Topic, extra: tuple[str, ...]
) -> None:
    for kind in get_args(Kind):
        is_node = kind == "NN"
        written = (
            node_token(node, zid, node_id)
            if is_node
            else endpoint_token(node, zid, node_id, id_, kind, topic)
        )
        key = "/".join([written, *extra])
        assert parse_token(key) == Token(
            key=key,
            kind=kind,
            node=node,
            zid=zid,
            topic="" if is_node else topic.name,
            extra="/".join(extra),
        )


TALKERS = f"@ros2_lv/0/{TALKER}/0/10/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/{STRING}"


@given(st.text(max_size=60) | st.text("@ros2_lv/0MPNS%:,2", max_size=60))
def test_no_text_makes_reading_a_token_fail_otherwise(key: str) -> None:
    for wrong in (key, f"{TALKERS}/{key}"):
        with contextlib.suppress(ValueError):
            assert parse_token(wrong).key == wrong


@pytest.mark.parametrize(
    "wrong",
    [
        *(
            "",
            "@ros2_lv",
            TALKERS,
            f"{TALKERS}/",
            f"{TALKERS}/::,10:,:,:",
            f"{TALKERS}/::,x:,:,:,,",
        ),
        f"{TALKERS}/::,10:,:,:,,/",
        TALKERS.replace("@ros2_lv", "@ros3_lv") + "/::,10:,:,:,,",
        TALKERS.replace("lv/0/", "lv/zero/") + "/::,10:,:,:,,",
        TALKERS.replace("/MP/", "/PP/") + "/::,10:,:,:,,",
        TALKERS.replace("/%chatter", "") + "/::,10:,:,:,,",
    ],
)
def test_a_token_with_something_missing_or_else_is_refused(wrong: str) -> None:
    with pytest.raises(ValueError, match="expected a liveliness token of ROS, found"):
        parse_token(wrong)


@pytest.mark.slow
@given(TOPICS, EXTRA)
def test_the_key_of_a_topic_s_endpoints_matches_theirs_only(
    topic: Topic, extra: tuple[str, ...]
) -> None:
    watched = zenoh.KeyExpr(endpoints_key(7, "MS", topic.name))
    kinds: tuple[tuple[int, Kind], ...] = ((7, "MS"), (8, "MS"), (7, "MP"))
    for domain, kind in kinds:
        node = NodeName(name="eye", namespace="/fleet", domain_id=domain)
        token = endpoint_token(node, "1f", 0, 3, kind, topic)
        key = zenoh.KeyExpr("/".join([token, *extra]))
        assert watched.intersects(key) == (domain == 7 and kind == "MS")


def test_the_key_of_a_topic_is_what_ros_puts_images_on() -> None:
    image = "sensor_msgs/msg/Image"
    topic = Topic(name="/spike/colorbars", type=image, hash=TypeStore().hash(image))
    assert data_key(0, topic) == (
        "0/spike/colorbars/sensor_msgs::msg::dds_::Image_/"
        "RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47"
    )
    assert ros2dds_key(topic) == "spike/colorbars"


def test_types_hash_as_ros_does_and_not_at_all_on_humble() -> None:
    store = TypeStore()
    assert store.hash("std_msgs/msg/String") == STRING
    assert store.hash("geometry_msgs/msg/Twist").startswith("RIHS01_9c45bf16fe0983d80e3cfe750d68")
    assert store.hash("tf2_msgs/msg/TFMessage").startswith("RIHS01_e369d0f05a23ae52508854b66f6a")
    assert TypeStore("humble").hash("std_msgs/msg/String") == "TypeHashNotSupported"
    with pytest.raises(ValueError, match=r"'std_msgs/msg/Strin'.*did you mean"):
        store.hash("std_msgs/msg/Strin")


@pytest.mark.parametrize(
    ("type_", "digits"),
    [  # as rosidl's generators print them
        (
            "std_msgs/msg/Char",
            "3ad2d04dd29ba19d04b16659afa3ccaedd691914b02a64e82e252f2fa6a586a9",
        ),
        (
            "service_msgs/msg/ServiceEventInfo",
            "41bcbbe07a75c9b52bc96bfd5c24d7f0fc0a08c0cb7921b3373c5732345a6f45",
        ),
        (
            "rmw_dds_common/msg/Gid",
            "ab6f21cfbb0a6dbb837161e1110c2051a2850ed9f9c53944d7115d9bcebedf71",
        ),
        (
            "rmw_dds_common/msg/NodeEntitiesInfo",
            "8ffef65ee2d088c63b1e8fcd31e800ba9fc8dbe0ee15ca60d1676de5218087a7",
        ),
    ],
)
def test_a_char_is_what_ros_2_makes_of_it(type_: str, digits: str) -> None:
    store = TypeStore()
    assert store.hash(type_) == f"RIHS01_{digits}"
    if type_.endswith("Char"):  # the definition keeps its word
        assert store.definition(type_).startswith("char data")


def test_a_gid_is_the_hash_of_the_token_low_half_first() -> None:
    # XXH3's published 128-bit hash of nothing is 99aa06d3014798d8 6001c324468d497f.
    assert gid("") == bytes.fromhex("7f498d4624c30160d8984701d306aa99")


def test_an_attachment_is_what_zenoh_serialises() -> None:
    said = Attachment(3, 1_700_000_000_123_456_789, bytes(range(16)))
    number, stamp = zenoh.ext.Int64(said.sequence), zenoh.ext.Int64(said.stamp)
    expected = zenoh.ext.z_serialize((number, stamp, said.gid)).to_bytes()
    assert pack(said) == expected
    assert len(expected) == SIZE == 33
    assert unpack(expected) == said


def test_a_malformed_attachment_is_never_made_nor_taken() -> None:
    with pytest.raises(ValueError, match="expected 16 bytes, found 3"):
        pack(Attachment(1, 2, b"abc"))
    with pytest.raises(ValueError, match="expected 33 bytes"):
        unpack(bytes(33))
    with pytest.raises(ValueError, match="expected 33 bytes"):
        unpack(b"")


def test_names_are_checked_as_ros_does() -> None:
    assert topic_name("/", "pose") == "/pose"
    assert topic_name("/fleet", "a/b") == "/fleet/a/b"
    assert topic_name("/fleet", "/tf") == "/tf"
    for wrong in ("", "/", "a//b", "1a", "a-b", "a/", "a b", "a/**"):
        with pytest.raises(ValueError, match="expected a topic"):
            topic_name("/", wrong)
    for wrong in ("Image", "a/b", "a/msg/B/c", "a/msg/1", "a/msg/B*"):
        with pytest.raises(ValueError, match="expected a type"):
            dds_type(wrong)


@pytest.mark.parametrize(
    ("source", "name"),
    [("drone/camera", "drone/camera"), ("front-left/2d", "front_left/_2d"), ("", "_")],
)
def test_a_source_becomes_a_name_that_ros_allows(source: str, name: str) -> None:
    assert ros_name(source) == name
    topic_name("/", name)
