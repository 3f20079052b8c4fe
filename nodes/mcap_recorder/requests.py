"""What a run and the process that writes for it send each other, beside the events."""

from __future__ import annotations

import sys

import msgspec

from nodes.mcap_recorder.settings import McapRecorderConfig


class WriteRequest(msgspec.Struct, frozen=True):
    """A file to write, and how.

    Attributes:
        path: The file to write.
        config: The recorder's settings.
        attachment: A file to add, if it is there.
        niceness: How much to stand back for others.
        cores: To run on; all if empty.
    """

    path: str
    config: McapRecorderConfig
    attachment: str
    niceness: int
    cores: tuple[int, ...]


class Reply(msgspec.Struct, frozen=True, omit_defaults=True):
    """A line that the process sends.

    Attributes:
        what: ``ready``, ``complaint``, ``error``, ``missing`` (a library) or ``done``;
            ``gone`` stands for a process that ended without a reply.
        text: For messages.
        written: Events in the file.
        size: Bytes of the file.
    """

    what: str
    text: str = ""
    written: int = 0
    size: int = 0


def command(request: WriteRequest) -> list[str]:
    """Return the command that starts such a process."""
    text = msgspec.json.encode(request).decode()
    return [sys.executable, "-m", "nodes.mcap_recorder.process", text]
