"""Time that clients pause and step, and runs that are equal if their scripts are."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import random
import socket
import threading
import time
from collections.abc import Awaitable, Callable
from typing import Any

import pytest

from extensions.airsim.tests.scripts import Caller, drone, with_script
from runtime.channels.wire import Digest
from runtime.config.model import Config, RunConfig
from runtime.node import Node
from runtime.testing import run_nodes, spec
from runtime.time.clock import SECOND, Once
from runtime.tools.preflight import of_nodes
from tests.runtime.samples_runs import supervise
from visnav_airsim import wire
from visnav_airsim.client.connection import RpcCallError, RpcClient
from visnav_airsim.server import AirsimServer
from visnav_airsim.server.methods import Table, rpc
from visnav_airsim.server.node import PORTS, Time


class Tasks:
    """A vehicle's tasks, which end after so many simulated seconds, or are superseded."""

    def __init__(self, time: Time) -> None:
        self._time, self._clock = time, time._clock
        self._tasks: dict[str, asyncio.Future[float]] = {}

    @rpc("task")
    def task(self, seconds: float, vehicle: str) -> Awaitable[float]:
        """Return the time at which it ended."""
        clock, task = self._clock, asyncio.get_running_loop().create_future()
        self._end(vehicle)
        self._tasks[vehicle] = task

        def end() -> None:
            if not task.done():
                task.set_result(clock.now() / SECOND)

        clock.schedule.add(clock.now() + round(seconds * SECOND), Once(end))
        return self._time.reply_for(task)

    @rpc("now")
    def now(self) -> float:
        """Return the time."""
        return self._clock.now() / SECOND

    def _end(self, vehicle: str) -> None:
        before = self._tasks.get(vehicle)
        if before is not None and not before.done():
            before.set_result(-1.0)


@pytest.fixture(autouse=True)
def _with_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    def with_tasks(groups: Any, *more: Any) -> Table:
        (time,) = (group for group in groups if isinstance(group, Time))
        return Table([*groups, Tasks(time)], *more)

    monkeypatch.setattr("visnav_airsim.server.node.Table", with_tasks)


def test_awaited_time_runs_while_a_task_is_owed_and_stands_when_it_ends(tiny_world: str) -> None:
    def script(airsim: Caller) -> None:
        for index in range(1, 4):
            assert airsim("task", 0.1, "a") == pytest.approx(0.1 * index)
            time.sleep(random.uniform(0, 0.02))  # real time, which must not matter
            assert airsim("now") == pytest.approx(0.1 * index)
            assert airsim("simIsPaused") is False
        airsim("simContinueForTime", 0.2)
        assert airsim("now") == pytest.approx(0.5)
        superseded = airsim.send("task", 1e6, "a")
        other = airsim.send("task", 0.1, "b")  # begins when it is read: time runs
        ended = airsim("task", 0.3, "a")
        assert ended > 0.8
        assert airsim.join(superseded) == -1.0
        last = max(ended, airsim.join(other))
        assert airsim("now") == last

    with_script(script, [drone(world=tiny_world)], time="awaited")


def test_a_pause_holds_awaited_time_until_it_is_lifted(tiny_world: str) -> None:
    def script(airsim: Caller) -> None:
        airsim("simPause", True)
        task = airsim.send("task", 0.5, "a")
        assert airsim("simIsPaused") is True
        assert airsim("now") == 0.0
        airsim("simContinueForTime", 0.2)
        assert airsim("now") == 0.2
        airsim("simContinueForTime", 0.0)
        airsim("simPause", False)
        assert airsim.join(task) == 0.5
        assert airsim("now") == 0.5

    with_script(script, [drone(world=tiny_world)], time="awaited")


@pytest.mark.slow
@pytest.mark.parametrize(("rates", "rate"), [((), 60), ((10, 25), 25)])
def test_a_frame_is_an_image_of_the_fastest_camera(
    rates: tuple[int, ...], rate: int, tiny_world: str
) -> None:
    def script(airsim: Caller) -> None:
        airsim("simContinueForTime", 0.001)
        for frames, total in ((1, 1), (0, 1), (5, 6)):
            airsim("simContinueForFrames", frames)
            assert airsim("now") == max(total * SECOND // rate, 1_000_000) / SECOND
            assert airsim("simIsPaused") is True

    cameras = [
        {"name": f"c{hz}", "rate": hz, "width": 8, "height": 8, "images": ["rgb"]} for hz in rates
    ]
    with_script(script, [drone(world=tiny_world, cameras=cameras)])


def test_steps_that_make_no_sense_are_refused(tiny_world: str) -> None:
    def script(airsim: Caller) -> None:
        for seconds in (math.nan, math.inf, -1.0, 1e300, "1", None):
            airsim.refuses("simContinueForTime", "simContinueForTime", seconds)
            assert airsim("now") == 0.0

    with_script(script, [drone(world=tiny_world)])


@pytest.mark.slow
def test_running_time_is_paused_stepped_and_resumed(tiny_world: str) -> None:
    def script(airsim: Caller) -> None:
        airsim("simPause", True)
        begin = airsim("now")
        assert airsim("simIsPaused") is True
        airsim("simContinueForTime", 0.1)
        assert airsim("now") == pytest.approx(begin + 0.1)
        airsim("simPause", False)
        assert airsim("simIsPaused") is False

    with_script(script, [drone(world=tiny_world)], time="running", duration=1e6)


def test_a_run_in_real_time_has_no_time_that_stands(tiny_world: str) -> None:
    nodes = [drone(world=tiny_world), spec(AirsimServer, "airsim", {"port": 0, "time": "paused"})]
    error = supervise(nodes, clock="real").error
    assert 'time: expected "running", found "paused": the run is in real time' in str(error)


def test_a_check_sees_an_address_of_another_machine_and_opens_no_port(tiny_world: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        here = {"host": "127.0.0.1", "port": taken.getsockname()[1]}
        for settings, errors in (({"host": "192.0.2.1"}, 1), (here, 0)):
            nodes = [drone(world=tiny_world), spec(AirsimServer, "airsim", settings)]
            found = of_nodes(Config(run=RunConfig(), nodes=tuple(nodes))).errors
            assert len(found) == errors
            assert all("airsim: host: expected an address of this machine" in e for e in found)


@pytest.mark.slow
def test_a_client_cannot_pause_a_run_in_real_time(tiny_world: str) -> None:
    refused: list[str] = []

    class Client(Node):
        """Asks for a pause."""

        async def run(self) -> None:
            port = self.share(PORTS, dict[str, int])["airsim"]
            loop = asyncio.get_running_loop()
            _, client = await loop.create_connection(RpcClient, "127.0.0.1", port)
            for call in (("simPause", True), ("simContinueForTime", 1.0)):
                with pytest.raises(RpcCallError) as error:
                    await client.send(*call)
                refused.append(str(error.value))
            await client.send("simPause", False)
            assert await client.send("simIsPaused") is False
            client.close()
            self.stop("asked")

    nodes = [
        drone(world=tiny_world),
        spec(AirsimServer, "airsim", {"port": 0}),
        spec(Client, "client"),
    ]
    assert supervise(nodes, clock="real", duration=20.0).error is None
    assert all("the run is in real time, which cannot be stopped" in text for text in refused)
    assert len(refused) == 2


@pytest.mark.slow
def test_clients_that_flood_the_server_do_not_stop_time(tiny_world: str) -> None:
    count = 1000

    def script(airsim: Caller) -> None:
        address = airsim._socket.getpeername()
        flood = b"".join(wire.request(n, "ping", ()) for n in range(count))
        answer = b"".join(wire.reply(n, None, True) for n in range(count))
        begin = airsim("now")
        with contextlib.ExitStack() as stack:
            clients = [stack.enter_context(socket.create_connection(address)) for _ in range(4)]
            for client in clients:
                threading.Thread(target=client.sendall, args=(flood,)).start()
            for client in clients:
                received = b""
                while len(received) < len(answer):
                    received += client.recv(1 << 16)
                assert received == answer
        assert airsim("now") > begin + 0.1

    with_script(script, [drone(world=tiny_world)], time="running", duration=1e6)


@pytest.mark.slow
def test_a_run_that_a_client_left_standing_ends(caplog: pytest.LogCaptureFixture) -> None:
    """It would stand for ever, since `duration` is simulated. The limit is real: 0.1 s here."""

    class Leaver(Node):
        """Connects, pauses and leaves."""

        async def run(self) -> None:
            port = self.share(PORTS, dict[str, int])["airsim"]

            def work() -> None:
                with contextlib.closing(Caller(port)) as call:
                    call("simPause", True)

            threading.Thread(target=work, daemon=True).start()

    server = spec(AirsimServer, "airsim", {"port": 0, "abandoned": 0.1})
    with caplog.at_level(logging.WARNING):
        result = run_nodes([drone(), server, spec(Leaver, "client")], duration=3600.0)
    assert "no client is left to let it run" in caplog.text
    assert "no client came for 0.1 s while time stood" in result.reason


YAW = {"is_rate": True, "yaw_or_rate": 0.0}


def fly(airsim: Caller) -> list[Any]:
    """Fly a little; the only waiting is for replies."""
    airsim("enableApiControl", True, "")
    airsim("armDisarm", True, "")
    replies = [airsim("takeoff", 20.0, "")]
    replies.append(airsim("moveToPosition", 1, 0, -2, 2, 3e38, 0, YAW, -1, 1, ""))
    replies.append(airsim("getMultirotorState", ""))
    replies.append(airsim("moveByVelocity", 0.0, 1.0, -0.5, 0.7, 0, YAW, ""))
    airsim("simContinueForTime", 0.31)
    replies.append(airsim("simGetVehiclePose", ""))
    replies.append(airsim("land", 30.0, ""))
    return [*replies, airsim("getMultirotorState", "")]


def step(airsim: Caller) -> list[Any]:
    """Fly a little, step by step; moves are not waited for."""
    airsim("enableApiControl", True, "")
    airsim("armDisarm", True, "")
    airsim.send("takeoff", 20.0, "")
    replies: list[Any] = []
    for index in range(12):
        airsim("simContinueForTime", 0.25)
        if index == 6:
            airsim.send("moveByVelocity", 1.0, 0.0, 0.0, 1.0, 0, YAW, "")
        airsim("simContinueForFrames", 3)
        replies.append(airsim("getMultirotorState", ""))
    return replies


@pytest.mark.slow
@pytest.mark.parametrize(("flight", "setting"), [(fly, "awaited"), (step, "paused")])
def test_equal_scripts_give_equal_runs_and_replies(
    flight: Callable[[Caller], list[Any]],
    setting: str,
    tiny_world: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    send = Caller.send
    lags = random.Random()  # real delays, which differ in each run

    def slow(self: Caller, method: str, *arguments: Any) -> int:
        time.sleep(lags.choice([0.0, 0.0, 0.001, 0.02]))  # a script that computes meanwhile
        return send(self, method, *arguments)

    monkeypatch.setattr(Caller, "send", slow)
    seen = []
    for _ in range(3):
        replies: list[Any] = []
        result = with_script(
            lambda airsim, replies=replies: replies.extend(flight(airsim)),  # type: ignore[misc]
            [drone(world=tiny_world)],
            time=setting,
        )
        digest = Digest()
        for event in result.sent:
            digest(None, event)
        seen.append((digest.hexdigest(), result.seconds, replies))
    assert len(seen[0][2]) > 5
    assert seen[0][2][-1]["timestamp"] > 3_000_000_000
    assert seen[0] == seen[1] == seen[2]
