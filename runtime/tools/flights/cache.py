"""Flights by their content, in ``~/.cache/visnav-runtime/flights``.

``VISNAV_FLIGHTS_GB`` says how much they may take (20 if it does not); of more, those that were not
used for longest are removed. A flight is written by one process at a time, and as a whole.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import logging
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from runtime.config.model import Config
from runtime.errors import VisnavError
from runtime.node import Node
from runtime.tools.flights.player import opened, stand_ins
from runtime.tools.flights.recorder import content_key, flight_of
from runtime.tools.flights.recorder import record as fly

_LOG = logging.getLogger("visnav.flights")

LIMIT = 20.0  # gigabytes, unless ``VISNAV_FLIGHTS_GB`` says otherwise


class Kept(NamedTuple):
    """A kept flight: its file, size (bytes), and time of last use (s)."""

    path: Path
    size: int
    used: float


def recorded(config: Config, *, record: bool) -> dict[str, type[Node[Any]]]:
    """Return stand-ins for the flying nodes of a file, playing their recorded flight.

    There are none if the run itself has to fly. With `record`, a flight that is not kept is flown.
    """
    part = flight_of(config)
    if part is None:
        return {}
    path = home() / f"{content_key(part)}.flight"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for each in (path, _unfinished(path)):
            if each.exists() and not each.is_file():
                raise OSError(errno.EEXIST, "what is no file", str(each))
        with _locked(path):  # whoever comes second waits, and finds it
            found = opened(path)
            if found is None and record:
                _write(part, path)
                found = opened(path)
            if found is None or found[0].unfit:
                return {}
            os.utime(path)
    except OSError as error:
        what = f"{error.filename or home()}: {error.strerror}"
        _LOG.warning("expected a cache of flights, found %s: the run flies itself", what)
        return {}
    return stand_ins(config, *found)


def home() -> Path:
    """Return the folder of all flights."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "visnav-runtime" / "flights"


def kept() -> list[Kept]:
    """Return the kept flights, the last used first."""
    found = []
    for path in home().glob("[!.]*.flight"):
        with contextlib.suppress(OSError):  # removed meanwhile
            if path.is_file():
                found.append(Kept(path, path.stat().st_size, path.stat().st_mtime))
    return sorted(found, key=lambda each: -each.used)


def remove_beyond(gigabytes: float) -> list[Kept]:
    """Remove the least recently used flights beyond `gigabytes`, and return them.

    What a run has open stays there for it. One that is being flown just now is left alone.
    """
    for unfinished in home().glob(".*.new"):  # left by a process that was killed, unless locked
        if unfinished.is_file():
            _remove(unfinished, unfinished.with_name(unfinished.stem[1:]))
    sizes = 0
    beyond = [each for each in kept() if (sizes := sizes + each.size) > gigabytes * 1e9]
    return [each for each in beyond if _remove(each.path, each.path)]


def _remove(file: Path, flight: Path) -> bool:
    """Remove a file of a flight, unless the flight is locked; tell whether removed."""
    with contextlib.suppress(OSError), _locked(flight, wait=False):
        file.unlink(missing_ok=True)
        return True
    return False


def _write(part: Config, path: Path) -> None:
    new = _unfinished(path)
    try:
        fly(part, new)
        limit = float(os.environ.get("VISNAV_FLIGHTS_GB", LIMIT))
        remove_beyond(max(limit - new.stat().st_size / 1e9, 0.0))
        new.rename(path)
    except (VisnavError, OSError):  # the run itself meets the same, and says so
        pass
    finally:
        new.unlink(missing_ok=True)


def _unfinished(path: Path) -> Path:
    return path.with_name(f".{path.name}.new")


@contextlib.contextmanager
def _locked(path: Path, *, wait: bool = True) -> Iterator[None]:
    # Neither a pipe of this name nor a link makes it wait for ever, or write elsewhere.
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
    file = os.open(path.with_name(f".{path.name}.lock"), flags, 0o644)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        yield
    finally:
        os.close(file)
