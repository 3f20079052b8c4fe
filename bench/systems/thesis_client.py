"""The thesis's client in C++17, written anew from its description: ``cpp/thesis_client.hpp``.

Delivery is synchronous and nested: the sample covers the ping through all nodes in order, the pong
back through all nodes until node 1 handles it, and one reading of the clock, which is most of it
at N = 2. Compiled with -O2. A large ping copies its array into the event; freed memory is kept
(`compiled.KEEP_MEMORY`), so the copy meets no fresh pages.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from bench.system import Case, Samples, System
from bench.systems.compiled import (
    Program,
    arguments,
    build,
    compiler_version,
    deadline_for,
    missing_compiler,
    read,
    run,
)

PROGRAM = Program(source="thesis_client.cpp")


def measure(case: Case) -> Samples:
    """Measure round trips.

    Raises:
        CompiledError: The client cannot be compiled, or failed.
    """
    with tempfile.TemporaryDirectory() as directory:
        out = Path(directory) / "samples"
        run([build(PROGRAM), *arguments(case, out)], deadline_for(case))
        return read(out, case)


def check() -> str:
    """Return in which order nodes hear an event that nobody handles, and one that node 2 does."""
    return run([build(PROGRAM), "check"], 30)


SYSTEMS = (
    System(
        name="thesis client (C++)",
        modes=("handler",),
        slowness=0.05,
        missing=missing_compiler,
        version=lambda: f"replica, {compiler_version()}",
        measure=measure,
    ),
)
