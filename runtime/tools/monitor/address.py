"""Where runs listen: each at a Unix socket, in a folder that only its user can enter."""

from __future__ import annotations

import os
import re
import socket
from pathlib import Path

from runtime.errors import CommandError, suggest
from runtime.paths import user_folder

_LONGEST = 100
"""Bytes of a Unix socket's path at most (108 on Linux, 104 elsewhere)."""


def socket_of(run: str) -> Path:
    """Return the path of the socket for a run of this process.

    Raises:
        CommandError: The folder cannot be used, or others could enter it.
    """
    place, end = user_folder(), f"-{os.getpid()}.sock"
    for other in place.glob("*.sock"):  # what killed runs have left is removed
        _answers(other)
    name = re.sub(r"[^\w.-]", "_", run)
    room = _LONGEST - len(os.fsencode(place)) - 1 - len(end)
    short = os.fsencode(name)[: max(room, 1)].decode(errors="ignore")
    return place / f"{short}{end}"


def runs() -> dict[str, Path]:
    """Return the runs that listen now, by name; ``name-process`` where two have the same name."""
    listening = [path for path in sorted(user_folder().glob("*.sock")) if _answers(path)]
    names = [path.stem.rpartition("-")[0] for path in listening]
    return {
        path.stem if names.count(name) > 1 else name: path
        for name, path in zip(names, listening, strict=True)
    }


def find(run: str | None) -> Path:
    """Return the path of a run's socket.

    Args:
        run: Its name, ``name-process`` if there are two, or the path of its socket; `None` if
            there is only one.

    Raises:
        CommandError: There is no such run, no run at all, or several without a name given.
    """
    if run is not None and run.endswith(".sock"):
        return Path(run)
    found = runs()
    listed = ", ".join(found)
    if not found:
        raise CommandError("expected a run to look at, found none that goes on")
    if run is None and len(found) > 1:
        raise CommandError(f"expected the name of one of several runs: {listed}")
    if run is not None and run not in found:
        raise CommandError(f"expected one of {listed}; found {run!r}{suggest(run, found)}")
    return found[run] if run is not None else next(iter(found.values()))


def _answers(path: Path) -> bool:
    """Tell whether a run listens at a socket; remove one that a killed run has left."""
    with socket.socket(socket.AF_UNIX) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(str(path))
        except (ConnectionRefusedError, FileNotFoundError):
            if path.is_socket():  # of a file, a connection is refused as well
                path.unlink(missing_ok=True)
            return False
        except OSError:
            return False
    return True
