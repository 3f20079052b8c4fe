"""Packages beside ours: `events`, and optional libraries, as extras of the package."""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import subprocess
import sys
from pathlib import Path
from typing import Any


def check_events() -> None:
    """Check where the package `events` comes from.

    Raises:
        ImportError: It is another project's; `name` is then ``runtime``, so that
            ``python -m runtime`` prints one line instead of a traceback.
    """
    expected = Path(__file__).resolve().parents[1] / "events" / "__init__.py"
    try:
        events = importlib.import_module("events")
        found = Path(events.__file__ or "?").resolve()
        ours = found == expected and hasattr(events, "PoseEstimate")
    except ModuleNotFoundError as error:
        if error.name != "events":
            raise
        found, ours = Path("none"), False
    if not ours:
        over = " installed over it" if found == expected else ""
        raise ImportError(
            f"expected the package events of visnav-runtime in {expected.parent}, found {found}"
            f"{over}: another package of this name stands in the way; remove or rename it",
            name="runtime",
        )


check_events()  # an import of the runtime reports it before anything else fails


_PROJECT = Path(__file__).parents[1] / "pyproject.toml"


def install_command(extra: str) -> str:
    """Return the command to install an extra's libraries, for the message of an error.

    In a checkout, the command names the extra. A wheel's package is in no index, so that its extra
    cannot be asked for by name: there, the command names the libraries.
    """
    if _PROJECT.is_file():
        return f"pip install -e '.[{extra}]'"
    try:
        required = importlib.metadata.requires("visnav-runtime") or []
    except importlib.metadata.PackageNotFoundError:
        required = []
    wanted = [
        requirement.partition(";")[0].strip()
        for requirement in required
        if f"extra == '{extra}'" in requirement.replace('"', "'")
    ]
    return f"pip install {' '.join(repr(each) for each in wanted or [f'visnav-runtime[{extra}]'])}"


def why_missing(library: str) -> str:
    """Return why a worker's library is not importable; empty if importable.

    An installed library is tried in another process: its system libraries may be missing.
    """
    modules: dict[str, Any] = {**sys.modules}
    if modules.get(library):
        return ""
    if library in modules or importlib.util.find_spec(library) is None:  # None: kept from import
        return f"No module named '{library}'"
    command = [sys.executable, "-c", f"import {library}"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    last = [f"exit code {done.returncode}", *done.stderr.strip().splitlines()][-1]
    return last if done.returncode else ""
