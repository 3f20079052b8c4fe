"""A run's folder: whose it is, and files in it that are written as a whole or not at all.

A folder that the runtime has made has a marker in it, and only such a folder is ever cleared.
Not here: what nodes write.
"""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import tomli_w

from runtime.config.model import Config, to_builtins
from runtime.errors import ResultsError
from runtime.summary import Summary

MARKER = ".visnav-run"
_MARK = "A run made this folder; the next one that is given it removes what this one has left.\n"
_SUMMARY_OF_OURS = {"clock", "seed", "reason", "digest", "sim_seconds", "announcements"}


def prepare(out: Path, config: Config) -> None:
    """Make a run's folder, or clear it of what an earlier run has left; recordings stay.

    Raises:
        ResultsError: It holds what no run has made, or it cannot be written.
    """
    with _readable(out):
        claim(out)
        for name in ("summary.json", "report.html"):
            (out / name).unlink(missing_ok=True)
        for name in ("evaluation", "trajectories", "frames", "plots", "answers"):
            shutil.rmtree(out / name, ignore_errors=True)
        write(out / "config.toml", tomli_w.dumps(to_builtins(config)).encode())


def keep_earlier(out: Path) -> Path | None:
    """Move the folder of an earlier run to ``NAME.1``, in the place of what was kept there before.

    Returns:
        Where it is now; `None` if there is no folder that a run has made.

    Raises:
        ResultsError: It cannot be moved, or ``NAME.1`` is not a run's.
    """
    if not (out / MARKER).is_file():
        return None
    kept = out.with_name(f"{out.name}.1")
    with _readable(out):
        claim(kept)
        shutil.rmtree(kept)
        out.rename(kept)
    return kept


def claim(out: Path) -> None:
    """Make a folder, if it is missing, and mark it as a run's.

    Raises:
        ResultsError: There is something in it, and no run has made it.
        OSError: It cannot be made.
    """
    out.mkdir(parents=True, exist_ok=True)
    marker = out / MARKER
    if marker.is_file():
        return
    found = next(iter(sorted(each.name for each in out.iterdir())), None)
    if found is not None and not _of_an_earlier_version(out):
        raise ResultsError(
            f"{out}: expected a new or empty folder, or one that a run has made (with a "
            f"{MARKER} in it), found {found!r}: name another with --out, or remove it"
        )
    marker.write_text(_MARK, encoding="utf-8")


def write(path: Path, content: bytes) -> None:
    """Write a file: as a whole, or not at all.

    Raises:
        OSError: It cannot be written; what was there before is as it was.
    """
    new = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with new.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        new.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            new.unlink(missing_ok=True)
        raise


def write_summary(out: Path, summary: Summary) -> None:
    """Write a run's ``summary.json``, and make the folder anew if somebody has removed it.

    Raises:
        ResultsError: It cannot be written.
    """
    encoded = msgspec.json.format(msgspec.json.encode(summary, enc_hook=_plain), indent=2)
    with _readable(out):
        if not out.is_dir():
            claim(out)
        write(out / "summary.json", encoded + b"\n")


def _of_an_earlier_version(out: Path) -> bool:
    """Tell whether a folder without a marker has a summary that only a run can have written."""
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
    """Return what JSON knows for a value that a node handed over, lest one lose all others."""
    for convert in ("item", "tolist"):
        if hasattr(value, convert):
            with contextlib.suppress(Exception):
                return getattr(value, convert)()
    return repr(value)
