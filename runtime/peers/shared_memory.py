"""Large events between processes of a machine: put once into memory visible to both.

A process offers the other a nameless file, by its path in ``/proc`` and a key at its beginning. A
process that can open the file and finds the key is on the same machine, and reads frames in
place; the others get them over the network. A block is used again once the last array on it is
gone. The file cannot shrink: mapped memory stays readable, whatever its owner does.
"""

from __future__ import annotations

import collections
import fcntl
import logging
import os
import re
import secrets
import stat
import weakref
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from runtime.errors import WireError
from runtime.peers.messages import MemoryOffer
from runtime.wire import Packed
from runtime.workers.shared_memory import Arena, MappedFile, anonymous_file

log = logging.getLogger("visnav.runtime")

LIMIT = 1 << 28  # most bytes of a file; events without room cross the network

KEY = 32


class Outgoing:
    """Memory written by this process, with large events for another.

    `put` is called by one thread at a time, `freed` by any. The file is closed with this object.
    """

    def __init__(self) -> None:
        self._fd = anonymous_file()
        self._arena = Arena(self._fd, LIMIT)
        weakref.finalize(self, self._arena.close)
        self._key = secrets.token_bytes(KEY)
        self._arena.put(memoryview(self._key))
        self._freed: collections.deque[int] = collections.deque()
        self._taken: set[int] = set()

    def offer(self) -> MemoryOffer:
        """Return the offer of this memory to the other process."""
        return MemoryOffer(
            machine=machine(), path=f"/proc/{os.getpid()}/fd/{self._fd}", key=self._key
        )

    def put(self, packed: Packed) -> tuple[int, int] | None:
        """Put a frame there, and return its place and size; `None` if there is no room."""
        while self._freed:
            if (freed := self._freed.popleft()) in self._taken:  # each once, and only ours
                self._taken.remove(freed)
                self._arena.free(freed)
        offset = self._arena.reserve(packed.size)
        if offset is None:
            return None
        self._taken.add(offset)
        packed.write(self._arena.view(offset, packed.size))
        return offset, packed.size

    def freed(self, offsets: Iterable[int]) -> None:
        """Note the frames read no more by the other process."""
        self._freed.extend(offsets)


class Incoming:
    """Memory written by another process, with large events for this process.

    The file is closed with this object; arrays that stand in it stay valid.
    """

    def __init__(self, fd: int) -> None:
        self._window = MappedFile(fd)
        weakref.finalize(self, self._window.close)

    @classmethod
    def found(cls, offer: MemoryOffer) -> Incoming | None:
        """Return the offered memory; `None` if not accessible from here."""
        here = offer.machine and offer.machine == machine()
        if not (here and re.fullmatch(r"/proc/\d+/fd/\d+", offer.path)):
            return None
        try:
            fd = os.open(offer.path, os.O_RDWR | os.O_CLOEXEC | os.O_NONBLOCK)
        except OSError as error:
            log.debug("no memory in common: %s", error)
            return None
        try:
            fits = (
                stat.S_ISREG(os.fstat(fd).st_mode)
                and fcntl.fcntl(fd, fcntl.F_GET_SEALS) & fcntl.F_SEAL_SHRINK
                and secrets.compare_digest(os.pread(fd, KEY, 0), offer.key)
            )
        except OSError:
            fits = False
        if not fits:
            os.close(fd)
            log.debug("no memory in common: %s is another file", offer.path)
            return None
        return cls(fd)

    def frame(self, offset: int, size: int) -> memoryview:
        """Return a frame in place, without a copy; raise `WireError` if there is none."""
        try:
            block = self._window.view(offset, size)
        except (OSError, ValueError) as error:
            text = f"expected {size} bytes of common memory at {offset}, found: {error}"
            raise WireError(text) from None
        return np.frombuffer(block, np.uint8).data

    @property
    def unread(self) -> int:
        """Number of frames read no more here and not yet returned by `freed`."""
        return len(self._window.freed)

    def freed(self) -> tuple[int, ...]:
        """Return the frames read no more here, each once."""
        freed = self._window.freed
        return tuple(freed.popleft() for _ in range(len(freed)))


def machine() -> str:
    """Return the boot id, common to the processes of a machine; "" if there is none."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text("ascii").strip()
    except OSError:
        return ""
