"""Mends recordings of runs that were killed, or whose disk was full."""

from __future__ import annotations

from pathlib import Path

import msgspec

from nodes.mcap_recorder.disk import RecordingError
from nodes.mcap_recorder.mcap_file import contents, recover


class Recovery(msgspec.Struct, frozen=True):
    """What came of it.

    Attributes:
        path: The whole file.
        messages: How many it has.
        trouble: What could not be read; empty if the file was whole.
        mended: Whether there was anything to do.
    """

    path: Path
    messages: int
    trouble: list[str]
    mended: bool


def recover_file(path: Path, out: Path | None = None) -> Recovery:
    """Write a whole, indexed file from what can be read of a torn one.

    Args:
        path: The torn file.
        out: The whole one; if `None`, it takes the place of the torn one when it is complete, and
            the torn one is gone: all that could be read of it is in the new one.

    Raises:
        RecordingError: The file is no MCAP file, nothing can be read of it, or the other cannot
            be written.
    """
    found = contents(path)
    if found.complete and out is None:
        return Recovery(path, 0, [], mended=False)
    if out is not None and out.exists():
        raise RecordingError(f"{out}: expected the name of a new file, found one that is there")
    place = out or path.with_name(f"{path.name}.mended")
    try:
        messages, trouble = recover(path, place)
        if not messages:
            raise RecordingError(f"{path}: expected messages, found none that can be read")
    except BaseException:
        place.unlink(missing_ok=True)
        raise
    if out is None:
        place.replace(path)
    return Recovery(out or path, messages, trouble, mended=True)
