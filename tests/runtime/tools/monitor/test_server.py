"""A run and those who look at it, through a real socket."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import AsyncMock, Mock

import pytest

from runtime.config.model import Config, RunConfig
from runtime.errors import VisnavError
from runtime.run.supervisor import Supervisor
from runtime.testing import spec
from runtime.tools.monitor import client, server
from runtime.tools.monitor.client import Client, ask, find, runs
from runtime.tools.monitor.observer import LastRecords, Observer
from runtime.tools.monitor.protocol import (
    Answer,
    Command,
    LogLine,
    Pause,
    Resume,
    Set,
    Snapshot,
    Speed,
    Stop,
    encode,
)
from tests.runtime.samples_loop import Camera, Estimator, Looked, Pilot, look
from tests.runtime.tools.monitor.samples import snapshot

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
    connection = await Client.connect(find("sample"))
    seen: list[Snapshot] = []
    asking: asyncio.Task[Any] | None = None

    async def ask_all() -> list[Any]:
        return [await connection.ask(command) for command in commands]

    async for found in connection.snapshots():
        seen.append(found)
        asking = asking or asyncio.create_task(ask_all())
        if len(seen) >= 3 and asking.done():
            connection.close()
            break
    assert asking is not None
    return seen, await asking


@pytest.mark.parametrize("clock", ["lockstep", "real"])
def test_snapshots_come_and_commands_are_answered(clock: str) -> None:
    def outside() -> None:
        seen, answers = asyncio.run(attached(Set(text="pilot.gain=3"), Speed(factor=5.0)))
        numbers = [each.number for each in seen]
        assert numbers == list(range(1, len(seen) + 1))
        assert [node[0] for node in seen[0].tables["nodes"]] == ["drone", "vo", "pilot"]
        changed, paced = answers
        assert (changed.done, changed.text) == (True, "gain = 3.0")
        assert paced.done == (clock == "lockstep")

    looked = served(outside, clock)
    assert looked.supervisor.state.reason == "seen enough"
    assert looked.supervisor.instruments.attached == ()


def test_images_come_to_those_who_watch_and_ask() -> None:
    async def looking() -> None:
        connection = await Client.connect(find("sample"))
        asked: asyncio.Task[Any] | None = None
        async for found in connection.snapshots():
            if asked is None and found.cameras:
                asked = asyncio.create_task(_images(connection, found.cameras))
            elif asked is not None and asked.done():
                connection.close()
                break
        assert asked is not None
        asked.result()

    looked = served(lambda: asyncio.run(looking()), "real")  # a thread's work holds simulated time
    assert looked.supervisor.instruments.attached == ()


async def _images(connection: Client, cameras: list[str]) -> None:
    assert cameras == ["drone.images: drone/front"]
    jpeg = await connection.image(cameras[0])
    assert jpeg[:2] == b"\xff\xd8"
    with pytest.raises(VisnavError, match="expected a camera that has sent images"):
        await connection.image("drone.images: drone/rear")


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

    assert served(outside).supervisor.state.reason == "seen enough"


def test_who_looks_sees_the_end() -> None:
    def outside() -> None:
        async def until_the_end() -> list[Snapshot]:
            connection = await Client.connect(find(None))
            seen = []
            async for found in connection.snapshots():
                seen.append(found)
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

    monkeypatch.setattr(Observer, "take", fail)

    def outside() -> None:
        with socket.socket(socket.AF_UNIX) as connection:
            connection.connect(str(find(None)))
            connection.sendall(b'{"type":"watch"}\n')
            assert ask(find(None), Set(text="pilot.gain=2")) == "gain = 2.0"

    assert served(outside).supervisor.state.reason == "seen enough"


def test_those_who_read_nothing_do_not_hold_up_the_end(
    monkeypatch: pytest.MonkeyPatch, sockets: Path
) -> None:
    monkeypatch.setattr(server, "CLOSING_TIMEOUT", 0.1)
    long = LogLine(number=0, seconds=0.0, level="INFO", logger_name="x", text="x" * 400_000)
    monkeypatch.setattr(LastRecords, "lines", lambda _: [long])
    enough = threading.Event()
    take = Observer.take

    def counted(observer: Observer) -> Snapshot:
        found = take(observer)
        if found.number > 3:
            enough.set()
        return found

    monkeypatch.setattr(Observer, "take", counted)
    watching = [socket.socket(socket.AF_UNIX) for _ in range(8)]

    def outside() -> None:
        for each in watching:
            each.connect(str(find(None)))
            each.sendall(b'{"type":"watch"}\n')
        assert enough.wait(10)

    try:
        assert served(outside).supervisor.state.reason == "seen enough"
        assert list(sockets.iterdir()) == []  # its thread has come to its end
    finally:
        for each in watching:
            each.close()


async def test_who_reads_no_answers_is_asked_for_no_more() -> None:
    class Stuck:
        """A writer whose other side reads nothing."""

        written = 0

        def write(self, _: bytes) -> None:
            self.written += 1

        async def drain(self) -> None:
            await asyncio.Event().wait()

        def close(self) -> None: ...

    reader, stuck = asyncio.StreamReader(), Stuck()
    reader.feed_data(b"nonsense\n" * 100)
    serving: Any = server.Server(None, asyncio.get_running_loop(), Path())  # type: ignore[arg-type]
    task = asyncio.create_task(serving._serve_client(reader, stuck))
    for _ in range(300):
        await asyncio.sleep(0)
    assert stuck.written == 1
    task.cancel()
    await task


async def test_measuring_begins_and_ends_with_those_who_watch(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(server, "PERIOD", 0)
    done: list[str] = []

    class Noting:
        def begin(self) -> None:
            done.append("begin")

        def end(self) -> None:
            done.append("end")

        def take(self) -> Snapshot:
            done.append("take")
            return snapshot()

    loop = asyncio.get_running_loop()
    serving: Any = server.Server(Noting(), loop, Path())  # type: ignore[arg-type]
    one, other = Mock(), Mock()
    for writer in (one, other):
        writer.transport.get_write_buffer_size.return_value = 0
        writer.drain = AsyncMock()
    watch = asyncio.StreamReader()
    watch.feed_data(b'{"type":"watch"}\n')
    watch.feed_eof()
    publishing = asyncio.create_task(serving._publish())
    await serving._serve_client(watch, one)  # and is gone
    await serving._handle_line(b'{"type":"watch"}', other)
    for _ in range(100):
        await asyncio.sleep(0)
    serving._watching.clear()
    for _ in range(100):
        await asyncio.sleep(0)
    publishing.cancel()
    assert [what for what in done if what != "take"] == ["begin", "end"]
    assert other.write.called


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


async def test_a_late_answer_and_the_end_disturb_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client, "ANSWER_TIMEOUT", 0.0)
    reader = asyncio.StreamReader()
    connection = Client(reader, Mock())
    assert (await connection.ask(Stop())).text == "the run does not answer"
    reader.feed_data(encode(Answer(number=0, done=True, text="at last")) + b"\n")
    reader.feed_data(encode(snapshot()) + b"\n")
    reader.feed_eof()
    assert [seen.run async for seen in connection.snapshots()] == ["sample"]
    monkeypatch.setattr(client, "ANSWER_TIMEOUT", 60.0)
    assert (await connection.ask(Stop())).text == "the run is over"
    with pytest.raises(VisnavError, match="the run is over"):
        await connection.image("drone.images: drone/front")


@pytest.mark.parametrize("line", [b"nonsense\n", b'{"type":"snapshot","run":1}\n', b"\xff\n"])
async def test_another_version_at_the_other_end_is_an_error(line: bytes) -> None:
    reader = asyncio.StreamReader()
    reader.feed_data(line)
    with pytest.raises(VisnavError, match="expected a run of this version: "):
        await anext(Client(reader, Mock()).snapshots())


async def test_who_comes_in_the_last_moment_is_let_go() -> None:
    """Also one whose task has not begun when all are cancelled."""
    serving: Any = server.Server(Mock(), asyncio.get_running_loop(), Path())
    early, late = Mock(), Mock()
    serving._accept(asyncio.StreamReader(), early)
    ((task, writer),) = serving._clients.items()
    assert writer is early  # so the end closes it
    task.cancel()
    await asyncio.wait([task])
    assert not serving._clients
    serving._end.set()
    serving._accept(asyncio.StreamReader(), late)
    assert late.transport.abort.called
    assert not serving._clients
