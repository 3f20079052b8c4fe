"""A run and those who look at it, through a real socket."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from runtime.config import Config, RunConfig
from runtime.errors import VisnavError
from runtime.monitor import server
from runtime.monitor.address import find
from runtime.monitor.client import Client, ask
from runtime.monitor.command import Command, Pause, Resume, Set, Speed, Stop
from runtime.monitor.observer import Observer
from runtime.monitor.records import LastRecords
from runtime.monitor.snapshot import Snapshot
from runtime.supervisor import Supervisor
from runtime.testing import spec
from tests.runtime.samples_loop import Camera, Estimator, Looked, Pilot, look

NODES = [spec(Camera, "drone"), spec(Estimator, "vo"), spec(Pilot, "pilot")]


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch, sockets: Path) -> None:
    monkeypatch.setattr(server, "PERIOD", 0.01)


def served(outside: Callable[[], Any], clock: str = "lockstep") -> Looked:
    """Run until a function that is called in another thread is through."""

    async def body(supervisor: Supervisor) -> None:
        try:
            await asyncio.to_thread(outside)
        finally:
            supervisor.stop("seen enough")

    def watch(supervisor: Supervisor) -> Any:
        config = Config(run=RunConfig(name="sample"), nodes=tuple(NODES))
        return server.serving(Observer(supervisor, config, LastRecords()), "sample")

    return look(NODES, body, duration=1e6, clock=clock, watch=watch)


async def attached(*commands: Command) -> tuple[list[Snapshot], list[Any]]:
    """Attach, ask for some things, and return what was seen and answered."""
    client = await Client.connect(find("sample"))
    seen: list[Snapshot] = []
    asking: asyncio.Task[Any] | None = None

    async def ask_all() -> list[Any]:
        return [await client.ask(command) for command in commands]

    async for snapshot in client.snapshots():
        seen.append(snapshot)
        asking = asking or asyncio.create_task(ask_all())
        if len(seen) >= 3 and asking.done():
            client.close()
            break
    assert asking is not None
    return seen, await asking


@pytest.mark.parametrize("clock", ["lockstep", "real"])
def test_snapshots_come_and_commands_are_answered(clock: str) -> None:
    def outside() -> None:
        seen, answers = asyncio.run(attached(Set(text="pilot.gain=3"), Speed(factor=5.0)))
        numbers = [snapshot.number for snapshot in seen]
        assert numbers == list(range(1, len(seen) + 1))
        assert [node.name for node in seen[0].nodes] == ["drone", "vo", "pilot"]
        changed, paced = answers
        assert (changed.done, changed.text) == (True, "gain = 3.0")
        assert paced.done == (clock == "lockstep")

    looked = served(outside, clock)
    assert looked.supervisor.reason == "seen enough"
    assert looked.supervisor.probes._probes == ()


def test_a_command_needs_no_more_than_a_line(sockets: Path) -> None:
    def outside() -> None:
        path = find(None)
        assert path.stat().st_mode & 0o777 == 0o600
        assert ask(path, Set(text="pilot.gain=2")) == "gain = 2.0"
        with pytest.raises(VisnavError, match="height: cannot change"):
            ask(path, Set(text="pilot.height=3"))
        assert ask(path, Pause()) == "paused"
        assert ask(path, Resume()) == "runs"

    served(outside)
    assert list(sockets.iterdir()) == []


def test_nonsense_is_answered_and_does_no_harm() -> None:
    def outside() -> None:
        for nonsense in (b"\xff\x00\n", b'{"type":"ask"}\n', b'{"a":' * 5000 + b"\n", b"no end"):
            with socket.socket(socket.AF_UNIX) as connection:
                connection.connect(str(find(None)))
                connection.sendall(nonsense)
                if nonsense.endswith(b"\n"):
                    assert b"expected a command" in connection.makefile("rb").readline()
        assert ask(find(None), Set(text="pilot.gain=2")) == "gain = 2.0"

    assert served(outside).supervisor.reason == "seen enough"


def test_who_looks_sees_the_end() -> None:
    def outside() -> None:
        async def until_the_end() -> list[Snapshot]:
            client = await Client.connect(find(None))
            seen = []
            async for snapshot in client.snapshots():
                seen.append(snapshot)
                if len(seen) == 1:
                    asking.append(asyncio.create_task(client.ask(Stop())))
            return seen

        asking: list[Any] = []
        ended.append(asyncio.run(until_the_end())[-1].ended)

    # The run ends while its end is waited for, so the thread is not one that the run waits for.
    ended: list[str] = []
    thread = threading.Thread(target=outside)

    async def body(supervisor: Supervisor) -> None:
        thread.start()

    def watch(supervisor: Supervisor) -> Any:
        config = Config(run=RunConfig(name="sample"), nodes=tuple(NODES))
        return server.serving(Observer(supervisor, config, LastRecords()), "sample")

    look(NODES, body, duration=1e6, watch=watch)
    thread.join()
    assert ended == ["stopped by hand"]


def test_a_run_that_is_over_cannot_be_asked(sockets: Path) -> None:
    with pytest.raises(VisnavError, match="expected a run that listens at"):
        ask(sockets / "gone.sock", Stop())


def test_a_monitor_that_fails_leaves_the_run_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: Observer) -> Snapshot:
        raise RuntimeError("no picture")

    monkeypatch.setattr(Observer, "take", fail)

    def outside() -> None:
        with socket.socket(socket.AF_UNIX) as connection:
            connection.connect(str(find(None)))
            connection.sendall(b'{"type":"watch"}\n')
            assert ask(find(None), Set(text="pilot.gain=2")) == "gain = 2.0"

    assert served(outside).supervisor.reason == "seen enough"


def test_who_leaves_while_the_end_is_told_does_no_harm(monkeypatch: pytest.MonkeyPatch) -> None:
    left = []

    async def leave(writer: asyncio.StreamWriter) -> None:
        left.append(writer)
        writer.transport.abort()
        for _ in range(20):
            await asyncio.sleep(0)  # the task that listened to it notices

    def outside() -> None:
        with socket.socket(socket.AF_UNIX) as connection:
            connection.connect(str(find(None)))
            connection.sendall(b'{"type":"watch"}\n')
            assert ask(find(None), Set(text="pilot.gain=2")) == "gain = 2.0"
            monkeypatch.setattr(asyncio.StreamWriter, "drain", leave)
            stays.append(connection.dup())

    stays: list[socket.socket] = []
    assert served(outside).supervisor.reason == "seen enough"
    stays.pop().close()
    assert left
