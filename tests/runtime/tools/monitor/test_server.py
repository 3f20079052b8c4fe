"""A run and those who look at it, through a real socket."""

from __future__ import annotations

import asyncio
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from runtime.config.model import Config, RunConfig
from runtime.errors import VisnavError
from runtime.run.supervisor import Supervisor
from runtime.testing import spec
from runtime.tools.monitor import protocol, server
from runtime.tools.monitor.observer import LastRecords, Observer
from runtime.tools.monitor.protocol import (
    Client,
    Command,
    LogLine,
    Look,
    Pause,
    Resume,
    Set,
    Snapshot,
    Speed,
    Stop,
    ask,
    find,
    runs,
    socket_of,
)
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
    connection = Client(find("sample"))
    seen: list[Snapshot] = []
    asking: asyncio.Task[Any] | None = None

    async def ask_all() -> list[Any]:
        return [await connection.ask(command) for command in commands]

    async for snapshot in connection.snapshots():
        seen.append(snapshot)
        asking = asking or asyncio.create_task(ask_all())
        if len(seen) >= 3 and asking.done():
            break
    assert asking is not None
    return seen, await asking


@pytest.mark.parametrize("clock", ["lockstep", "real"])
def test_snapshots_come_and_commands_are_answered(clock: str) -> None:
    def outside() -> None:
        seen, answers = asyncio.run(attached(Set(text="pilot.gain=3"), Speed(factor=5.0)))
        times = [snapshot.now for snapshot in seen]
        assert times == sorted(times)
        assert [node[0] for node in seen[0].tables["nodes"]] == ["drone", "vo", "pilot"]
        changed, paced = answers
        assert (changed.done, changed.text) == (True, "gain = 3.0")
        assert paced.done == (clock == "lockstep")

    looked = served(outside, clock)
    assert looked.supervisor.state.reason == "seen enough"
    assert looked.supervisor.instruments.attached == ()


def test_images_come_to_those_who_watch_and_ask() -> None:
    async def looking() -> None:
        connection = Client(find("sample"))
        asked: asyncio.Task[Any] | None = None
        async for snapshot in connection.snapshots():
            if asked is None and snapshot.cameras:
                asked = asyncio.create_task(_images(snapshot.cameras))
            elif asked is not None and asked.done():
                break
        assert asked is not None
        asked.result()

    looked = served(lambda: asyncio.run(looking()), "real")  # a thread's work holds simulated time
    assert looked.supervisor.instruments.attached == ()


async def _images(cameras: list[str]) -> None:
    assert cameras == ["drone.images: drone/front"]
    answer = await Client(find(None)).ask(Look(camera=cameras[0]))
    assert answer.jpeg[:2] == b"\xff\xd8"
    refused = await Client(find(None)).ask(Look(camera="drone.images: drone/rear"))
    assert not refused.done
    assert refused.text.startswith("expected a camera that has sent images")


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
        long = b"x" * 2 * protocol.LONGEST_COMMAND + b"\n"
        deep = b'{"a":' * 5000 + b"\n"
        for nonsense in (b"\xff\x00\n", b'{"do":"ask"}\n', deep, long, b"no end"):
            with socket.socket(socket.AF_UNIX) as connection:
                connection.connect(str(find(None)))
                connection.sendall(nonsense)
                if nonsense.endswith(b"\n"):
                    assert b"expected a command" in connection.makefile("rb").readline()
        assert ask(find(None), Set(text="pilot.gain=2")) == "gain = 2.0"

    assert served(outside).supervisor.state.reason == "seen enough"


def test_who_looks_sees_the_end() -> None:
    def outside() -> None:
        async def until_the_end() -> list[Snapshot]:
            connection = Client(find(None))
            seen = []
            async for snapshot in connection.snapshots():
                seen.append(snapshot)
                if len(seen) == 1:
                    asking.append(asyncio.create_task(connection.ask(Stop())))
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
        raise RuntimeError("no image")

    monkeypatch.setattr(Observer, "snapshot", fail)

    def outside() -> None:
        with socket.socket(socket.AF_UNIX) as connection:
            connection.connect(str(find(None)))
            connection.sendall(b'{"do":"watch"}\n')
            assert ask(find(None), Set(text="pilot.gain=2")) == "gain = 2.0"

    assert served(outside).supervisor.state.reason == "seen enough"


def test_those_who_read_nothing_do_not_hold_up_the_end(
    monkeypatch: pytest.MonkeyPatch, sockets: Path
) -> None:
    monkeypatch.setattr(server, "CLOSING_TIMEOUT", 0.1)
    long = LogLine(number=0, level="INFO", text="x" * 400_000)
    monkeypatch.setattr(LastRecords, "lines", lambda _: [long])
    enough = threading.Event()
    snapshot = Observer.snapshot
    snapshots: list[Snapshot] = []

    def counted(observer: Observer) -> Snapshot:
        snapshots.append(snapshot(observer))
        enough.set()
        return snapshots[-1]

    monkeypatch.setattr(Observer, "snapshot", counted)
    watching = [socket.socket(socket.AF_UNIX) for _ in range(8)]

    def outside() -> None:
        for client in watching:
            client.connect(str(find(None)))
            client.sendall(b'{"do":"watch"}\n')
        assert enough.wait(10)

    try:
        assert served(outside).supervisor.state.reason == "seen enough"
        assert list(sockets.iterdir()) == []  # its thread has come to its end
    finally:
        for sock in watching:
            sock.close()


def test_who_reads_no_answers_is_asked_for_no_more() -> None:
    def outside() -> None:
        with socket.socket(socket.AF_UNIX) as connection:
            connection.connect(str(find(None)))
            connection.settimeout(0.3)
            with pytest.raises(TimeoutError):
                connection.sendall(b"nonsense\n" * 1_000_000)

    assert served(outside).supervisor.state.reason == "seen enough"


def test_measuring_begins_and_ends_with_those_who_watch(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []
    begin, end = Observer.begin, Observer.end

    def noted(name: str, do: Callable[[Observer], None]) -> Callable[[Observer], None]:
        def noting(observer: Observer) -> None:
            done.append(name)
            do(observer)

        return noting

    monkeypatch.setattr(Observer, "begin", noted("begin", begin))
    monkeypatch.setattr(Observer, "end", noted("end", end))

    def outside() -> None:
        watching = [socket.socket(socket.AF_UNIX) for _ in range(2)]
        for client in watching:
            client.connect(str(find(None)))
            client.sendall(b'{"do":"watch"}\n')
            assert client.makefile("rb").readline()
        one, other = watching
        one.close()
        other.makefile("rb").readline()
        assert done == ["begin"]
        other.close()
        for _ in range(1000):
            if done == ["begin", "end"]:
                break
            time.sleep(0.01)  # for threads, which have no clock of ours
        assert done == ["begin", "end"]

    looked = served(outside)
    assert looked.supervisor.instruments.attached == ()


def test_who_looks_for_runs_does_no_harm_to_one_that_begins(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    listen = socket.socket.listen

    def looked_for(new: socket.socket, backlog: int) -> None:
        runs()
        listen(new, backlog)

    monkeypatch.setattr(socket.socket, "listen", looked_for)
    served(lambda: find("sample"))


def test_an_error_of_the_monitors_own_is_an_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: Observer, __: Command) -> str:
        raise RuntimeError("no hands")

    monkeypatch.setattr(Observer, "execute", fail)

    def outside() -> None:
        with pytest.raises(VisnavError, match="could not do it, and its log says why"):
            ask(find(None), Stop())

    assert served(outside).supervisor.state.reason == "seen enough"


async def test_who_does_not_answer_is_not_waited_for_for_ever(
    monkeypatch: pytest.MonkeyPatch, sockets: Path
) -> None:
    monkeypatch.setattr(protocol, "ANSWER_TIMEOUT", 0.01)
    with socket.socket(socket.AF_UNIX) as silent:
        path = socket_of("silent")
        silent.bind(str(path))
        silent.listen()
        assert (await Client(path).ask(Stop())).text == "the run does not answer"
    assert (await Client(path).ask(Stop())).text.startswith("expected a run that listens at")


@pytest.mark.parametrize("line", [b"nonsense\n", b'{"headline":1}\n', b"\xff\n"])
async def test_another_version_at_the_other_end_is_an_error(line: bytes, sockets: Path) -> None:
    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readline()
        writer.write(line)
        writer.close()

    path = socket_of("other")
    async with await asyncio.start_unix_server(answer, path):
        with pytest.raises(VisnavError, match="expected a run of this version: "):
            await anext(Client(path).snapshots())


async def test_who_has_said_nothing_does_not_hold_up_the_end(sockets: Path) -> None:
    path = socket_of("tour")
    serving = server.Server(Mock(), asyncio.get_running_loop(), path)
    with socket.socket(socket.AF_UNIX) as other:
        other.connect(str(path))
        begin = time.monotonic()
        serving.stop()
        assert time.monotonic() - begin < server.CLOSING_TIMEOUT
        other.settimeout(5.0)
        assert other.recv(1) == b""
    with pytest.raises(OSError), socket.socket(socket.AF_UNIX) as late:  # noqa: PT011
        late.connect(str(path))
