"""Arrays between two processes: what arrives, who may write it, and which memory is used again."""

from __future__ import annotations

import math
import mmap
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runtime.workers.shared_memory import INLINE, Arena, SharedPipe, anonymous_file
from tests.runtime.samples_workers import Plant
from tests.runtime.workers.test_worker import alive, worker

pytestmark = pytest.mark.timeout(120)
MEGABYTE = 1 << 20
PAGE = mmap.PAGESIZE


def pipes() -> tuple[SharedPipe, SharedPipe]:
    """Return both ends of a pipe, in this process."""
    ours, theirs = socket.socketpair()
    there, back = anonymous_file(), anonymous_file()
    near = SharedPipe(ours, there, back)
    far = SharedPipe(theirs, os.dup(back), os.dup(there))
    return near, far


@pytest.fixture
def ends() -> Iterator[tuple[SharedPipe, SharedPipe]]:
    near, far = pipes()
    yield near, far
    near.close()
    far.close()


def memory_of(fd: int) -> int:
    """Return the bytes that a file takes: what was never written takes none."""
    return os.fstat(fd).st_blocks * 512


def arena_size(pipe: SharedPipe) -> int:
    return memory_of(pipe._arena._fd)


ARRAYS: dict[str, Any] = {
    "small": np.arange(10),
    "large": np.arange(MEGABYTE, dtype=np.uint8),
    "empty": np.empty((0, 3), np.float32),
    "non-contiguous": np.arange(60_000, dtype=np.int16).reshape(200, 300)[::2, ::-3],
    "fortran": np.asfortranarray(np.arange(40_000, dtype=np.float64).reshape(200, 200)),
    "image": np.arange(3 * 40_000, dtype=np.uint8).reshape(200, 200, 3),
    "inf": np.full((100, 100), np.inf, np.float32),
}


@pytest.mark.parametrize("name", ARRAYS)
def test_an_array_arrives_unchanged(name: str, ends: tuple[SharedPipe, SharedPipe]) -> None:
    near, far = ends
    array = ARRAYS[name]
    before = array.copy()
    near.send({"array": array, "twice": array})
    got = far.receive()
    for received in got.values():
        assert received.dtype == array.dtype
        assert received.shape == array.shape
        assert np.array_equal(received, before)
    assert np.array_equal(array, before)


def test_a_read_only_array_may_be_sent_and_arrives(ends: tuple[SharedPipe, SharedPipe]) -> None:
    near, far = ends
    array = np.arange(50_000)
    array.setflags(write=False)
    near.send(array)
    assert np.array_equal(far.receive(), array)


def test_writing_to_what_arrived_does_not_change_what_was_sent(
    ends: tuple[SharedPipe, SharedPipe],
) -> None:
    near, far = ends
    array = np.zeros(50_000)
    near.send(array)
    got = far.receive()
    got[:] = 1.0
    assert not array.any()


def test_small_arrays_take_no_shared_memory(ends: tuple[SharedPipe, SharedPipe]) -> None:
    near, far = ends
    near.send(np.zeros(INLINE - 1, np.uint8))
    far.receive()
    assert arena_size(near) == 0
    near.send(np.zeros(INLINE, np.uint8))
    far.receive()
    assert arena_size(near) > 0


def test_a_failed_send_keeps_no_memory(ends: tuple[SharedPipe, SharedPipe]) -> None:
    near, _ = ends
    for _ in range(5):
        with pytest.raises(TypeError):
            near.send((np.zeros(MEGABYTE, np.uint8), threading.Lock()))
    assert arena_size(near) == MEGABYTE


def test_memory_is_used_again_once_the_arrays_are_gone(
    ends: tuple[SharedPipe, SharedPipe],
) -> None:
    near, far = ends
    for count in range(200):
        near.send(np.full(MEGABYTE, count % 256, np.uint8))
        assert far.receive()[-1] == count % 256
        far.send(None)  # carries back which blocks are free
        near.receive()
    assert arena_size(near) <= 3 * MEGABYTE


def test_what_grows_takes_no_more_memory_than_it_is_large(
    ends: tuple[SharedPipe, SharedPipe],
) -> None:
    """A cloud that grows with every message, up to 3 MB, both ways."""
    near, far = ends
    for count in range(1, 101):
        near.send(np.full(30_000 * count, count, np.uint8))
        far.send(far.receive())
        assert near.receive()[-1] == count
    assert arena_size(near) <= 4 * 3_000_000
    assert arena_size(far) <= 4 * 3_000_000


SIZES = [100, 3000, 300_000, 5_000_000]


@settings(max_examples=20, deadline=None)
@given(st.lists(st.sampled_from(SIZES), max_size=12))
def test_posting_never_waits_for_who_reads_and_keeps_the_order(sizes: list[int]) -> None:
    near, far = pipes()
    for number, size in enumerate(sizes):
        near.post(near.pack((number, b"x" * size)))  # nobody reads, and nothing of it is an array
    for number, size in enumerate(sizes):
        assert far.receive() == (number, b"x" * size)
    near.post(near.pack("after"))
    assert far.receive() == "after"
    near.close()
    far.close()


def test_what_was_posted_and_not_read_does_not_hold_up_the_end() -> None:
    near, far = pipes()
    near.post(near.pack(b"x" * 5_000_000))
    near.close()
    with pytest.raises((EOFError, OSError)):
        far.receive()
    far.close()


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 7), st.sampled_from([1, 5000, 70_000])), max_size=30))
def test_a_held_array_stays_intact_while_others_come_and_go(
    steps: list[tuple[int, int]],
) -> None:
    near, far = pipes()
    held: dict[int, tuple[int, Any]] = {}
    for number, (slot, size) in enumerate(steps):
        near.send(np.full(size, number, np.int64))
        held[slot] = (number, far.receive())  # what was in this slot is dropped
        far.send(None)
        near.receive()
        for value, array in held.values():
            assert (array == value).all()
    near.close()
    far.close()
    for value, array in held.values():
        assert (array == value).all()


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


def test_a_block_that_is_freed_twice_or_never_was_is_not_given_to_two() -> None:
    arena = Arena(anonymous_file())
    first, second = arena.reserve(PAGE), arena.reserve(PAGE)
    assert first is not None
    arena.free(first)
    arena.free(first)
    arena.free(12345)
    third, fourth = arena.reserve(PAGE), arena.reserve(PAGE)
    assert len({second, third, fourth}) == 3
    arena.close()


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


@pytest.mark.slow
async def test_a_view_keeps_the_memory_of_its_array() -> None:
    async with worker() as plant:
        view = (await plant.call(Plant.big, MEGABYTE, 1))[10:20]
        for value in range(2, 20):
            await plant.call(Plant.big, MEGABYTE, value)
        assert (view == 1).all()
    assert (view == 1).all()


@pytest.mark.slow
async def test_200_megabytes_through_a_worker_take_a_few() -> None:
    async with worker() as plant:
        for value in range(200):
            array = np.full(MEGABYTE, value, np.uint8)
            got = await plant.call(Plant.echo, array)
            assert got[0] == got[-1] == value
            del got
        pipe = plant._processes[0]._pipe
        assert arena_size(pipe) <= 4 * MEGABYTE
        assert memory_of(pipe._window._fd) <= 4 * MEGABYTE


@pytest.mark.slow
async def test_what_a_worker_keeps_stays_intact() -> None:
    async with worker() as plant:
        for value in range(6):
            await plant.call(Plant.keep, np.full(70_000, value))
        for value in range(6):
            assert (await plant.call(Plant.kept, value) == value).all()


PARENT = """
import asyncio, sys, time
from runtime import Worker
from runtime.time.clock import RealClock
from tests.runtime.samples_workers import Plant
import numpy as np
async def main():
    worker = Worker("plant", RealClock(asyncio.get_running_loop()), Plant, timeout=8)
    await worker.ready()
    await worker.call(Plant.keep, np.zeros(1 << 20, np.uint8))
    print(await worker.call(Plant.pid), flush=True)
    if sys.argv[1:]:
        worker._processes[0].request((sys.argv[1], (), {}))
        print("asked", flush=True)
    await asyncio.sleep(1000)
asyncio.run(main())
"""


@pytest.mark.timeout(200)
@pytest.mark.parametrize(
    "call",
    [
        "",
        pytest.param("loop", marks=pytest.mark.slow),
        pytest.param("loop_in_c", marks=pytest.mark.slow),
    ],
)
def test_a_killed_run_leaves_neither_processes_nor_memory(call: str) -> None:
    """Not even one that is in an endless call."""
    shared = Path("/dev/shm")
    before = set(shared.iterdir())
    command = [sys.executable, "-c", PARENT, *filter(None, [call])]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        assert alive(pid)
        if call:
            parent.stdout.readline()
        parent.kill()
    # A limit of 13 s, with a processor, on each of them: that is how long the kernel lets it go on.
    deadline = time.monotonic() + (150 if call else 20)
    while alive(pid) and time.monotonic() < deadline:
        time.sleep(0.02)  # another process's end; nothing here can be awaited
    assert not alive(pid)
    theirs = (".zenoh", "iox2")  # of other programs that may start or end meanwhile
    left = {path.name for path in set(shared.iterdir()) - before}
    assert not [name for name in left if not name.endswith(theirs) and not name.startswith(theirs)]
