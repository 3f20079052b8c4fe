"""Whole flights: a run of an example in a process of its own, and a program beside it."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from tests.runtime.tools.samples_cli import ROOT, start, summary

HERE = "extensions.mavlink.tests"


def free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        port: int = sock.getsockname()[1]
        return port


@contextlib.contextmanager
def running(out: Path, port: int, *settings: str, example: str = "mavsdk") -> Iterator[Any]:
    """Run an example that speaks to a port; end it at last, whatever has happened."""
    node = "vision" if example == "external_vision" else "mavlink"
    endpoints = f'{node}.endpoints=["udp://127.0.0.1:{port}"]'
    words = ["run", f"extensions/mavlink/examples/{example}.toml", "--quiet", "--out", str(out)]
    for setting in (endpoints, *settings):
        words += ["--set", setting]
    with start(words, ROOT) as process:
        try:
            yield process
        finally:
            if example == "mavsdk":  # the other one ends with its pilot
                process.terminate()
            try:
                process.wait(60)
            finally:
                process.kill()


def done(script: tuple[str, ...], limit: float) -> str:
    """Run a Python script to its end, and what it has started; return what it prints."""
    with subprocess.Popen(
        [sys.executable, *script],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        try:
            out, err = process.communicate(timeout=limit)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            out, err = process.communicate()
            err += f"\nstill running after {limit:g} s; it had printed: {out}"
        finally:
            with contextlib.suppress(ProcessLookupError):  # what it has started and left
                os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == 0, err
    return out


def flown(
    out: Path,
    port: int,
    *script: str,
    example: str = "mavsdk",
    settings: tuple[str, ...] = (),
    limit: float = 150,
) -> tuple[str, dict[str, Any]]:
    """Run a script beside an example; return what it prints, and the run's summary."""
    with running(out, port, *settings, example=example):
        printed = done(script, limit)
    return printed, summary(out)


def calling(module: str, function: str, argument: str, *, plain: bool = False) -> tuple[str, ...]:
    """Return a Python's arguments for a call of these tests' function, a coroutine if not plain."""
    call = f"{function}(sys.argv[1])"
    call = call if plain else f"asyncio.run({call})"
    code = f"import asyncio, sys; from {HERE}.{module} import {function}; {call}"
    return "-c", code, argument


async def first(stream: Any, ok: Callable[[Any], Any] = lambda _: True) -> Any:
    """Return a stream's first sample that is as wanted."""
    async for sample in stream:
        if ok(sample):
            return sample
    raise AssertionError("expected more telemetry, found its end")
