"""Objects between processes, with their arrays in shared memory.

Python's pickle (protocol 5) hands large buffers over beside the pickled bytes. Here they are
copied once, into a block of an anonymous file that both processes map, and come out on the other
side as arrays on that memory, without another copy. When the last array on a block is gone, its
reader says so with its next message, and the writer uses the block again. The file has no name:
nothing is left behind, however a process ends.
"""

from __future__ import annotations

import bisect
import collections
import contextlib
import ctypes
import fcntl
import mmap
import os
import pickle
import select
import socket
import struct
import sys
import tempfile
import threading
import weakref
from typing import Any

INLINE = 4096  # buffers smaller than this (bytes) travel inside the message
MAPPED = 1 << 24  # first length of a file (bytes); doubled from there on
LIMIT = 1 << 30  # maximum length of a file (bytes); buffers without room travel inside the message

_LENGTH = struct.Struct("<Q")


def anonymous_file() -> int:
    """Return the descriptor of a new nameless file in memory (on disk where there is none)."""
    if sys.platform == "linux":
        fd = os.memfd_create("visnav", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        fcntl.fcntl(fd, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK)
        return fd
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


class Arena:
    """The writer's side of a file, with its free blocks.

    Blocks are whole pages. A new one takes the first room by address that it fits into, and room
    that comes free joins with what is free beside it. So the file stays near the most that was
    taken at once: it never takes more than that times 1 + log2 of the largest block's pages
    (first fit's bound, by Robson, 1977), and in practice less than twice as much.

    Args:
        limit: Bytes to which it may grow.
    """

    def __init__(self, fd: int, limit: int = LIMIT) -> None:
        self._fd = fd
        self._limit = limit
        self._map: mmap.mmap | None = None
        self._reserved: dict[int, int] = {}  # offset: size
        self._holes: list[tuple[int, int]] = []  # offset and size, by offset; no two touch
        self._top = 0  # where the last block ends

    def store(self, data: memoryview) -> int | None:
        """Copy `data` (contiguous bytes) into a block and return its offset; `None` if full."""
        offset = self.reserve(data.nbytes)
        if offset is not None:
            self.view(offset, data.nbytes)[:] = data
        return offset

    def reserve(self, size: int) -> int | None:
        """Reserve a block of at least `size` bytes and return its offset; `None` if full."""
        size = max(-(-size // mmap.PAGESIZE), 1) * mmap.PAGESIZE
        for index, (offset, room) in enumerate(self._holes):
            if room >= size:
                self._holes[index : index + 1] = [(offset + size, room - size)] * (room > size)
                break
        else:
            offset = self._top
            if offset + size > self._limit:
                return None
            self._reach(offset + size)
            self._top = offset + size
        self._reserved[offset] = size
        return offset

    def view(self, offset: int, size: int) -> memoryview:
        """Return the memory of a block, to be written."""
        assert self._map is not None
        return memoryview(self._map)[offset : offset + size]

    def free(self, offset: int) -> None:
        """Free a block; where none begins, nothing happens."""
        size = self._reserved.pop(offset, 0)
        if not size:
            return
        index = bisect.bisect(self._holes, (offset, 0))
        if index < len(self._holes) and self._holes[index][0] == offset + size:
            size += self._holes.pop(index)[1]
        if index and sum(self._holes[index - 1]) == offset:
            index -= 1
            offset, room = self._holes.pop(index)
            size += room
        if offset + size == self._top:
            self._top = offset
        else:
            self._holes.insert(index, (offset, size))

    def close(self) -> None:
        """Close the file."""
        os.close(self._fd)

    def _reach(self, end: int) -> None:
        if self._map is None or end > len(self._map):
            # Pages cost nothing before they are used, but a new map of them does on both sides.
            length = min(max(2 * end, MAPPED), self._limit)
            os.ftruncate(self._fd, length)
            self._map = mmap.mmap(self._fd, length)


class MappedFile:
    """The reader's side of a file."""

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._map: mmap.mmap | None = None
        self.freed: collections.deque[int] = collections.deque()
        """Offsets of blocks no longer read; appended to from any thread."""

    def pop_freed(self) -> tuple[int, ...]:
        """Remove and return the offsets of the blocks no longer read."""
        return tuple(self.freed.popleft() for _ in range(len(self.freed)))

    def view(self, offset: int, size: int) -> Any:
        """Return the bytes of a block, freed when the last array on them is gone."""
        if self._map is None or offset + size > len(self._map):
            self._map = mmap.mmap(self._fd, os.fstat(self._fd).st_size)
        block = (ctypes.c_char * size).from_buffer(self._map, offset)
        weakref.finalize(block, self.freed.append, offset).atexit = False
        return block

    def close(self) -> None:
        """Close the file; blocks in view stay mapped until the last array is gone."""
        os.close(self._fd)


class SharedPipe:
    """A connection for objects, with a file of shared memory for each direction.

    One thread may send and another receive, each always the same one.

    Args:
        out_fd: File for the arrays that this side sends.
    """

    def __init__(self, connection: socket.socket, out_fd: int, in_fd: int) -> None:
        self._connection = connection
        self._readable = select.poll()
        self._readable.register(connection, select.POLLIN)
        self._arena = Arena(out_fd)
        self._window = MappedFile(in_fd)
        self._returned: collections.deque[int] = collections.deque()
        self._unsent: collections.deque[memoryview] = collections.deque()
        self._sending = threading.Lock()
        self._writer: threading.Thread | None = None

    def send(self, message: Any) -> None:
        """Send an object, and wait until the connection has taken all bytes; else `OSError`."""
        self.write(self.pack(message))

    def write(self, packed: bytes) -> None:
        """Send the result of `pack`, as `send` does."""
        self._connection.sendall(packed)

    def pack(self, message: Any) -> bytes:
        """Copy an object's arrays into shared memory, and return the message to send."""
        while self._returned:
            self._arena.free(self._returned.popleft())
        spans: list[tuple[int, int]] = []

        def place(buffer: pickle.PickleBuffer) -> bool:
            """Tell pickle (by True) to keep a buffer inside the message."""
            raw = buffer.raw()
            if raw.nbytes < INLINE or (offset := self._arena.store(raw)) is None:
                return True
            spans.append((offset, raw.nbytes))
            return False

        try:
            body = pickle.dumps(message, protocol=5, buffer_callback=place)
        except BaseException:
            for offset, _ in spans:
                self._arena.free(offset)
            raise
        frame = pickle.dumps((self._window.pop_freed(), spans, body))
        return _LENGTH.pack(len(frame)) + frame

    def post(self, packed: bytes) -> None:
        """Send the result of `pack` without waiting: a thread sends what is left; or `OSError`."""
        with self._sending:
            sent = 0
            if not self._unsent:
                with contextlib.suppress(BlockingIOError):
                    sent = self._connection.send(packed, socket.MSG_DONTWAIT)
            if sent < len(packed):
                self._unsent.append(memoryview(packed)[sent:])
                if len(self._unsent) == 1:
                    self._writer = threading.Thread(target=self._send_rest, daemon=True)
                    self._writer.start()

    def _send_rest(self) -> None:
        with contextlib.suppress(OSError):  # the receiver is notified, too
            while True:
                self._connection.sendall(self._unsent[0])
                with self._sending:
                    self._unsent.popleft()
                    if not self._unsent:
                        return

    def receive(self) -> Any:
        """Wait for an object; `EOFError` or `OSError`: the other side is gone."""
        return self.unpack(self.read())

    def read(self) -> bytearray:
        """Wait for a message, and return its bytes.

        Raises:
            EOFError: The other side is gone.
            OSError: The same, found out in another way; `BlockingIOError` if the rest of a message
                does not come within the time limit that the socket has.
        """
        (length,) = _LENGTH.unpack(self._read(_LENGTH.size))
        return self._read(length)

    def unpack(self, message: bytearray) -> Any:
        """Return the object of a message; raises any exception of making the object."""
        freed, spans, body = pickle.loads(message)  # noqa: S301  # from our child, or to it
        self._returned.extend(freed)
        return pickle.loads(body, buffers=[self._window.view(*span) for span in spans])  # noqa: S301

    def poll(self, timeout: float) -> bool:
        """Wait up to `timeout` seconds for a message, and return whether there is any."""
        return bool(self._readable.poll(timeout * 1e3))

    def shut_down(self) -> None:
        """End the connection for both sides; a thread waiting in `receive` is notified."""
        with contextlib.suppress(OSError):  # it has ended already
            self._connection.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Close connection and files; received arrays stay valid."""
        self.shut_down()
        if self._writer is not None:
            self._writer.join()
        self._connection.close()
        self._arena.close()
        self._window.close()

    def _read(self, size: int) -> bytearray:
        data = bytearray(size)
        rest = memoryview(data)
        while rest:
            count = self._connection.recv_into(rest, 0, socket.MSG_WAITALL)
            if not count:
                raise EOFError
            rest = rest[count:]
        return data
