"""Programs in C++, the thesis's client among them: compiled into a cache, run, and read.

Sources are in ``bench/systems/cpp``. A program is compiled again when a source, the compiler or
what it is linked with has changed. Programs write their samples as raw int64.

The thesis's client is written anew from its description: ``cpp/thesis_client.hpp``. Delivery is
synchronous and nested: the sample covers the ping through all nodes in order, the pong back through
all nodes until node 1 handles it, and one reading of the clock, which is most of it at N = 2. A
large ping copies its array into the event; freed memory is kept, so the copy meets no fresh pages.
"""

from __future__ import annotations

import hashlib
import os
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench.system import Case, Samples, System

CLIENT = "thesis_client.cpp"
SOURCES = Path(__file__).parent / "cpp"

KEEP_MEMORY = {"MALLOC_MMAP_THRESHOLD_": "33554432", "MALLOC_TRIM_THRESHOLD_": "1073741824"}
"""Environment for glibc to keep freed memory rather than returning pages.

Clearing new pages costs more than copying a large message, a property of the allocator.
"""


class CompiledError(RuntimeError):
    """A program cannot be compiled, failed, or did not end in time."""


def missing_compiler() -> str | None:
    """Return why nothing can be compiled here, or `None`."""
    command = _compiler()
    if shutil.which(command[0]) is None:
        return f"no compiler: expected {command[0]}; `apt-get install g++`, or set CXX"
    return None


def compiler_version() -> str:
    """Return the compiler and its version, as ``g++ (Debian 12.2.0-14) 12.2.0``."""
    command = [*_compiler(), "--version"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.split("\n")[0]


def build(source: str, libraries: Sequence[str] = (), built_for: str = "") -> Path:
    """Return a compiled program, from the cache if present.

    Args:
        source: Name of its one file in `SOURCES`.
        built_for: Version of what it is linked with.

    Raises:
        CompiledError: It does not compile.
    """
    command = [*_compiler(), "-std=c++17", "-O2", "-DNDEBUG", "-Wall", "-Wextra"]
    links = [f"-l{library}" for library in libraries]
    key = hashlib.sha256(repr((command, links, built_for, compiler_version())).encode())
    for file in (SOURCES / source, *sorted(SOURCES.glob("*.hpp"))):
        key.update(file.read_bytes())
    cache = _cache()
    built = cache / f"{Path(source).stem}-{key.hexdigest()[:16]}"
    if built.exists():
        return built
    cache.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=cache) as directory:
        fresh = Path(directory) / "program"
        command += [str(SOURCES / source), "-o", str(fresh), *links]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
        if done.returncode:
            raise CompiledError(f"{shlex.join(command)}: {done.stderr[:2000]}")
        fresh.replace(built)  # At once: another process may be at the same.
    return built


def run(command: Sequence[str | Path], deadline: float, env: dict[str, str] | None = None) -> str:
    """Return a program's output; raise `CompiledError` if it fails, or is ended at the deadline."""
    try:
        done = subprocess.run(
            guarded(command),
            env={**os.environ, **KEEP_MEMORY, **(env or {})},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=deadline,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise CompiledError(f"{command[0]}: expected to end within {deadline:g} s") from None
    if done.returncode:
        raise CompiledError(f"{command[0]} ended with {done.returncode}: {done.stderr[-2000:]}")
    return done.stdout


def guarded(command: Sequence[str | Path]) -> list[str]:
    """Return a command under ``setpriv``, if available: killed with its parent process."""
    words = [str(word) for word in command]
    setpriv = shutil.which("setpriv")
    return [setpriv, "--pdeathsig", "KILL", "--", *words] if setpriv else words


def arguments(case: Case, out: Path) -> list[str]:
    """Return a case as every program's arguments: CASE NODES SAMPLES WARM_UP OUT."""
    return [case.case, str(case.nodes), str(case.samples), str(case.warm_up), str(out)]


def deadline_for(case: Case) -> float:
    """Return a deadline for hangs, seconds: 30, plus 0.02 (small) or 0.2 a round trip."""
    per_round_trip = 0.02 if case.case == "small" else 0.2
    return 30 + per_round_trip * (case.samples + case.warm_up)


def read(out: Path, case: Case) -> Samples:
    """Read the samples written by a program; raise `CompiledError` unless all are there."""
    samples = np.fromfile(out, np.int64)
    if len(samples) != case.samples:
        raise CompiledError(f"{out.name}: expected {case.samples} samples, found {len(samples)}")
    return samples


def _compiler() -> list[str]:
    return shlex.split(os.environ.get("CXX", "")) or ["g++"]


def _cache() -> Path:
    home = os.environ.get("XDG_CACHE_HOME")
    return (Path(home) if home else Path.home() / ".cache") / "visnav-runtime"


def measure_client(case: Case) -> Samples:
    """Measure round trips."""
    with tempfile.TemporaryDirectory() as directory:
        out = Path(directory) / "samples"
        run([build(CLIENT), *arguments(case, out)], deadline_for(case))
        return read(out, case)


def order_heard() -> str:
    """Return the order of hearing an unhandled event, and an event node 2 handles."""
    return run([build(CLIENT), "check"], 30)


_COMPILED: dict[str, Any] = {
    "missing": missing_compiler,
    "version": lambda: f"replica, {compiler_version()}",
}

SYSTEMS = (System("thesis client (C++)", ("handler",), measure_client, 0.05, **_COMPILED),)
