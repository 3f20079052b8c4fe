"""The secret of a run: a process that has it may take part, and no other.

On one machine it is a random key in a file that only its user can read, made when it is first
needed; so nobody has to think of it. Processes on several machines, or of several users, are given
one by `network.secret`.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import stat
import tempfile
from pathlib import Path

from runtime.errors import CommandError, PeerError
from runtime.paths import user_folder

SHORTEST = 16
"""Characters of a secret at least."""


def secret_of(setting: str) -> bytes:
    """Return the secret that all processes of a run share.

    Args:
        setting: `network.secret`: ``env:NAME``, ``file:PATH``, the secret itself, or nothing for
            that of this user on this machine.

    Raises:
        PeerError: There is none, or others may read it.
    """
    kind, _, name = setting.partition(":")
    if kind == "env":
        found = os.environ.get(name, "")
    elif kind == "file":
        found = _read(Path(name).expanduser())
    else:
        found = setting or _of_this_user()
    if len(found) < SHORTEST:
        where = setting if kind in {"env", "file"} else "the file"
        raise PeerError(
            f"network.secret: expected at least {SHORTEST} characters in {where}, found "
            f"{len(found)}"
        )
    return found.encode()


def _of_this_user() -> str:
    try:
        path = user_folder() / "network.key"
        if not path.exists():
            _make(path)
        return _read(path)
    except (CommandError, OSError) as error:
        raise PeerError(
            f"network.secret: expected a private folder for the key of this machine, found: "
            f"{error}; name a secret"
        ) from None


def _make(path: Path) -> None:
    """Write a new key; of several processes that do so at once, one succeeds."""
    with tempfile.NamedTemporaryFile("w", dir=path.parent) as file:  # mode 0600
        file.write(secrets.token_hex(32))
        file.flush()
        with contextlib.suppress(FileExistsError):
            os.link(file.name, path)


def _read(path: Path) -> str:
    try:
        with path.open(encoding="utf-8") as file:
            mode = os.fstat(file.fileno()).st_mode
            if stat.S_IMODE(mode) & 0o077:
                raise PeerError(
                    f"network.secret: expected a file that only its user may read, found mode "
                    f"{stat.S_IMODE(mode):o}: {path}"
                )
            return file.read().strip()
    except (OSError, UnicodeDecodeError) as error:
        raise PeerError(f"network.secret: expected a secret in {path}, found: {error}") from None
