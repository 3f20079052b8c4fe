"""Files of a run with programs, kept from these until its end.

While a run has programs, its nodes write into a private folder, which no program is told of: truth,
plan, recording. When all nodes are down, whatever ended the run, its files take their place in the
run's folder, in an instant. Of a run that was killed it stays, and the next such run says where. It
is no guard against a program that searches the whole machine.
"""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from runtime.errors import ResultsError

log = logging.getLogger("visnav.runtime")


@contextlib.contextmanager
def private_results(out: Path) -> Iterator[Path]:
    """Yield a private folder for nodes' files, moved into the run's folder at the end."""
    base = _home()
    try:
        base.mkdir(parents=True, exist_ok=True, mode=0o700)
        if base.stat().st_dev != out.stat().st_dev:  # where moving would mean to copy
            base = out.parent / ".visnav-unfinished"
            base.mkdir(exist_ok=True, mode=0o700)
        made = Path(tempfile.mkdtemp(prefix=f".{out.absolute().parent.name}-{out.name}-", dir=base))
        shutil.copy(out / "config.toml", made)  # which recordings have in them
    except OSError as error:
        raise ResultsError(f"{base}: expected to write a run's results, found: {error}") from error
    with _private_results_locked(made):
        left = [entry.name for entry in sorted(base.glob("[!.]*")) if _is_left(entry)]
        if left:
            names = ", ".join(left[:3] + ["…"] * (len(left) > 3))
            log.warning("what killed runs have recorded is in %s: move or remove %s", base, names)
        private = made.rename(made.with_name(made.name[1:]))  # now that it has its lock
        try:
            yield private
        finally:
            try:
                _move_private_results(private, out)
                shutil.rmtree(private, ignore_errors=True)
            except OSError as error:
                log.error("what was recorded stays in %s: it cannot be moved: %s", private, error)


def _home() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "visnav-runtime" / "unfinished"


@contextlib.contextmanager
def _private_results_locked(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder; any end of the process releases the lock."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


def _is_left(folder: Path) -> bool:
    with contextlib.suppress(OSError), _private_results_locked(folder):
        return True
    return False


def _move_private_results(source: Path, target: Path) -> None:
    target.mkdir(parents=True, exist_ok=True)
    for entry in source.iterdir():
        destination = target / entry.name
        if entry.is_dir() and destination.is_dir():
            _move_private_results(entry, destination)
        else:
            entry.replace(destination)
