"""A run's folder: its owner, and files written as a whole or not at all.

A folder that the runtime has made has a marker in it, and only such a folder is ever moved or
removed. The marker says which process uses it, when its first update was, and in the end which
files it has made; that process holds a lock on it. Not here: what nodes write.

While a run has programs, its nodes write into a private folder, which no program is told of: truth,
plan, recording. When all nodes are down, whatever ended the run, its files take their place in the
run's folder, in an instant. Of a run that was killed it stays, and the next such run says where. It
is no guard against a program that searches the whole machine.
"""

from __future__ import annotations

import contextlib
import datetime as dt
import errno
import fcntl
import itertools
import logging
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

import msgspec
import tomli_w

from runtime.config.model import Config, to_builtins
from runtime.errors import ResultsError
from runtime.summary import Summary

log = logging.getLogger("visnav.runtime")

MARKER = ".visnav-run"
_MARK = "A run made this folder; the next one that is given it moves it to NAME.1.\n"
_SUMMARY_OF_OURS = {"clock", "seed", "reason", "digest", "sim_seconds", "announcements"}


class Folder:
    """The folder of a run, locked against other runs.

    An earlier run that is in it is put aside. With the first update it becomes ``NAME.1``, in the
    place of what was kept there before; if there is none, it comes back, and the start that failed
    goes to ``NAME.failed``.

    Args:
        out: Of the run; made if missing.

    Raises:
        ResultsError: Another run uses it, it holds what no run has made, or it cannot be written.
    """

    def __init__(self, out: Path) -> None:
        with _readable(out):
            if out.is_symlink() or out.name in {"", ".."}:
                out = Path(os.path.realpath(out))
            self._out, self._flown = out, False
            self._aside = out.parent / f".{out.name}.earlier"
            self._kept, self._failed = (out.parent / f"{out.name}.{end}" for end in ("1", "failed"))
            out.mkdir(parents=True, exist_ok=True)
            with _locked(out.parent):
                self._marker = _mark(out)
                try:
                    self._take()
                except BaseException:
                    os.close(self._marker)
                    raise

    def __enter__(self) -> Folder:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        with _readable(self._out), _locked(self._out.parent):
            made = (f"made: {file}\n" for file in sorted(_files(self._out)))
            os.write(self._marker, "".join(made).encode(errors="surrogateescape"))
            if not self._flown and self._aside.exists():
                self._give_back()
                print(
                    f"warning: {self._out} is as it was: the start that failed is in "
                    f"{self._failed}",
                    file=sys.stderr,
                )
            os.close(self._marker)

    def flown(self) -> None:
        """Note the first update: from here on the earlier run is ``NAME.1``.

        Raises:
            ResultsError: It cannot be moved there.
        """
        with _readable(self._out), _locked(self._out.parent):
            if self._aside.exists():
                _move(self._aside, self._kept)
                log.info("the earlier run in %s is now %s", self._out, self._kept)
            now = dt.datetime.now(dt.UTC).isoformat(timespec="seconds")
            os.write(self._marker, f"first update: {now}\n".encode())
            self._flown = True

    def _take(self) -> None:
        """Move an earlier run aside, and write this process into the marker."""
        if self._aside.exists():  # a start was killed
            self._give_back()
        for place in (self._kept, self._failed):
            _check(place)
        marked = _read(self._marker)
        started = "process: " in marked
        if "first update: " in marked or (not started and _has_summary_of_ours(self._out)):
            self._move_away(self._aside)
        elif started:
            self._move_away(self._failed)
        os.write(self._marker, f"process: {os.getpid()}\n".encode())

    def _give_back(self) -> None:
        """Restore the earlier run; the present content goes to ``NAME.failed``."""
        if self._out.exists():
            _move(self._out, self._failed)
        self._aside.rename(self._out)
        self._mark_anew()

    def _move_away(self, place: Path) -> None:
        _move(self._out, place)
        self._mark_anew()

    def _mark_anew(self) -> None:
        before, self._marker = self._marker, _mark(self._out)
        os.close(before)


def clear(out: Path) -> None:
    """Make an empty folder for a run to come, in place of an earlier run's.

    Raises:
        ResultsError: A run uses the folder, or no run has made it.
        OSError: The folder cannot be made.
    """
    os.close(_mark(out))
    shutil.rmtree(out)
    claim(out)


def claim(out: Path) -> None:
    """Make a folder, if missing, and mark the folder as a run's.

    Raises:
        ResultsError: There is something in it, and no run has made it.
        OSError: It cannot be made.
    """
    out.mkdir(parents=True, exist_ok=True)
    _check(out)
    marker = out / MARKER
    if not marker.is_file():
        marker.write_text(_MARK, encoding="utf-8")


def _check(out: Path) -> None:
    """Raise `ResultsError` for a non-empty folder not made by a run."""
    if not out.exists() or (out / MARKER).is_file() or _has_summary_of_ours(out):
        return
    found = next(iter(sorted(each.name for each in out.iterdir())), None)
    if found is not None:
        raise ResultsError(
            f"{out}: expected a new or empty folder, or one that a run has made (with a "
            f"{MARKER} in it), found {found!r}: name another with --out, or remove it"
        )


def _mark(out: Path) -> int:
    """Claim a folder, and return its marker, open and locked.

    Raises:
        ResultsError: A run uses it.
    """
    claim(out)
    marker = os.open(out / MARKER, os.O_RDWR | os.O_APPEND | os.O_NOFOLLOW)
    try:
        fcntl.flock(marker, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        numbers = re.findall(r"process: (\d+)", _read(marker))
        os.close(marker)
        raise ResultsError(
            f"{out}: expected a folder that no other run uses, found that of process "
            f"{numbers[-1] if numbers else '?'}, which still runs: name another with --out, or "
            "end that one first"
        ) from None
    except OSError:  # a file system without locks
        pass
    return marker


def _read(marker: int) -> str:
    return os.pread(marker, 1000, 0).decode(errors="replace")


def _move(source: Path, place: Path) -> None:
    """Move a run's folder to `place`, and remove a folder of only a run's files there.

    Else that one is kept, by the first free number from 2 on.
    """
    _check(place)
    if place.exists():
        marked = (place / MARKER).read_bytes().decode(errors="surrogateescape").splitlines()
        made = {line.removeprefix("made: ") for line in marked}
        if others := sorted(_files(place) - made):
            numbers = itertools.count(2)
            names = (place.with_name(f"{place.stem}.{number}") for number in numbers)
            kept = next(name for name in names if not os.path.lexists(name))
            place.rename(kept)
            log.warning("%s is kept: its run is not known to have made %s", kept, others[0])
        else:
            shutil.rmtree(place)
    source.rename(place)


def _files(folder: Path) -> set[str]:
    """Return the files in a run's folder, as relative paths, without the marker."""
    found = (path for path in folder.rglob("*") if path.is_symlink() or not path.is_dir())
    return {str(path.relative_to(folder)) for path in found} - {MARKER}


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder while its runs are moved."""
    number = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        with contextlib.suppress(OSError):  # a file system without locks
            fcntl.flock(number, fcntl.LOCK_EX)
        yield
    finally:
        os.close(number)


def write(path: Path, content: bytes) -> None:
    """Write a file: as a whole, or not at all.

    Raises:
        OSError: It cannot be written; what was there before is as it was.
    """
    with replacing(path) as new, new.open("wb") as file:
        file.write(content)
        file.flush()
        if new != path:
            os.fsync(file.fileno())


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a path for a new file, then move the new file to `path`.

    Only a file is ever replaced. A link stays, and so does a device, which is written to itself.

    Raises:
        OSError: What is there can be neither replaced nor written to, or the block raises it; then
            `path` is as it was.
    """
    if path.is_symlink():
        path = Path(os.path.realpath(path))
    if path.is_char_device():
        yield path
        return
    if path.exists() and not path.is_file():
        raise FileExistsError(errno.EEXIST, "expected a file there, found none", str(path))
    new = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        yield new
        new.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            new.unlink(missing_ok=True)
        raise


def write_config(out: Path, config: Config) -> None:
    """Write all settings of a run as ``config.toml``.

    Raises:
        ResultsError: It cannot be written.
    """
    with _readable(out):
        write(out / "config.toml", tomli_w.dumps(to_builtins(config)).encode())


def write_summary(out: Path, summary: Summary) -> None:
    """Write a run's ``summary.json``; a folder removed meanwhile is made anew.

    Raises:
        ResultsError: The file cannot be written.
    """
    encoded = msgspec.json.format(msgspec.json.encode(summary, enc_hook=_plain), indent=2)
    with _readable(out):
        if not out.is_dir():
            claim(out)
        write(out / "summary.json", encoded + b"\n")


def _has_summary_of_ours(out: Path) -> bool:
    """Tell whether a folder has a ``summary.json`` written by a run."""
    try:
        found = msgspec.json.decode((out / "summary.json").read_bytes())
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(found, dict) and set(found) >= _SUMMARY_OF_OURS


@contextlib.contextmanager
def _readable(out: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        what = error.strerror or str(error)
        raise ResultsError(
            f"{error.filename or out}: expected to write a run's results, found: {what}"
        ) from error


def _plain(value: Any) -> Any:
    """Return a node's value as plain data for JSON; its `repr` rather than an error."""
    for convert in ("item", "tolist"):
        if hasattr(value, convert):
            with contextlib.suppress(Exception):
                return getattr(value, convert)()
    return repr(value)


@contextlib.contextmanager
def private_results(out: Path) -> Iterator[Path]:
    """Yield a private folder for nodes' files, moved into the run's folder at the end.

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
    with _private_results_locked(made):
        left = [each.name for each in sorted(base.glob("[!.]*")) if _is_left(each)]
        if left:
            names = ", ".join(left[:3] + ["…"] * (len(left) > 3))
            log.warning("what killed runs have recorded is in %s: move or remove %s", base, names)
        private = made.rename(made.with_name(made.name[1:]))  # now that it has its lock
        try:
            yield private
        finally:
            try:
                _private_results_move(private, out)
                shutil.rmtree(private, ignore_errors=True)
            except OSError as error:
                log.error("what was recorded stays in %s: it cannot be moved: %s", private, error)


def _home() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "visnav-runtime" / "unfinished"


@contextlib.contextmanager
def _private_results_locked(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder; any end of the process releases the lock.

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
    """Tell whether a private folder was left behind by a run already ended."""
    with contextlib.suppress(OSError), _private_results_locked(folder):
        return True
    return False


def _private_results_move(source: Path, target: Path) -> None:
    """Move a folder's content into another folder, replacing files of the same names."""
    target.mkdir(parents=True, exist_ok=True)
    for each in source.iterdir():
        there = target / each.name
        if each.is_dir() and there.is_dir():
            _private_results_move(each, there)
        else:
            each.replace(there)
