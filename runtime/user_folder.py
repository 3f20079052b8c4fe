"""Private folder of a user, for sockets."""

from __future__ import annotations

import os
import stat
import tempfile
from pathlib import Path

from runtime.errors import CommandError


def user_folder() -> Path:
    """Return the folder, made if missing.

    Raises:
        CommandError: It cannot be made, or others than its user may get at it.
    """
    base = os.environ.get("XDG_RUNTIME_DIR")
    path = Path(base) / "visnav" if base else Path(tempfile.gettempdir()) / f"visnav-{os.getuid()}"
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = path.lstat()
    except OSError as error:
        raise CommandError(f"{path}: expected a folder for sockets: {error.strerror}") from None
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & 0o077:
        raise CommandError(
            f"{path}: expected a folder that only its user may enter, found mode "
            f"{stat.S_IMODE(status.st_mode):o} of user {status.st_uid}"
        )
    return path
