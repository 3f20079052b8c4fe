"""Looking at steps of nodes that run, and leaving no trace of it."""

from __future__ import annotations

import asyncio
from concurrent.futures import Future
from typing import Any

import pytest

from events import Event
from runtime.errors import ChannelClosedError
from runtime.instruments import Call
from runtime.node import Node, senders
from runtime.sender import Sender, Tap
from runtime.supervisor import Supervisor
from runtime.tasks import Steps
from runtime.testing import spec
from tests.runtime.samples_loop import Camera, Estimator, Pilot, look, until_sent
from tests.runtime.samples_workers import Plant

NODES = [spec(Camera, "drone"), spec(Estimator, "vo"), spec(Pilot, "pilot")]


class Gardener(Node):
    """Has a worker, and asks it something."""

    async def run(self) -> None:
        plant = await self.worker(Plant)
        await plant.call(Plant.pid)


class Eye:
    """A probe that notes what it sees."""

    def __init__(self) -> None:
        self.steps: list[str] = []
        self.events: list[str] = []
        self.calls: list[str] = []
        self.tap: Tap | None = self._tap

    def around(self, node: str, what: str, call: Call) -> Call:
        def seeing(argument: Any) -> Any:
            self.steps.append(f"{node}.{what}")
            return call(argument)

        return seeing

    def asked(self, process: str, method: str, answer: Future[Any]) -> None:
        self.calls.append(f"{process}: {method}")

    def _tap(self, sender: Sender[Any] | None, event: Event) -> None:
        self.events.append(type(event).__name__)


def insides(supervisor: Supervisor) -> list[Any]:
    """Return all that a probe could leave behind."""
    lives = supervisor._lives.values()
    return [
        [
            (s.name, s.send.__name__, [c.deliver for c in s._candidates], s._taps)
            for life in lives
            if life.node
            for s in senders(life.node).values()
        ],
        [ticker._call for life in lives for ticker in life.tickers],
        all(  # of tasks there are now more, now fewer
            steps._step == steps._coro.send
            for life in lives
            for task in life.tasks
            if isinstance(steps := task.get_coro(), Steps)
        ),
    ]


@pytest.mark.parametrize("clock", ["lockstep", "real"])
def test_a_probe_sees_ticks_handlers_steps_and_events_while_it_is_there(clock: str) -> None:
    eye = Eye()

    async def body(supervisor: Supervisor) -> None:
        await supervisor.clock.sleep(0.05)
        before = insides(supervisor)
        supervisor.probes.attach(eye)
        assert insides(supervisor) != before
        await until_sent(supervisor, "pilot", 3)
        supervisor.probes.detach(eye)
        assert insides(supervisor) == before
        seen.append(len(eye.steps))
        await until_sent(supervisor, "pilot", 1)
        supervisor.stop("seen enough")

    seen: list[int] = []
    look(NODES, body, duration=60, clock=clock)
    assert len(eye.steps) == seen[0]
    assert set(eye.events) == {"Image", "PoseEstimate", "VelocitySetpoint"}
    assert set(eye.steps) == {"drone.expose", "drone.deliver", "vo.run", "pilot.fly"}
    assert eye.steps.count("pilot.fly") == eye.events.count("VelocitySetpoint") == 3
    if clock == "lockstep":
        assert eye.events == ["Image", "PoseEstimate", "VelocitySetpoint"] * 3


def test_a_probe_is_put_around_a_node_that_restarts() -> None:
    eye = Eye()

    async def body(supervisor: Supervisor) -> None:
        supervisor.probes.attach(eye)
        supervisor.restart("pilot", anyway=True)  # half a second later it is up again

    look(NODES, body, duration=0.75)  # set-points at 530, 630 and 730 ms
    assert eye.steps.count("pilot.fly") == 3


def test_a_link_does_not_hide_the_handler_behind_it() -> None:
    eye = Eye()

    async def body(supervisor: Supervisor) -> None:
        supervisor.probes.attach(eye)

    pilot = spec(Pilot, "pilot", links={"fly": {"delay": 0.01}})
    look([*NODES[:2], pilot], body, duration=0.15)  # set-points at 40 and 140 ms
    assert eye.steps.count("pilot.fly") == 2


def test_a_probe_hears_of_a_workers_calls() -> None:
    eye = Eye()

    async def body(supervisor: Supervisor) -> None:
        supervisor.probes.attach(eye)
        await asyncio.sleep(0)

    look([spec(Gardener, "gardener")], body, duration=0.1)
    assert eye.calls == ["gardener.Plant: pid"]


def test_a_probe_does_not_let_nodes_send_before_the_first_update() -> None:
    refused = []

    class Late(Node):
        async def on_startup(self) -> None:
            supervisor: Any = self._host
            supervisor.probes.attach(Eye())
            early = senders(supervisor._lives["drone"].node)["images"]
            with pytest.raises(ChannelClosedError):
                early.send(None)
            refused.append(early.name)

    look([*NODES, spec(Late, "late")], duration=0.1)
    assert refused == ["drone.images"]
