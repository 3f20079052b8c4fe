"""Where nodes write while a run has programs that must not see it: the truth, a plan, a recording.

Nobody tells a program of this folder. When all nodes are down, whatever ended the run, what is in
it takes its place in the run's folder, in an instant. Of a run that was killed it stays, and the
next such run says where. It is no guard against a program that searches the whole machine.
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
    """Make a folder for what nodes write, and put it into the run's own in the end.

    Raises:
        ResultsError: It cannot be made.
    """
    base = _home()
    try:
        base.mkdir(parents=True, exist_ok=True, mode=0o700)
        if base.stat().st_dev != out.stat().st_dev:  # where moving would mean to copy
            base = out.parent / ".visnav-unfinished"
            base.mkdir(exist_ok=True, mode=0o700)
        made = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=base))
        shutil.copy(out / "config.toml", made)  # which recordings have in them
    except OSError as error:
        raise ResultsError(f"{base}: expected to write a run's results, found: {error}") from error
    with _locked(made):
        left = [each.name for each in sorted(base.glob("[!.]*")) if _is_left(each)]
        if left:
            names = ", ".join(left[:3] + ["…"] * (len(left) > 3))
            log.warning("what killed runs have recorded is in %s: move or remove %s", base, names)
        private = made.rename(made.with_name(made.name[1:]))  # now that it has its lock
        try:
            yield private
        finally:
            try:
                _move(private, out)
                shutil.rmtree(private, ignore_errors=True)
            except OSError as error:
                log.error("what was recorded stays in %s: it cannot be moved: %s", private, error)


def _home() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "visnav-runtime" / "unfinished"


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder, which a process loses when it ends in any way.

    Raises:
        OSError: Another process has it, or it is no folder.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


def _is_left(folder: Path) -> bool:
    """Tell whether the run whose folder it is has ended without moving it."""
    with contextlib.suppress(OSError), _locked(folder):
        return True
    return False


def _move(source: Path, target: Path) -> None:
    """Move what is in a folder into another one, in the place of files of the same names."""
    target.mkdir(parents=True, exist_ok=True)
    for each in source.iterdir():
        there = target / each.name
        if each.is_dir() and there.is_dir():
            _move(each, there)
        else:
            each.replace(there)
