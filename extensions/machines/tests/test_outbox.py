"""Messages leave in order whatever goes wrong with one, large events by memory in common."""

from __future__ import annotations

import gc
import os
import threading
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from events import Image
from extensions.machines.tests.samples import apart, settings
from extensions.machines.tests.test_runs import THREE
from runtime.channels.wire import Packed, pack, unpack
from runtime.errors import WireError
from runtime.workers.shared_memory import anonymous_file
from visnav_machines import member
from visnav_machines.member import SMALL, Incoming, Outbox, Outgoing
from visnav_machines.messages import EventMessage, MemoryMapped, Message, Ready, decode

LARGE = 1000
"""Side of an image that a line's thread writes."""


def sample_image(value: int = 0, side: int = 100) -> Image:
    data = np.full((side, side, 3), value, np.uint8)
    return Image(stamp=value, source="camera", frame_id="f", data=data)


def both() -> tuple[Outgoing, Incoming]:
    outgoing = Outgoing()
    incoming = Incoming.open_offer(outgoing.offer())
    assert incoming is not None
    return outgoing, incoming


def put(outgoing: Outgoing, event: Image) -> tuple[int, int]:
    place = outgoing.store(pack(event))
    assert place is not None
    return place


def test_an_event_arrives_as_it_was() -> None:
    outgoing, incoming = both()
    sent = sample_image(7)
    got = unpack(incoming.frame(*put(outgoing, sent)))
    assert pack(got).frame() == pack(sent).frame()
    assert isinstance(got, Image)
    assert not got.data.flags.writeable


def test_a_frame_stays_until_its_last_array_is_gone_and_then_its_place_is_used_again() -> None:
    outgoing, incoming = both()
    place = put(outgoing, sample_image(1))
    got = unpack(incoming.frame(*place))
    assert isinstance(got, Image)
    part = got.data[5]
    del got
    assert not incoming.freed
    others = {put(outgoing, sample_image(n)) for n in range(2, 5)}
    assert place not in others
    assert (part == 1).all()
    del part
    assert len(incoming.freed) == 1
    outgoing.freed.extend(incoming.pop_freed())
    assert not incoming.freed
    assert put(outgoing, sample_image(9)) == place


def test_there_is_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(member, "LIMIT", 100_000)
    outgoing, _ = both()
    packed = pack(sample_image())
    assert [outgoing.store(packed) is None for _ in range(4)] == [False, False, True, True]


def test_who_is_elsewhere_or_finds_another_file_does_without(tmp_path: Path) -> None:
    offer = Outgoing().offer()
    outgoing = Outgoing()  # so that the first one's descriptor may be another's now
    gc.collect()
    assert Incoming.open_offer(offer) is None
    offer = outgoing.offer()
    assert Incoming.open_offer(offer) is not None
    other = tmp_path / "other"
    other.write_bytes(offer.key)
    for wrong in (
        {"machine": "another"},
        {"machine": ""},
        {"key": bytes(len(offer.key))},
        {"path": str(other)},  # it could shrink while it is read
        {"path": str(tmp_path)},
        {"path": "/dev/zero"},
        {"path": "/proc/1/fd/4711"},
    ):
        assert Incoming.open_offer(msgspec.structs.replace(offer, **wrong)) is None


def test_no_descriptor_is_left() -> None:
    def opened() -> int:
        return len(list(Path("/proc/self/fd").iterdir()))

    gc.collect()
    before = opened()
    outgoing, incoming = both()
    got = unpack(incoming.frame(*put(outgoing, sample_image(3))))
    del outgoing, incoming
    assert isinstance(got, Image)
    assert (got.data == 3).all()
    del got
    assert opened() == before


@pytest.mark.parametrize("place", [(1 << 30, 10), (0, 1 << 30), (-1, 10), (0, -5), (0, 10)])
def test_a_wrong_place_is_an_error_of_the_wire(place: tuple[int, int]) -> None:
    outgoing, incoming = both()
    put(outgoing, sample_image())
    with pytest.raises(WireError):
        unpack(incoming.frame(*place))


def test_nobody_can_shrink_the_file() -> None:
    fd = anonymous_file()
    os.ftruncate(fd, 5000)
    with pytest.raises(PermissionError):
        os.ftruncate(fd, 100)
    os.close(fd)


Said = list[tuple[Message, bytes]]


def lined(
    outgoing: Outgoing | None = None, put: Any = None
) -> tuple[Outbox, Said, list[Exception]]:
    """Return an outbox, what it has written, and what went wrong."""
    said: Said = []
    wrong: list[Exception] = []

    def write(head: bytes, payload: bytes) -> None:
        said.append((decode(head), payload))

    line = Outbox("x", put or write, wrong.append)
    line.memory = outgoing
    return line, said, wrong


def place_of(message: Message) -> tuple[int, int]:
    assert isinstance(message, EventMessage)
    assert message.place is not None
    return message.place


def test_a_line_puts_a_image_there_at_once_and_a_larger_one_in_its_thread() -> None:
    outgoing, incoming = both()
    line, said, _ = lined(outgoing)
    line.send(EventMessage("a.b"), sample_image(1))
    ((first, payload),) = said  # already
    assert payload == b""
    got = unpack(incoming.frame(*place_of(first)))
    line.send(EventMessage("a.b"), sample_image(2, side=LARGE))
    line.send(MemoryMapped())
    line.close()
    second = unpack(incoming.frame(*place_of(said[1][0])))
    assert [got.stamp, second.stamp] == [1, 2]
    assert isinstance(said[2][0], MemoryMapped)


def test_a_line_without_room_there_sends_the_frame_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Outgoing, "store", lambda self, packed: None)
    line, said, _ = lined(Outgoing())
    packed = pack(sample_image(1))
    assert packed.size > SMALL
    line.send(EventMessage("a.b"), sample_image(1))
    line.close()
    assert said == [(EventMessage("a.b"), packed.frame())]


def test_it_goes_on_though_a_library_fails() -> None:
    said: list[Message] = []

    def put(head: bytes, payload: bytes) -> None:
        if not said and payload:
            said.append(Ready())
            raise RuntimeError("of the library's own")
        said.append(decode(head))

    line, _, wrong = lined(put=put)
    large = sample_image(1, side=LARGE)
    line.send(EventMessage("a.b"), large)
    line.send(EventMessage("c.d"), large)
    line.close()
    assert said[1:] == [EventMessage("c.d")]
    assert "RuntimeError: of the library's own" in str(wrong[0])


def test_what_cannot_be_put_into_memory_is_counted_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """In lockstep all that was sent is awaited, though it is without its event."""

    def full(*_: Any) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(Outgoing, "store", full)
    line, said, wrong = lined(Outgoing())
    line.send(EventMessage("a.b", 7), sample_image(1, side=LARGE))
    line.send(Ready())
    line.close()
    assert said == [(EventMessage("a.b", 7), b""), (Ready(), b"")]
    assert "no space left" in str(wrong[0])


def test_it_has_no_thread_before_it_needs_one() -> None:
    before = threading.active_count()
    line, _, _ = lined()
    line.send(Ready())
    assert threading.active_count() == before
    line.close()


@pytest.mark.slow
@pytest.mark.parametrize("shared", [True, False])
def test_images_pass_through_it_if_the_file_says_so(
    shared: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    placed: list[int] = []
    store = Outgoing.store

    def noted(outgoing: Outgoing, packed: Packed) -> tuple[int, int] | None:
        placed.append(packed.size)
        return store(outgoing, packed)

    monkeypatch.setattr(Outgoing, "store", noted)
    monkeypatch.setattr("visnav_machines.member.SMALL", 4096)  # less than an image of the sample
    config = settings(*THREE, shared=shared)
    one, other = apart(config, "asker", "one,other")
    assert one.outputs == other.outputs
    assert one.outputs["asker.images"] == 5
    assert len(placed) == (5 if shared else 0)
