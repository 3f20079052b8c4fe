"""Commit of this project: of a checkout as git knows it, of an installed tool as of its build.

The build loads this file by its path, so it imports the standard library only.
"""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

RECORD = Path(__file__).with_name("commit.txt")
"""Written by the build (`tools/wheel.py`) beside this file; a checkout has none."""


def commit() -> str:
    """Return the commit that this project's files are of, with ``-dirty`` if some differ.

    The folder in which a command is called plays no part. Empty if nothing is known.
    """
    revision = of_repository(Path(__file__))
    if not revision and RECORD.is_file():
        revision = RECORD.read_text(encoding="ascii", errors="replace").strip()
    return revision


def write_commit(folder: Path) -> None:
    """Write the commit beside a copy of this file; of an unpacked archive, that archive's."""
    if revision := commit():
        folder.mkdir(parents=True, exist_ok=True)
        (folder / RECORD.name).write_text(f"{revision}\n", encoding="ascii")


def of_repository(file: Path) -> str:
    """Return the commit of the repository that a file belongs to, ``-dirty`` if that has changes.

    Empty if the file is none of a repository's own, such as one in an environment that only lies
    in somebody's checkout.
    """
    file = file.resolve()
    environment = {k: v for k, v in os.environ.items() if not k.startswith("GIT_")}  # of a hook

    def git(*words: str) -> str:
        return subprocess.run(  # noqa: S603
            ["git", "-C", str(file.parent), *words],  # noqa: S607
            env=environment, capture_output=True, text=True, check=True, timeout=5.0,
        ).stdout.strip()  # fmt: skip

    try:
        git("ls-files", "--error-unmatch", "--", file.name)
        return git("describe", "--always", "--dirty")
    except (OSError, subprocess.SubprocessError):
        return ""
