"""Virtual environments with AirSim's own clients: made once, and kept in the user's cache.

The clients need other packages than this project (numpy 1, an old msgpack), so that they cannot be
installed beside it; the environments are found again by what is installed in them.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

COMMON = ("numpy<2", "opencv-python-headless<4.12")
TOO_NEW = (3, 13)
"""The first Python for which there is no numpy 1."""


class Client(NamedTuple):
    """A client, and how it is installed.

    Attributes:
        module: What a script imports.
        steps: Arguments of ``pip install``, one after the other.
    """

    module: str
    steps: tuple[tuple[str, ...], ...]


CLIENTS = {
    "airsim": Client(
        "airsim",
        (
            (*COMMON, "setuptools<81", "wheel", "msgpack-rpc-python==0.4.1"),
            ("backports.ssl_match_hostname",),  # of which tornado 4.5 has need from Python 3.12 on
            ("--no-build-isolation", "--no-deps", "airsim==1.8.1"),
        ),
    ),
    "cosysairsim": Client("cosysairsim", ((*COMMON, "cosysairsim==3.5.0"),)),
}
NO_NETWORK = ("NewConnectionError", "ConnectTimeoutError", "NameResolutionError", "ProxyError")


def python_of(name: str) -> Path:
    """Return the Python of an environment with a client, which is made if it is not there.

    The test is skipped where there is no Python that is old enough, or no network.
    """
    client = CLIENTS[name]
    pins = repr((client, Path(_old_python()).resolve()))
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    key = hashlib.md5(pins.encode()).hexdigest()[:10]
    folder = cache / "visnav-runtime" / "clients" / f"{name}-{key}"
    folder.parent.mkdir(parents=True, exist_ok=True)
    with folder.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # of several tests at a time, one makes it
        if not (folder / "complete").exists():
            _make(client, folder)
            (folder / "complete").touch()
    return folder / "bin" / "python"


def _old_python() -> str:
    if sys.version_info < TOO_NEW:
        return sys.executable
    for version in ("3.12", "3.11"):
        if interpreter := shutil.which(f"python{version}"):
            return interpreter
    pytest.skip("AirSim's clients need numpy 1, and so a Python of 3.12 or before: there is none")


def _make(client: Client, folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    subprocess.run([_old_python(), "-m", "venv", str(folder)], check=True)
    for step in client.steps:
        command = [str(folder / "bin" / "python"), "-m", "pip", "install", "--retries", "1", *step]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode and any(sign in done.stdout + done.stderr for sign in NO_NETWORK):
            pytest.skip(f"there is no network to install {client.module} from")
        assert done.returncode == 0, done.stdout + done.stderr
