"""Flights by their content, in ``~/.cache/visnav-runtime/flights``.

``VISNAV_FLIGHTS_GB`` says how much they may take (20 if it does not); of more, those that were not
used for longest are removed. A flight is written by one process at a time, and as a whole.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import xxhash

from runtime.config.model import Config
from runtime.errors import VisnavError
from runtime.node import Node
from runtime.tools.flights.layout import EVENTS, INDEX, Flight
from runtime.tools.flights.part import content_key, flight_of
from runtime.tools.flights.player import stand_ins
from runtime.tools.flights.recorder import record as fly

LIMIT = 20.0
"""Gigabytes, unless ``VISNAV_FLIGHTS_GB`` says otherwise."""

_CHUNK = 1 << 24


class Kept(NamedTuple):
    """A flight that is kept: its folder, bytes, and when it was last used (s)."""

    folder: Path
    size: int
    used: float


def recorded(config: Config, *, record: bool) -> dict[str, type[Node[Any]]]:
    """Return nodes that play the flight of a file in the place of those that fly it.

    Args:
        config: Of the run.
        record: Whether to fly it, if it is not kept; this takes as long as the flight alone.

    Returns:
        Classes by name of a node; none if it has to be flown by the run itself.
    """
    part = flight_of(config)
    if part is None:
        return {}
    folder = home() / content_key(part)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with _locked(folder):  # whoever comes second waits, and finds it
        flight = _read(folder)
        if flight is None:
            shutil.rmtree(folder, ignore_errors=True)
            flight = _written(part, folder) if record else None
        if flight is None or flight.unfit:
            return {}
        os.utime(folder)
        return stand_ins(config, flight, folder)


def home() -> Path:
    """Return the folder of all flights."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "visnav-runtime" / "flights"


def kept() -> list[Kept]:
    """Return the flights that are kept, the one used last first."""
    found = []
    for folder in home().glob("*"):
        with contextlib.suppress(OSError):  # removed meanwhile
            if folder.is_dir() and not folder.name.startswith("."):
                size = sum(file.stat().st_size for file in folder.iterdir())
                found.append(Kept(folder, size, folder.stat().st_mtime))
    return sorted(found, key=lambda each: -each.used)


def remove_beyond(gigabytes: float) -> list[Kept]:
    """Remove the flights that were not used for longest, and return them.

    What a run has open stays there for it. One that is being flown just now is left alone.
    """
    for unfinished in home().glob(".*/"):  # left by a process that was killed, unless it is locked
        folder = unfinished.with_name(unfinished.name[1:])
        with contextlib.suppress(BlockingIOError), _locked(folder, wait=False):
            shutil.rmtree(unfinished, ignore_errors=True)
    removed, taken = [], 0
    for each in kept():
        taken += each.size
        if taken > gigabytes * 1e9:
            with contextlib.suppress(BlockingIOError), _locked(each.folder, wait=False):
                shutil.rmtree(each.folder, ignore_errors=True)
                removed.append(each)
    return removed


def _written(part: Config, folder: Path) -> Flight | None:
    """Fly, and keep it if it can be used again or never can; `None` if it could not be flown."""
    new = folder.with_name(f".{folder.name}")
    shutil.rmtree(new, ignore_errors=True)
    new.mkdir()
    try:
        flight = fly(part, new)
        if flight.unfit:
            (new / EVENTS).write_bytes(b"")
        else:
            _remember(new)
        limit = float(os.environ.get("VISNAV_FLIGHTS_GB", LIMIT))
        remove_beyond(max(limit - flight.size / 1e9, 0.0))
        new.rename(folder)
    except (VisnavError, OSError):  # the run itself meets the same, and says so
        return None
    else:
        return flight
    finally:
        shutil.rmtree(new, ignore_errors=True)


def _read(folder: Path) -> Flight | None:
    """Return a flight, unless there is none or it is damaged."""
    try:
        flight = msgspec.msgpack.decode((folder / INDEX).read_bytes(), type=Flight)
        if (folder / EVENTS).stat().st_size != flight.size:
            return None
        if (folder / "checked").read_text() == _state(folder):
            return flight
        digest = xxhash.xxh3_128()
        with (folder / EVENTS).open("rb") as file:
            while chunk := file.read(_CHUNK):
                digest.update(chunk)
    except (OSError, msgspec.MsgspecError):
        return None
    if digest.hexdigest() != flight.checksum:
        return None
    _remember(folder)
    return flight


def _remember(folder: Path) -> None:
    """Note that a flight's events are as they were written, until the machine starts anew."""
    (folder / "checked").write_text(_state(folder))


def _state(folder: Path) -> str:
    found = (folder / EVENTS).stat()
    started = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    return f"{found.st_size} {found.st_mtime_ns} {started}"


@contextlib.contextmanager
def _locked(folder: Path, *, wait: bool = True) -> Iterator[None]:
    with folder.with_name(f".{folder.name}.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        yield
