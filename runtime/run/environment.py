"""What figures depend on besides the file: machine, versions, command line and commit."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import re
import shlex
import subprocess
import sys
from pathlib import Path


def environment() -> dict[str, str]:
    """Return what a figure depends on: machine, Python and the libraries' versions."""
    libraries = [
        "visnav-runtime",
        "numpy",
        "mujoco",
        "opencv-python-headless",
        "scipy",
        "uvloop",
        "msgspec",
    ]
    versions = {}
    for library in libraries:
        try:
            versions[library] = importlib.metadata.version(library)
        except importlib.metadata.PackageNotFoundError:
            versions[library] = "not installed"
    return {
        "system": f"{platform.system()} {platform.release().partition('-')[0]}",
        "processor": platform.machine(),
        "cores": str(os.cpu_count()),
        "python": platform.python_version(),
        **versions,
    }


_SECRET = re.compile(r"(secret\s*=\s*)(?!\W*(?:file|env):).*", re.DOTALL)
"""A secret in a setting of the command line, unless it only says where the secret is."""


def command_line() -> str:
    """Return the command that started this process, without Python's folder and secrets."""
    program, *arguments = sys.orig_argv
    shown = [_SECRET.sub(r"\1…", each) for each in arguments]
    return shlex.join([Path(program).name, *shown])


def commit(folder: Path | None = None) -> str:
    """Return the commit of a folder's files, with ``-dirty`` if they differ; empty without git.

    Args:
        folder: Somewhere in a repository; the current folder if not given.
    """
    command = ["git", "describe", "--always", "--dirty"]
    try:
        done = subprocess.run(  # noqa: S603
            command, cwd=folder, capture_output=True, text=True, check=True, timeout=5.0
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout.strip()
