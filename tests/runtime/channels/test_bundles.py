"""Bundles: events of one stamp put together, with what is missing counted."""

from __future__ import annotations

import random
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from events import Event
from runtime import Bundle, Input, Node, Output
from runtime.channels.bundles import HISTORY, WAITING_BYTES, Matcher
from runtime.errors import AmbiguousSourceError, ConfigError, DeclarationError, NodeError
from runtime.testing import NodeResult, run_nodes, spec

MS = 1_000_000


class A(Event):
    """Sets the stamp."""


class B(Event):
    """Goes with it."""


class C(Event):
    """Comes often."""


class Two(NamedTuple):
    a: A
    b: B


class Three(NamedTuple):
    a: A
    b: B | None
    c: tuple[C, ...]


class Matched(Event):
    """What the reader got, as stamps."""

    stamps: tuple[Any, ...]


def stamps(part: Any) -> Any:
    return tuple(e.stamp for e in part) if isinstance(part, tuple) else part and part.stamp


class Reader(Node):
    """Tells what it reads."""

    sets = Bundle(Two)
    matched = Output(Matched)

    async def run(self) -> None:
        async for bundle in self.sets:
            parts = tuple(stamps(part) for part in bundle)
            self.matched.send(Matched(stamp=self.clock.now(), source=self.name, stamps=parts))


class Loose(Reader):
    """Takes what is near."""

    sets = Bundle(Two, tolerance=0.003)


class Rich(Reader):
    """Takes what may be there, and all of a kind."""

    sets = Bundle(Three)  # type: ignore[assignment]


class Newest(Reader):
    """Skips sets while it is busy."""

    sets = Bundle(Two, keep="latest")

    async def run(self) -> None:
        await self.clock.sleep(0.1)
        await super().run()


def at(event: type[Event], *milliseconds: float, source: str = "x") -> list[Event]:
    return [event(stamp=round(ms * MS), source=source) for ms in milliseconds]


def read(node: type[Node], *events: list[Event], **options: Any) -> NodeResult:
    script = sorted((e for group in events for e in group), key=lambda e: e.stamp)
    return run_nodes([spec(node, "n", **options)], inputs=script, duration=1.0)


def matched_stamps(result: NodeResult) -> list[Any]:
    return [event.stamps for event in result.of(Matched)]


def test_what_is_of_one_stamp_comes_together_whoever_comes_first() -> None:
    result = run_nodes(
        [spec(Reader, "n")], inputs=at(A, 1) + at(B, 1) + at(B, 2) + at(A, 2), duration=0.1
    )
    assert matched_stamps(result) == [(1 * MS, 1 * MS), (2 * MS, 2 * MS)]


def test_a_set_that_lacks_something_is_left_out_and_counted() -> None:
    result = read(Reader, at(A, 1, 2, 3), at(B, 1, 3))
    assert matched_stamps(result) == [(1 * MS, 1 * MS), (3 * MS, 3 * MS)]
    assert result.drops["n.sets"].missed == {"b": 1}


def test_without_tolerance_near_is_not_enough() -> None:
    result = read(Reader, at(A, 1, 5), at(B, 2, 5))
    assert matched_stamps(result) == [(5 * MS, 5 * MS)]


def test_with_tolerance_the_nearest_is_taken() -> None:
    result = read(Loose, at(A, 10, 20, 30), at(B, 8, 11, 21, 27, 34))
    assert matched_stamps(result) == [(10 * MS, 11 * MS), (20 * MS, 21 * MS), (30 * MS, 27 * MS)]


def test_beyond_the_tolerance_nothing_is_taken() -> None:
    result = read(Loose, at(A, 10, 20), at(B, 14, 20))
    assert matched_stamps(result) == [(20 * MS, 20 * MS)]
    assert result.drops["n.sets"].missed == {"b": 1}


def test_a_tuple_gathers_all_since_the_set_before_up_to_the_stamp() -> None:
    result = read(Rich, at(A, 10, 20), at(C, 2, 6, 10, 14, 18, 22))
    ms = [(a // MS, b, tuple(c // MS for c in cs)) for a, b, cs in matched_stamps(result)]
    assert ms == [(10, None, (2, 6, 10)), (20, None, (14, 18))]


def test_what_comes_twice_or_late_makes_no_set_and_is_counted() -> None:
    sent = [event for ms in (10, 10, 20, 15, 30) for event in (*at(A, ms), *at(B, ms))]
    result = run_nodes([spec(Reader, "n")], inputs=sent)
    assert matched_stamps(result) == [(ms * MS, ms * MS) for ms in (10, 20, 30)]
    assert result.drops["n.sets"].missed == {"a": 2}


def test_what_may_be_missing_is_taken_if_it_is_there() -> None:
    result = read(Rich, at(A, 10, 20), at(B, 10), at(C, 10, 20))
    assert [b for _, b, _ in matched_stamps(result)] == [10 * MS, None]


def test_a_reader_of_the_latest_skips_sets_and_counts_them() -> None:
    result = read(Newest, at(A, 1, 2, 3), at(B, 1, 2, 3))
    assert matched_stamps(result) == [(3 * MS, 3 * MS)]
    assert result.drops["n.sets"].dropped == 2


def test_a_second_source_is_an_error_that_says_what_to_write() -> None:
    with pytest.raises(NodeError, match=r'inputs = \{ "sets.b" = "x" \}') as caught:
        read(Reader, at(B, 1), at(B, 2, source="y"))
    assert isinstance(caught.value.__cause__, AmbiguousSourceError)


def test_of_a_source_and_one_below_it_the_upper_counts() -> None:
    below = at(A, 1, 2, 3, source="x/grey")
    both = sorted(below + at(A, 1, 2, 3) + at(B, 1, 2, 3), key=lambda e: e.stamp)
    matcher: Matcher[Two] = Reader.sets.make("n")
    for event in both:
        matcher.slots["a" if isinstance(event, A) else "b"].add(event)
    got = []
    while matcher.statistics().buffered:
        got.append(matcher.receive_nowait())
    assert [bundle.a.stamp for bundle in got] == [1 * MS, 2 * MS, 3 * MS]
    assert {bundle.a.source for bundle in got[1:]} == {"x"}


def test_the_file_narrows_a_bundle_and_its_fields() -> None:
    twice = at(A, 1), at(B, 1, 9), at(A, 2, source="y"), at(B, 2, source="y")
    assert matched_stamps(read(Reader, *twice, inputs={"sets": "y"})) == [(2 * MS, 2 * MS)]
    mixed = {"sets": "y", "sets.b": "x"}
    assert matched_stamps(read(Loose, *twice, inputs=mixed)) == [(2 * MS, 1 * MS)]


def test_events_without_partners_do_not_pile_up() -> None:
    matcher = Reader.sets.make("n")
    for index in range(3 * HISTORY):
        matcher.slots["a"].add(A(stamp=index, source="x"))
    assert len(matcher.slots["a"].events) < HISTORY
    assert matcher.missed["b"] > HISTORY


@pytest.mark.slow
@given(st.sets(st.integers(1, 40)), st.sets(st.integers(1, 40)), st.integers(0, 1 << 16))
def test_each_common_stamp_gives_one_set_however_the_two_are_interleaved(
    a: set[int], b: set[int], seed: int
) -> None:
    matcher: Matcher[Two] = Reader.sets.make("n")
    left: dict[str, list[int]] = {"a": sorted(a), "b": sorted(b)}
    kinds: dict[str, type[Event]] = {"a": A, "b": B}
    order = random.Random(seed)
    while left["a"] or left["b"]:
        field = order.choice([name for name, rest in left.items() if rest])
        matcher.slots[field].add(kinds[field](stamp=left[field].pop(0), source="x"))
    got = []
    while matcher.statistics().buffered:
        got.append(matcher.receive_nowait())
    assert [bundle.a.stamp for bundle in got] == sorted(a & b)
    assert all(bundle.a.stamp == bundle.b.stamp for bundle in got)


class Wrong(NamedTuple):
    a: int


class Optional(NamedTuple):
    a: A | None


class Mixed(NamedTuple):
    a: A
    b: A | B


@pytest.mark.parametrize(
    ("set_type", "expected"),
    [
        (Wrong, "Wrong.a: expected an event E"),
        (Optional, "expected an event as first field"),
        (Mixed, "Mixed.b: expected an event E, E \\| None"),
        (tuple, "expected a NamedTuple"),
    ],
)
def test_mistakes_in_declarations(set_type: Any, expected: str) -> None:
    with pytest.raises(DeclarationError, match=expected):
        Bundle(set_type)


def test_a_negative_tolerance_is_refused() -> None:
    with pytest.raises(DeclarationError, match="tolerance"):
        Bundle(Two, tolerance=-1)


def test_an_input_of_the_same_node_is_served_as_before() -> None:
    class Both(Reader):
        plain = Input(A)

    assert matched_stamps(read(Both, at(A, 1), at(B, 1))) == [(1 * MS, 1 * MS)]


def test_the_file_cannot_name_a_field_that_there_is_not() -> None:
    from runtime.config.reading import parse

    table = {"nodes": [{"name": "n", "type": f"{__name__}:Reader", "inputs": {"sets.z": "x"}}]}
    with pytest.raises(ConfigError, match=r"sets\.z.*did you mean"):
        parse(table, "c.toml")


class Four(NamedTuple):
    a: A
    b: B
    c: tuple[C, ...]


class NewestRich(Newest):
    """Skips sets, and must have what they had gathered."""

    sets = Bundle(Four, keep="latest")  # type: ignore[assignment]


class Strict(Reader):
    """Takes all sets."""

    sets = Bundle(Four)  # type: ignore[assignment]


def gathered(result: NodeResult) -> list[tuple[int, ...]]:
    return [tuple(c // MS for c in cs) for _, _, cs in matched_stamps(result)]


def test_a_set_that_does_not_come_about_leaves_its_tuples_to_the_next() -> None:
    result = read(Strict, at(A, 10, 20, 30), at(B, 10, 30), at(C, *range(2, 32, 4)))
    assert gathered(result) == [(2, 6, 10), (14, 18, 22, 26, 30)]
    assert result.drops["n.sets"].missed == {"b": 1}


def test_a_set_that_is_skipped_leaves_its_tuples_to_the_next() -> None:
    result = read(NewestRich, at(A, 10, 20, 30), at(B, 10, 20, 30), at(C, *range(2, 32, 4)))
    assert gathered(result) == [tuple(range(2, 32, 4))]
    assert result.drops["n.sets"].dropped == 2


@pytest.mark.slow
@given(
    st.sets(st.integers(1, 40)), st.sets(st.integers(1, 40)), st.sets(st.integers(1, 40)), st.data()
)
def test_each_event_of_a_tuple_is_read_once_whatever_is_lost_or_skipped(
    a: set[int], b: set[int], c: set[int], data: st.DataObject
) -> None:
    matcher: Matcher[Four] = Bundle(Four, bound=2, overflow="drop_oldest").make("n")
    stamps_of = {"a": a, "b": b, "c": c}
    events = sorted((stamp, kind) for kind, numbers in stamps_of.items() for stamp in numbers)
    kinds: dict[str, type[Event]] = {"a": A, "b": B, "c": C}
    got: list[Four] = []
    for stamp, kind in events:
        matcher.slots[kind].add(kinds[kind](stamp=stamp, source="x"))
        if matcher.statistics().buffered and data.draw(st.booleans()):
            got.append(matcher.receive_nowait())
    while matcher.statistics().buffered:
        got.append(matcher.receive_nowait())
    read_ = [event.stamp for every in got for event in every.c]
    last = max((bundle.a.stamp for bundle in got), default=0)
    assert read_ == sorted(stamp for stamp in c if stamp <= last)


class Heavy(Event):
    """Holds an array."""

    data: Any


class Pair(NamedTuple):
    heavy: Heavy
    b: B
    also: Heavy | None


def test_what_waits_is_bounded_in_bytes() -> None:
    """The first field gives up its oldest, which is counted; so does any other."""
    matcher: Matcher[Pair] = Bundle(Pair).make("n")
    array = np.broadcast_to(np.uint8(0), (1 << 20, 10))  # of no memory: 10 MiB
    for index in range(30):
        for field in ("heavy", "also"):
            matcher.slots[field].add(Heavy(stamp=index, source="x", data=array))
    most = WAITING_BYTES // array.nbytes + 1
    assert 1 <= len(matcher.slots["heavy"].events) <= most
    assert 1 <= len(matcher.slots["also"].events) <= most
    assert matcher.missed["b"] == 30 - len(matcher.slots["heavy"].events)
    matcher.slots["b"].add(B(stamp=29, source="x"))
    assert matcher.receive_nowait().heavy.stamp == 29


def test_an_event_larger_than_all_that_may_wait_finds_its_partners() -> None:
    matcher: Matcher[Pair] = Bundle(Pair).make("n")
    array = np.broadcast_to(np.uint8(0), (WAITING_BYTES, 2))
    matcher.slots["heavy"].add(Heavy(stamp=1, source="x", data=array))
    matcher.slots["b"].add(B(stamp=1, source="x"))
    assert matcher.receive_nowait().heavy.stamp == 1
