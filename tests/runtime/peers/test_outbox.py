"""A line goes on, whatever goes wrong with one message."""

from __future__ import annotations

import threading
from typing import Any

import pytest

from events import Image
from runtime.errors import VisnavError
from runtime.peers.messages import EventMessage, Message, Ready, decode
from runtime.peers.outbox import Outbox, Outgoing
from tests.runtime.peers.test_shared_memory import sample_image

LARGE = 1000
"""Side of an image that a line's thread writes."""


def line_of(put: Any) -> tuple[Outbox, list[VisnavError]]:
    wrong: list[VisnavError] = []
    return Outbox("x", put, wrong.append), wrong


def test_it_goes_on_though_a_library_fails() -> None:
    said: list[Message] = []

    def put(head: bytes, payload: bytes) -> None:
        if not said and payload:
            said.append(Ready())
            raise RuntimeError("of the library's own")
        said.append(decode(head))

    line, wrong = line_of(put)
    large: Image = sample_image(1, side=LARGE)
    line.send(EventMessage("a.b"), large)
    line.send(EventMessage("c.d"), large)
    line.close()
    assert said[1:] == [EventMessage("c.d")]
    assert "RuntimeError: of the library's own" in str(wrong[0])


def test_what_cannot_be_put_into_memory_is_counted_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """In lockstep all that was sent is awaited, though it is without its event."""
    said: list[tuple[Message, bytes]] = []

    def full(*_: Any) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(Outgoing, "put", full)
    line, wrong = line_of(lambda head, payload: said.append((decode(head), payload)))
    line.memory = Outgoing()
    line.send(EventMessage("a.b", 7), sample_image(1, side=LARGE))
    line.send(Ready())
    line.close()
    assert said == [(EventMessage("a.b", 7), b""), (Ready(), b"")]
    assert "no space left" in str(wrong[0])


def test_it_has_no_thread_before_it_needs_one() -> None:
    before = threading.active_count()
    line, _ = line_of(lambda *_: None)
    line.send(Ready())
    assert threading.active_count() == before
    line.close()
