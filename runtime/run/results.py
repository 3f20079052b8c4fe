"""A run's folder: its name, its owner, and files written as a whole or not at all.

Without a folder of the user's a run gets one by time, ``runs/NAME/20261123-154012``, and with its
first update the link ``runs/NAME/latest`` names it. A folder that the runtime has made has a marker
in it, which says what process uses it and when its first update was; that process holds a lock on
it. A run removes nobody's results: where it is given the folder of an earlier one, that one is
renamed by its time. Not here: what nodes write, and where while programs run
(`runtime.run.private_results`).
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import itertools
import logging
import os
import re
import shutil
import stat
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import tomli_w

from runtime.config.model import Config, to_builtins
from runtime.errors import ResultsError
from runtime.paths import not_utf8
from runtime.summary import Summary

log = logging.getLogger("visnav.runtime")

MARKER = ".visnav-run"
LATEST = "latest"
SIGNS = ("summary.json", "config.toml", "log.txt", "trajectories", "evaluation")
"""Files and folders of a run; any of them marks a run's folder."""

_MARK = "A run made this folder; one that is given it by --out renames it to NAME.TIME.\n"
_STARTED, _FLOWN = "process: ", "first update"


class Folder:
    """The folder of a run, made and locked against other runs while in its context.

    Args:
        path: New, empty, or an earlier run's, which is renamed: ``tour.20261123-154012``.
        by_time: Whether to make a folder in `path`, and there the link ``latest``.

    Attributes:
        path: Of this run; by time only within the context.
        earlier: Where the earlier run is now; `None` if there was none in the way.

    Raises:
        ResultsError: On entering: another run uses the folder, it holds what no run has made, or it
            cannot be written.
    """

    def __init__(self, path: Path, *, by_time: bool = False) -> None:
        self.path = path
        self.earlier: Path | None = None
        self._by_time = by_time

    def __enter__(self) -> Folder:
        path = self.path
        if why := not_utf8(path.absolute()):
            raise ResultsError(f"folder of results: {why}")
        with _readable(path):
            if path.is_symlink() or path.name in {"", ".."}:
                path = Path(os.path.realpath(path))
            path.parent.mkdir(parents=True, exist_ok=True)
            with _locked(path.parent):
                if has_run(path):
                    self.earlier = _new(path.parent, f"{path.name}.", time_of(path))
                    with os.fdopen(_lock(path)):
                        path.rename(self.earlier)
                self.path = _new(path, "", time.time()) if self._by_time else path
                claim(self.path)
                self._marker = _lock(self.path)
            os.write(self._marker, f"{_STARTED}{os.getpid()}\n".encode())
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._marker)

    def flown(self) -> None:
        """Note the first update: from here on ``latest`` is this run; or raise `ResultsError`."""
        with _readable(self.path):
            os.write(self._marker, f"{_FLOWN}\n".encode())
        if self._by_time:
            _link(self.path.with_name(LATEST), self.path.name)


def run_folder(path: Path) -> Path:
    """Return the run's folder meant by a path: itself or its ``latest``; else `ResultsError`."""
    folder = newest(path)
    if any((folder / sign).exists() for sign in SIGNS):
        return folder
    inside = "none"
    if folder != path:
        inside = f"a link to {folder.name}, which is none"
    elif path.is_dir():
        inside = ", ".join(sorted(entry.name for entry in path.iterdir())[:5]) or "nothing in it"
    raise ResultsError(
        f"{path}: expected the folder of a run, with {', '.join(SIGNS[:-1])} or {SIGNS[-1]} in it, "
        f"or one with a link {LATEST} to such a folder, found {inside}"
    )


def newest(path: Path) -> Path:
    """Return the folder that ``latest`` in a folder links to; the path itself if it has none."""
    link = path / LATEST
    return path / link.readlink() if link.is_symlink() and not has_run(path) else path


def has_run(folder: Path) -> bool:
    """Return whether a run has begun in a folder."""
    return _STARTED in _marked(folder) or all((folder / sign).is_file() for sign in SIGNS[:3])


def has_flown(folder: Path) -> bool:
    """Return whether the run in a folder has come to its first update."""
    marked = _marked(folder)
    return _FLOWN in marked or _STARTED not in marked


def time_of(folder: Path) -> float:
    """Return the time of a run's first update, or else of its start (Unix time, seconds)."""
    marker = folder / MARKER
    return (marker if marker.exists() else folder / SIGNS[0]).stat().st_mtime


def clear(out: Path) -> None:
    """Make an empty folder in place of an earlier run's; raise `ResultsError` if it is not ours."""
    claim(out)
    os.close(_lock(out))
    shutil.rmtree(out)
    claim(out)


def claim(out: Path) -> None:
    """Make a folder, or take an empty one or a run's, and mark it; else raise `ResultsError`."""
    if why := not_utf8(out.absolute()):
        raise ResultsError(f"folder of results: {why}")
    out.mkdir(parents=True, exist_ok=True)
    marker = out / MARKER
    if marker.is_file():
        return
    if os.path.lexists(marker):
        raise ResultsError(f"{marker}: expected a file, which a run has made, found none")
    if names := sorted(entry.name for entry in out.iterdir()):
        raise ResultsError(
            f"{out}: expected a new or empty folder, or one that a run has made (with a "
            f"{MARKER} in it), found {names[0]!r}: name another with --out, or remove it"
        )
    marker.write_text(_MARK, encoding="utf-8")


def _marked(folder: Path) -> str:
    with contextlib.suppress(OSError), os.fdopen(_open(folder, os.O_RDONLY), "rb") as marker:
        return marker.read().decode(errors="replace")
    return ""


def _open(folder: Path, flags: int) -> int:
    """Open a folder's marker without waiting, or raise `OSError` if it is no file (a fifo, say)."""
    marker = os.open(folder / MARKER, flags | os.O_NONBLOCK, 0o666)
    if not stat.S_ISREG(os.fstat(marker).st_mode):
        os.close(marker)
        raise FileExistsError(errno.EEXIST, "expected a file, found none", str(folder / MARKER))
    return marker


def _lock(folder: Path) -> int:
    marker = _open(folder, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW)
    try:
        fcntl.flock(marker, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(marker)
        numbers = re.findall(rf"{_STARTED}(\d+)", _marked(folder))
        raise ResultsError(
            f"{folder}: expected a folder that no other run uses, found that of process "
            f"{numbers[-1] if numbers else '?'}, which still runs: name another with --out, or "
            "end that one first"
        ) from None
    except OSError:  # a file system without locks
        pass
    return marker


def _new(folder: Path, prefix: str, when: float) -> Path:
    """Return a path that is not there yet, by local time: ``20261123-154012``, then ``…-2``."""
    first = prefix + time.strftime("%Y%m%d-%H%M%S", time.localtime(when))
    names = itertools.chain([first], (f"{first}-{number}" for number in itertools.count(2)))
    return next(folder / name for name in names if not os.path.lexists(folder / name))


def _link(link: Path, name: str) -> None:
    """Have a link lead to a folder beside it, in an instant; what is no link is left alone."""
    try:
        if os.path.lexists(link) and not link.is_symlink():
            raise FileExistsError(errno.EEXIST, "it is no link")
        new = link.with_name(f".{LATEST}.{name}")
        new.symlink_to(name)
        new.replace(link)
    except OSError as error:
        log.warning("%s does not lead to %s: %s", link, name, error.strerror)


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    number = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        with contextlib.suppress(OSError):  # a file system without locks
            fcntl.flock(number, fcntl.LOCK_EX)
        yield
    finally:
        os.close(number)


def write(path: Path, content: bytes) -> None:
    """Write a file as a whole, or raise `OSError` and leave what was there."""
    with replacing(path) as new, new.open("wb") as file:
        file.write(content)
        file.flush()
        if new != path:
            os.fsync(file.fileno())


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a path for a new file, then move the new file to `path`, unless an error is raised.

    Only a file is ever replaced. A link stays, and so does a device, which is written to itself.
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
    """Write all settings of a run as ``config.toml``, or raise `ResultsError`."""
    with _readable(out):
        write(out / "config.toml", tomli_w.dumps(to_builtins(config)).encode())


def write_summary(out: Path, summary: Summary) -> None:
    """Write a run's ``summary.json``, in a new folder if need be; or raise `ResultsError`."""
    encoded = msgspec.json.format(msgspec.json.encode(summary, enc_hook=_plain), indent=2)
    with _readable(out):
        if not out.is_dir():
            claim(out)
        write(out / "summary.json", encoded + b"\n")


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
