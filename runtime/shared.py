"""Objects between two processes, with their arrays in shared memory.

Python's pickle (protocol 5) hands large buffers over beside the pickled bytes. Here they are
copied once, into a block of an anonymous file that both processes map, and come out on the other
side as arrays on that memory, without another copy. When the last array on a block is gone, its
reader says so with its next message, and the writer uses the block again. The file has no name:
nothing is left behind, however a process ends.
"""

from __future__ import annotations

import collections
import contextlib
import ctypes
import fcntl
import mmap
import os
import pickle
import socket
import sys
import tempfile
import weakref
from multiprocessing.connection import Connection
from typing import Any

INLINE = 4096
"""Buffers smaller than this (bytes) travel inside the message."""

MAPPED = 1 << 24
"""Length to which a file grows at first (bytes); from there on it doubles."""

LIMIT = 1 << 30
"""A file never grows beyond this (bytes); what does not fit travels inside the message."""


def anonymous_file() -> int:
    """Return the descriptor of a new nameless file in memory (on disk where there is none)."""
    if sys.platform == "linux":
        fd = os.memfd_create("visnav", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        fcntl.fcntl(fd, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK)
        return fd
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


class Arena:
    """The writer's side of a file: which blocks are free.

    Args:
        fd: The file.
        limit: Bytes to which it may grow.
    """

    def __init__(self, fd: int, limit: int = LIMIT) -> None:
        self._fd = fd
        self._limit = limit
        self._size = 0
        self._map: mmap.mmap | None = None
        self._blocks: dict[int, int] = {}  # offset: size
        self._free: set[int] = set()

    def put(self, data: memoryview) -> int | None:
        """Copy `data` (contiguous bytes) into a block and return its offset; `None` if full."""
        offset = self.reserve(data.nbytes)
        if offset is not None:
            self.view(offset, data.nbytes)[:] = data
        return offset

    def reserve(self, size: int) -> int | None:
        """Take a block of at least `size` bytes and return its offset; `None` if full."""
        fitting = [o for o in self._free if size <= self._blocks[o] <= 2 * size]
        if not fitting:
            return self._grow(size)
        offset = min(fitting, key=self._blocks.__getitem__)
        self._free.remove(offset)
        return offset

    def view(self, offset: int, size: int) -> memoryview:
        """Return the memory of a block, to be written."""
        assert self._map is not None
        return memoryview(self._map)[offset : offset + size]

    def free(self, offset: int) -> None:
        """Let a block be used again."""
        self._free.add(offset)

    def close(self) -> None:
        """Close the file."""
        os.close(self._fd)

    def _grow(self, size: int) -> int | None:
        offset = self._size
        size = -(-size // mmap.PAGESIZE) * mmap.PAGESIZE
        if offset + size > self._limit:
            return None
        if self._map is None or offset + size > len(self._map):
            # Pages cost nothing before they are used, but a new map of them does on both sides.
            length = min(max(2 * (offset + size), MAPPED), self._limit)
            os.ftruncate(self._fd, length)
            self._map = mmap.mmap(self._fd, length)
        self._size += size
        self._blocks[offset] = size
        return offset


class Window:
    """The reader's side of a file.

    Args:
        fd: The file.
    """

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._map: mmap.mmap | None = None
        self.freed: collections.deque[int] = collections.deque()
        """Offsets of blocks that nobody reads any more; appended to from any thread."""

    def view(self, offset: int, size: int) -> Any:
        """Return the bytes of a block; when the last array on them is gone, it is freed."""
        if self._map is None or offset + size > len(self._map):
            self._map = mmap.mmap(self._fd, os.fstat(self._fd).st_size)
        block = (ctypes.c_char * size).from_buffer(self._map, offset)
        weakref.finalize(block, self.freed.append, offset).atexit = False
        return block

    def close(self) -> None:
        """Close the file; what it shows stays mapped until the last array is gone."""
        os.close(self._fd)


class SharedPipe:
    """A connection over which objects pass, one way each file.

    `send` and `receive` may be called from two different threads, each from one only.

    Args:
        connection: Carries the messages.
        out_fd: File for the arrays that this side sends.
        in_fd: File for those it receives.
    """

    def __init__(self, connection: Connection, out_fd: int, in_fd: int) -> None:
        self._connection = connection
        self._arena = Arena(out_fd)
        self._window = Window(in_fd)
        self._returned: collections.deque[int] = collections.deque()

    def send(self, message: Any) -> None:
        """Send an object.

        Raises:
            OSError: The other side is gone.
        """
        while self._returned:
            self._arena.free(self._returned.popleft())
        spans: list[tuple[int, int]] = []

        def place(buffer: pickle.PickleBuffer) -> bool:
            """Tell pickle (by True) to keep a buffer inside the message."""
            raw = buffer.raw()
            if raw.nbytes < INLINE or (offset := self._arena.put(raw)) is None:
                return True
            spans.append((offset, raw.nbytes))
            return False

        try:
            body = pickle.dumps(message, protocol=5, buffer_callback=place)
        except BaseException:
            for offset, _ in spans:
                self._arena.free(offset)
            raise
        freed = [self._window.freed.popleft() for _ in range(len(self._window.freed))]
        self._connection.send_bytes(pickle.dumps((freed, spans, body)))

    def receive(self) -> Any:
        """Wait for an object.

        Raises:
            EOFError: The other side is gone.
            OSError: The same, found out in another way.
        """
        freed, spans, body = pickle.loads(self._connection.recv_bytes())  # noqa: S301  # our child
        self._returned.extend(freed)
        return pickle.loads(body, buffers=[self._window.view(*span) for span in spans])  # noqa: S301

    def poll(self, timeout: float) -> bool:
        """Wait up to `timeout` seconds for a message, and tell whether there is one."""
        return self._connection.poll(timeout)

    def shut_down(self) -> None:
        """End the connection for both sides; a thread that waits in `receive` is told."""
        with (
            contextlib.suppress(OSError),  # it has ended already
            socket.socket(fileno=os.dup(self._connection.fileno())) as end,
        ):
            end.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Close connection and files; arrays that came through them stay valid."""
        self._connection.close()
        self._arena.close()
        self._window.close()
