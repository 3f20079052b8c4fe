"""The bytes of AirSim's protocol."""

from __future__ import annotations

import contextlib
import math
import struct
from collections.abc import Iterable
from typing import Any

import msgpack
import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from visnav_airsim import wire
from visnav_airsim.wire import ImageResponse, Pose, Vector3r

VALUES = st.recursive(
    st.one_of(
        st.none(),
        st.booleans(),
        st.integers(-(2**63), 2**64 - 1),
        st.floats(allow_nan=False),
        st.text(),
        st.binary(max_size=300),
    ),
    lambda inner: st.one_of(st.lists(inner), st.dictionaries(st.text(), inner)),
    max_leaves=8,
)
REQUESTS = st.tuples(st.integers(0, 2**32 - 1), st.text(), st.lists(VALUES, max_size=4))


def decoded(chunks: Iterable[bytes]) -> list[Any]:
    decoder = wire.Decoder()
    return [message for chunk in chunks for message in decoder.feed(chunk)]


def test_the_first_bytes_of_airsims_client_are_a_ping() -> None:
    captured = b"\x94\x00\x00\xa4ping\x90"
    assert decoded(bytes([byte]) for byte in captured) == [wire.Request(0, "ping", [])]
    assert wire.request(0, "ping", ()) == captured


@pytest.mark.parametrize(
    ("packed", "value"),
    [
        (b"\xa3abc", "abc"),  # fixstr
        (b"\xd9\x03abc", "abc"),  # str8: rpc-msgpack's
        (b"\xda\x00\x03abc", "abc"),  # raw16: msgpack-python's old family
        (b"\xdb\x00\x00\x00\x03abc", "abc"),
        (b"\xa4a\xffb\xe9", "a\ufffdb\ufffd"),  # no UTF-8
        (b"\xc4\x02\x00\xff", b"\x00\xff"),  # bin8
        (b"\xca" + struct.pack(">f", 0.5), 0.5),
        (b"\xcb" + struct.pack(">d", 3e38), 3e38),
        (b"\xcf" + b"\xff" * 8, 2**64 - 1),
        (b"\x82\xa5x_val\x01\x05\x02", {"x_val": 1, 5: 2}),
    ],
)
def test_both_families_of_strings_and_all_numbers_are_read(packed: bytes, value: object) -> None:
    (request,) = decoded([b"\x94\x00\x07\xa1m\x91" + packed])
    assert request == wire.Request(7, "m", [value])


def test_numbers_that_are_none_pass() -> None:
    (request,) = decoded([wire.request(1, "m", [math.nan, -math.inf])])
    assert math.isnan(request.arguments[0])
    assert request.arguments[1] == -math.inf


def test_replies_have_strings_bytes_and_maps_as_airsims_clients_expect() -> None:
    data = wire.reply(3, None, ImageResponse(image_data_uint8=b"\x01\x02", time_stamp=2**62))
    message = msgpack.unpackb(data, raw=False)
    assert message[:3] == [1, 3, None]
    assert message[3]["image_data_uint8"] == b"\x01\x02"
    assert message[3]["time_stamp"] == 2**62
    assert message[3]["camera_position"] == {"x_val": 0.0, "y_val": 0.0, "z_val": 0.0}
    assert b"\xc4\x02\x01\x02" in data  # bin8, not str


def test_floats_are_packed_in_five_bytes_each() -> None:
    numbers = np.array([[1.0, -2.5], [np.inf, 0.0]])
    (reply,) = decoded([wire.reply(7, None, {"data": wire.float_array(numbers)})])
    assert reply == wire.Reply(7, None, {"data": [1.0, -2.5, np.inf, 0.0]})


def test_whole_numbers_are_taken_for_floats_but_not_the_reverse() -> None:
    assert msgspec.convert({"position": {"x_val": 1}}, Pose) == Pose(Vector3r(x_val=1.0))
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert([1.5], tuple[int])


@pytest.mark.slow
@given(st.lists(REQUESTS, max_size=4), st.data())
def test_what_is_encoded_is_decoded_however_the_stream_is_split(
    requests: list[tuple[int, str, list[Any]]], data: st.DataObject
) -> None:
    stream = b"".join(wire.request(*request) for request in requests)
    cuts = sorted(data.draw(st.sets(st.integers(0, len(stream)), max_size=6)))
    chunks = [stream[a:b] for a, b in zip([0, *cuts], [*cuts, len(stream)], strict=True)]
    assert decoded(chunks) == [wire.Request(*request) for request in requests]


@given(st.lists(st.binary(max_size=30), max_size=5))
def test_any_bytes_are_messages_or_refused(chunks: list[bytes]) -> None:
    with contextlib.suppress(wire.WireFormatError):
        for message in decoded(chunks):
            assert isinstance(message, wire.Request | wire.Reply)


@pytest.mark.parametrize("head", [b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff"])
def test_a_message_that_never_ends_is_refused_at_its_limit(head: bytes) -> None:
    decoder = wire.Decoder(longest=10_000)
    for _ in range(10):
        assert [*decoder.feed(head + b"\x01" * 995)] == []
    with pytest.raises(wire.WireFormatError, match="at most 10000 bytes"):
        [*decoder.feed(head)]


def test_a_limit_holds_for_each_message_not_for_their_sum() -> None:
    decoder = wire.Decoder(longest=100)
    one = wire.request(1, "method", ["x" * 50])
    for _ in range(50):
        assert len([*decoder.feed(one * 3)]) == 3
