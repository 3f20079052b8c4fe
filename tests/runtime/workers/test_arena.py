"""Which blocks of shared memory are free: none lies on another, and the file stays small."""

from __future__ import annotations

import math
import mmap
import os
from collections.abc import Iterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runtime.workers.shared_memory import Arena, anonymous_file

PAGE = mmap.PAGESIZE


@pytest.fixture
def arena() -> Iterator[Arena]:
    made = Arena(anonymous_file())
    yield made
    made.close()


@pytest.mark.slow
@settings(max_examples=200, deadline=None)
@given(
    st.lists(
        st.one_of(
            st.integers(1, 1 << 18).map(lambda size: ("take", size)),
            st.integers(0, 1 << 10).map(lambda which: ("free", which)),
        ),
        max_size=200,
    )
)
def test_blocks_are_disjoint_and_the_file_is_bounded(steps: list[tuple[str, int]]) -> None:
    """By the bound of first fit: what was taken at once, times 1 + log2 of the largest block."""
    arena = Arena(anonymous_file())
    taken: dict[int, int] = {}
    peak = largest = 0
    for what, number in steps:
        if what == "take":
            offset = arena.reserve(number)
            assert offset is not None
            size = -(-number // PAGE) * PAGE
            assert all(offset + size <= o or o + s <= offset for o, s in taken.items())
            taken[offset] = size
            peak, largest = max(peak, sum(taken.values())), max(largest, size)
        elif taken:
            offset = sorted(taken)[number % len(taken)]
            del taken[offset]
            arena.free(offset)
        assert max((o + s for o, s in taken.items()), default=0) == arena._top
        assert arena._top <= peak * (1 + math.log2(max(largest // PAGE, 1)))
    for offset in taken:
        arena.free(offset)
    assert arena._top == 0
    arena.close()


@settings(max_examples=50, deadline=None)
@given(
    step=st.integers(1, 64),
    held=st.integers(1, 4),
    count=st.integers(2, 150),
    first=st.integers(1, 64),
)
def test_what_grows_keeps_near_its_working_set(
    step: int, held: int, count: int, first: int
) -> None:
    """Each message a little larger than the last, and the oldest of those held let go."""
    arena = Arena(anonymous_file())
    offsets: list[int] = []
    sizes: list[int] = []
    for number in range(count):
        if len(offsets) == held:
            arena.free(offsets.pop(0))
        size = (first + step * number) * PAGE
        offset = arena.reserve(size)
        assert offset is not None
        offsets.append(offset)
        sizes.append(size)
    assert arena._top <= 3 * sum(sizes[-held:])
    arena.close()


def test_a_block_that_is_freed_twice_or_never_was_is_not_given_to_two(arena: Arena) -> None:
    first, second = arena.reserve(PAGE), arena.reserve(PAGE)
    assert first is not None
    arena.free(first)
    arena.free(first)
    arena.free(12345)
    third, fourth = arena.reserve(PAGE), arena.reserve(PAGE)
    assert len({second, third, fourth}) == 3


def test_a_full_file_says_so_and_has_room_again_later() -> None:
    arena = Arena(anonymous_file(), limit=4 * PAGE)
    offsets = [arena.reserve(PAGE) for _ in range(4)]
    assert arena.reserve(1) is None
    for offset in offsets[1:3]:
        assert offset is not None
        arena.free(offset)
    assert arena.reserve(2 * PAGE) == offsets[1]
    assert os.fstat(arena._fd).st_size == 4 * PAGE
    arena.close()
