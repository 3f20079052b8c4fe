"""Files of a run that outlast what happens to it.

Text files grow with a run, so that a run that is killed leaves all but its last second; and what a
node wrote before it was restarted is never overwritten.
"""

from __future__ import annotations

import threading
from collections import deque
from pathlib import Path
from typing import Any

from runtime import Node

_INTERVAL = 500_000_000
"""Nanoseconds of the run's clock between two writes."""


def part_name(node: Node[Any], name: str) -> str:
    """Return the name of a node's file or folder; after a restart one beside those of before.

    ``flight.png`` is followed by ``flight-2.png``, ``dataset`` by ``dataset-2``.
    """
    path = Path(name)
    number = f"-{node.restarts + 1}" if node.restarts else ""
    return str(path.with_name(f"{path.stem}{number}{path.suffix}"))


class GrowingFile:
    """A file of lines: they are added on the loop, and written beside it twice a second.

    Args:
        node: In whose name it is written.
        path: The file; made anew, unless the node was restarted: then it goes on.
        head: Its first line.
    """

    def __init__(self, node: Node[Any], path: Path, head: str = "") -> None:
        self._node = node
        self._file = path.open("ab" if node.restarts else "wb", buffering=0)
        self.begin = self._file.tell()
        """Bytes that were there before."""
        self._lines = deque([] if self.begin else [head])
        self._due = 0
        self._writing = False
        self._lock = threading.Lock()

    def add(self, line: str) -> None:
        """Add a line, with its end."""
        self._lines.append(line)
        now = self._node.clock.now()
        if now >= self._due and not self._writing:
            self._due, self._writing = now + _INTERVAL, True
            self._node.start(self._node.offload(self._write))

    def close(self) -> None:
        """Write what is left, and close the file."""
        try:
            self._write()
        finally:
            self._file.close()

    def _write(self) -> None:
        with self._lock:  # the run's end does not wait for a write that it cancels
            if not self._file.closed:
                lines = [self._lines.popleft() for _ in range(len(self._lines))]
                rest = memoryview("".join(lines).encode("ascii"))
                while rest:
                    rest = rest[self._file.write(rest) :]
        self._writing = False
