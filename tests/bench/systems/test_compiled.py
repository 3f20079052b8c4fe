"""The C++ client and ROS 1: each measures what it is asked to, and ends."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from bench.system import Case, CaseName, System
from bench.systems import compiled, ros1
from bench.systems.children import PeerError
from bench.systems.ros1 import graph

SYSTEMS = (*compiled.SYSTEMS, *ros1.SYSTEMS)


def or_skip(system: System) -> System:
    if reason := system.missing():
        pytest.skip(f"{system.name}: {reason}")
    return system


@pytest.fixture
def client() -> System:
    return or_skip(compiled.SYSTEMS[0])


@pytest.fixture
def roscpp() -> System:
    return or_skip(ros1.SYSTEMS[0])


def measures(system: System, case: CaseName, nodes: int) -> None:
    or_skip(system)
    samples = system.measure(Case(case=case, nodes=nodes, samples=30, warm_up=5))
    assert samples.shape == (30,)
    assert samples.dtype == "int64"
    assert (samples > 0).all()


@pytest.mark.parametrize("case", ["small", "large", "large-shared"])
@pytest.mark.parametrize("nodes", [2, 4])
def test_client_measures(nodes: int, case: CaseName) -> None:
    measures(compiled.SYSTEMS[0], case, nodes)


@pytest.mark.slow  # Compiling roscpp's programs, once, takes several seconds.
@pytest.mark.parametrize("case", ["small", "large", "large-shared"])
@pytest.mark.parametrize("nodes", [2, 4])
@pytest.mark.parametrize("system", ros1.SYSTEMS, ids=lambda system: str(system.name))
def test_ros_measures(system: System, nodes: int, case: CaseName) -> None:
    measures(system, case, nodes)


def test_client_hands_events_to_nodes_in_order_until_one_handles_them(client: System) -> None:
    assert compiled.order_heard().splitlines() == [
        "heard by 1 2 3 unhandled",
        "heard by 1 2 handled",
    ]


@pytest.mark.slow
def test_program_is_compiled_once(
    client: System, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    built = compiled.build(compiled.CLIENT)
    made = built.stat().st_mtime_ns
    assert built.is_relative_to(tmp_path)
    assert compiled.build(compiled.CLIENT) == built
    assert built.stat().st_mtime_ns == made


def test_missing_compiler_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    assert "no-such-compiler" in str(compiled.missing_compiler())


def test_program_that_fails_says_why(client: System) -> None:
    with pytest.raises(compiled.CompiledError, match="expected CASE NODES"):
        compiled.run([compiled.build(compiled.CLIENT), "nonsense"], 10)


def test_program_that_hangs_is_ended() -> None:
    with pytest.raises(compiled.CompiledError, match=r"within 0\.2 s"):
        compiled.run(["sleep", "30"], 0.2)


@pytest.mark.slow
def test_graph_ends_its_nodes_when_one_fails(roscpp: System) -> None:
    with graph() as ros:
        steady = ros.start(["sleep", "60"])
        failing = ros.start(["false"])
        with pytest.raises(PeerError, match="ended with 1"):
            ros.finish(steady, [failing], 20)
    assert steady.returncode == -signal.SIGKILL


@pytest.mark.slow
def test_nothing_outlives_the_measuring_process(roscpp: System) -> None:
    code = (
        "from bench.systems.ros1 import graph\n"
        "with graph() as ros:\n"
        "    print(ros.start(['sleep', '60']).pid, flush=True)\n"
        "    input()\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as measuring:
        assert measuring.stdout is not None
        node = int(measuring.stdout.readline())
        # Between its start and its first instructions nothing ends a node with its parent yet.
        wait_until(lambda: "(sleep)" in status(node))
        measuring.kill()
    wait_until(lambda: status(node) == "" or ") Z " in status(node))


def status(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8")
    except (ProcessLookupError, FileNotFoundError):
        return ""


def wait_until(condition: Callable[[], bool]) -> None:
    until = time.monotonic() + 10
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.01)  # What other processes do has no event to wait for.
